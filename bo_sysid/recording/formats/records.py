"""JSON: a list of records, or an object that holds one beside numbers that stay."""

import json
from pathlib import Path
from typing import Any

import numpy as np

from bo_sysid.errors import RecordingError
from bo_sysid.recording.formats.registry import reader
from bo_sysid.recording.numbers import dated
from bo_sysid.recording.table import RawTable


@reader(".json")
def read_json(path: Path) -> RawTable:
    """Read records (objects of one shape in a list) or columns (lists of one length).

    Vectors, and objects in records, become one column for each element.

    Numbers beside the records become columns that never change.

    Raises:
        RecordingError: it is no JSON, holds neither, or a record is none.
    """
    try:
        data = json.loads(path.read_text(encoding="utf-8-sig"))
    except (ValueError, UnicodeDecodeError) as error:
        raise RecordingError(f"{path}: not JSON as its ending says: {error}") from None
    except RecursionError:
        raise RecordingError(f"{path}: nested too deeply for a recording") from None
    whole: dict[str, Any] = data if isinstance(data, dict) else {"": data}
    lists = {k: v for k, v in whole.items() if isinstance(v, list) and v}
    records = [k for k, v in lists.items() if isinstance(_first(v), dict)]
    if records:
        longest = max(records, key=lambda k: len(lists[k]))
        rows = _objects(lists[longest], f"{path}: {longest}" if longest else str(path))
        names = list(dict.fromkeys(k for row in rows for k in row))
        fields = [_columns(n, [row.get(n) for row in rows]) for n in names]
    else:
        fields = [_columns(k, v) for k, v in lists.items()]
    columns = {name: cells for made in fields for name, cells in made.items()}
    if not columns:
        raise RecordingError(f"{path}: holds neither a list of records nor lists of numbers")
    length = max(map(len, columns.values()))
    for name, value in whole.items():
        if isinstance(value, int | float) and name not in columns:
            columns[name] = np.full(length, _number(value))
    return RawTable(str(path), columns)


def _first(cells: list[Any]) -> Any:
    return next((c for c in cells if c is not None), None)


def _objects(records: list[Any], where: str) -> list[dict[str, Any]]:
    """Return records, all of which are objects."""
    for row, record in enumerate(records):
        if not isinstance(record, dict):
            raise RecordingError(
                f"{where}, row {row}: {json.dumps(record)[:40]} is no record; in a list of "
                'records every entry is an object, as in {"time": 0.0, "qpos.elbow": 0.1}'
            )
    return records


def _columns(name: str, cells: list[Any]) -> dict[str, np.ndarray]:
    """Return a field as columns: of vectors and objects one for each element, q.0 or q.elbow."""
    first = _first(cells)
    if not isinstance(first, list | dict):
        return {name: _column(cells)}
    rows = [dict(enumerate(c)) if isinstance(c, list) else c for c in cells]
    if not all(isinstance(row, dict | None) for row in rows):
        return {name: _column(list(map(str, cells)))}
    keys = list(dict.fromkeys(k for row in rows if row for k in row))
    parts = [_columns(f"{name}.{k}", [(row or {}).get(k) for row in rows]) for k in keys]
    return {n: column for made in parts for n, column in made.items()}


def _column(cells: list[Any]) -> np.ndarray:
    """Return numbers or dates where all cells are (or missing), else the cells as they are."""
    if all(c is None or isinstance(c, bool | int | float) for c in cells):
        return np.array([np.nan if c is None else _number(c) for c in cells])
    return dated(np.array(cells, dtype=object))


def _number(cell: bool | int | float) -> float:
    """Return a number; an integer that no float holds is infinite, which nothing recorded is."""
    try:
        return float(cell)
    except OverflowError:
        return float(np.copysign(np.inf, 1 if cell > 0 else -1))

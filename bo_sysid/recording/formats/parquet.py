"""Parquet files, from whatever wrote them."""

import json
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from bo_sysid.errors import RecordingError
from bo_sysid.recording.formats.registry import reader, require_content
from bo_sysid.recording.numbers import dated
from bo_sysid.recording.table import RawTable
from bo_sysid.recording.value import Hold

_HOLDS: dict[bytes, Hold] = {b"zero": "zero", b"linear": "linear"}


@reader(".parquet", ".pq")
def read_parquet(path: Path) -> RawTable:
    """Read a Parquet file, with the units and notes that `write_recording` leaves in it."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    require_content(path, b"PAR1")
    try:
        table = pq.ParquetFile(path).read()
    except (pa.ArrowException, OSError) as error:
        raise RecordingError(f"{path}: a damaged Parquet file: {error}") from None
    if repeated := [n for n, count in Counter(table.column_names).items() if count > 1]:
        raise RecordingError(
            f"{path}: several columns are named {repeated[0]!r}; each needs a name of its own"
        )
    described = {f.name: f.metadata or {} for f in table.schema}
    own = _own(table.schema.metadata or {}, path)
    columns, left_out = arrow_columns(table)
    return RawTable(
        source=str(path),
        columns=columns,
        units={n: m[b"unit"].decode() for n, m in described.items() if b"unit" in m},
        holds={n: _HOLDS.get(m[b"hold"], "none") for n, m in described.items() if b"hold" in m},
        name=own.get("name", ""),
        notes=(*own.get("notes", ()), *left_out),
    )


def _own(metadata: Mapping[bytes, bytes], path: Path) -> dict[str, Any]:
    """Return what `write_recording` left in a file beside its columns; nothing in others."""
    try:
        own = json.loads(metadata.get(b"bo_sysid", b"{}"))
    except ValueError:
        own = None
    if not isinstance(own, dict):
        raise RecordingError(f"{path}: its metadata 'bo_sysid' are not those of this package")
    return own


def arrow_columns(table: Any) -> tuple[dict[str, np.ndarray], tuple[str, ...]]:
    """Return the columns of a `pyarrow.Table` by name, and sentences about those left out.

    Null becomes NaN, dates become UTC, also where they are text. Vectors of one length become
    columns with an index; those of several lengths are left out.
    """
    import pyarrow as pa

    columns: dict[str, np.ndarray] = {}
    notes = []
    for name in table.column_names:
        column = table.column(name)
        if pa.types.is_timestamp(column.type):
            column = column.cast(pa.timestamp(column.type.unit))  # without its zone
        values = column.to_pandas().to_numpy()
        if not _lists(column.type):
            columns[name] = dated(values)
            continue
        sizes = sorted({len(v) for v in values if v is not None})
        if len(sizes) > 1:
            notes.append(
                f"Column {name!r} left out: its lists have {sizes[0]} to {sizes[-1]} numbers."
            )
            continue
        empty = np.full(sizes[0] if sizes else 0, np.nan)
        cells = [empty if v is None else v for v in values]
        wide = np.stack(cells) if cells else np.zeros((0, 0))
        columns |= {f"{name}.{i}": wide[:, i] for i in range(wide.shape[1])}
    return columns, tuple(notes)


def _lists(kind: Any) -> bool:
    import pyarrow as pa

    listed = pa.types.is_list, pa.types.is_large_list, pa.types.is_fixed_size_list
    return bool(
        any(of(kind) for of in listed)
        and (pa.types.is_floating(kind.value_type) or pa.types.is_integer(kind.value_type))
    )

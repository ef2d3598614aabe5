"""LeRobot datasets: a folder of Parquet files with many episodes and `meta/info.json`."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from bo_sysid.errors import RecordingError
from bo_sysid.recording.formats.parquet import arrow_columns
from bo_sysid.recording.formats.registry import folder_reader
from bo_sysid.recording.table import RawTable

_NUMBERS = {"float32", "float64", "int32", "int64", "bool", "int8", "int16", "uint8"}


@folder_reader("meta/info.json")
def read_lerobot(path: Path) -> tuple[RawTable, ...]:
    """Read the numeric features of every episode; images and video stay where they are.

    A feature with names becomes ``<feature>.<name>`` (``observation.state.elbow``); the clock is
    ``timestamp``.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        info = json.loads((path / "meta" / "info.json").read_text(encoding="utf-8"))
        features = {
            n: f for n, f in info["features"].items() if f["dtype"] in _NUMBERS and n != "index"
        }
    except (ValueError, KeyError, TypeError) as error:
        raise RecordingError(f"{path}/meta/info.json: not a LeRobot dataset: {error!r}") from None
    files = sorted(path.glob("data/**/*.parquet"))
    if not files:
        raise RecordingError(f"{path}: a LeRobot dataset without files under data/")
    tables = []
    for file in files:
        try:
            table = pq.ParquetFile(file).read()
        except (pa.ArrowException, OSError) as error:
            raise RecordingError(f"{file}: a damaged Parquet file: {error}") from None
        columns, notes = arrow_columns(table)
        if "timestamp" not in columns:
            raise RecordingError(f"{file}: no column 'timestamp', which LeRobot's clock is in")
        episode = columns.pop("episode_index", np.zeros(len(table), int))
        for number in np.unique(episode):
            rows = episode == number
            made = _episode(path, int(number), columns, rows, features)
            tables.append(replace(made, notes=notes))
    return tuple(tables)


def _episode(
    path: Path, number: int, columns: dict[str, np.ndarray], rows: np.ndarray, features: Any
) -> RawTable:
    wide = {"time": columns["timestamp"][rows]}
    for name, feature in features.items():
        if name in columns and name != "timestamp":  # one number a row
            wide[name] = columns[name][rows]
        parts = [c for c in columns if c.startswith(f"{name}.") and c[len(name) + 1 :].isdigit()]
        labels = _labels(feature, len(parts))
        for k, label in enumerate(labels):
            wide[f"{name}.{label}"] = columns[f"{name}.{k}"][rows]
    title = f"{path.name}-episode-{number}"
    return RawTable(f"{path}, episode {number}", wide, name=title)


def _labels(feature: Any, count: int) -> list[str]:
    """Return the names of a feature's components, or their numbers."""
    names = feature.get("names")
    if isinstance(names, dict):  # {"motors": [...]}
        names = next(iter(names.values()), None)
    if isinstance(names, list) and len(names) == count:
        return [str(n) for n in names]
    return [str(k) for k in range(count)]

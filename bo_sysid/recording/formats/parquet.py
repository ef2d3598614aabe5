"""Parquet files, from whatever wrote them."""

import json
from pathlib import Path
from typing import Any

import numpy as np

from bo_sysid.errors import RecordingError
from bo_sysid.recording.formats.registry import reader, require_content
from bo_sysid.recording.table import RawTable


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
    described = {f.name: f.metadata or {} for f in table.schema}
    own = json.loads((table.schema.metadata or {}).get(b"bo_sysid", b"{}"))
    return RawTable(
        source=str(path),
        columns=arrow_columns(table),
        units={n: m[b"unit"].decode() for n, m in described.items() if b"unit" in m},
        holds={
            n: "zero" if m[b"hold"] == b"zero" else "none"
            for n, m in described.items()
            if b"hold" in m
        },
        name=own.get("name", ""),
        notes=tuple(own.get("notes", ())),
    )


def arrow_columns(table: Any) -> dict[str, np.ndarray]:
    """Return the columns of a `pyarrow.Table` by name; null becomes NaN, dates become UTC."""
    import pyarrow as pa

    columns: dict[str, np.ndarray] = {}
    for name in table.column_names:
        column = table.column(name)
        if pa.types.is_timestamp(column.type):
            column = column.cast(pa.timestamp("ns"))
        values = column.to_pandas().to_numpy()
        if _lists(column.type):  # a vector in every cell becomes columns with an index
            wide = np.stack(values) if len(values) else np.zeros((0, 0))
            columns |= {f"{name}.{i}": wide[:, i] for i in range(wide.shape[1])}
        else:
            columns[name] = values
    return columns


def _lists(kind: Any) -> bool:
    import pyarrow as pa

    return bool(
        (pa.types.is_list(kind) or pa.types.is_fixed_size_list(kind))
        and (pa.types.is_floating(kind.value_type) or pa.types.is_integer(kind.value_type))
    )

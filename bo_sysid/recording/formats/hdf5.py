"""HDF5 files, through h5py (group `hdf5` of dependencies)."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from bo_sysid.errors import RecordingError
from bo_sysid.recording.formats.arrays import not_read, split
from bo_sysid.recording.formats.registry import needs, reader, require_content
from bo_sysid.recording.table import RawTable


@reader(".h5", ".hdf5")
def read_hdf5(path: Path) -> RawTable:
    """Read the numeric datasets of a file; groups are joined by dots, ``T x k`` gets an index.

    An attribute ``unit`` (or ``units``) of a dataset is its unit. Those of more than two
    dimensions, such as pictures, are left where they are.
    """
    with needs("hdf5", path):
        import h5py
    require_content(path, b"\x89HDF")
    arrays: dict[str, np.ndarray] = {}
    units: dict[str, str] = {}
    notes: list[str] = []

    def take(name: str, item: Any) -> None:
        if isinstance(item, h5py.Dataset) and item.ndim and item.dtype.kind in "fiub":
            key = name.replace("/", ".")
            if (dimensions := sum(n > 1 for n in item.shape)) > 2:
                notes.append(not_read(key, dimensions))
                return
            arrays[key] = item[()]
            unit = item.attrs.get("unit", item.attrs.get("units", ""))
            if isinstance(unit, bytes):
                unit = unit.decode()
            if isinstance(unit, str) and unit:
                units[key] = unit

    try:
        with h5py.File(path, "r") as file:
            file.visititems(take)
    except (OSError, RuntimeError, ValueError) as error:
        raise RecordingError(f"{path}: cannot be read as an HDF5 file: {error}") from None
    table = split(arrays, str(path), units)
    return replace(table, notes=(*table.notes, *notes))

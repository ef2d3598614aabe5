"""Files of named arrays: NumPy archives and MATLAB files."""

from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from bo_sysid.errors import RecordingError
from bo_sysid.recording.formats.registry import content, first_bytes, reader, require_content
from bo_sysid.recording.table import RawTable

_SHORT = 10  # times shorter than the longest vector of a file, from which one is no clock


@reader(".npz")
def read_npz(path: Path) -> RawTable:
    """Read named NumPy arrays; a ``T x k`` array becomes k columns with an index."""
    require_content(path, b"PK\x03\x04")
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as archive:
            arrays = {name: np.asarray(archive[name]) for name in archive.files}
    except Exception as error:  # a damaged archive can lead the parser to raise anything
        raise RecordingError(
            f"{path}: cannot be read as a NumPy archive: {error}. Only plain arrays of numbers are "
            "read, no Python objects"
        ) from None
    return split(arrays, str(path))


@reader(".mat")
def read_mat(path: Path) -> RawTable:
    """Read a MATLAB file up to version 7; fields of a struct become ``struct.field``."""
    from scipy.io import loadmat

    first = first_bytes(path)
    if first.startswith((b"MATLAB 7.3", b"\x89HDF")):
        raise RecordingError(
            f"{path}: a MATLAB 7.3 (HDF5) file; save it again with save('file.mat', ..., '-v7')"
        )
    if content(first):
        require_content(path, b"MATLAB 5.0")  # version 4 has no signature of its own
    try:
        found = loadmat(path, simplify_cells=True)
    except Exception as error:  # a damaged file can lead the parser to raise anything
        raise RecordingError(f"{path}: cannot be read as a MATLAB file: {error}") from None
    return split(_flat({k: v for k, v in found.items() if not k.startswith("__")}), str(path))


def _flat(content: Mapping[str, Any], prefix: str = "") -> dict[str, np.ndarray]:
    """Return the arrays of nested structs by dotted name."""
    flat: dict[str, np.ndarray] = {}
    for key, value in content.items():
        if isinstance(value, dict):
            flat.update(_flat(value, f"{prefix}{key}."))
        else:
            flat[f"{prefix}{key}"] = np.asarray(value)
    return flat


def split(
    arrays: Mapping[str, np.ndarray], source: str, units: Mapping[str, str] | None = None
) -> RawTable:
    """Return vectors by name: one axis of a matrix is time, the other one an index.

    Time is the axis that is as long as a vector of the file, such as its clock. Where neither or
    both are, it is the longer one.
    """
    sizes = {len(a) for a in map(np.squeeze, arrays.values()) if a.ndim == 1}
    lengths = {n for n in sizes if _SHORT * n > max(sizes)}  # no gains, or names of joints
    units = units or {}
    known: dict[str, str] = {}
    columns: dict[str, np.ndarray] = {}
    notes = []
    for name, array in arrays.items():
        array = np.squeeze(array) if array.ndim > 1 else array
        if array.ndim <= 1:
            columns[name] = np.atleast_1d(array)
            known |= {name: units[name]} if name in units else {}
        elif array.ndim == 2:
            samples = _along_time(array, lengths)
            parts = {f"{name}.{i}": samples[:, i] for i in range(samples.shape[1])}
            columns |= parts
            known |= dict.fromkeys(parts, units[name]) if name in units else {}
        else:
            notes.append(not_read(name, array.ndim))
    return RawTable(source, columns, units=known, notes=tuple(notes))


def not_read(name: str, dimensions: int) -> str:
    """Return that an array has too many dimensions to be the samples of a machine."""
    return f"Array {name!r} has {dimensions} dimensions and was not read."


def _along_time(matrix: np.ndarray, lengths: Collection[int]) -> np.ndarray:
    """Return a matrix whose first axis is time, which vectors of some lengths stand beside."""
    rows, columns = (size in lengths for size in matrix.shape)
    across = columns if rows != columns else matrix.shape[0] < matrix.shape[1]
    return matrix.T if across else matrix

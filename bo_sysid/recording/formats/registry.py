"""Readers by file ending, and what the first bytes of a file say."""

from collections.abc import Callable
from pathlib import Path

from bo_sysid.errors import RecordingError
from bo_sysid.recording.table import RawTable

Reader = Callable[[Path], RawTable]
READERS: dict[str, Reader] = {}
"""Reader by file ending, for instance ``.csv``."""

# the first bytes of a file say what it is, whatever its name says
SIGNATURES = {
    b"PAR1": "a Parquet file (.parquet)",
    b"PK\x03\x04": "a NumPy archive (.npz) or another zip file",
    b"\x1f\x8b": "a gzip file (.csv.gz)",
    b"\x93NUMPY": "a single NumPy array; save named arrays with numpy.savez (.npz)",
    b"MATLAB 5.0": "a MATLAB file (.mat)",
    b"MATLAB 7.3": "a MATLAB 7.3 file; save it with save(..., '-v7')",
    b"\x89HDF": "an HDF5 file",
}


def reader(*endings: str) -> Callable[[Reader], Reader]:
    """Register the decorated function as the reader of files with these endings."""

    def register(function: Reader) -> Reader:
        READERS.update(dict.fromkeys(endings, function))
        return function

    return register


def content(data: bytes) -> str:
    """Return what the first bytes of a file say that it is; empty where they say nothing."""
    return next((text for s, text in SIGNATURES.items() if data.startswith(s)), "")


def first_bytes(path: Path) -> bytes:
    """Return the first bytes of a file, enough for every signature."""
    with path.open("rb") as file:
        return file.read(32)


def require_content(path: Path, expected: bytes) -> None:
    """Raise `RecordingError` unless the file starts with the bytes that its ending promises."""
    first = first_bytes(path)
    if not first.startswith(expected):
        found = content(first) or "something else"
        raise RecordingError(
            f"{path}: not {SIGNATURES[expected]} as its ending says; its content is {found}"
        )

"""Readers by file ending, and what the first bytes of a file say."""

import contextlib
from collections.abc import Callable, Iterator
from pathlib import Path

from bo_sysid.errors import RecordingError
from bo_sysid.recording.table import RawTable

Reader = Callable[[Path], RawTable]
READERS: dict[str, Reader] = {}
"""Reader by file ending, for instance ``.csv``."""

FolderReader = Callable[[Path], tuple[RawTable, ...]]
FOLDERS: dict[str, FolderReader] = {}
"""Reader of a folder by the file that says what it is, for instance ``metadata.yaml``."""

# the first bytes of a file say what it is, whatever its name says
SIGNATURES = {
    b"PAR1": "a Parquet file (.parquet)",
    b"PK\x03\x04": "a NumPy archive (.npz) or another zip file",
    b"\x1f\x8b": "a gzip file (.csv.gz)",
    b"\x93NUMPY": "a single NumPy array; save named arrays with numpy.savez (.npz)",
    b"MATLAB 5.0": "a MATLAB file (.mat)",
    b"MATLAB 7.3": "a MATLAB 7.3 file; save it with save(..., '-v7')",
    b"\x89HDF": "an HDF5 file",
    b"\x89MCAP": "an MCAP file (.mcap)",
    b"SQLite format 3": "a SQLite file (.db3)",
}


def reader(*endings: str) -> Callable[[Reader], Reader]:
    """Register the decorated function as the reader of files with these endings."""

    def register(function: Reader) -> Reader:
        READERS.update(dict.fromkeys(endings, function))
        return function

    return register


def folder_reader(mark: str) -> Callable[[FolderReader], FolderReader]:
    """Register the decorated function as the reader of folders that hold a file `mark`."""

    def register(function: FolderReader) -> FolderReader:
        FOLDERS[mark] = function
        return function

    return register


def log_folder(path: Path) -> FolderReader | None:
    """Return the reader of a folder that is a log; None for any other folder."""
    return next((read for mark, read in FOLDERS.items() if (path / mark).is_file()), None)


@contextlib.contextmanager
def needs(group: str, path: Path) -> Iterator[None]:
    """Say which group of dependencies a file needs, where an import inside fails.

    Raises:
        RecordingError: a package is not installed.
    """
    try:
        yield
    except ImportError as error:
        raise RecordingError(
            f"{path}: needs the package {error.name}: pip install 'bo-sysid[{group}]'"
        ) from None


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

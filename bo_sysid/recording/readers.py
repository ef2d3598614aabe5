"""Readers of logs, one a file format, found by the ending of the file's name.

A reader turns a file into a `RawTable` and interprets nothing; names, units and clocks are settled
by `bo_sysid.recording.mapping`. A new format is one function with the decorator `reader`.
"""

import csv
import gzip
import io
import json
import zipfile
import zlib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from bo_sysid.errors import RecordingError, nearest
from bo_sysid.recording.mapping import to_recording
from bo_sysid.recording.table import RawTable
from bo_sysid.recording.value import Recording

Reader = Callable[[Path], RawTable]
READERS: dict[str, Reader] = {}
"""Reader by file ending, for instance ``.csv``."""

# the first bytes of a file say what it is, whatever its name says
_SIGNATURES = {
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


def read_table(path: str | Path) -> RawTable:
    """Read a file as it is.

    Raises:
        RecordingError: there is no such file, no reader for its ending, or the file is not what
            its ending says.
    """
    path = Path(path)
    ending = _ending(path)
    if not path.exists():
        siblings = [p.name for p in path.parent.iterdir()] if path.parent.is_dir() else []
        raise RecordingError(f"{path}: no such file; {nearest(path.name, siblings)}")
    if path.is_file() and path.stat().st_size == 0:
        raise RecordingError(f"{path}: the file is empty")
    return READERS[ending](path)


def read_recording(
    path: str | Path,
    columns: Mapping[str, Any] | None = None,
    clocks: Mapping[str, Any] | None = None,
    strict: bool = False,
) -> Recording:
    """Read a log into a recording.

    Args:
        path: a file whose ending names its format: ``.csv`` (``.csv.gz``, ``.tsv``), ``.parquet``,
            ``.npz``, ``.mat``.
        columns: a study's ``columns:``: by channel (or ``time``), which column it is and how it
            is converted; see `ColumnRule`.
        clocks: a study's ``clocks:``: by kind or channel, the column of its time stamps; see
            `ClockRule`.
        strict: refuse gaps, jitter, duplicate stamps and channels that never move, which are
            otherwise used and noted.

    Returns:
        The recording, in SI units; its notes say what was done.

    Raises:
        RecordingError: with file, column, row, the rule and the nearest valid choice.
    """
    path = Path(path)
    table = read_table(path)
    name = path.name.removesuffix(_ending(path))
    return to_recording(table, columns, clocks, name=name, strict=strict)


@reader(".csv", ".csv.gz", ".tsv", ".txt")
def read_csv(path: Path) -> RawTable:
    """Read a text file with one header line; the separator is found in that line."""
    text = _text(path)
    header, separator = _header(path, text)
    try:
        frame = pd.read_csv(
            io.StringIO(text),
            sep=separator,
            header=None,
            skiprows=1,
            names=header,
            index_col=False,
            skipinitialspace=True,
            float_precision="round_trip",
            keep_default_na=False,
            na_values=["", "nan", "NaN", "NAN", "null", "NULL"],
            low_memory=False,
        )
    except (pd.errors.ParserError, pd.errors.EmptyDataError) as error:
        raise RecordingError(f"{path}: not a table: {error}") from None
    return RawTable(str(path), {str(c): frame[c].to_numpy() for c in frame.columns})


@reader(".parquet", ".pq")
def read_parquet(path: Path) -> RawTable:
    """Read a Parquet file, with the units and notes that `write_recording` leaves in it."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    _require_content(path, b"PAR1")
    try:
        table = pq.ParquetFile(path).read()
    except (pa.ArrowException, OSError) as error:
        raise RecordingError(f"{path}: a damaged Parquet file: {error}") from None
    columns = {n: table.column(n).to_pandas().to_numpy() for n in table.column_names}
    described = {f.name: f.metadata or {} for f in table.schema}
    own = json.loads((table.schema.metadata or {}).get(b"bo_sysid", b"{}"))
    return RawTable(
        source=str(path),
        columns=columns,
        units={n: m[b"unit"].decode() for n, m in described.items() if b"unit" in m},
        holds={
            n: "zero" if m[b"hold"] == b"zero" else "none"
            for n, m in described.items()
            if b"hold" in m
        },
        name=own.get("name", ""),
        notes=tuple(own.get("notes", ())),
    )


@reader(".npz")
def read_npz(path: Path) -> RawTable:
    """Read named NumPy arrays; a ``T x k`` array becomes k columns with an index."""
    _require_content(path, b"PK\x03\x04")
    try:
        with np.load(path, allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in archive.files}
    except (zipfile.BadZipFile, zlib.error, EOFError, OSError) as error:
        raise RecordingError(f"{path}: a damaged NumPy archive: {error}") from None
    except ValueError as error:
        raise RecordingError(
            f"{path}: {error}; arrays of Python objects are not read, save plain numbers"
        ) from None
    return RawTable(str(path), _split(arrays, str(path)))


@reader(".mat")
def read_mat(path: Path) -> RawTable:
    """Read a MATLAB file up to version 7; fields of a struct become ``struct.field``."""
    from scipy.io import loadmat
    from scipy.io.matlab import MatReadError

    if _starts(path, b"MATLAB 7.3") or _starts(path, b"\x89HDF"):
        raise RecordingError(
            f"{path}: a MATLAB 7.3 (HDF5) file; save it again with save('file.mat', ..., '-v7')"
        )
    signature = next((s for s in _SIGNATURES if _starts(path, s)), None)
    if signature not in (None, b"MATLAB 5.0"):
        _require_content(path, b"MATLAB 5.0")
    try:
        content = loadmat(path, simplify_cells=True)
    except (MatReadError, ValueError, TypeError, OSError, EOFError, zlib.error) as error:
        raise RecordingError(f"{path}: not a MATLAB file: {error}") from None
    arrays = _flat({k: v for k, v in content.items() if not k.startswith("__")})
    return RawTable(str(path), _split(arrays, str(path)))


def _ending(path: Path) -> str:
    """Return the registered ending of a file's name."""
    name = path.name.lower()
    known = [e for e in READERS if name.endswith(e)]
    if not known:
        written = "".join(path.suffixes[-2:]) if name.endswith(".gz") else path.suffix
        raise RecordingError(
            f"{path}: no reader for files that end in {written!r}; {nearest(written, READERS)}"
        )
    return max(known, key=len)


def _starts(path: Path, signature: bytes) -> bool:
    with path.open("rb") as file:
        return file.read(len(signature)) == signature


def _require_content(path: Path, expected: bytes) -> None:
    """Raise unless the file starts with the bytes that its ending promises."""
    if _starts(path, expected):
        return
    found = next((text for s, text in _SIGNATURES.items() if _starts(path, s)), None)
    is_ = f"its content is {found}" if found else "its content is something else"
    raise RecordingError(f"{path}: not {_SIGNATURES[expected]} as its ending says; {is_}")


def _text(path: Path) -> str:
    """Return the text of a plain or gzipped file."""
    try:
        if path.name.lower().endswith(".gz"):
            _require_content(path, b"\x1f\x8b")
            data = gzip.decompress(path.read_bytes())
        else:
            data = path.read_bytes()
        found = next((text for s, text in _SIGNATURES.items() if data.startswith(s)), None)
        if found or b"\0" in data[:4096]:
            raise RecordingError(
                f"{path}: not text as its ending says; its content is {found or 'binary'}"
            )
        return data.decode("utf-8-sig")
    except (gzip.BadGzipFile, EOFError, zlib.error) as error:
        raise RecordingError(f"{path}: a damaged gzip file: {error}") from None
    except UnicodeDecodeError as error:
        raise RecordingError(f"{path}: not UTF-8 text: {error}") from None


def _header(path: Path, text: str) -> tuple[list[str], str]:
    """Return the column names of the first line and the separator."""
    first = text.split("\n", 1)[0].strip("\r").lstrip("#").strip()
    separator = max(",;\t", key=first.count)
    if separator not in first:
        separator = r"\s+" if " " in first else ","
    names = first.split() if separator == r"\s+" else next(csv.reader([first], delimiter=separator))
    names = [n.strip() for n in names]
    if not first or all(_is_number(n) for n in names):
        raise RecordingError(
            f"{path}: the first line must name the columns (time, qpos.<joint>, …), not "
            f"{first[:60]!r}"
        )
    for name in names:
        if not name or names.count(name) > 1:
            raise RecordingError(
                f"{path}: column {name!r} appears {names.count(name)} times in the first line; "
                "every column needs a name of its own"
            )
    return names, separator


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _flat(content: Mapping[str, Any], prefix: str = "") -> dict[str, np.ndarray]:
    """Return the arrays of nested structs by dotted name."""
    flat: dict[str, np.ndarray] = {}
    for key, value in content.items():
        if isinstance(value, dict):
            flat.update(_flat(value, f"{prefix}{key}."))
        else:
            flat[f"{prefix}{key}"] = np.asarray(value)
    return flat


def _split(arrays: Mapping[str, np.ndarray], source: str) -> dict[str, np.ndarray]:
    """Return vectors by name; the longer axis of a matrix is time, the other one an index."""
    columns: dict[str, np.ndarray] = {}
    for name, array in arrays.items():
        array = np.squeeze(array) if array.ndim > 1 else np.atleast_1d(array)
        if array.ndim <= 1:
            columns[name] = np.atleast_1d(array)
        elif array.ndim == 2:
            samples = array if array.shape[0] >= array.shape[1] else array.T
            columns.update({f"{name}.{i}": samples[:, i] for i in range(samples.shape[1])})
        else:
            raise RecordingError(
                f"{source}: array {name!r} has {array.ndim} dimensions; at most 2 are read"
            )
    return columns

"""Readers of logs, one a file format, found by the ending of the file's name.

A reader turns a file into a `RawTable` and interprets nothing; names, units and clocks are settled
by `bo_sysid.recording.mapping`. A new format is one function with the decorator `reader`.
"""

import gzip
import json
import re
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

_TRAILING = ""  # name of the empty column after a separator at the end of each line

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
    if path.is_dir():
        raise RecordingError(f"{path}: a folder, not a file")
    if path.stat().st_size == 0:
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
    name = path.name[: -len(_ending(path))]
    return to_recording(table, columns, clocks, name=name, strict=strict)


@reader(".csv", ".csv.gz", ".tsv", ".txt")
def read_csv(path: Path) -> RawTable:
    """Read a text file with one header line; the separator is found in that line.

    Blank lines and lines that start with ``#`` may stand before the header; the header itself may
    start with ``#``, as `numpy.savetxt` writes it.
    """
    import pyarrow as pa
    from pyarrow import csv as arrow_csv

    names, separator, body = _header_and_body(path, _text(path))
    if not body.strip():
        raise RecordingError(f"{path}: the file names its columns but holds no samples")
    if separator == " ":  # any run of blanks
        body = "\n".join(" ".join(line.split()) for line in body.split("\n"))
    try:
        table = arrow_csv.read_csv(
            pa.BufferReader(body.encode()),
            arrow_csv.ReadOptions(column_names=names, use_threads=False),
            arrow_csv.ParseOptions(delimiter=separator),
            arrow_csv.ConvertOptions(
                null_values=["", "nan", "NaN", "NAN", "null", "NULL"], strings_can_be_null=True
            ),
        )
    except pa.ArrowInvalid as error:
        found = re.search(r"Row #(\d+): (.*)", str(error), re.DOTALL)
        what = f"row {int(found[1]) - 1}: {found[2]}" if found else str(error)
        raise RecordingError(f"{path}: not a table of {len(names)} columns: {what}") from None
    columns = _columns(table)
    if not pd.isna(columns.pop(_TRAILING, np.empty(0))).all():
        raise RecordingError(f"{path}: the last column has values but no name in the first line")
    return RawTable(str(path), columns)


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
    described = {f.name: f.metadata or {} for f in table.schema}
    own = json.loads((table.schema.metadata or {}).get(b"bo_sysid", b"{}"))
    return RawTable(
        source=str(path),
        columns=_columns(table),
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
        with path.open("rb") as file, np.load(file, allow_pickle=False) as archive:
            arrays = {name: np.asarray(archive[name]) for name in archive.files}
    except Exception as error:  # a damaged archive can lead the parser to raise anything
        raise RecordingError(
            f"{path}: cannot be read as a NumPy archive: {error}. Only plain arrays of numbers are "
            "read, no Python objects"
        ) from None
    return _split(arrays, str(path))


@reader(".mat")
def read_mat(path: Path) -> RawTable:
    """Read a MATLAB file up to version 7; fields of a struct become ``struct.field``."""
    from scipy.io import loadmat

    if _starts(path, b"MATLAB 7.3") or _starts(path, b"\x89HDF"):
        raise RecordingError(
            f"{path}: a MATLAB 7.3 (HDF5) file; save it again with save('file.mat', ..., '-v7')"
        )
    if not _starts(path, b"MATLAB 5.0") and any(_starts(path, s) for s in _SIGNATURES):
        _require_content(path, b"MATLAB 5.0")  # version 4 has no signature of its own
    try:
        content = loadmat(path, simplify_cells=True)
    except Exception as error:  # a damaged file can lead the parser to raise anything
        raise RecordingError(f"{path}: cannot be read as a MATLAB file: {error}") from None
    return _split(_flat({k: v for k, v in content.items() if not k.startswith("__")}), str(path))


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


def _header_and_body(path: Path, text: str) -> tuple[list[str], str, str]:
    """Return the column names, the separator, and the lines below the header."""
    lines = text.replace("\r\n", "\n").replace("\r", "\n").split("\n")
    comments = []
    while lines and (not lines[0].strip() or lines[0].lstrip().startswith("#")):
        comments.append(lines.pop(0))
    header = lines.pop(0) if lines else ""
    separator, names = _names(header)
    if all(_is_number(name) for name in names) and comments:
        lines.insert(0, header)
        header = comments[-1].lstrip("# ")
        separator, names = _names(header)
    if not names or all(_is_number(name) for name in names):
        raise RecordingError(
            f"{path}: the first line must name the columns (time, qpos.<joint>, …), not "
            f"{header[:60]!r}"
        )
    if lines and lines[0].count(separator) == len(names) and lines[0].endswith(separator):
        names.append(_TRAILING)  # every line ends with a separator, only the header does not
    for name in names:
        if (not name and name is not names[-1]) or names.count(name) > 1:
            raise RecordingError(
                f"{path}: the first line names column {names.index(name)} {name!r}; every column "
                "needs a name of its own"
            )
    return names, separator, "\n".join(lines)


def _names(header: str) -> tuple[str, list[str]]:
    """Return the separator of a header line and the names between."""
    separator = max(",;\t", key=header.count)
    if separator not in header:
        return " ", header.split()
    return separator, [name.strip().strip('"').strip() for name in header.split(separator)]


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


def _split(arrays: Mapping[str, np.ndarray], source: str) -> RawTable:
    """Return vectors by name; the longer axis of a matrix is time, the other one an index."""
    columns: dict[str, np.ndarray] = {}
    notes = []
    for name, array in arrays.items():
        array = np.squeeze(array) if array.ndim > 1 else array
        if array.ndim <= 1:
            columns[name] = np.atleast_1d(array)
        elif array.ndim == 2:
            samples = array if array.shape[0] >= array.shape[1] else array.T
            columns.update({f"{name}.{i}": samples[:, i] for i in range(samples.shape[1])})
        else:
            notes.append(f"Array {name!r} has {array.ndim} dimensions and was not read.")
    return RawTable(source, columns, notes=tuple(notes))


def _columns(table: Any) -> dict[str, np.ndarray]:
    """Return the columns of an Arrow table by name; null becomes NaN."""
    return {n: table.column(n).to_pandas().to_numpy() for n in table.column_names}

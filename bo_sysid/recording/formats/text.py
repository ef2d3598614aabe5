"""Tables in text: CSV and its relatives, plain or gzipped."""

import csv
import gzip
import re
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from bo_sysid.errors import RecordingError
from bo_sysid.recording.formats.parquet import arrow_columns
from bo_sysid.recording.formats.registry import content, reader, require_content
from bo_sysid.recording.table import RawTable
from bo_sysid.recording.units import is_unit

_COMMA_NUMBER = r"[-+]?(\d+|\d*,\d+|\d+,)([eE][-+]?\d+)?"
_TIME_OF_DAY = r"\d{1,2}:\d\d:\d\d(\.\d+)?"
_HALF_A_DAY = np.timedelta64(12, "h")
_SEPARATOR = re.compile(r'"?sep=.?"?')  # a first line that Excel writes and reads
_UTF16 = (b"\xff\xfe", b"\xfe\xff")  # the first bytes of what Excel calls Unicode text
_MOST = 2**31 - 1  # bytes that are parsed at once
_TRAILING = ""  # name of the empty column after a separator at the end of each line
_INDEX = "index"  # name of a first column that has none
_EMPTY = (  # what stands in cells without a value: of R, Excel, pandas and C on Windows
    "", "nan", "NaN", "NAN", "-nan", "-NaN", "nan(ind)", "-nan(ind)", "1.#QNAN", "-1.#QNAN",
    "1.#IND", "-1.#IND", "NA", "N/A", "n/a", "#N/A", "<NA>", "null", "NULL", "None",
)  # fmt: skip


@reader(".csv", ".csv.gz", ".tsv", ".txt")
def read_csv(path: Path) -> RawTable:
    """Read a text file with one header line; the separator is found in that line.

    Between other separators than commas, numbers may have decimal commas. Times of day such as
    12:00:00.02 are durations.
    Blank lines and lines that start with ``#`` may stand before the header; the header itself may
    start with ``#``, as `numpy.savetxt` writes it. Before all may stand Excel's ``sep=;``, and
    below the header a line of units. A last line that breaks off, as that of a logger that was
    killed does, is left out.
    """
    import pyarrow as pa
    from pyarrow import csv as arrow_csv

    try:
        text, note = _text(path)
        names, separator, body = _header_and_body(path, text)
        units, body = _units(names, separator, body)
    except csv.Error as error:
        raise RecordingError(f"{path}: the header is no list of names: {error}") from None
    if not body.strip():
        raise _no_samples(path)
    if separator == " ":  # any run of blanks
        body = "\n".join(" ".join(line.split()) for line in body.split("\n"))
    last = _LastLine(body)
    data = body.encode()
    if len(data) >= _MOST:
        raise RecordingError(f"{path}: more than 2 GiB of text; write it as Parquet")
    try:
        table = arrow_csv.read_csv(
            pa.BufferReader(data),
            # one block: the type of a column is that of all its cells, not of the first ones
            arrow_csv.ReadOptions(column_names=names, use_threads=False, block_size=len(data) + 1),
            arrow_csv.ParseOptions(delimiter=separator, invalid_row_handler=last.judged),
            arrow_csv.ConvertOptions(null_values=_EMPTY, strings_can_be_null=True),
        )
    except pa.ArrowInvalid as error:
        found = re.search(r"Row #(\d+): (.*)", str(error), re.DOTALL)
        what = f"row {int(found[1]) - 1}: {found[2]}" if found else str(error)
        raise RecordingError(f"{path}: not a table of {len(names)} columns: {what}") from None
    if not table.num_rows:
        raise _no_samples(path)
    _require_closed_quotes(path, body, table.num_rows + bool(last.note))
    columns, _ = arrow_columns(table)
    if not pd.isna(columns.pop(_TRAILING, np.empty(0))).all():
        raise RecordingError(f"{path}: the last column has values but no name in the first line")
    pointed = separator == "," or any(map(pa.types.is_floating, table.schema.types))
    commas = {} if pointed else _decimal_commas(columns)
    notes = [*filter(None, (note, last.note))]
    if units:
        notes.append("Units were read from the line below the header.")
    if commas:
        notes.append(f"Decimal commas read as points in columns {', '.join(map(repr, commas))}.")
    daily = _times_of_day(columns)
    columns |= commas | daily
    return RawTable(str(path), columns, units=units, notes=tuple(notes))


def _no_samples(path: Path) -> RecordingError:
    return RecordingError(f"{path}: the file names its columns but holds no samples")


def _require_closed_quotes(path: Path, body: str, rows: int) -> None:
    """Raise where a quote that is not closed on its line takes the next one into its cell."""
    if '"' not in body:
        return
    lines = [line for line in body.split("\n") if line.strip("\r")]
    if rows < len(lines):
        row = next((k for k, line in enumerate(lines, 1) if line.count('"') % 2), 1)
        raise RecordingError(
            f"{path}: row {row}: a quote that is not closed on its line would take the next line "
            "into its cell; close it, or write the cell without quotes"
        )


class _LastLine:
    """The last line of a text that ends without one, which may break off.

    Attributes:
        note: that it was left out; empty where it was not.
    """

    def __init__(self, body: str) -> None:
        self._text = body.rpartition("\n")[2]
        self.note = ""

    def judged(self, row: Any) -> str:  # row: pyarrow.csv.InvalidRow
        """Return what is done about a line with another number of cells: "skip" or "error"."""
        whole = row.actual_columns >= row.expected_columns
        if self.note or whole or row.text != self._text:
            return "error"
        self.note = (
            f"The last line breaks off after {row.actual_columns} of {row.expected_columns} cells "
            "and was left out."
        )
        return "skip"


def _times_of_day(columns: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return the columns of times such as 23:59:59.98 as durations, on past midnight."""
    found = {}
    for name, values in columns.items():
        first = str(values[0]).strip().replace(",", ".") if values.dtype == object else ""
        if not re.fullmatch(_TIME_OF_DAY, first) or pd.isna(values).any():
            continue  # text of another kind is not looked through
        cells = pd.Series(values).astype(str).str.strip().str.replace(",", ".")
        if cells.str.fullmatch(_TIME_OF_DAY).all():
            passed = pd.to_timedelta(cells).to_numpy()
            days = np.cumsum(np.diff(passed, prepend=passed[:1]) < -_HALF_A_DAY)
            found[name] = passed + days * 2 * _HALF_A_DAY
    return found


def _decimal_commas(columns: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return the columns whose numbers have decimal commas.

    A cell that is no number at all stays as it is, for whoever reads the column.
    """
    found = {}
    for name, values in columns.items():
        if not any(isinstance(c, str) for c in values):
            continue
        stripped = [c.strip() if isinstance(c, str) else None for c in values]
        cells = pd.Series(stripped, dtype="object")
        numbers = cells.str.fullmatch(_COMMA_NUMBER).eq(True)
        if cells[numbers].str.contains(",").any() and 2 * numbers.sum() > cells.notna().sum():
            pointed = cells.where(~numbers, cells.str.replace(",", "."))
            whole = bool((numbers | cells.isna()).all())
            found[name] = pointed.to_numpy(dtype=float if whole else object)
    return found


def _text(path: Path) -> tuple[str, str]:
    """Return the text of a plain or gzipped file, and how it is written where that is unusual."""
    try:
        if path.name.lower().endswith(".gz"):
            require_content(path, b"\x1f\x8b")
            data = gzip.decompress(path.read_bytes())
        else:
            data = path.read_bytes()
        if data.startswith(_UTF16):
            return data.decode("utf-16"), ""
        if content(data) or b"\0" in data[:4096]:
            raise RecordingError(
                f"{path}: not text as its ending says; its content is {content(data) or 'binary'}"
            )
        return _decoded(data)
    except (gzip.BadGzipFile, EOFError, zlib.error) as error:
        raise RecordingError(f"{path}: a damaged gzip file: {error}") from None
    except UnicodeDecodeError as error:
        raise RecordingError(f"{path}: not UTF-8, UTF-16 or Windows-1252 text: {error}") from None


def _decoded(data: bytes) -> tuple[str, str]:
    """Return text as UTF-8, or as programs of Windows write it in Western languages."""
    try:
        return data.decode("utf-8-sig"), ""
    except UnicodeDecodeError:
        return data.decode("cp1252"), "Read as Windows-1252 text, for it is not UTF-8."


def _header_and_body(path: Path, text: str) -> tuple[list[str], str, str]:
    """Return the column names, the separator, and the lines below the header."""
    lines = text.replace("\r\n", "\n").replace("\r", "\n").split("\n")
    if _SEPARATOR.fullmatch(lines[0].strip()):
        lines.pop(0)  # the header tells it as well
    comments = []
    while lines and (not lines[0].strip() or lines[0].lstrip().startswith("#")):
        comments.append(lines.pop(0))
    header = lines.pop(0) if lines else ""
    separator, names = _names(header, lines[0] if lines else "")
    if all(_is_number(name) for name in names) and comments:
        lines.insert(0, header)
        header = comments[-1].lstrip("# ")
        separator, names = _names(header, lines[0])
    if not names or all(_is_number(name) for name in names):
        raise RecordingError(
            f"{path}: the first line must name the columns (time, qpos.<joint>, …), not "
            f"{header[:60]!r}"
        )
    if lines and lines[0].count(separator) == len(names) and lines[0].endswith(separator):
        names.append(_TRAILING)  # every line ends with a separator, only the header does not
    if not names[0] and _INDEX not in names:  # as pandas writes a frame
        names[0] = _INDEX
    for name in names:
        if (not name and name is not names[-1]) or names.count(name) > 1:
            raise RecordingError(
                f"{path}: the first line names column {names.index(name)} {name!r}; every column "
                "needs a name of its own"
            )
    return names, separator, "\n".join(lines)


def _units(names: list[str], separator: str, body: str) -> tuple[dict[str, str], str]:
    """Return the unit of each column where the first line holds units, and the lines below.

    It does where no cell is a number and at least half of those that are not empty are known units.
    """
    first, _, rest = body.partition("\n")
    blank = separator == " "  # any run of them
    cells = first.split() if blank else next(csv.reader([first], delimiter=separator), [])
    if len(cells) != len(names):
        return {}, body
    stated = zip(names, (c.strip().strip("[]()").strip() for c in cells), strict=True)
    written = {n: c for n, c in stated if c}
    known = sum(is_unit(c) for c in written.values())
    if not known or 2 * known < len(written) or any(_is_number(c) for c in written.values()):
        return {}, body
    return written, rest


def _names(header: str, row: str) -> tuple[str, list[str]]:
    """Return the separator of a header line and the names between.

    Names may hold others, as in "q [rad, absolute]"; the first row has as many of the right one.
    Where that is true of two, the comma is the other: of decimals.
    """

    def fits(separator: str) -> tuple[bool, bool, int]:
        count = header.count(separator)
        consistent = count == row.count(separator)
        return count > 0, consistent, 0 if consistent else count

    separator = max(";\t,", key=fits)
    if separator not in header:
        return " ", header.split()
    names = next(csv.reader([header], delimiter=separator, skipinitialspace=True))
    return separator, [name.strip() for name in names]


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True

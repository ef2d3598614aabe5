"""Reading a log: the file's format, then names, units and clocks.

A reader turns a file into a `RawTable` and interprets nothing; the rest is settled by
`bo_sysid.recording.mapping`. A new format is one function in `bo_sysid.recording.formats` with the
decorator `reader`.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from bo_sysid.errors import RecordingError, nearest
from bo_sysid.recording.formats import READERS
from bo_sysid.recording.mapping import to_recording
from bo_sysid.recording.table import RawTable
from bo_sysid.recording.value import Recording


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

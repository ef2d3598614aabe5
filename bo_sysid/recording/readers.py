"""Reading a log: the file's format, then names, units and clocks.

A reader turns a file into a `RawTable` and interprets nothing; the rest is settled by
`bo_sysid.recording.mapping`. A new format is one function in `bo_sysid.recording.formats` with the
decorator `reader`.
"""

from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

from bo_sysid.errors import RecordingError, nearest
from bo_sysid.recording.formats import FOLDERS, READERS, log_folder
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
    if not path.exists():
        raise RecordingError(f"{path}: no such file; {_near(path)}")
    ending = _ending(path)
    if path.is_dir():
        raise RecordingError(f"{path}: a folder; {_folders()}")
    if path.stat().st_size == 0:
        raise RecordingError(f"{path}: the file is empty")
    return READERS[ending](path)


def read_tables(path: str | Path) -> tuple[RawTable, ...]:
    """Read a file, or a folder that is a log: a ROS 2 bag, or a LeRobot dataset with its episodes.

    Raises:
        RecordingError: as for `read_table`, or the folder is no log.
    """
    path = Path(path)
    if not path.is_dir():
        return (read_table(path),)
    read = log_folder(path)
    if read is None:
        inside = sorted(p.name for p in path.iterdir())[:8]
        raise RecordingError(
            f"{path}: a folder with {', '.join(inside) or 'nothing'}; {_folders()}"
        )
    return read(path)


def read_recordings(
    path: str | Path,
    columns: Mapping[str, Any] | None = None,
    clocks: Mapping[str, Any] | None = None,
    strict: bool = False,
    no_channels: Collection[str] = (),
) -> tuple[Recording, ...]:
    """Read a log that may hold several recordings; see `read_recording` and `to_recording`."""
    path, tables = Path(path), read_tables(path)
    name = path.name if path.is_dir() else path.name[: -len(_ending(path))]
    return tuple(
        to_recording(t, columns, clocks, name=name, strict=strict, no_channels=no_channels)
        for t in tables
    )


def read_recording(
    path: str | Path,
    columns: Mapping[str, Any] | None = None,
    clocks: Mapping[str, Any] | None = None,
    strict: bool = False,
) -> Recording:
    """Read a log into a recording.

    Args:
        path: a file whose ending names its format: ``.csv`` (``.csv.gz``, ``.tsv``, ``.txt``),
            ``.parquet`` (``.pq``), ``.json``, ``.npz``, ``.mat``, ``.mcap``, ``.db3``, ``.bag``,
            ``.h5`` (``.hdf5``).
        columns: a study's ``columns:``: by channel (or ``time``), which column it is and how it
            is converted; see `ColumnRule`.
        clocks: a study's ``clocks:``: by kind or channel, the column of its time stamps; see
            `ClockRule`.
        strict: refuse gaps, jitter, duplicate stamps, outliers and channels that never move, which
            are otherwise used and noted.

    Returns:
        The recording, in SI units; its notes say what was done.

    Raises:
        RecordingError: with file, column, row, the rule and the nearest valid choice.
    """
    found = read_recordings(path, columns, clocks, strict)
    if len(found) != 1:
        raise RecordingError(f"{path}: {len(found)} recordings; read_recordings returns them all")
    return found[0]


def _near(path: Path) -> str:
    """Return what there is instead of a file that is missing."""
    if not path.parent.is_dir():
        return f"there is no folder {path.parent}"
    found = [p.name for p in path.parent.iterdir()]
    return nearest(path.name, found) or f"the folder {path.parent} is empty"


def _folders() -> str:
    marks = ", ".join(FOLDERS)
    return f"folders that are logs hold {marks} (a ROS 2 bag, a LeRobot dataset)"


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

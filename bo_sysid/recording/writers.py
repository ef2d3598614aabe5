"""Writers of recordings, in the column convention, each file whole or not at all.

``time`` is the clock that most channels share; a channel with another clock brings its own stamps
in ``time.<kind>`` (all channels of its kind share it) or ``time.<channel>``. Columns that are
shorter than the longest one end in empty cells. Reading a file back gives the same numbers, bit
for bit. Parquet also keeps units, holds, the name and the notes; CSV keeps none of them.
"""

import json
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np

from bo_sysid.errors import RecordingError, nearest
from bo_sysid.recording.value import HELD_KINDS, UNNAMED, Recording, kind_of
from bo_sysid.runs import atomic

Writer = Callable[[Recording, Path], None]


def write_recording(recording: Recording, path: str | Path) -> Path:
    """Write a recording to a Parquet or CSV file.

    Args:
        recording: what to write.
        path: where to; the ending (``.parquet``, ``.csv``, ``.csv.gz``) names the format. Folders
            are made; an existing file is replaced.

    Returns:
        The path.

    Raises:
        RecordingError: no writer for this ending, or a hold that CSV cannot say.
    """
    path = Path(path)
    ending = next((e for e in WRITERS if path.name.lower().endswith(e)), None)
    if ending is None:
        raise RecordingError(
            f"{path}: no writer for files that end in {path.suffix!r}; "
            f"{nearest(path.suffix, WRITERS)}"
        )
    with atomic(path) as beside:
        WRITERS[ending](recording, beside)
    return path


def _write_parquet(recording: Recording, path: Path) -> None:
    import pyarrow as pa
    import pyarrow.parquet as pq

    columns, length = _columns(recording)
    fields, arrays = [], []
    for name, values in columns.items():
        channel = recording.channels.get(name)
        unit, hold = (channel.unit, channel.hold) if channel else ("s", "none")
        fields.append(pa.field(name, pa.float64(), metadata={"unit": unit, "hold": hold}))
        arrays.append(pa.array([*values, *[None] * (length - len(values))], pa.float64()))
    about: dict[str, object] = {"format": 1, "notes": recording.notes}
    if recording.name != UNNAMED:  # else it takes the file's name
        about["name"] = recording.name
    schema = pa.schema(fields, metadata={"bo_sysid": json.dumps(about)})
    pq.write_table(pa.Table.from_arrays(arrays, schema=schema), path)


def _write_csv(recording: Recording, path: Path) -> None:
    import pandas as pd

    for name, channel in recording.channels.items():
        if channel.hold != ("zero" if kind_of(name) in HELD_KINDS else "none"):
            raise RecordingError(
                f"{recording.name}: channel {name!r} has hold {channel.hold!r}, which its kind "
                "does not imply and CSV cannot say; write Parquet"
            )
    columns, length = _columns(recording)
    padded = {n: np.append(v, np.full(length - len(v), np.nan)) for n, v in columns.items()}
    pd.DataFrame(padded).to_csv(path, index=False)  # compressed where the ending says so


WRITERS: Mapping[str, Writer] = {
    ".parquet": _write_parquet,
    ".csv": _write_csv,
    ".csv.gz": _write_csv,
}
"""Writer by file ending."""


def _columns(recording: Recording) -> tuple[dict[str, np.ndarray], int]:
    """Return the columns of the file by name, clocks before what they time, and the longest."""
    clocks: dict[bytes, list[str]] = {}
    for name, channel in recording.channels.items():
        clocks.setdefault(channel.time.tobytes(), []).append(name)
    main = max(clocks.values(), key=len)
    columns = {"time": recording.channels[main[0]].time}
    for names in clocks.values():
        if names is not main:
            for clock in _clock_names(recording, names):
                columns[clock] = recording.channels[names[0]].time
    columns |= {name: channel.values for name, channel in recording.channels.items()}
    return columns, max(map(len, columns.values()))


def _clock_names(recording: Recording, names: list[str]) -> list[str]:
    """Return the names of the columns that hold the clock which the channels `names` share."""
    clocks = []
    for name in names:
        kind = kind_of(name)
        whole = all(f"{kind}.{other}" in names for other in recording.of_kind(kind))
        clocks.append(f"time.{kind}" if whole else f"time.{name}")
    return list(dict.fromkeys(clocks))

"""A raw table: what a reader hands over before names, units and clocks are settled."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Any

import numpy as np

from bo_sysid.errors import RecordingError, nearest
from bo_sysid.recording.numbers import DATED, in_seconds
from bo_sysid.recording.value import Hold

FILL_IN = "FILL IN"
"""What `init` writes for a column that it did not find."""
ROWS = "row number"
"""Name of the column that stands for the time stamps of a log without any."""


@dataclass(frozen=True)
class RawTable:
    """Columns of a file by name, each a vector, as they were written.

    Columns may differ in length: a file can hold several clocks. An empty cell is NaN, as is a
    cell that says so; a column that is shorter than others of the file ends in empty cells.

    Attributes:
        source: the file, for messages.
        columns: samples by column name; numbers, truth values, time stamps or text.
        clocks: name of the column that holds the time stamps of a column, where the file says so.
        units: unit of a column, where the file says so.
        holds: "zero", "linear" or "none" by column, where the file says so.
        name: name of the recording, where the file says so.
        notes: what the reader did, and what the file says was done before.
        rate: rows per second in [Hz], where they came at a steady rate and are counted; else 0.
    """

    source: str
    columns: Mapping[str, np.ndarray]
    clocks: Mapping[str, str] = field(default_factory=dict)
    units: Mapping[str, str] = field(default_factory=dict)
    holds: Mapping[str, Hold] = field(default_factory=dict)
    name: str = ""
    notes: tuple[str, ...] = ()
    rate: float = 0.0

    def __post_init__(self) -> None:
        if not self.columns:
            raise RecordingError(f"{self.source}: the file holds no columns")
        if not any(len(c) for c in self.columns.values()):
            raise RecordingError(f"{self.source}: the file holds no samples")
        for key in ("columns", "clocks", "units", "holds"):
            object.__setattr__(self, key, MappingProxyType(dict(getattr(self, key))))

    def counted(self, rate: float) -> "RawTable":
        """Return the table with the column `ROWS`: row number / rate, in [s]."""
        longest = max(len(c) for c in self.columns.values())
        return replace(self, columns={**self.columns, ROWS: np.arange(longest) / rate}, rate=rate)

    def column(self, name: str, wanted_by: str = "") -> np.ndarray:
        """Return one column as floats; dates as seconds since 1970, durations in seconds.

        Args:
            name: name of the column.
            wanted_by: the channel that asks for it, for the message.

        Raises:
            RecordingError: there is no such column, or a cell is not a number.
        """
        if name not in self.columns:
            if name == FILL_IN and wanted_by:
                raise RecordingError(
                    f"{self.source}: {wanted_by}: fill in the column that it is to be read from; "
                    f"there are {', '.join(map(str, self.columns))}"
                )
            asked = f", which {wanted_by} is to be read from" if wanted_by else ""
            raise RecordingError(
                f"{self.source}: no column {name!r}{asked}; {nearest(name, self.columns)}"
            )
        values = self.columns[name]
        if values.dtype.kind in "fiub":
            return values.astype(float)
        if values.dtype.kind in DATED:
            return in_seconds(values)
        return _numbers(values, f"{self.source}: column {name!r}")


def _numbers(values: np.ndarray, where: str) -> np.ndarray:
    """Convert a column of text or mixed cells, or say which cell is not a number."""
    numbers = np.empty(len(values))
    for row, cell in enumerate(values.tolist()):
        number = _number(cell)
        if number is None:
            hint = "; write decimals with a point" if "," in str(cell) else ""
            raise RecordingError(
                f"{where}, row {row}: {cell!r} is not a number; a recorded column holds numbers "
                f"only{hint}"
            )
        numbers[row] = number
    return numbers


def _number(cell: Any) -> float | None:
    if cell is None:
        return float("nan")
    text = str(cell).strip()
    if text.lower() in ("true", "false"):
        return float(text.lower() == "true")
    if not text:
        return float("nan")
    try:
        return float(text) if "_" not in text else None  # Python reads 1_0 as ten
    except ValueError:
        return None

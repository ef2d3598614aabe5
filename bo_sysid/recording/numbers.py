"""Arrays as numbers, and time stamps in seconds."""

import re
from typing import Any

import numpy as np
import pandas as pd

from bo_sysid.errors import RecordingError

DATED = "Mm"
"""Kinds of NumPy arrays that hold dates or durations."""

_DATE = r"\d{4}-\d\d-\d\d[T ]\d\d:\d\d:\d\d([.,]\d+)?(Z|[-+]\d\d:?\d\d)?"  # ISO 8601


def in_seconds(stamps: np.ndarray) -> np.ndarray:
    """Return dates as seconds since 1970, and durations in seconds; NaN where there is none."""
    passed = stamps - np.datetime64(0, "s") if stamps.dtype.kind == "M" else stamps
    return np.asarray(passed / np.timedelta64(1, "s"))


def dated(cells: np.ndarray) -> np.ndarray:
    """Return text that is dates, such as 2024-03-31T01:59:50.02Z, as dates in UTC.

    Cells of any other kind are returned as they are; a cell that is None has no date.
    """
    first = next((c for c in cells if not pd.isna(c)), None) if cells.dtype == object else None
    if not isinstance(first, str) or not re.fullmatch(_DATE, first.strip()):
        return cells  # text of another kind is not looked through
    text = pd.Series(cells, dtype="object").str.strip()
    if not (text.str.fullmatch(_DATE).eq(True) | text.isna()).all():
        return cells
    try:
        dates = pd.to_datetime(text.str.replace(",", "."), format="ISO8601", utc=True)
    except ValueError:  # no day of any month
        return cells
    return np.asarray(dates.dt.tz_localize(None))


def stamps(time: Any, where: str) -> np.ndarray:
    """Return time stamps in [s]: numbers as they are, dates and durations in seconds.

    Raises:
        RecordingError: they are none of these; the message begins with `where`.
    """
    if isinstance(getattr(time, "dtype", None), pd.DatetimeTZDtype):
        time = pd.Series(time).dt.tz_convert(None)  # in UTC
    if isinstance(time, np.ndarray | pd.Series | pd.Index) and time.dtype.kind in DATED:
        return in_seconds(np.asarray(time))
    return numbers(time, where)


def numbers(values: Any, where: str) -> np.ndarray:
    """Return samples as floats.

    Raises:
        RecordingError: they are no array of numbers; the message begins with `where`.
    """
    try:
        if np.ma.is_masked(values):
            values = np.ma.filled(np.ma.asarray(values).astype(float), np.nan)  # no samples
        array = np.asarray(values)
        if array.dtype.kind not in (*DATED, "c"):
            return array.astype(float)
        why = f"they are {array.dtype}"
    except (TypeError, ValueError) as error:
        why = str(error)
    raise RecordingError(f"{where}: samples must be numbers; {why}")

"""What the columns of a log may be, by their names and by how they behave."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace

import numpy as np
import pandas as pd

from bo_sysid.errors import RecordingError
from bo_sysid.recording import RawTable
from bo_sysid.recording.table import ROWS
from bo_sysid.recording.units import is_unit, unit
from bo_sysid.starter.naming import PLACED, PLACES, Column, named, named_after

_ALIKE = 0.9  # correlation of a column with a rate, from which on it is that rate
_LATE = 8  # samples that a speed may come late
_MOST = 20_000
_FEEDING = ("voltage", "current", "torque", "force")
"""Quantities that are no rate of a position, though a motor's speed may follow its voltage."""
BY_STEPS = "it alone rises in equal steps"
"""Why a column that is not called so is the clock."""


def describe(table: RawTable, elements: Sequence[str] = ()) -> tuple[Column, ...]:
    """Return the numeric columns of a table, with what they may be.

    Args:
        table: any.
        elements: names of joints and actuators; a column that is called like one, and nothing more,
            is no rate.

    Raises:
        RecordingError: no column is a clock.
    """
    found = []
    for name in table.columns:
        try:
            values = table.column(name)
        except RecordingError:
            continue  # text
        if np.isfinite(values).any():
            column = named(name, table.units.get(name, ""))
            still = column.kind == "time" and _stands_still(values)
            found.append(replace(column, kind="other", reason="") if still else column)
    if table.rate:
        found = [replace(c, kind="time") if c.name == ROWS else c for c in found]
    if not any(c.kind == "time" for c in found):
        found = _timed(table, found)
    return tuple(_behaved(table, _wished(table, found), elements))


def _stands_still(values: np.ndarray) -> bool:
    """Whether a column repeats itself most of the time, as whole seconds beside nanoseconds do."""
    steps = np.diff(values[np.isfinite(values)])
    return len(steps) > 1 and float(np.median(steps)) == 0


def spoilt(table: RawTable) -> tuple[str, ...]:
    """Return which cells keep columns that are numbers for the rest from being read."""
    found = []
    for name, values in table.columns.items():
        try:
            table.column(name)
        except RecordingError as error:
            numbers = pd.to_numeric(pd.Series(values), errors="coerce").notna()
            if 2 * numbers.sum() > len(values):
                found.append(str(error))
    return tuple(found)


def _unread_clocks(table: RawTable) -> list[str]:
    """Return which columns are called like a clock and are text or one number, and what reads."""
    found = []
    for name, values in table.columns.items():
        cells = pd.Series(values).dropna().astype(str)
        numbers = pd.to_numeric(cells, errors="coerce")
        if named(name, "").kind != "time" or not len(cells):
            continue
        if (numbers == numbers.iloc[0]).all():
            found.append(f"column {name!r} is called like one and never rises")
        elif numbers.isna().all():
            found.append(
                f"column {name!r} is called like one and holds text, as {cells.iloc[0]!r}: stamps "
                "are numbers, or times of day with or without a date: 2024-05-01 12:00:00.25"
            )
    return found


def _timed(table: RawTable, found: Sequence[Column]) -> list[Column]:
    """Find the clock by its behaviour: the column that only rises, in equal steps."""
    best, spread = "", 0.2
    for column in found:
        steps = np.diff(table.column(column.name))
        steps = steps[np.isfinite(steps)]
        if len(steps) > 2 and (steps > 0).all():
            share = float(np.std(steps) / np.mean(steps))
            if share < spread:
                best, spread = column.name, share
    if not best:
        raise RecordingError(
            f"{table.source}: no column looks like a clock among "
            f"{', '.join(repr(c.name) for c in found)}; expected one called time, t or stamp, or "
            "one that rises in equal steps; where rows came at a steady rate without stamps, say "
            "it: --rate 500 (in Hz)"
            + "".join(f"; {s}" for s in (*spoilt(table), *_unread_clocks(table)))
        )
    return [replace(c, kind="time", reason=BY_STEPS) if c.name == best else c for c in found]


def _wished(table: RawTable, found: Sequence[Column]) -> list[Column]:
    """Tell what was commanded where a column is called like another with a d (q_d beside q)."""
    known = {c.words: c for c in found}
    out = []
    for c in found:
        other = known.get(tuple(w for w in c.words if w != "d"))
        if "d" in c.words and other and c.kind == other.kind and _go_together(table, c, other):
            reason = f"it is what {other.name} was to be"
            c = replace(c, kind="command", reason=reason)
        out.append(c)
    return out


def _go_together(table: RawTable, one: Column, other: Column) -> bool:
    """Whether two columns are as alike as what was to be and what was."""
    a, b = table.column(one.name), table.column(other.name)
    finite = np.isfinite(a[: len(b)]) & np.isfinite(b[: len(a)])
    a, b = a[: len(finite)][finite], b[: len(finite)][finite]
    if len(a) <= 10 or np.ptp(a) == 0 or np.ptp(b) == 0:
        return False
    return float(np.corrcoef(a, b)[0, 1]) > _ALIKE


def _behaved(table: RawTable, found: Sequence[Column], elements: Sequence[str]) -> list[Column]:
    """Tell velocities that are called states (or nothing) by the positions they derive from."""
    doubtful = [c for c in found if _doubtful(c) and not named_after(elements, c)]
    places = [c.name for c in found if c.kind in ("position", "other")]
    rates = derivatives(table, places, [c.name for c in doubtful])
    out = []
    for c in found:
        if c.name in rates:
            c = replace(c, kind="velocity", reason=f"it is the rate of {rates[c.name]}")
        elif c.name in rates.values() and c.kind == "other":
            c = replace(c, kind="position", reason="another column is its rate")
        out.append(c)
    return out


def _doubtful(column: Column) -> bool:
    """Whether a name leaves open if a column is a position or a velocity."""
    if column.kind == "position":
        return column.unit not in PLACES and not PLACED & set(column.words)
    if is_unit(column.unit) and unit(column.unit, column.name).quantity in _FEEDING:
        return False
    return column.kind == "other"


def derivatives(
    table: RawTable, names: Sequence[str], among: Collection[str] | None = None
) -> Mapping[str, str]:
    """Return, for columns that are the rate of another, that other; the best pairs first.

    Args:
        table: any.
        names: columns that may be the rate of another, or have another as their rate.
        among: those of them that may be a rate; all where left out.
    """
    values = {n: table.column(n)[:_MOST] for n in names}
    values = {n: v for n, v in values.items() if np.isfinite(v).all() and np.ptp(v) > 0}
    smooth = {n: _smooth(_smooth(v)) for n, v in values.items()}
    rough = {n: _rough(v) for n, v in smooth.items()}
    place = {n: k for k, n in enumerate(values)}
    rating = [n for n in values if among is None or n in among]
    pairs = []
    for source, q in values.items():
        rate = _smooth(np.gradient(_smooth(q)))
        for name in rating:
            other = name == source or len(values[name]) != len(q)
            if other or _axes_of_one(name, source):
                continue
            faster = rough[name] / max(rough[source], 1e-300)
            later = place[name] > place[source]
            if faster > 1.1 or (faster > 0.9 and later):  # one tone: loggers put rates behind
                pairs.append((_likeness(rate, smooth[name]), name, source))
    rates: dict[str, str] = {}
    for likeness, name, source in sorted(pairs, reverse=True):
        free = name not in rates and source not in rates and name not in rates.values()
        if likeness > _ALIKE and free and source not in rates.values():
            rates[name] = source
    return rates


def _axes_of_one(name: str, other: str) -> bool:
    """Whether names differ in an axis alone: on a circle y goes like the rate of x."""
    axes = frozenset("xyzXYZ")
    unlike = [(a, b) for a, b in zip(name, other, strict=False) if a != b]
    return len(name) == len(other) and len(unlike) == 1 and axes.issuperset(unlike[0])


def _smooth(values: np.ndarray) -> np.ndarray:
    width = max(min(len(values) // 200, 5), 1)
    return np.convolve(values, np.ones(width) / width, mode="valid")


def _rough(smooth: np.ndarray) -> float:
    """Return how fast a column changes for its size: a rate changes faster than its integral."""
    return float(np.diff(smooth).std() / max(float(smooth.std()), 1e-300))


def _likeness(rate: np.ndarray, values: np.ndarray) -> float:
    """Return the largest correlation, where speeds may come some samples late (filters)."""
    best = 0.0
    for late in range(_LATE + 1):
        a, b = rate[: len(rate) - late], values[late:]
        if len(a) > 10 and a.std() > 0 and b.std() > 0:
            best = max(best, abs(float(np.corrcoef(a, b)[0, 1])))
    return best

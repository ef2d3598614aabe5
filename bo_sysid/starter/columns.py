"""What the columns of a log may be, by their names and by how they behave."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import pandas as pd

from bo_sysid.errors import RecordingError
from bo_sysid.recording import RawTable
from bo_sysid.recording.units import is_unit
from bo_sysid.recording.units import unit as unit_called

Kind = Literal["time", "position", "velocity", "command", "effort", "other"]

WORDS: dict[str, frozenset[str]] = {
    "time": frozenset({"time", "t", "timestamp", "stamp", "timestamps", "clock"}),
    "position": frozenset(
        {"position", "positions", "pos", "q", "qpos", "angle", "angles", "theta", "enc", "encoder",
         "state", "states", "joint", "x"}
    ),
    "velocity": frozenset(
        {"velocity", "velocities", "vel", "v", "qvel", "qd", "dq", "speed", "omega", "rate"}
    ),
    "command": frozenset(
        {"ctrl", "cmd", "command", "commands", "action", "goal", "target", "desired", "des", "ref",
         "reference", "setpoint", "input", "inputs", "u", "con", "control"}
    ),
    "effort": frozenset(
        {"torque", "tau", "tq", "trq", "effort", "efforts", "current", "cur", "curr", "amps", "pwm",
         "duty", "load", "force", "volts", "voltage", "thrust", "throttle"}
    ),
    "measured": frozenset({"meas", "measured", "present", "actual", "feedback", "applied"}),
}  # fmt: skip
"""Words in the names of columns, by what they say."""
UNITS = {
    "deg": "deg", "degrees": "deg", "rad": "rad", "ticks": "ticks", "mrad": "mrad", "ms": "ms",
    "us": "us", "ns": "ns", "rpm": "rpm", "mm": "mm", "percent": "%",
}  # fmt: skip
"""Units that names of columns carry as a word of theirs, in any letters."""
_ENDINGS = ("mA", "mNm", "Nm")
"""Units at the end of a name, in these letters."""
_ELECTRIC = {
    "A": frozenset({"i", "current", "cur", "curr", "amps"}),
    "V": frozenset({"u", "voltage", "volts"}),
}
"""Words beside which A and V at the end are units; alone they may be the name of a motor."""
_CONVENTION: dict[str, Kind] = {"qpos": "position", "qvel": "velocity", "ctrl": "command"}
_BRACKETS = re.compile(r"\[([^\[\]]+)\]|\(([^()]+)\)")
_BY_QUANTITY: dict[str, Kind] = {
    "angle": "position", "length": "position", "angular velocity": "velocity",
    "velocity": "velocity",
}  # fmt: skip
_PLACES = frozenset({"deg", "rad", "mrad", "ticks", "mm"})
"""Units of positions: a column that carries one and says nothing else is a position."""
_ALIKE = 0.9  # correlation of a column with a rate, from which on it is that rate
_LATE = 8  # samples that a speed may come late
_MOST = 20_000


@dataclass(frozen=True)
class Column:
    """A column of a log.

    Attributes:
        name: as in the file.
        kind: what it may be.
        words: the parts of its name, in small letters.
        unit: the unit that its name or the file says, empty where neither does.
        reason: why it is thought to be of its kind.
    """

    name: str
    kind: Kind
    words: tuple[str, ...]
    unit: str
    reason: str

    @property
    def commands(self) -> bool:
        """Whether it may be what an actuator was told."""
        return self.kind in ("command", "effort")


def describe(table: RawTable) -> tuple[Column, ...]:
    """Return the numeric columns of a table, with what they may be.

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
            found.append(_named(name, table.units.get(name, "")))
    if not any(c.kind == "time" for c in found):
        found = _timed(table, found)
    return tuple(_behaved(table, found))


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
    """Return which columns of text are called like a clock, and what could be read."""
    found = []
    for name, values in table.columns.items():
        cells = pd.Series(values).dropna().astype(str)
        text = pd.to_numeric(cells, errors="coerce").isna()
        if _named(name, "").kind == "time" and text.all() and len(cells):
            found.append(
                f"column {name!r} is called like one and holds text, as {cells.iloc[0]!r}: stamps "
                "are numbers, or dates with a time of day such as 2024-05-01 12:00:00.25"
            )
    return found


def words(name: str) -> tuple[str, ...]:
    """Return the parts of a name, split at marks, before capitals and before digits."""
    spaced = re.sub(r"([a-z])([A-Z])", r"\1 \2", name)
    return tuple(w.lower() for w in re.findall(r"[A-Za-z]+|\d+", spaced))


def named_unit(name: str) -> tuple[str, str]:
    """Return a name without the unit that it carries in brackets or at its end, and that unit."""
    for found in _BRACKETS.finditer(name):
        inside = (found[1] or found[2]).strip()
        if is_unit(inside) and not inside.isdigit():
            return f"{name[: found.start()]} {name[found.end() :]}".strip(), inside
    for ending in _ENDINGS:
        if re.search(rf"[^A-Za-z]{ending}$", name):
            return name[: -len(ending)], ending
    if re.search(r"[^A-Za-z][AV]$", name) and _ELECTRIC[name[-1]] & set(words(name[:-1])):
        return name[:-1], name[-1]
    return name, ""


def _named(name: str, unit: str) -> Column:
    by_channel = _CONVENTION.get(name.split(".", 1)[0]) if "." in name else None
    if by_channel is not None:  # the rest is the name of an element, and says nothing
        return Column(name, by_channel, words(name), unit, "its name")
    plain, told = named_unit(name)
    parts = words(plain)
    said = _said(parts)
    unit = unit or told or next((UNITS[w] for w in reversed(parts) if w in UNITS), "")
    bare = tuple(w for w in parts if w not in UNITS)
    kind: Kind = "other"
    if (bare and bare[-1] in WORDS["time"]) or parts[:1] == ("time",):
        kind = "time"
    elif "command" in said:
        kind = "command"
    elif "effort" in said:
        kind = "other" if "measured" in said else "effort"
    elif "velocity" in said:
        kind = "velocity"
    elif unit and parts[-1:] == ("s",) and unit in _PLACES:
        kind, unit = "velocity", f"{unit}/s"
    elif told:
        kind = _BY_QUANTITY.get(unit_called(told, name).quantity, "other")
        kind = "position" if kind == "other" and "position" in said else kind
    elif "position" in said or unit in _PLACES:
        kind = "position"
    return Column(name, kind, parts, unit, "its name" if kind != "other" else "")


def _said(parts: Sequence[str]) -> set[str]:
    """Return what the words of a name say; of the letters x and i, only where they come first."""
    plain = {w for k, w in enumerate(parts) if w != "x" or k == 0}
    said = {kind for kind, known in WORDS.items() if known & plain}
    return said | {"effort"} if parts[:1] == ("i",) and len(parts) > 1 else said


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
            "one that rises in equal steps"
            + "".join(f"; {s}" for s in (*spoilt(table), *_unread_clocks(table)))
        )
    return [
        replace(c, kind="time", reason="it alone rises in equal steps") if c.name == best else c
        for c in found
    ]


def _behaved(table: RawTable, found: Sequence[Column]) -> list[Column]:
    """Tell velocities that are called positions (or nothing) by the positions they derive from."""
    doubtful = [
        c for c in found if c.kind in ("position", "other") and not c.name.startswith("qpos.")
    ]
    rates = derivatives(table, [c.name for c in doubtful])
    out = []
    for c in found:
        if c.name in rates:
            c = replace(c, kind="velocity", reason=f"it is the rate of {rates[c.name]}")
        elif c.name in rates.values() and c.kind == "other":
            c = replace(c, kind="position", reason="another column is its rate")
        out.append(c)
    return out


def derivatives(table: RawTable, names: Sequence[str]) -> Mapping[str, str]:
    """Return, for columns that are the rate of another, that other; the best pairs first."""
    values = {n: table.column(n)[:_MOST] for n in names}
    values = {n: v for n, v in values.items() if np.isfinite(v).all() and np.ptp(v) > 0}
    pairs = []
    for source, q in values.items():
        rate = _smooth(np.gradient(_smooth(q)))
        for name, v in values.items():
            if name == source or len(v) != len(q) or _axes_of_one(name, source):
                continue
            faster = _rough(v) / max(_rough(q), 1e-300)
            later = list(values).index(name) > list(values).index(source)
            if faster > 1.1 or (faster > 0.9 and later):  # one tone: loggers put rates behind
                pairs.append((_likeness(rate, _smooth(_smooth(v))), name, source))
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


def _rough(values: np.ndarray) -> float:
    """Return how fast a column changes for its size: a rate changes faster than its integral."""
    smooth = _smooth(_smooth(values))
    return float(np.diff(smooth).std() / max(float(smooth.std()), 1e-300))


def _likeness(rate: np.ndarray, values: np.ndarray) -> float:
    """Return the largest correlation, where speeds may come some samples late (filters)."""
    best = 0.0
    for late in range(_LATE + 1):
        a, b = rate[: len(rate) - late], values[late:]
        if len(a) > 10 and a.std() > 0 and b.std() > 0:
            best = max(best, abs(float(np.corrcoef(a, b)[0, 1])))
    return best

"""What the name of a column says: its kind, its unit and its words."""

import re
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Literal

from bo_sysid.recording.units import is_unit
from bo_sysid.recording.units import unit as unit_called
from bo_sysid.recording.value import kind_of

Kind = Literal["time", "position", "velocity", "command", "effort", "foreign", "other"]
"""What a column may be: a foreign one is no channel at all, of another nothing is said."""

WORDS: dict[str, frozenset[str]] = {
    "time": frozenset(
        {"time", "t", "ts", "timestamp", "stamp", "timestamps", "clock", "elapsed", "epoch",
         "seconds", "millis", "micros", "zeit"}
    ),
    "position": frozenset(
        {"position", "positions", "pos", "q", "qpos", "angle", "angles", "theta", "enc", "encoder",
         "state", "states", "joint", "x", "y", "th", "phi", "alpha", "beta", "gamma",
         "winkel"}
    ),
    "velocity": frozenset(
        {"velocity", "velocities", "vel", "v", "qvel", "qd", "dq", "speed", "speeds", "omega",
         "rate", "dot", "geschwindigkeit", "drehzahl"}
    ),
    "command": frozenset(
        {"ctrl", "cmd", "command", "commands", "action", "actions", "goal", "goals", "target",
         "targets", "desired", "des", "ref", "reference", "setpoint", "setpoints", "input",
         "inputs", "u", "con", "control", "set", "soll", "sollwert"}
    ),
    "effort": frozenset(
        {"torque", "torques", "tau", "tq", "trq", "moment", "moments", "effort", "efforts",
         "current", "currents", "cur", "curr", "amps", "pwm", "duty", "load", "force", "forces",
         "volts", "voltage", "voltages", "thrust", "throttle", "drehmoment", "strom"}
    ),
    "foreign": frozenset(
        {"error", "errors", "acceleration", "accelerations", "accel", "acc", "ddq", "qdd",
         "temperature", "temperatures", "temp"}
    ),
    "measured": frozenset({"meas", "measured", "present", "actual", "feedback", "applied",
                           "act", "ist", "istwert"}),
}  # fmt: skip
"""Words in the names of columns, by what they say."""
PLACED = WORDS["position"] - {
    "state", "states", "joint", "x", "y", "alpha", "beta", "gamma",
}  # fmt: skip
"""Words of positions alone; a velocity may be a state or an output as well, or a Greek letter."""
UNITS = {
    "deg": "deg", "degrees": "deg", "rad": "rad", "ticks": "ticks", "mrad": "mrad", "ms": "ms",
    "us": "us", "ns": "ns", "msec": "ms", "usec": "us", "nsec": "ns", "rpm": "rpm", "mm": "mm",
    "percent": "%", "pct": "%", "grad": "deg", "counts": "ticks", "gf": "gf", "kgf": "kgf",
    "lbf": "lbf",
}  # fmt: skip
"""Units that names of columns carry as a word of theirs, in any letters."""
_ENDINGS = ("mA", "mNm", "Nm", "Ncm", "kN", "mV", "kPa", "MPa", "turns", "revs", "cm")
"""Units at the end of a name, in these letters."""
_CURRENT = frozenset({"i", "current", "cur", "curr", "amps"})
_TURNED = frozenset({"position", "pos", "angle", "encoder", "enc"})
_PRESSED = frozenset({"p", "pressure", "druck"})
_ELEMENTS = frozenset({"axis", "joint", "phase", "link", "leg"})
"""Words beside which a V at the end is the name of an element, as W is."""
_BESIDE = {
    "A": ("A", _CURRENT), "ma": ("mA", _CURRENT), "V": ("V", frozenset({"u", "voltage", "volts"})),
    "rev": ("rev", _TURNED), "turn": ("turn", _TURNED), "bar": ("bar", _PRESSED),
    "psi": ("psi", _PRESSED), "Pa": ("Pa", _PRESSED),
}  # fmt: skip
"""Endings and words beside which they are units; alone they may be the name of an element."""
_PER_SECOND = {
    "deg": "deg", "degrees": "deg", "rad": "rad", "mrad": "mrad", "mm": "mm", "cm": "cm",
    "turn": "turn", "turns": "turn", "rev": "rev", "revs": "rev",
}  # fmt: skip
_GYROSCOPES = frozenset({"gyro", "gyros", "gyroscope"})
_SECONDS = {"s": "s", "sec": "s", "secs": "s", "seconds": "s", "millis": "ms", "micros": "us"}
"""Units that names of clocks carry as a word of theirs, which in other names may be an element."""
_RATES = {"dps": "deg/s", "degps": "deg/s", "radps": "rad/s", "mmps": "mm/s"}
"""Units of rates, by the words that stand before a second, and as one word."""
_CONVENTION: dict[str, Kind] = {"qpos": "position", "qvel": "velocity", "ctrl": "command"}
_BRACKETS = re.compile(r"\[([^\[\]]+)\]|\(([^()]+)\)")
_BY_QUANTITY: dict[str, Kind] = {
    "time": "time",
    "angle": "position", "length": "position", "angular velocity": "velocity",
    "velocity": "velocity",
}  # fmt: skip
PLACES = frozenset({"deg", "rad", "mrad", "ticks", "mm"})
"""Units of positions: a column that carries one and says nothing else is a position."""


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


def words(name: str) -> tuple[str, ...]:
    """Return the parts of a name, split at marks, before capitals and before digits."""
    spaced = re.sub(r"([^\W\d_A-Z])([A-Z])", r"\1 \2", name)
    return tuple(w.lower() for w in re.findall(r"[^\W\d_]+|\d+", spaced))


def named_unit(name: str) -> tuple[str, str]:
    """Return a name without the unit that it carries in brackets or at its end, and that unit."""
    for found in _BRACKETS.finditer(name):
        inside = (found[1] or found[2]).strip()
        if is_unit(inside) and not inside.isdigit():
            return f"{name[: found.start()]} {name[found.end() :]}".strip(), inside
    for ending in _ENDINGS:
        if re.search(rf"[^A-Za-z]{ending}$", name):
            return name[: -len(ending)], ending
    for ending, (unit, beside) in _BESIDE.items():
        if re.search(rf"[^A-Za-z]{ending}$", name) and beside & set(words(name[: -len(ending)])):
            return name[: -len(ending)], unit
    if re.search(r"[^A-Za-z]V$", name) and not _ELEMENTS & set(words(name)):
        return name[:-1], "V"
    return name, ""


def _rate(parts: Sequence[str]) -> str:
    """Return the unit of a rate with which a name ends, as in elbow_vel_deg_s; empty if none."""
    left = [w for w in parts if not w.isdigit() and w != "per"]
    if left[-1:] and left[-1] in _RATES:
        return _RATES[left[-1]]
    place = _PER_SECOND.get(left[-2], "") if len(left) > 1 and left[-1] in ("s", "sec") else ""
    return f"{place}/s" if place else ""


def named(name: str, unit: str) -> Column:
    """Return a column as its name and the unit that the file states describe it."""
    plain, unit_word = named_unit(name)
    parts = words(plain)
    kinds = _kinds_of(parts)
    unit_word = unit_word or _rate(parts)
    unit = unit or unit_word or next((UNITS[w] for w in reversed(parts) if w in UNITS), "")
    by_channel = _CONVENTION.get(kind_of(name)) if "." in name else None
    if by_channel is not None:  # the rest is the name of an element, and says nothing of the kind
        return Column(name, by_channel, words(name), unit, "its name")
    bare = tuple(w for k, w in enumerate(parts) if w not in UNITS and (k == 0 or w not in _SECONDS))
    kind: Kind = "other"
    if (bare and bare[-1] in WORDS["time"]) or parts[:1] == ("time",):
        kind = "time"
        unit = unit or next((_SECONDS[w] for w in reversed(parts) if w in _SECONDS), "")
    elif "foreign" in kinds or _of_gyroscope(parts, kinds):
        kind = "foreign"
    elif "command" in kinds:
        kind = "command"
    elif "effort" in kinds:
        kind = "other" if "measured" in kinds else "effort"
    elif "velocity" in kinds:
        kind = "velocity"
    elif unit == "ticks" and parts[-1:] == ("s",):
        kind, unit = "velocity", ""
    elif unit_word:
        kind = _BY_QUANTITY.get(unit_called(unit_word, name).quantity, "other")
        kind = "position" if kind == "other" and "position" in kinds else kind
        kind = "effort" if unit_word == "V" and kind == "other" and not kinds else kind
    elif "position" in kinds or unit in PLACES or ("measured" in kinds and "applied" not in parts):
        kind = "position"  # what was measured, of which nothing else is said
    if kind == "velocity" and unit in _PER_SECOND:  # vel_deg
        unit = f"{_PER_SECOND[unit]}/s"
    return Column(name, kind, parts, unit, "its name" if kind != "other" else "")


def _of_gyroscope(parts: Sequence[str], kinds: Collection[str]) -> bool:
    """Whether a column is an axis of a gyroscope, which turns with a body and not with a joint."""
    about = bool(_GYROSCOPES & set(parts)) or ("imu" in parts and "velocity" in kinds)
    return about and parts[-1] in ("x", "y", "z")


def _kinds_of(parts: Sequence[str]) -> set[str]:
    """Return what the words of a name say; of letters x, y and i, only where they come first."""
    plain = {w for k, w in enumerate(parts) if w not in ("x", "y") or k == 0}
    kinds = {kind for kind, known in WORDS.items() if known & plain}
    if WORDS["effort"] & plain == {"current"} and (PLACED | WORDS["velocity"]) & plain:
        kinds = kinds - {"effort"}  # the present one
    return kinds | {"effort"} if parts[:1] == ("i",) and len(parts) > 1 else kinds


def named_after(elements: Sequence[str], column: Column) -> bool:
    """Whether a column of no other kind is called like an element, and nothing more."""
    return column.kind == "other" and set(column.words) in [set(words(e)) for e in elements]

"""Units of recorded columns, and their SI equivalents.

Angles and lengths, their rates, forces, torques and pressures, and the electrical quantities that
logs carry.
A unit names a quantity, so that a velocity given for a position is refused and not rescaled,
whether a rule gives it or the file.
"""

import re
from dataclasses import dataclass
from math import pi

from bo_sysid.errors import RecordingError, nearest


@dataclass(frozen=True)
class Unit:
    """A unit of measurement.

    Attributes:
        quantity: what is measured, "angle" for instance.
        si: the SI unit of the same quantity, as channels carry it.
        factor: SI value of one unit; None where only the user knows it (encoder ticks).
    """

    quantity: str
    si: str
    factor: float | None


_TURN = 2 * pi
_DEGREE = pi / 180

# quantity: SI unit, then the factor of each accepted name
_QUANTITIES: dict[str, tuple[str, dict[str, float]]] = {
    "time": ("s", {"s": 1, "sec": 1, "ms": 1e-3, "us": 1e-6, "µs": 1e-6, "ns": 1e-9, "min": 60}),
    "angle": (
        "rad",
        {"rad": 1, "mrad": 1e-3, "deg": _DEGREE, "°": _DEGREE, "turn": _TURN, "rev": _TURN},
    ),
    "length": ("m", {"m": 1, "cm": 1e-2, "mm": 1e-3, "um": 1e-6, "µm": 1e-6, "in": 0.0254}),
    "angular velocity": (
        "rad/s",
        {
            "rad/s": 1,
            "mrad/s": 1e-3,
            "deg/s": _DEGREE,
            "°/s": _DEGREE,
            "rpm": _TURN / 60,
            "rev/min": _TURN / 60,
            "rps": _TURN,
            "rev/s": _TURN,
            "turn/s": _TURN,
        },
    ),
    "velocity": ("m/s", {"m/s": 1, "cm/s": 1e-2, "mm/s": 1e-3, "km/h": 1 / 3.6}),
    "angular acceleration": ("rad/s²", {"rad/s²": 1, "rad/s2": 1, "deg/s²": _DEGREE}),
    "acceleration": ("m/s²", {"m/s²": 1, "m/s2": 1, "mm/s²": 1e-3, "g0": 9.80665}),
    "torque": ("N m", {"N m": 1, "mN m": 1e-3, "N cm": 1e-2, "N mm": 1e-3, "kgf cm": 0.0980665}),
    "force": (
        "N",
        {"N": 1, "mN": 1e-3, "kN": 1e3, "kgf": 9.80665, "gf": 9.80665e-3, "lbf": 4.4482216},
    ),
    "pressure": (
        "Pa",
        {"Pa": 1, "kPa": 1e3, "MPa": 1e6, "mbar": 1e2, "bar": 1e5, "psi": 6894.757},
    ),
    "voltage": ("V", {"V": 1, "mV": 1e-3}),
    "current": ("A", {"A": 1, "mA": 1e-3, "uA": 1e-6, "µA": 1e-6}),
    "power": ("W", {"W": 1, "mW": 1e-3, "kW": 1e3}),
    "mass": ("kg", {"kg": 1, "g": 1e-3}),
    "frequency": ("Hz", {"Hz": 1, "kHz": 1e3}),
    "ratio": ("", {"": 1, "1": 1, "%": 1e-2, "percent": 1e-2}),
    "temperature": ("°C", {"°C": 1, "degC": 1}),
}
_ALIASES = {
    "degree": "deg",
    "degrees": "deg",
    "radian": "rad",
    "radians": "rad",
    "turns": "turn",
    "revs": "rev",
    "turns/s": "turn/s",
    "degrees/s": "deg/s",
    "dps": "deg/s",
    "RPM": "rpm",
    "seconds": "s",
    "Nm": "N m",
    "N-m": "N m",
    "mNm": "mN m",
    "Nmm": "N mm",
    "Ncm": "N cm",
    "volt": "V",
    "volts": "V",
    "amp": "A",
    "bool": "",
}

UNITS: dict[str, Unit] = {
    name: Unit(quantity, si, float(factor))
    for quantity, (si, names) in _QUANTITIES.items()
    for name, factor in names.items()
} | {name: Unit("count", "", None) for name in ("tick", "ticks", "count", "counts")}

# what a kind of channel can be measured in; kinds that are not named take any quantity
QUANTITIES_OF_KIND: dict[str, tuple[str, ...]] = {
    "time": ("time",),
    "qpos": ("angle", "length", "ratio", "count"),
    "qvel": ("angular velocity", "velocity", "ratio", "count"),
}


def unit(name: str, where: str) -> Unit:
    """Return the unit called `name`.

    Args:
        name: as written by the user; products may be joined by a space, ``*`` or ``·``.
        where: file and channel, for the message.

    Raises:
        RecordingError: the unit is unknown.
    """
    plain = _plain(name)
    if plain not in UNITS:
        raise RecordingError(
            f"{where}: unknown unit {name!r} ({nearest(name, UNITS)}). For any other unit leave "
            "`unit` out and give `scale`, the SI value of one"
        )
    return UNITS[plain]


def is_unit(name: str) -> bool:
    """Whether `unit` knows a unit called `name`."""
    return _plain(name) in UNITS


def unit_of_kind(name: str, kind: str, where: str) -> Unit:
    """Return the unit called `name`, if a channel of this kind can be measured in it.

    Raises:
        RecordingError: the unit is unknown, or measures another quantity than the channel.
    """
    found = unit(name, where)
    if kind == "sensor" and found.quantity == "mass":
        raise RecordingError(
            f"{where}: unit {name!r} measures mass, which no sensor does; multiples of the "
            "acceleration of gravity are in g0"
        )
    allowed = QUANTITIES_OF_KIND.get(kind)
    if allowed is not None and found.quantity not in allowed:
        valid = [n for n, u in UNITS.items() if u.quantity in allowed and n]
        raise RecordingError(
            f"{where}: unit {name!r} measures {found.quantity or 'nothing'}, but {kind} must be "
            f"{' or '.join(q for q in allowed if q not in ('ratio', 'count'))}; "
            f"{nearest(name, valid)}"
        )
    return found


def require_scale(found: Unit, name: str, scale: float, where: str) -> None:
    """Raise `RecordingError` where only the user knows what one `name` is, and did not say it."""
    if found.factor is None and scale == 1.0:
        raise RecordingError(
            f"{where}: unit {name!r} needs `scale`, the SI value of one (an encoder of 4096 ticks "
            f"a turn has scale: {2 * pi / 4096:.6g}; a number that is meant as it is has unit: '1')"
        )


def _plain(name: str) -> str:
    plain = " ".join(name.replace("*", " ").replace("·", " ").split())
    plain = re.sub(r"/sec$", "/s", plain)
    return _ALIASES.get(plain, plain)

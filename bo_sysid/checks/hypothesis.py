"""What a channel may really be: another column, sign, unit, zero."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from math import isclose, pi

Units = Sequence[tuple[str, float]]
ANGLES: Units = (("deg", pi / 180), ("mrad", 1e-3), ("turn", 2 * pi), ("ticks", 2 * pi / 4096))
LENGTHS: Units = (("mm", 1e-3), ("cm", 1e-2))
UNDONE: Mapping[str, Units] = {"rad": (("rad", 180 / pi),), "m": (("m", 1e3), ("m", 1e2))}
"""By SI unit, the ways back to it where deg, mm or cm was stated and is wrong."""
INPUTS: Units = (("milli", 1e-3), ("%", 1e-2), ("PWM", 1 / 255))
"""Other units that a control may be in, with their SI values: mN m or mA, per cent, −255…255."""
CENTRED = "angles counted from one end"
"""The fault that all angles are off by half of what their servos count."""
COUNTED = (2 * pi, 5 * pi / 3)
"""What servos count over from one end, in [rad]: 360 and 300 degrees."""
FREE = "of its own"
"""Unit of a motor's control whose value follows from the recordings (motors.py)."""

_ABOUT = 0.02  # [rad] beside the middle


@dataclass(frozen=True, order=True)
class Wire:
    """How a channel follows from a recorded one: sign · scale · recorded + offset - less.

    Attributes:
        source: name of the recorded channel.
        sign: 1 or -1.
        scale: SI value of its unit.
        offset: added last, in SI units.
        unit: name of the unit, where it is not what it was taken for; `FREE` for a motor's own.
        less: channel whose wire shows what this one shows as well; empty for nothing.
    """

    source: str
    sign: int = 1
    scale: float = 1.0
    offset: float = 0.0
    unit: str = ""
    less: str = ""

    @property
    def centred(self) -> bool:
        """Whether its zero is the middle of what a servo counts from one end."""
        return any(isclose(self.offset, -turn / 2, abs_tol=_ABOUT) for turn in COUNTED)

    def plain(self, name: str) -> bool:
        """Whether the channel `name` is what was recorded as such."""
        return self == Wire(name)


@dataclass(frozen=True)
class WiringHypothesis:
    """What all channels are.

    Attributes:
        wires: by channel of the model.
        delay: how much later than stamped the controls act, in [s].
        causes: the faults that it supposes, each a short sentence.
    """

    wires: Mapping[str, Wire]
    delay: float = 0.0
    causes: tuple[str, ...] = ()

    def with_wires(self, changed: Mapping[str, Wire], cause: str) -> "WiringHypothesis":
        """Return the hypothesis with one more fault."""
        return replace(self, wires={**self.wires, **changed}, causes=(*self.causes, cause))

    @property
    def key(self) -> tuple[object, ...]:
        """What makes two hypotheses the same."""
        return (*sorted(self.wires.items()), round(self.delay, 6))

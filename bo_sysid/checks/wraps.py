"""Angles that jump by a turn: found in the samples, before anything else is looked at."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import pi

import numpy as np

from bo_sysid.checks.flags import Flag
from bo_sysid.recording import Channel, Recording

PERIODS = (2 * pi, pi, 360.0, 1.0, 256.0, 1024.0, 4096.0, 65536.0)
"""Jumps that are a turn: in radians, degrees, turns, encoder ticks."""
_NEAR = 0.12  # relative difference of a jump from a turn
_CLEAR = 4.0  # times the largest step that is no jump


@dataclass(frozen=True)
class Wrap:
    """A channel that jumps.

    Attributes:
        period: size of the jump, in the channel's unit.
        jumps: how often it jumps.
    """

    period: float
    jumps: int


def find_wraps(recordings: Sequence[Recording]) -> dict[str, Wrap]:
    """Return the position channels that jump by a turn."""
    found: dict[str, Wrap] = {}
    for name in dict.fromkeys(n for r in recordings for n in r.channels if n.startswith("qpos.")):
        steps = np.concatenate(
            [np.diff(r.channels[name].values) for r in recordings if name in r.channels]
        )
        wrap = _wrap(steps)
        if wrap is not None:
            found[name] = wrap
    return found


def _wrap(steps: np.ndarray) -> Wrap | None:
    size = np.abs(steps)
    for period in PERIODS:
        jump = np.abs(size - period) < _NEAR * period
        rest = size[~jump]
        if jump.any() and (not rest.size or rest.max() * _CLEAR < period):
            return Wrap(period, int(jump.sum()))
    return None


def unwrapped(recordings: Sequence[Recording], wraps: Mapping[str, Wrap]) -> tuple[Recording, ...]:
    """Return the recordings with the jumps taken out."""
    if not wraps:
        return tuple(recordings)
    out = []
    for r in recordings:
        channels = dict(r.channels)
        for name, wrap in wraps.items():
            if name in channels:
                c = channels[name]
                values = np.unwrap(c.values, period=wrap.period)
                channels[name] = Channel(c.time, values, c.unit, c.source, c.hold)
        out.append(Recording(r.name, channels, r.notes))
    return tuple(out)


def wrap_flags(wraps: Mapping[str, Wrap]) -> list[Flag]:
    """Return a flag for each channel that jumps."""
    return [
        Flag(
            "wrong",
            "wrap",
            (name,),
            f"{name} jumps by {wrap.period:g} {wrap.jumps} time{'s' * (wrap.jumps > 1)}: an angle "
            "that wraps round.",
            {"period": wrap.period, "jumps": wrap.jumps},
        )
        for name, wrap in wraps.items()
    ]

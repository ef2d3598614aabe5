"""Angles that jump by a turn, and registers read without their sign: found in the samples."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from bo_sysid.checks.flags import Flag
from bo_sysid.recording import Channel, Recording
from bo_sysid.recording.alignment import GAP
from bo_sysid.recording.mapping import turns_at_start, twos_complement
from bo_sysid.recording.outliers import PERIODS

_NEAR = 0.12  # relative difference of a jump from a turn
_CLEAR = 4.0  # times the largest step that is no jump
_WORDS = (16, 32)  # bits
_SEVERAL = 4  # different values at least; of two, a motor may be switched on and off


@dataclass(frozen=True)
class Wrap:
    """A channel that jumps.

    Attributes:
        period: size of the jump, in the channel's unit.
        jumps: how often it jumps.
        signed: bits of the register, where it is one that was read without its sign; else 0.
    """

    period: float
    jumps: int
    signed: int = 0

    def removed(self, values: np.ndarray) -> np.ndarray:
        """Return samples without the jumps."""
        if self.signed:
            return twos_complement(values, self.signed, "register")
        whole = np.unwrap(values, period=self.period)
        return np.asarray(whole - turns_at_start(whole, self.period) * self.period)


def find_wraps(recordings: Sequence[Recording]) -> dict[str, Wrap]:
    """Return the position channels that jump by a turn, and registers without their sign."""
    found: dict[str, Wrap] = {}
    others = (n for r in recordings for n in r.channels if not n.startswith("qpos."))
    for name in dict.fromkeys(others):
        values = [r.channels[name].values for r in recordings if name in r.channels]
        word = _word(np.concatenate(values))
        if word is not None:
            found[name] = word
    for name in dict.fromkeys(n for r in recordings for n in r.channels if _turns(n)):
        steps = np.concatenate([_steps(r.channels[name]) for r in recordings if name in r.channels])
        wrap = _wrap(steps)
        if wrap is not None:
            found[name] = wrap
    return found


def _turns(name: str) -> bool:
    """Whether a channel is a position of one number: signs of a quaternion flip without a turn.

    A joint may be called 1, so that ``qpos.1`` is one and ``qpos.root.1`` is not.
    """
    kind, _, rest = name.partition(".")
    joint, _, index = rest.rpartition(".")
    return kind == "qpos" and not (joint and index.isdigit())


def _steps(channel: Channel) -> np.ndarray:
    """Return the steps between neighbouring samples; over a gap a joint may move by anything."""
    intervals = np.diff(channel.time)
    if not intervals.size:
        return intervals
    whole = intervals <= GAP * np.median(intervals)
    return np.asarray(np.diff(channel.values)[whole])


def _wrap(steps: np.ndarray) -> Wrap | None:
    """Return the turn by which steps jump.

    A jump of 1.0 must come twice, and something must move between: a joint in rad or m may be
    knocked as far once, and a gripper that is told as 0 or 1 does nothing else.
    """
    size = np.abs(steps)
    for period in PERIODS:
        jump = np.abs(size - period) < _NEAR * period
        rest = size[~jump]
        least = 2 if period == 1.0 else 1
        still = period == 1.0 and not rest.any()
        if jump.sum() >= least and not still and (not rest.size or rest.max() * _CLEAR < period):
            return Wrap(period, int(jump.sum()))
    return None


def _word(values: np.ndarray) -> Wrap | None:
    """Return the register that integers come from which lie at both ends of its range alone."""
    values = values[np.isfinite(values)]
    if not values.size or values.min() < 0 or (values != np.rint(values)).any():
        return None
    if len(np.unique(values)) < _SEVERAL:
        return None
    for bits in _WORDS:
        share = values / 2.0**bits
        ends = (share < 0.25).any() and (share > 0.75).any() and share.max() < 1.0
        if ends and not ((share > 0.25) & (share < 0.75)).any():
            return Wrap(2.0**bits, int(np.count_nonzero(np.diff(share > 0.5))), bits)
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
                channels[name] = replace(c, values=wrap.removed(c.values))
        out.append(replace(r, channels=channels))
    return tuple(out)


def wrap_flags(wraps: Mapping[str, Wrap]) -> list[Flag]:
    """Return a flag for each channel that jumps."""
    return [
        Flag(
            "wrong",
            "wrap",
            (name,),
            f"{name} jumps by {wrap.period:g} {wrap.jumps} time{'s' * (wrap.jumps > 1)}: "
            + (
                f"a register of {wrap.signed} bits that was read without its sign."
                if wrap.signed
                else "an angle that wraps round."
            ),
            {"period": wrap.period, "jumps": wrap.jumps},
        )
        for name, wrap in wraps.items()
    ]

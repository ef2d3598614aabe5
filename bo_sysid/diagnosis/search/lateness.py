"""Sets that make a machine late: how early their windows begin, and which stand for one another."""

from collections.abc import Iterable, Sequence

from bo_sysid.diagnosis.sets.fit import Fit
from bo_sysid.diagnosis.windows.problem import ROUGH

_LATE = ("actuator_delay", "sensor_delay")  # one may be told as the other
_FAR = 2.0  # times what the leader leaves, above which a rival's delay does not count


def lead_of(chosen: Sequence[Fit]) -> float:
    """Return how much earlier in [s] than they are compared windows begin, for sets, leader first.

    Not at all far from the recordings, where what is missing moves a longer window further, and not
    for a rival that is far from the leader.
    """
    if chosen[0].rms > ROUGH:
        return 0.0
    return max(_lateness(f) for f in chosen if f.rms <= _FAR * chosen[0].rms)


def _lateness(fit: Fit) -> float:
    """Return by how much in [s] the delays of a set make a machine late, one behind the other.

    A late encoder shows in the first instants of a window what was before it. How a motion went on
    there is known where windows begin earlier; continued backwards with the acceleration of its
    start, it was off by 4 sigma² where held commands change the acceleration from one step to the
    next, and a late command was told in its place.
    """
    late = [float(x[0]) for c, x in zip(fit.members, fit.x, strict=True) if c.effect.id in _LATE]
    return sum(late)


def late_elsewhere(fits: Iterable[Fit], leader: Fit) -> list[Fit]:
    """Return the sets that have another delay in the place of one of a leader's, nearest first.

    Where motors are late a window shows what its start does at once, and where encoders are it
    shows that later. A start that is moved by the slopes of the other does not come to where it
    fits: behind a stiff servo a late encoder left 2.2 sigma beside a late command's 1.01, and as
    much as that once it was fitted by its own slopes.
    """
    return sorted(
        (f for f in fits if f.exchanges_one(leader) and _exchanges_delays(f, leader)),
        key=lambda f: f.rms,
    )


def _exchanges_delays(fit: Fit, leader: Fit) -> bool:
    return all(effect in _LATE for effect, _ in fit.effects ^ leader.effects)

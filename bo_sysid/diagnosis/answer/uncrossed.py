"""Plays whose two ends the recordings do not both show: their size is then told by nothing."""

from collections.abc import Sequence

from bo_sysid.diagnosis.answer.wording import spoken
from bo_sysid.diagnosis.sets.fit import Fit
from bo_sysid.diagnosis.windows.problem import Problem
from bo_sysid.effects import Hidden, Site

_NEAR = 0.1  # share of a play from its end, within which it is at that end
_RARE = 0.02  # share of the windows, below which an end that is reached there tells nothing


def uncrossed_plays(problem: Problem, fit: Fit) -> tuple[str, ...]:
    """Return the joints whose play rests at one of its ends in nearly all windows.

    A load that never reverses holds a gear against one flank: that is an offset, however wide the
    gap is.

    Args:
        problem: all windows.
        fit: the answer.
    """
    joints = [c.site.name for c in fit.members if c.effect.id == "backlash"]
    if not joints:
        return ()
    shown = problem.simulate(fit.hypothesis, fit.start)
    added = {p.of: p.joint for p in shown.parts if isinstance(p, Hidden)}
    found = []
    for name in joints:
        play = shown.model.joint(added[name])
        low, high = play.range
        share = (shown.whole.qpos[..., int(play.qposadr[0])] - low) / (high - low)
        ends = (share.min(axis=1) < _NEAR).mean(), (share.max(axis=1) > 1.0 - _NEAR).mean()
        if min(ends) < _RARE:
            found.append(name)
    return tuple(found)


def uncrossed_sentence(joints: Sequence[str]) -> str:
    """Return in words that a play was not crossed, and what would tell its size."""
    which = " and ".join(spoken(Site("joint", name)) for name in joints)
    return (
        f"The play at {which} hardly ever changes from one of its ends to the other in these "
        "recordings: a load that always pushes the same way does that. How wide it is they do not "
        "tell, nor an offset from it: motions on which the load reverses would."
    )

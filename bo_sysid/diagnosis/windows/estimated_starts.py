"""The start of every window, estimated from what was recorded of it and a wide prior.

Where no small step leads to the start, fits begin from several: on either side of a gap, at rest
where friction may hold a joint, in contact from a window's first part on and from draws.
"""

import numpy as np
from jaxtyping import Float

from bo_sysid.diagnosis.windows.fitted_starts import FittedStarts
from bo_sysid.diagnosis.windows.hypothesis import Hypothesis
from bo_sysid.diagnosis.windows.problem import ROUGH, Problem
from bo_sysid.simulation import State

_WORTH = 1e-3  # of what a window leaves beyond noise, for which starts to judge by are moved
_FEW = 0.4  # share of the windows that may be near the recordings where the others are far
_IN_A_GAP = 4  # first starts of each window, where a joint moves in a gap


def estimated(
    problem: Problem, hypothesis: Hypothesis, finer: int, *, resting: bool = False
) -> State:
    """Return the least-squares start of every window.

    Args:
        problem: its windows begin where a smoother says.
        hypothesis: simulates.
        finer: divides the time step.
        resting: whether slow joints with friction are tried at rest where a window leaves more than
            noise: no small change of the start leads from one to the other.
    """
    first, *more = first_starts(problem, hypothesis, finer)
    found = FittedStarts(problem, hypothesis, first, finer, worth=_WORTH)
    found.fit()
    for start in more:
        found.tried(np.arange(len(first)), start)
    if problem.machine.impacts:
        found.grown()
        found.multistart()
    if resting:
        found.rested()
    return found.start


def caught_up(
    problem: Problem, hypothesis: Hypothesis, start: State
) -> tuple[State, Float[np.ndarray, "W R"]]:
    """Return starts and residuals where windows that leave more than noise were fitted on.

    In contact a start decides when something is touched, and no small step leads from one order of
    impacts to another; what is left there asks for names that are not there. Each such window
    begins anew at the smoother's start and is fitted to its first part, then to more of it, and
    from starts drawn about the smoother's. Elsewhere those begin anew that leave much more than
    others. Slow joints that friction may hold are tried at rest,
    far from the recordings in half of the windows: all of them leave more than noise there.

    Args:
        problem: the windows.
        hypothesis: simulates.
        start: starts so far.
    """
    found = FittedStarts(problem, hypothesis, start, 1)
    if problem.machine.impacts:
        found.grown()
        found.multistart()
    else:
        found.refit_from_recorded()
    far = _far(found)
    found.rested(half=far)
    if far and not _far(found):  # only the starts were
        found.rested()
    return found.start, found.residual


def _far(found: FittedStarts) -> bool:
    """Whether most windows leave much more than noise."""
    return bool(np.quantile(found.level, _FEW) > ROUGH**2)


def on_the_right_side(problem: Problem, hypothesis: Hypothesis, start: State) -> State:
    """Return starts that are fitted on, for a hypothesis with a joint that moves in a gap.

    Windows that leave more than noise are fitted from all places where that joint may begin.

    Args:
        problem: the windows.
        hypothesis: simulates.
        start: starts so far.
    """
    found = FittedStarts(problem, hypothesis, start, 1)
    found.fit()
    rows = found.left_behind()
    if rows.size:
        for first in first_starts(problem.rows(rows), hypothesis):
            found.tried(rows, first)
    return found.start


def first_starts(problem: Problem, hypothesis: Hypothesis, finer: int = 1) -> list[State]:
    """Return first starts: for each window what leaves least, then what leaves a little more.

    More than one only where a joint moves in a gap: with what speed it is on its way there decides
    when it arrives, and no step leads from one arrival to another.

    Args:
        problem: its windows begin where a smoother says.
        hypothesis: simulates.
        finer: divides the time step.
    """
    smooth = problem.smoothed(hypothesis)
    tried = [smooth, *problem.starts(hypothesis, smooth, moving=True)]
    if len(tried) == 1:
        return tried
    left = [(problem.residual(hypothesis, s, finer) ** 2).sum(axis=1) for s in tried]
    found = []
    for rank in np.argsort(left, axis=0)[: _IN_A_GAP if problem.loose(hypothesis) else 1]:
        start = smooth
        for k, other in enumerate(tried):
            start = start.picked(rank == k, other)
        found.append(start)
    return found

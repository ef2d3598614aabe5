"""Starts that follow a hypothesis along one response to them, window by window.

Cheap, and enough near the recordings; `fitted_starts` fits every window as a problem of its own.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float

from bo_sysid.diagnosis.windows.hypothesis import Hypothesis
from bo_sysid.diagnosis.windows.linear import Linear
from bo_sysid.diagnosis.windows.problem import Problem
from bo_sysid.simulation import State

# [sigma²] of a window, for which its start is moved; with 1e-3 a set of two ended elsewhere
_WORTH = 1e-6


def settle(
    problem: Problem,
    frame: Linear,
    hypothesis: Hypothesis,
    start: State,
    steps: int = 2,
    shares: Sequence[float] = (1.0,),
    r: Float[np.ndarray, "W R"] | None = None,
) -> tuple[State, Float[np.ndarray, "W R"]]:
    """Move the starts to where the residual is least, window by window.

    Args:
        problem: the windows.
        frame: gives the response to the start.
        hypothesis: what is simulated.
        start: first starts.
        steps: most steps.
        shares: of a step, tried in this order where the one before does not help a window.
        r: residual at the first starts; simulated where left out.
    """
    r = problem.residual(hypothesis, start) if r is None else r
    going = np.ones(len(r), bool)
    for _ in range(steps):
        left, toward = going.copy(), r
        for share in shares:
            start, r, better = moved_along(
                problem, frame, hypothesis, start, r, share * toward, left
            )
            left &= ~better
            if not left.any():
                break
        going &= ~left  # one that no share of its step helped would try the same step again
        if not going.any():
            break
    return start, r


def first_start(
    problem: Problem, hypothesis: Hypothesis, start: State
) -> tuple[State, Float[np.ndarray, "W R"]]:
    """Return for each window the better of the given start and the smoother's, and what it leaves.

    Starts fitted to another hypothesis took over part of what that one lacked. Joints that the
    hypothesis adds are tried in all places where they may begin.
    """
    smooth = problem.smoothed(hypothesis)
    r = problem.residual(hypothesis, start)
    for other in (smooth, *problem.starts(hypothesis, smooth)):
        start, r, _ = better_of(start, r, other, problem.residual(hypothesis, other))
    return start, r


def moved_along(
    problem: Problem,
    frame: Linear,
    hypothesis: Hypothesis,
    start: State,
    r: Float[np.ndarray, "W R"],
    toward: Float[np.ndarray, "W R"],
    among: Bool[np.ndarray, " W"] | None = None,
) -> tuple[State, Float[np.ndarray, "W R"], Bool[np.ndarray, " W"]]:
    """Return starts moved to explain `toward`, where that lowers the residual of a window.

    Only windows `among` them are moved and simulated, by default all, and of these only those that
    can gain by it: to first order |Qᵀ r|² at most, next to nothing where a start is at its best.
    """
    change = np.einsum("wki,wi->wk", frame.start_gain, toward)
    worth = (np.einsum("wrk,wr->wk", frame.Q, r) ** 2).sum(axis=1) > _WORTH
    among = worth if among is None else among & worth
    if not among.any():
        return start, r, among
    if among.all():
        moved = problem.moved(start, change)
        return better_of(start, r, moved, problem.residual(hypothesis, moved))
    part = problem.rows(among)
    moved = part.moved(start.rows(among), change[among])
    own, rn, better = better_of(
        start.rows(among), r[among], moved, part.residual(hypothesis, moved)
    )
    rows = np.flatnonzero(among)
    residual, taken = r.copy(), np.zeros(len(r), bool)
    residual[rows], taken[rows] = rn, better
    return start.placed(rows, own), residual, taken


def better_of(
    start: State, r: Float[np.ndarray, "W R"], moved: State, rn: Float[np.ndarray, "W R"]
) -> tuple[State, Float[np.ndarray, "W R"], Bool[np.ndarray, " W"]]:
    """Return for each window the one of two starts that leaves less, and where it is the second."""
    better = (rn**2).sum(axis=1) < (r**2).sum(axis=1)
    return start.picked(better, moved), np.where(better[:, None], rn, r), better

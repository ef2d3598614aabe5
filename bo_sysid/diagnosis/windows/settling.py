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
    for _ in range(steps):
        toward, done = r, np.zeros(len(r), bool)
        for share in shares:
            share_of = np.where(done, 0.0, share)[:, None] * toward
            start, r, better = moved_along(problem, frame, hypothesis, start, r, share_of)
            done |= better
            if done.all():
                break
        if not done.any():
            break
    return start, r


def first_start(
    problem: Problem, hypothesis: Hypothesis, start: State
) -> tuple[State, Float[np.ndarray, "W R"]]:
    """Return for each window the better of the given start and the smoother's, and what it leaves.

    Starts fitted to another hypothesis took over part of what that one lacked. Joints that the
    hypothesis adds are tried in all places where they may begin.
    """
    smooth = problem.windows.start
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
) -> tuple[State, Float[np.ndarray, "W R"], Bool[np.ndarray, " W"]]:
    """Return starts moved to explain `toward`, where that lowers the residual of a window."""
    change = np.einsum("wki,wi->wk", frame.start_gain, toward)
    moved = problem.moved(start, change)
    return better_of(start, r, moved, problem.residual(hypothesis, moved))


def better_of(
    start: State, r: Float[np.ndarray, "W R"], moved: State, rn: Float[np.ndarray, "W R"]
) -> tuple[State, Float[np.ndarray, "W R"], Bool[np.ndarray, " W"]]:
    """Return for each window the one of two starts that leaves less, and where it is the second."""
    better = (rn**2).sum(axis=1) < (r**2).sum(axis=1)
    return start.picked(better, moved), np.where(better[:, None], rn, r), better

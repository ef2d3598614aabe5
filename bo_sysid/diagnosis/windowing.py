"""Windows whose starts are fitted, with the discretisation of the simulator as a nuisance.

A plant moves continuously, the model in steps; that difference looks like half a step of sensor
delay on every joint and was the main source of false names. It is one column for all windows: the
projected difference between a finer step and the model's, with one coefficient.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from bo_sysid.diagnosis.hypothesis import Hypothesis
from bo_sysid.diagnosis.linear import Linear, linearise, project
from bo_sysid.diagnosis.problem import FINER, Problem
from bo_sysid.diagnosis.refit import settle
from bo_sysid.errors import ModelError
from bo_sysid.simulation import State

_ROUNDS = 3
_SHARES = (1.0, 0.3, 0.09, 0.027)  # of a Gauss-Newton step on the starts
_CHAOTIC = 4.0  # windows whose correction is this many medians above are dropped
_DIVERGED = 0.5  # share of diverged windows at which there is nothing to compare
_NEGLIGIBLE = 0.01  # [sigma] a correction below is left out


@dataclass(frozen=True)
class Prepared:
    """A problem with settled starts.

    Attributes:
        problem: with its correction.
        start: starts fitted to the hypothesis at which it was prepared.
        linear: that hypothesis linearised there.
        correction_rms: size of the correction in sigma.
        dropped: windows left out because the time step decides what happens in them.
    """

    problem: Problem
    start: State
    linear: Linear
    correction_rms: float
    dropped: int


def prepare(problem: Problem, at: Hypothesis | None = None) -> Prepared:
    """Fit the starts of a hypothesis, by default of nothing, and add the correction there."""
    at = at or nothing(problem)
    start = problem.windows.start
    _require_finite(problem, at, start)
    for _ in range(_ROUNDS):
        linear = linearise(problem, at, start)
        start, _ = settle(problem, linear, at, start, 1, _SHARES)
    linear = linearise(problem, at, start)
    correction = correction_at(problem, linear, at, start)
    size = np.sqrt((correction**2).mean(axis=1))
    keep = size < _CHAOTIC * np.median(size) + 0.5
    if not keep.all():
        problem, start, correction = problem.rows(keep), start.rows(keep), correction[keep]
        linear = linearise(problem, at, start)
    rms = float(np.sqrt((correction**2).sum() / problem.dof))
    if rms > _NEGLIGIBLE:
        problem = replace(problem, correction=correction)
        linear = replace(linear, problem=problem)
    return Prepared(problem, start, linear, rms, int((~keep).sum()))


def _require_finite(problem: Problem, at: Hypothesis, start: State) -> None:
    diverged = problem.simulate(at, start).trajectory.diverged
    if diverged.mean() > _DIVERGED:
        raise ModelError(
            f"{problem.model.source}: the simulation diverges in {int(diverged.sum())} of "
            f"{len(diverged)} windows of the recordings; check the model's units, its time step "
            f"({problem.windows.timestep:g} s) and the signs and units of the controls"
        )


def nothing(problem: Problem) -> Hypothesis:
    """Return the hypothesis that nothing is missing, parameters as in the model."""
    zeros = tuple(np.zeros(c.size) for c in problem.nuisances)
    return Hypothesis(nuisances=problem.nuisances, nuisance_x=zeros)


def correction_at(
    problem: Problem, linear: Linear, hypothesis: Hypothesis, start: State
) -> Float[np.ndarray, "W R"]:
    """Return the projected difference that a finer time step makes to a hypothesis."""
    plain = replace(hypothesis, numerics=0.0)
    fine = problem.residual(plain, start, finer=FINER)
    return project(linear.Q, problem.residual(plain, start) - fine)

"""Windows whose starts are fitted, with the discretisation of the simulator as a nuisance.

A plant moves continuously, the model in steps; that difference looks like half a step of sensor
delay on every joint and was the main source of false names. It is one column for all windows: the
projected difference between a finer step and the model's, with one coefficient.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float

from bo_sysid.diagnosis.windows.estimated_starts import caught_up, first_starts
from bo_sysid.diagnosis.windows.hypothesis import Hypothesis
from bo_sysid.diagnosis.windows.input_noise import smoothed
from bo_sysid.diagnosis.windows.linear import Linear, linearise
from bo_sysid.diagnosis.windows.problem import Problem
from bo_sysid.diagnosis.windows.projection import project
from bo_sysid.diagnosis.windows.recorded_contact import meets_stops
from bo_sysid.diagnosis.windows.settling import better_of, settle
from bo_sysid.diagnosis.windows.timestep import FINER, share_of
from bo_sysid.errors import ModelError
from bo_sysid.mjcf.touching import touching
from bo_sysid.simulation import State

_ROUNDS = 3
# share of the squared residual that a round must gain to be followed by another
_WORTH_A_ROUND = 1e-3
_DRAWS = 6  # starts drawn to see where contact decides
_SHARES = (1.0, 0.3, 0.09, 0.027)  # of a Gauss-Newton step on the starts
# of a finer step's difference, the part that differs between impacts and is noise
_NOT_SHARED = 0.5
_CHAOTIC = 4.0  # times the median correction, up to which a window is never left out for it
_DECIDES = 0.5  # added to that bound, as a share of what the hypothesis leaves
_TOUCHING = 0.05  # share of the windows from which a motion counts as one in contact
_DIVERGED = 0.5  # share of diverged windows at which there is nothing to compare
_NEGLIGIBLE = 0.01  # [sigma] a correction below is left out


@dataclass(frozen=True)
class Prepared:
    """A problem with settled starts.

    Attributes:
        problem: with its correction, without windows that the time step decides.
        start: starts fitted to the hypothesis at which it was prepared.
        linear: that hypothesis linearised there.
        correction_rms: size of the correction in sigma.
        step_rms: the same without what other starts can make up for, as a forecast meets it.
    """

    problem: Problem
    start: State
    linear: Linear
    correction_rms: float
    step_rms: float

    def rows(self, keep: Bool[np.ndarray, " W"]) -> "Prepared":
        """Return some of the windows, as they were prepared among all."""
        linear = self.linear.rows(keep)
        return replace(self, problem=linear.problem, start=linear.start, linear=linear)


def prepare(problem: Problem, at: Hypothesis | None = None, known: State | None = None) -> Prepared:
    """Fit the starts of a hypothesis, by default of nothing, and add the correction there.

    Args:
        problem: the windows.
        at: the hypothesis.
        known: starts that were fitted to it before.
    """
    at = at or nothing(problem)
    _require_finite(problem, at, problem.smoothed(at))
    linear, contact = _begun(problem, at, known), problem.machine.impacts
    if contact:
        start, _ = caught_up(problem, at, linear.start)
        linear = linear if start is linear.start else linearise(problem, at, start)
        linear = linear.observing(noise_with_chaos(linear))
    elif problem.input_noise:
        linear = smoothed(linear, problem.input_noise)
    change = _by_a_finer_step(linear)
    if contact:
        linear, change = _weighted_by_step(linear, change)
    correction = project(linear.Q, change)
    keep = _undecided(linear, correction)
    linear, correction = linear.rows(keep), correction[keep]
    problem, start = linear.problem, linear.start
    rms, unfitted = (float(np.sqrt((c**2).sum() / problem.dof)) for c in (correction, change[keep]))
    if rms > _NEGLIGIBLE:
        problem = replace(problem, correction=correction)
        linear = replace(linear, problem=problem)
    return Prepared(problem, start, linear, rms, unfitted)


def second_order(prepared: Prepared) -> float:
    """Return in [sigma] by how much half a time step misses its share of the correction.

    To first order in the step it has a share of what a finer one changes. Near the step at which a
    stiff servo is unstable that does not hold, h k_v / I > 1/2: what is left then looks like a lag.
    """
    linear, problem = prepared.linear, prepared.problem
    if problem.correction is None:
        return 0.0
    half = linear.residual - problem.residual(linear.hypothesis, prepared.start, finer=2)
    missed = project(linear.Q, half) - share_of(2) * problem.correction
    return float(np.sqrt((missed**2).sum() / problem.dof))


def _begun(problem: Problem, at: Hypothesis, known: State | None) -> Linear:
    """Return a hypothesis linearised at its starts, which a killed diagnosis may have left."""
    made: list[Linear] = []

    def fitted() -> dict[str, np.ndarray]:
        first = [] if known is None else [known]
        if known is None:
            first = first_starts(problem, at)
        elif problem.loose(at):  # in a gap no step leads from one arrival to another
            first = [*first_starts(problem, at)[:1], *first]
        made.append(linearise_at_best_starts(problem, at, first))
        return made[0].start.arrays

    of = () if known is None else tuple(known.arrays.items())
    found = problem.kept.arrays((problem.identity, at.identity, of), fitted)
    return made[0] if made else linearise(problem, at, State.of(found))


def linearise_at_best_starts(problem: Problem, at: Hypothesis, first: Sequence[State]) -> Linear:
    """Return the model linearised at the starts that leave least of each window.

    Args:
        problem: the windows.
        at: the hypothesis.
        first: starts from each of which the best ones are looked for.
    """
    found: tuple[State, Float[np.ndarray, "W R"]] | None = None
    for start in first:
        linear, r = linearise(problem, at, start), problem.residual(at, start)
        for _ in range(_ROUNDS):
            moved, rn = settle(problem, linear, at, start, 1, _SHARES, r=r)
            if (rn**2).sum() > (1 - _WORTH_A_ROUND) * (r**2).sum():
                break
            start, r = moved, rn
            linear = linearise(problem, at, start)
        found = (start, r) if found is None else better_of(*found, start, r)[:2]
    assert found is not None  # noqa: S101 - there is always a first start
    return linear if len(first) == 1 else linearise(problem, at, found[0])


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


def in_contact(problem: Problem) -> bool:
    """Whether geoms touch at the beginning of more than a few windows, or stops are met."""
    model, poses = problem.machine.model, problem.windows.start.qpos
    return touching(model, poses) > _TOUCHING or meets_stops(model, problem.recordings)


def meets_impacts(problem: Problem) -> bool:
    """Whether the machine is in contact, and contacts are made and broken in the recordings."""
    return problem.machine.impacts and in_contact(problem)


def noise_with_chaos(linear: Linear) -> Problem:
    """Return the problem with less weight where contact decides.

    What of a start's noise is not linear is a variance of every sample, added to the sensor's.
    Windows in which a contact is made or not by chance lose their weight by themselves.
    """
    light = 1.0 / np.sqrt(1.0 + chaos(linear))
    return replace(linear.problem, weight=linear.problem.weight * light)


def chaos(linear: Linear) -> Float[np.ndarray, "W H c"]:
    """Return the variance of each prediction that slopes at the start do not tell, in sigma².

    The start is moved within its own uncertainty.
    """
    problem, at, start = linear.problem, linear.hypothesis, linear.start
    nv, r = problem.machine.model.nv, problem.residual(at, start)
    J = linear.J[..., : 2 * nv]
    N = np.einsum("wri,wrj->wij", J, J)
    ridge = 1e-6 * np.trace(N, axis1=1, axis2=2)[:, None, None] * np.eye(2 * nv) / (2 * nv)
    root = np.linalg.cholesky(np.linalg.inv(N + ridge + 1e-12 * np.eye(2 * nv)))
    rng = np.random.default_rng(0)
    squares = np.zeros_like(r)
    for _ in range(_DRAWS):
        move = np.einsum("wij,wj->wi", root, rng.normal(size=(len(start), 2 * nv)))
        moved = problem.residual(at, problem.moved(start, move))
        squares += (moved - r + np.einsum("wri,wi->wr", J, move)) ** 2
    return np.asarray(squares / _DRAWS).reshape(problem.weight.shape)


def _weighted_by_step(
    linear: Linear, change: Float[np.ndarray, "W R"]
) -> tuple[Linear, Float[np.ndarray, "W R"]]:
    """Return the linear model, and what a finer step changes, with less weight where that decides.

    One share of the correction holds for all of a smooth motion, not for impacts: half of what a
    finer step changes there is a standard deviation of every sample, added to the sensor's.
    """
    light = 1.0 / np.sqrt(1.0 + (_NOT_SHARED * project(linear.Q, change)) ** 2)
    weight = linear.problem.weight * light.reshape(linear.problem.weight.shape)
    return linear.observing(replace(linear.problem, weight=weight)), change * light


def _undecided(linear: Linear, correction: Float[np.ndarray, "W R"]) -> Bool[np.ndarray, " W"]:
    """Return the windows that the time step does not decide.

    Where motion reverses under friction a finer step changes more than where it goes on. That is no
    reason to drop a window where the hypothesis leaves much more, there or in most of them.
    """
    r = project(linear.Q, linear.residual)
    size, left = (np.sqrt(linear.problem.mean_square(e)) for e in (correction, r))
    left = np.maximum(left, max(float(np.median(left)), 1.0))
    return np.asarray(size < _CHAOTIC * np.median(size) + _DECIDES * left)


def _by_a_finer_step(linear: Linear) -> Float[np.ndarray, "W R"]:
    """Return the difference that a finer time step makes to a hypothesis."""
    fine = linear.problem.residual(linear.hypothesis, linear.start, finer=FINER)
    return np.asarray(linear.residual - fine)

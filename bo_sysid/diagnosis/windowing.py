"""Windows whose starts are fitted, with the discretisation of the simulator as a nuisance.

A plant moves continuously, the model in steps; that difference looks like half a step of sensor
delay on every joint and was the main source of false names. It is one column for all windows: the
projected difference between a finer step and the model's, with one coefficient.
"""

from dataclasses import dataclass, replace

import mujoco
import numpy as np
from jaxtyping import Float

from bo_sysid.diagnosis.hypothesis import Hypothesis
from bo_sysid.diagnosis.linear import Linear, linearise, project
from bo_sysid.diagnosis.problem import FINER, Problem
from bo_sysid.diagnosis.refit import better_of, settle
from bo_sysid.diagnosis.starts import first_starts
from bo_sysid.errors import ModelError
from bo_sysid.mjcf.touching import can_touch
from bo_sysid.simulation import State

_ROUNDS = 3
_DRAWS = 6  # starts drawn to see where contact decides
_SHARES = (1.0, 0.3, 0.09, 0.027)  # of a Gauss-Newton step on the starts
_CHAOTIC = 4.0  # windows whose correction is this many medians above are dropped
_TOUCHING = 0.05  # share of the windows from which a motion counts as one in contact
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


def prepare(problem: Problem, at: Hypothesis | None = None, known: State | None = None) -> Prepared:
    """Fit the starts of a hypothesis, by default of nothing, and add the correction there.

    Args:
        problem: the windows.
        at: the hypothesis.
        known: starts that were fitted before, kept where they leave less.
    """
    at = at or nothing(problem)
    _require_finite(problem, at, problem.windows.start)
    start = _settled(problem, at, known)
    linear = linearise(problem, at, start)
    if can_touch(problem.machine.model):
        problem = weighted_by_chaos(linear, at, start)
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


def _settled(problem: Problem, at: Hypothesis, known: State | None) -> State:
    """Return the starts that leave least of each window, settled from several first ones."""
    found: tuple[State, Float[np.ndarray, "W R"]] | None = None
    for start in (*first_starts(problem, at), *([known] if known is not None else [])):
        for _ in range(_ROUNDS):
            linear = linearise(problem, at, start)
            start, r = settle(problem, linear, at, start, 1, _SHARES)
        found = (start, r) if found is None else better_of(*found, start, r)[:2]
    assert found is not None  # noqa: S101 - there is always a first start
    return found[0]


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
    """Whether geoms touch at the beginning of more than a few windows."""
    return touching(problem.machine.model, problem.windows.start.qpos) > _TOUCHING


def touching(model: mujoco.MjModel, poses: Float[np.ndarray, "W nq"]) -> float:
    """Return the share of poses in which geoms of the model touch."""
    if not can_touch(model):
        return 0.0
    data, count = mujoco.MjData(model), 0
    for pose in poses:
        data.qpos[:] = pose
        mujoco.mj_fwdPosition(model, data)
        count += data.ncon > 0
    return count / len(poses)


def weighted_by_chaos(linear: Linear, at: Hypothesis, start: State) -> Problem:
    """Return the problem with less weight where contact decides.

    The start is moved within its own uncertainty; what of the change of the predictions is not
    linear is a variance of every sample, added to the sensor's. Windows in which a contact is made
    or not by chance lose their weight by themselves.
    """
    problem, nv = linear.problem, linear.problem.machine.model.nv
    r = problem.residual(at, start)
    J = linear.J[..., : 2 * nv]
    N = np.einsum("wri,wrj->wij", J, J)
    ridge = 1e-6 * np.trace(N, axis1=1, axis2=2)[:, None, None] * np.eye(2 * nv) / (2 * nv)
    root = np.linalg.cholesky(np.linalg.inv(N + ridge + 1e-12 * np.eye(2 * nv)))
    rng = np.random.default_rng(0)
    squares = np.zeros_like(r)
    for _ in range(_DRAWS):
        move = np.einsum("wij,wj->wi", root, rng.normal(size=(len(start), 2 * nv)))
        moved = problem.residual(at, start.moved(problem.machine.model, move))
        squares += (moved - r + np.einsum("wri,wi->wr", J, move)) ** 2
    variance = (squares / _DRAWS).reshape(problem.weight.shape)
    return replace(problem, weight=problem.weight / np.sqrt(1.0 + variance))


def correction_at(
    problem: Problem, linear: Linear, hypothesis: Hypothesis, start: State
) -> Float[np.ndarray, "W R"]:
    """Return the projected difference that a finer time step makes to a hypothesis."""
    plain = replace(hypothesis, numerics=0.0)
    fine = problem.residual(plain, start, finer=FINER)
    return project(linear.Q, problem.residual(plain, start) - fine)

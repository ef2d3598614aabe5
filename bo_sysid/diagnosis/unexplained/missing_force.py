"""The force on each joint that a model lacks to follow the recordings, by regression."""

from dataclasses import replace

import numpy as np
import pandas as pd
from jaxtyping import Float

from bo_sysid.diagnosis.sets.signatures import response_to_forces
from bo_sysid.diagnosis.windows.cutting import cut_problem
from bo_sysid.diagnosis.windows.evidence import Evidence
from bo_sysid.diagnosis.windows.fitted_starts import DIVERGING
from bo_sysid.diagnosis.windows.hypothesis import Hypothesis
from bo_sysid.diagnosis.windows.linear import Linear, linearise
from bo_sysid.diagnosis.windows.problem import Problem
from bo_sysid.diagnosis.windows.projection import project
from bo_sysid.diagnosis.windows.settling import settle
from bo_sysid.diagnosis.windows.timestep import finer_step
from bo_sysid.effects.machine import JointScale

_PIECE = 0.1  # [s] over which the missing force is taken as constant: above noise, below motion
_LEAST = 8  # instants in such a piece
_PIECES = 300  # most pieces
_ROUNDS = 3
_SHARES = (1.0, 0.3, 0.09)  # of a Gauss-Newton step on the starts
_PRIOR = 3.0  # deviation of the missing force, in units of the joint's typical force
_FORCE_COLUMNS = (
    "recording", "time", "begin", "joint", "position", "speed", "unit", "nominal", "repaired",
    "sigma",
)  # fmt: skip


def missing_force(evidence: Evidence, repaired: Hypothesis, timestep: float) -> pd.DataFrame:
    """Return the force on each joint that a model lacks to follow the training recordings.

    The recordings are cut into pieces of a tenth of a second. In each the residual is explained by
    a start and one constant force a joint, by least squares on the linearised simulator with a
    wide prior: y = P r, f = (AᵀA + 1/s²)⁻¹ Aᵀ y with A the projected response to the forces.
    Both models step as finely as the recordings show: half a long step is a slope over speed that
    no force explains. In a closed chain the forces are those on the joints that are free.

    Args:
        evidence: what the diagnosis was made from.
        repaired: what the nominal model lacks, with the share of a finer step that is shown.
        timestep: at which it was fitted, in [s].

    Returns:
        Columns recording, time [s], begin (the recording's first stamp), joint, position, speed,
        unit, nominal, repaired, and sigma, the standard deviation of the force; one row a piece
        and a joint, forces in `unit`. No rows for a machine without hinges and slides.
    """
    machine = evidence.machine
    if not machine.joints:
        return pd.DataFrame(columns=list(_FORCE_COLUMNS))
    horizon = max(round(_PIECE / machine.sampling), _LEAST)
    whole = sum(r.duration for r in evidence.recordings) / machine.sampling
    problem = cut_problem(
        evidence.model,
        machine,
        evidence.recordings,
        evidence.sigma,
        (),
        horizon=evidence.horizons(horizon, _LEAST),
        keep_every=max(int(np.ceil(whole / horizon / _PIECES)), 1),
        timestep=timestep,
        engine=evidence.engine,
        laws=evidence.laws,
    )
    finer, plain = finer_step(repaired.numerics), replace(repaired, numerics=0.0)
    _, nominal, _ = _forces(problem, Hypothesis(), finer)
    linear, left, sigma = _forces(problem, plain, finer)
    windows = problem.windows
    middle = windows.time + 0.5 * windows.step[:, -1] * windows.timestep
    parts = [
        pd.DataFrame(
            {
                "recording": [problem.recordings[i].name for i in windows.recording],
                "time": middle,
                "begin": [problem.recordings[i].span[0] for i in windows.recording],
                "joint": name,
                "position": linear.along.qpos[name].mean(axis=1),
                "speed": linear.along.qvel[name].mean(axis=1),
                "unit": "N m" if joint.hinge else "N",
                "nominal": nominal[:, k],
                "repaired": left[:, k],
                "sigma": sigma[:, k],
            }
        )
        for k, (name, joint) in enumerate(_free(problem).items())
    ]
    return pd.concat(parts, ignore_index=True)


def _free(problem: Problem) -> dict[str, JointScale]:
    """Return the joints that do not follow from others."""
    joints = problem.machine.joints.items()
    return {name: joint for name, joint in joints if name not in problem.model.loops.joints}


def _forces(
    problem: Problem, hypothesis: Hypothesis, finer: int
) -> tuple[Linear, Float[np.ndarray, "W j"], Float[np.ndarray, "W j"]]:
    """Return the linearised model, and for every window the missing forces with their sigma.

    The residual is that of a time step `finer` times smaller.
    """
    start = problem.smoothed(hypothesis)
    for _ in range(_ROUNDS):
        linear = linearise(problem, hypothesis, start)
        start, _ = settle(problem, linear, hypothesis, start, 1, _SHARES)
    linear = linearise(problem, hypothesis, start)
    y = project(linear.Q, problem.residual(hypothesis, start, finer))
    joints = _free(problem)
    one = np.ones((len(y), linear.macros, 1))
    A = np.concatenate(
        [response_to_forces(linear, n, j.force * one) for n, j in joints.items()], -1
    )
    scale = np.array([j.force for j in joints.values()])
    force, sigma = explained(A, y)
    return linear, force * scale, sigma * scale


def explained(
    A: Float[np.ndarray, "W R j"], y: Float[np.ndarray, "W R"]
) -> tuple[Float[np.ndarray, "W j"], Float[np.ndarray, "W j"]]:
    """Return the least-squares forces f of A f = y beside their prior, and their deviations.

    [A; 1/s] f = [y; 0] without normal equations, which impacts make singular. A window whose
    response diverges says nothing: there the prior is left.
    """
    A = np.where((np.abs(A) < DIVERGING).all(axis=(1, 2), keepdims=True), A, 0.0)
    count = A.shape[-1]
    prior = np.broadcast_to(np.eye(count) / _PRIOR, (len(A), count, count))
    inverse = np.linalg.pinv(np.concatenate([A, prior], axis=1), rcond=1e-12)
    force = (inverse[..., : A.shape[1]] @ y[..., None])[..., 0]
    return force, np.sqrt((inverse**2).sum(axis=2))

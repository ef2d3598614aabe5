"""Where controls rest: what holds a machine at its reference against gravity and springs."""

import itertools
from collections.abc import Sequence
from typing import NamedTuple

import mujoco
import numpy as np
from jaxtyping import Float
from scipy.optimize import lsq_linear

from bo_sysid.checks.balance import Dynamics
from bo_sysid.mjcf.commands import LAGS, controlled
from bo_sysid.simulation import ForceLaw, State
from bo_sysid.simulation.lockstep import LockStep

_CORNERS = 5  # parameters up to which all corners of their bounds are taken


class Hold(NamedTuple):
    """Controls at rest, and what is then missing.

    Attributes:
        ctrl: `nu` controls.
        needed: `nv` forces along each joint that hold the reference, in [N m] or [N].
        given: `nv` forces of the actuators under the controls.
    """

    ctrl: Float[np.ndarray, " nu"]
    needed: Float[np.ndarray, " nv"]
    given: Float[np.ndarray, " nv"]


def holding(
    model: mujoco.MjModel,
    laws: Sequence[ForceLaw],
    low: Float[np.ndarray, " nu"],
    high: Float[np.ndarray, " nu"],
) -> Hold:
    """Return the controls under which a machine comes nearest to standing still at `qpos0`.

    The actuators give Σ_a r_a (g_a u_a + b_a), r the moments, g the gains, b the forces at zero
    control. What is needed are the inverse dynamics at zero velocity and acceleration less the
    forces beside the model: least squares over low ≤ u ≤ high.

    Args:
        model: the compiled model; it is changed.
        laws: forces that are stepped with it.
        low: least controls.
        high: largest controls.
    """
    still = np.zeros((1, model.nv))
    terms = Dynamics(model).terms(model.qpos0[None], still, still)
    needed = terms.required_force[0] - _beside(model, laws)
    own = terms.bias[0] @ terms.moment[0]
    per_control = (terms.gain[0][:, None] * terms.moment[0]).T
    ctrl = lsq_linear(per_control, needed - own, (low, high)).x
    return Hold(ctrl, needed, per_control @ ctrl + own)


def _beside(model: mujoco.MjModel, laws: Sequence[ForceLaw]) -> Float[np.ndarray, " nv"]:
    """Return the forces of laws at the reference, at rest and without controls."""
    views = {
        "qpos": model.qpos0[None].copy(),
        "qvel": np.zeros((1, model.nv)),
        "ctrl": np.zeros((1, model.nu)),
        "qfrc_applied": np.zeros((1, model.nv)),
    }
    LockStep(model, tuple(laws), {}, views, None).apply(0)
    return np.asarray(views["qfrc_applied"][0])


def held(model: mujoco.MjModel, ctrl: Float[np.ndarray, " nu"]) -> State:
    """Return a machine that stands at its reference, where controls have long been held."""
    act = np.zeros((1, model.na))
    for k, a in enumerate(controlled(model)):
        if int(model.actuator_dyntype[a]) in LAGS:
            last = int(model.actuator_actadr[a] + model.actuator_actnum[a]) - 1
            act[0, last] = ctrl[k]
    return State(model.qpos0[None].copy(), np.zeros((1, model.nv)), act)


def corners(
    low: Float[np.ndarray, " d"], high: Float[np.ndarray, " d"], drawn: Float[np.ndarray, "n d"]
) -> Float[np.ndarray, "c d"]:
    """Return the corners of a box; of many dimensions those next to what was drawn.

    Args:
        low: least values.
        high: largest values.
        drawn: points of the unit cube.
    """
    if len(low) <= _CORNERS:
        ends = np.array(list(itertools.product((0.0, 1.0), repeat=len(low))))
    else:
        ends = np.unique(np.round(drawn), axis=0)
    return np.asarray(low + (high - low) * ends)

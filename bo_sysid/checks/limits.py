"""The limits of force of a model's drives: each actuator's own, and each joint's."""

import copy

import mujoco
import numpy as np
from jaxtyping import Float

from bo_sysid.mjcf import Loops
from bo_sysid.mjcf.commands import compensating, controlled


def unlimited(model: mujoco.MjModel) -> mujoco.MjModel | None:
    """Return a model of hinges and slides whose drives have no limits of force; None if none has.

    Args:
        model: the compiled model; it is not changed.
    """
    if not (model.actuator_forcelimited.any() or model.jnt_actfrclimited.any()):
        return None
    free = copy.copy(model)
    free.actuator_forcelimited[:] = free.jnt_actfrclimited[:] = 0
    return free


def force_ends(model: mujoco.MjModel) -> Float[np.ndarray, "2 nu"]:
    """Return the least and largest force of each actuator that has a control."""
    own = controlled(model)
    limited = model.actuator_forcelimited[own].astype(bool)
    return np.where(limited, model.actuator_forcerange[own].T, [[-np.inf], [np.inf]])


def joint_ends(model: mujoco.MjModel, loops: Loops | None) -> Float[np.ndarray, "2 nv"]:
    """Return the least and largest force of all actuators along each degree of freedom.

    None counts in a closed chain, whose balance is of several joints, nor where actuators
    compensate gravity within the same limit.
    """
    joint = model.dof_jntid
    limited = model.jnt_actfrclimited[joint].astype(bool) & ~compensating(model) & (not loops)
    return np.where(limited, model.jnt_actfrcrange[joint].T, [[-np.inf], [np.inf]])

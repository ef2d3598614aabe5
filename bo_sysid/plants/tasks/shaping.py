"""Soft indicator functions and draws that dm_control's tasks share.

Tassa et al., "dm_control: Software and tasks for continuous control" (2020), section 3.1.3:
a tolerance is 1 inside its bounds and falls with the distance d to them, in units of a margin.
"""

from typing import Literal

import mujoco
import numpy as np

from bo_sysid.mjcf.joints import HINGE

Shape = Literal["linear", "quadratic", "gaussian", "long_tail"]


def tolerance(
    x: np.ndarray,
    low: float = 0.0,
    high: float = 0.0,
    margin: float = 0.0,
    shape: Shape = "gaussian",
    at_margin: float = 0.1,
) -> np.ndarray:
    """Return 1 where ``low <= x <= high``, and less with the distance to these bounds.

    Args:
        x: values.
        low: lower bound.
        high: upper bound.
        margin: the distance at which the value is `at_margin`; 0 gives a sharp indicator.
        shape: how the value falls.
        at_margin: value at the margin.
    """
    outside = np.maximum(low - x, x - high)
    if margin == 0.0:
        return (outside <= 0).astype(float)
    return _falling(np.maximum(outside, 0.0) / margin, at_margin, shape)


def _falling(d: np.ndarray, at_margin: float, shape: Shape) -> np.ndarray:
    """Return 1 at d = 0, `at_margin` at d = 1."""
    if shape == "gaussian":
        return np.asarray(np.exp(np.log(at_margin) * d**2))
    if shape == "long_tail":
        return np.asarray(1 / (d**2 * (1 / at_margin - 1) + 1))
    if shape == "linear":
        return np.maximum(1 - d * (1 - at_margin), 0.0)
    return np.maximum(1 - d**2 * (1 - at_margin), 0.0)


def random_joints(model: mujoco.MjModel, rng: np.random.Generator) -> np.ndarray:
    """Draw positions of all hinges and slides, `nq`.

    Limited joints are uniform within their range, unlimited hinges uniform on the circle, and
    unlimited slides stay where the model has them.
    """
    qpos = np.array(model.qpos0)
    for joint in range(model.njnt):
        address = model.jnt_qposadr[joint]
        if model.jnt_limited[joint]:
            qpos[address] = rng.uniform(*model.jnt_range[joint])
        elif model.jnt_type[joint] == HINGE:
            qpos[address] = rng.uniform(-np.pi, np.pi)
    return qpos

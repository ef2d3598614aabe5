"""What delayed actuators still have to act on when a simulation begins."""

import mujoco
import numpy as np
from jaxtyping import Float
from mujoco.batch import Batch

from bo_sysid.mjcf.commands import controlled


def remembered_steps(model: mujoco.MjModel) -> int:
    """Return how many steps of commands the actuators of a model remember at most."""
    return int(model.actuator_history[:, 0].max(initial=0))


def load_past(batch: Batch, past: Float[np.ndarray, "W D nu"]) -> None:
    """Fill the buffers of a batch that was reset with the commands of the last steps.

    MuJoCo keeps of each delayed actuator (user data, cursor, n times, n values), the oldest first
    after a reset, at the steps before time 0, where it puts zeros. Commands older than `past` are
    its first.

    Args:
        batch: to be stepped.
        past: commands of the steps before the first, the oldest first.
    """
    model, history = batch.model, batch.bind("history")
    for k, a in enumerate(controlled(model)):
        count = int(model.actuator_history[a, 0])
        if count:
            own = np.maximum(np.arange(past.shape[1] - count, past.shape[1]), 0)
            first = int(model.actuator_historyadr[a]) + 2 + count
            history[:, first : first + count] = past[:, own, k]

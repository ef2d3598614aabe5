"""What delayed actuators and sensors have of the time before a simulation begins."""

from collections.abc import Mapping, Sequence

import mujoco
import numpy as np
from jaxtyping import Bool, Float, Int
from mujoco.batch import Batch

from bo_sysid.mjcf.commands import controlled

_ON_STEP = 1e-6  # of a step, by which a sum of steps may miss a delay


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


def shown_of_before(
    model: mujoco.MjModel,
    columns: Mapping[str, int],
    channels: Sequence[str],
    step: Int[np.ndarray, "W H"],
) -> Bool[np.ndarray, "W H c"]:
    """Return where delayed sensors show what was before a window, which no simulation knows.

    MuJoCo shows zeros there.

    Args:
        model: the compiled model.
        columns: of `sensordata` by channel.
        channels: names of the c observed channels.
        step: `W x H` simulation step at or before each instant.
    """
    delays = np.repeat(model.sensor_delay, model.sensor_dim) / model.opt.timestep  # in steps
    late = np.array([delays[columns[n]] if n in columns else 0.0 for n in channels])
    return np.asarray(step[..., None] < late - _ON_STEP)

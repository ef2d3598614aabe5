"""What delayed actuators and sensors have of the time before a simulation begins."""

from collections.abc import Mapping, Sequence

import mujoco
import numpy as np
from jaxtyping import Float, Int

from bo_sysid.mjcf.commands import control_limits, controlled

_ON_STEP = 1e-6  # of a step, by which a sum of steps may miss a delay


def remembered_steps(model: mujoco.MjModel) -> int:
    """Return how many steps of commands the actuators of a model remember at most."""
    return int(model.actuator_history[:, 0].max(initial=0))


def load_past(
    model: mujoco.MjModel, history: Float[np.ndarray, "W nh"], past: Float[np.ndarray, "W D nu"]
) -> None:
    """Fill the buffers of simulations that were reset with the commands of the last steps.

    MuJoCo keeps of each delayed actuator (user data, cursor, n times, n values), the oldest first
    after a reset, at the steps before time 0, where it puts zeros. Commands older than `past` are
    its first.

    Args:
        model: that has them.
        history: its buffers in each simulation, changed in place.
        past: commands of the steps before the first, the oldest first.
    """
    for k, a in enumerate(controlled(model)):
        count = int(model.actuator_history[a, 0])
        if count:
            own = np.maximum(np.arange(past.shape[1] - count, past.shape[1]), 0)
            first = int(model.actuator_historyadr[a]) + 2 + count
            history[:, first : first + count] = past[:, own, k]


def delayed_commands(
    model: mujoco.MjModel, history: Float[np.ndarray, "W nh"]
) -> dict[str, Float[np.ndarray, " W"]]:
    """Return the controls on which delayed actuators act in the step that comes, by name.

    As MuJoCo reads them: t - delay lies between two samples of the buffer, of which the earlier one
    holds, or both are interpolated, linearly here. An actuator that acts on an activation is left
    out: that is the simulation's, and delayed already.

    Args:
        model: that has them.
        history: the buffers of W simulations before that step: its newest sample is the last one's.
    """
    acting = {}
    for k, a in enumerate(controlled(model)):
        count, interp = model.actuator_history[a].tolist()
        if not count or model.actuator_actnum[a]:
            continue
        first = int(model.actuator_historyadr[a]) + 2
        time, sent = (
            history[:, first : first + count],
            history[:, first + count : first + 2 * count],
        )
        order = np.argsort(time, axis=1)
        time, sent = (np.take_along_axis(x, order, axis=1) for x in (time, sent))
        dt = float(model.opt.timestep)
        at = time[:, -1:] + dt - float(model.actuator_delay[a])
        before = np.maximum((time <= at + _ON_STEP * dt).sum(axis=1, keepdims=True) - 1, 0)
        after = np.minimum(before + 1, count - 1) if interp else before
        (t0, u0), (t1, u1) = (
            [np.take_along_axis(x, i, axis=1) for x in (time, sent)] for i in (before, after)
        )
        share = np.clip((at - t0) / np.where(t1 > t0, t1 - t0, 1.0), 0.0, 1.0)
        low, high = control_limits(model, k) or (-np.inf, np.inf)
        acting[model.actuator(a).name] = np.clip(u0 + share * (u1 - u0), low, high)[:, 0]
    return acting


def mask_pre_window_samples(
    model: mujoco.MjModel,
    columns: Mapping[str, int],
    name: str,
    channels: Sequence[str],
    observed: Float[np.ndarray, "W H c"],
    step: Int[np.ndarray, "W H"],
) -> tuple[Float[np.ndarray, "W H c"], tuple[str, ...]]:
    """Set to NaN the samples that delayed sensors took before a window began; say so in words.

    A simulation that begins there cannot predict them: MuJoCo shows zeros.

    Args:
        model: the compiled model.
        columns: of `sensordata` by channel.
        name: of the recording.
        channels: names of the c channels.
        observed: `W x H x c` measurements; not changed.
        step: `W x H` simulation step at or before each instant.
    """
    delays = np.repeat(model.sensor_delay, model.sensor_dim) / model.opt.timestep  # in steps
    late = np.array([delays[columns[n]] if n in columns else 0.0 for n in channels])
    before = step[..., None] < late - _ON_STEP
    notes = tuple(
        f"{name}: {n} begins each window with what was before it, by the sensor's delay in the "
        "model; that is not compared"
        for k, n in enumerate(channels)
        if before[..., k].any()
    )
    return np.where(before, np.nan, observed), notes

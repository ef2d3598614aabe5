"""Activations at the start of a window: what actuators with memory made of the controls before."""

import mujoco
import numpy as np
from jaxtyping import Float

from bo_sysid.arrays import Ctrl
from bo_sysid.effects.memory import activation, remembers
from bo_sysid.mjcf import Model
from bo_sysid.mjcf.commands import controlled
from bo_sysid.recording import Recording


def activations(
    model: Model,
    compiled: mujoco.MjModel,
    recording: Recording,
    start: Float[np.ndarray, " W"],
    ctrl: Ctrl,
) -> Float[np.ndarray, "W na"]:
    """Return the activations at some times: recorded, or what the recorded controls led to.

    A lag begins settled at its first control. An integrator that holds a position begins where its
    joint is. Any other activation is taken as settled at its control.

    Args:
        model: names the channels.
        compiled: the same model.
        recording: what was recorded.
        start: `W` times in [s].
        ctrl: `W x S x nu` controls from there on.
    """
    act = np.zeros((len(start), compiled.na))
    for k, a in enumerate(controlled(compiled)):
        address, count = int(compiled.actuator_actadr[a]), int(compiled.actuator_actnum[a])
        if address < 0:
            continue
        control = model.ctrl_channels[k]
        name = control.replace("ctrl.", "act.", 1)
        own = slice(address, address + count)
        if count == 1 and name in recording.channels:
            act[:, own] = recording.channels[name].at(start)[:, None]
        elif control not in recording.channels:
            continue
        elif remembers(compiled, a):
            act[:, address] = activation(compiled, recording, a, start)
        else:
            act[:, own] = ctrl[:, 0, k][:, None]
    return act

"""Activations that follow from motion as well as from controls, by MuJoCo's own rule.

The activation of a muscle lags behind its excitation at a rate that hangs on both, the current of a
motor with an inductance on its speed, the integral of a PID on the error. The model is stepped with
each recorded state put in its place; what it makes of the activations is kept.
"""

import copy

import mujoco
import numpy as np
from jaxtyping import Float

from bo_sysid.effects.recorded_motion import along
from bo_sysid.recording import Recording

_PID = int(mujoco.mjtDyn.mjDYN_PID)
_KINDS = (int(mujoco.mjtDyn.mjDYN_MUSCLE), int(mujoco.mjtDyn.mjDYN_DCMOTOR), _PID)
_APART = int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)  # forces that no activation follows from
_SETTLING = 0.2  # [s] that the first state is held before, but for integrals


def is_driven(compiled: mujoco.MjModel, a: int) -> bool:
    """Whether an actuator's activations follow from motion, or from themselves, by a rate."""
    return int(compiled.actuator_dyntype[a]) in _KINDS


def driven(
    compiled: mujoco.MjModel, recording: Recording, at: Float[np.ndarray, " W"]
) -> Float[np.ndarray, "W na"]:
    """Return all activations at some times in [s], stepped along what was recorded.

    Joints that were not recorded, and such with several coordinates, stay where the model puts
    them. A recording begins settled at its first state, integrals of errors at 0.
    """
    model = copy.copy(compiled)
    model.opt.disableflags |= _APART
    dt, begin = float(model.opt.timestep), recording.span[0]
    time = begin + dt * np.arange(max(int(np.ceil((at.max() - begin) / dt)), 0) + 2)
    qpos, qvel, _ = along(model, recording, time)
    ctrl = np.zeros((len(time), model.nu))
    for a in range(model.nactuator):
        name = f"ctrl.{model.actuator(a).name}"
        if model.actuator_ctrlnum[a] == 1 and name in recording.channels:
            ctrl[:, model.actuator_ctrladr[a]] = recording.channels[name].at(time)
    data, act = mujoco.MjData(model), np.zeros((len(time), model.na))

    def step(k: int) -> None:
        data.qpos[:], data.qvel[:], data.ctrl[:] = qpos[k], qvel[k], ctrl[k]
        mujoco.mj_step(model, data)

    for _ in range(int(_SETTLING / dt)):
        step(0)
    for a in np.flatnonzero(model.actuator_dyntype == _PID).tolist():
        first = int(model.actuator_actadr[a])
        data.act[first : first + int(model.actuator_actnum[a])] = 0.0
    for k in range(len(time)):
        act[k] = data.act
        step(k)
    return np.stack([np.interp(at, time, column) for column in act.T], axis=1)

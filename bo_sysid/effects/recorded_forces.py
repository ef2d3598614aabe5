"""What the actuators did in the recordings, as MuJoCo has it along the recorded motion."""

import copy
from collections.abc import Collection, Sequence

import mujoco
import numpy as np
from jaxtyping import Float

from bo_sysid.effects.driven import driven, is_driven
from bo_sysid.effects.memory import activation, remembers
from bo_sysid.effects.recorded_motion import along
from bo_sysid.mjcf.joints import SCALAR
from bo_sysid.recording import Recording


def with_control(model: mujoco.MjModel, recording: Recording) -> set[int]:
    """Return the actuators with one control that was recorded."""
    return {
        a for a in range(model.nactuator)
        if model.actuator_ctrlnum[a] == 1 and f"ctrl.{model.actuator(a).name}" in recording.channels
    }  # fmt: skip


def unseen(model: mujoco.MjModel, recordings: Sequence[Recording]) -> set[str]:
    """Return the hinges and slides whose position some recording lacks."""
    names = [model.joint(j).name for j in range(model.njnt) if int(model.jnt_type[j]) in SCALAR]
    return {n for n in names if not all(f"qpos.{n}" in r.channels for r in recordings)}


def forces_along(
    model: mujoco.MjModel,
    recording: Recording,
    time: Float[np.ndarray, " n"],
    acting: Collection[int],
) -> tuple[Float[np.ndarray, "n a"], Float[np.ndarray, "n nv"]]:
    """Return what some actuators did at some times in [s]; delays are left out.

    Returns:
        The `n x nactuator` forces of the actuators themselves and the `n x nv` ones along the
        degrees of freedom, zero of what the others did.
    """
    bare = copy.copy(model)
    others = [a for a in range(model.nactuator) if a not in acting]
    bare.actuator_gear[others], bare.actuator_delay[:] = 0.0, 0.0
    qpos, qvel, _ = along(model, recording, time)
    ctrl, act = np.zeros((len(time), model.nu)), np.zeros((len(time), model.na))
    for a in acting:
        channel = recording.channels[f"ctrl.{model.actuator(a).name}"]
        ctrl[:, model.actuator_ctrladr[a]] = channel.at(time)
        if remembers(model, a):
            act[:, model.actuator_actadr[a]] = activation(model, recording, a, time)
        elif is_driven(model, a):
            first = int(model.actuator_actadr[a])
            own_act = slice(first, first + int(model.actuator_actnum[a]))
            act[:, own_act] = driven(model, recording, time)[:, own_act]
    data, along_dofs = mujoco.MjData(bare), np.zeros((len(time), model.nv))
    own = np.zeros((len(time), model.nactuator))
    for k in range(len(time)):
        data.qpos[:], data.qvel[:], data.ctrl[:], data.act[:] = qpos[k], qvel[k], ctrl[k], act[k]
        mujoco.mj_fwdPosition(bare, data)
        mujoco.mj_fwdVelocity(bare, data)
        mujoco.mj_fwdActuation(bare, data)
        own[k], along_dofs[k] = data.actuator_force, data.qfrc_actuator
    own[:, others] = 0.0
    return own, along_dofs

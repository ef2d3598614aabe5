"""Where the activation of an integrating servo begins: where forces balance on the whole.

A machine's integrator remembers what it was told before its log began, and holds its joint beside
that, by what the joint carries: under a load of τ a servo with gain k rests τ/k from where it is
told to be. What the motion needs, M(q) q̈ + c(q, q̇) - passive forces, tells where it was.
"""

import copy

import mujoco
import numpy as np
from jaxtyping import Float

from bo_sysid.effects.recorded_motion import along
from bo_sysid.mjcf.commands import compensating, controlled, driven_joint, other_drives
from bo_sysid.recording import Recording

_INTEGRATOR = int(mujoco.mjtDyn.mjDYN_INTEGRATOR)
_TOUCH = int(mujoco.mjtDisableBit.mjDSBL_CONTACT)  # forces that no motion tells
_INSTANTS = 400  # of a recording, at which forces are balanced


def balances(compiled: mujoco.MjModel, a: int) -> bool:
    """Whether an actuator integrates its control and pulls a joint to the integral."""
    integrates = int(compiled.actuator_dyntype[a]) == _INTEGRATOR
    gain, gear = compiled.actuator_gainprm[a, 0], compiled.actuator_gear[a, 0]
    pulls = bool(gain and gear and compiled.actuator_biasprm[a, 1])
    return integrates and pulls and driven_joint(compiled, a) is not None


def balancing_activations(
    compiled: mujoco.MjModel, recording: Recording, a: int
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]] | None:
    """Return times in [s] and the activations with which an actuator does what was recorded.

    Its joint carries nothing where other actuators drive it, or the model has closed chains.

    Returns:
        None where the actuator does not balance, or its joint was not recorded.
    """
    joint = driven_joint(compiled, a)
    if joint is None or not balances(compiled, a) or f"qpos.{joint}" not in recording.channels:
        return None
    seen = recording.channels[f"qpos.{joint}"].time
    time = seen[np.unique(np.linspace(0, len(seen) - 1, _INSTANTS).astype(int))]
    moved, at = along(compiled, recording, time), compiled.joint(joint)
    q, v = moved[0][:, at.qposadr[0]], moved[1][:, at.dofadr[0]]
    b, gear = compiled.actuator_biasprm[a], compiled.actuator_gear[a, 0]
    force = _carried(compiled, joint, *moved) / gear
    held = b[0] + b[1] * gear * q + b[2] * gear * v
    return time, np.asarray((force - held) / compiled.actuator_gainprm[a, 0])


def balance_notes(compiled: mujoco.MjModel, recording: Recording) -> tuple[str, ...]:
    """Return in words which servos begin where their forces balance, and what that hides."""
    notes = []
    for a in controlled(compiled):
        name, joint = str(compiled.actuator(a).name), driven_joint(compiled, a)
        sent = f"ctrl.{name}" in recording.channels and f"act.{name}" not in recording.channels
        if joint is None or not sent or not balances(compiled, a):
            continue
        if _alone(compiled, joint):
            begins = "its forces balance"
            consequence = f"no constant force on {joint} can be told"
        else:
            begins = "it would hold nothing"
            consequence = (
                f"what else drives {joint} is left out of that, so that act.{name} is needed"
            )
        notes.append(
            f"{name} integrates its control and begins where {begins}, since act.{name} was not "
            f"recorded: {consequence}"
        )
    return tuple(notes)


def _alone(compiled: mujoco.MjModel, joint: str) -> bool:
    """Whether one actuator alone drives a joint, and no chain is closed."""
    drives = [k for k in controlled(compiled) if driven_joint(compiled, k) == joint]
    return len(drives) == 1 and not other_drives(compiled, joint) and not compiled.neq


def _carried(
    compiled: mujoco.MjModel,
    joint: str,
    qpos: Float[np.ndarray, "n nq"],
    qvel: Float[np.ndarray, "n nv"],
    qacc: Float[np.ndarray, "n nv"],
) -> Float[np.ndarray, " n"]:
    """Return what the actuator of a joint has to do in some motion, in [N m] or [N]."""
    force = np.zeros(len(qpos))
    if not _alone(compiled, joint):
        return force
    model = copy.copy(compiled)
    model.opt.disableflags |= _TOUCH
    data, dof = mujoco.MjData(model), int(model.joint(joint).dofadr[0])
    asked = compensating(model)[dof]
    for k in range(len(force)):
        data.qpos[:], data.qvel[:], data.qacc[:] = qpos[k], qvel[k], qacc[k]
        mujoco.mj_inverse(model, data)
        force[k] = data.qfrc_inverse[dof] - asked * data.qfrc_gravcomp[dof]
    return force

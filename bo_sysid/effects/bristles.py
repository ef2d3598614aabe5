"""Friction that bends before it slips: the bristles of LuGre."""

import mujoco
import numpy as np
from jaxtyping import Float, Int

from bo_sysid.effects.actuators import passive_motor
from bo_sysid.effects.contract import Motion, Signal
from bo_sysid.effects.machine import JointScale, Machine

BENT_FINER = (0.6, 1.6)
"""Factors by which the bend that explains most is varied."""

_STIFFNESS = 5  # place in `dynprm` of a motor with LuGre friction
_STEADY = slice(3, 6)  # place in `biasprm` of sliding level, level at standstill and their speed
_BENDS = (1e-4, 3e-4, 1e-3, 3e-3)  # of the spread of the joint's position
_STIFF = 1e-5  # the same, of friction that none of them was found for
_BEYOND = 2.0  # times the largest of them, where a fit between them may end
_LEAST = 1e-30  # [J] that bristles store
_RESOLVED = 0.5  # k·h²/m of bristles that do not bend: a step h follows their oscillation


def most_bent(joint: JointScale) -> float:
    """Return the largest bend that a fit may end at, in [rad] or [m]."""
    return _BEYOND * bends(joint)[-1]


def bends(joint: JointScale) -> tuple[float, ...]:
    """Return the bends that are tried at a joint, in [rad] or [m]."""
    return tuple(bend * joint.spread for bend in _BENDS)


def stiff(joint: JointScale) -> float:
    """Return the bend of bristles in the place of friction that does not bend, in [rad] or [m]."""
    return _STIFF * joint.spread


def add_bristles(
    spec: mujoco.MjSpec,
    name: str,
    friction: tuple[float, float, float],
    bend: float,
    machine: Machine,
) -> None:
    """Put LuGre friction [1] in the place of a joint's dry friction.

    The bristles bend by √(b² + b₀²) before they slip, b₀ that at which a step can still resolve
    their stiffness: no bend is below what it tells, where nothing would change with it. They are
    damped against the joint's inertia, but by no more than the Coulomb level at the joint's speed:
    more would be felt as friction of its own at every reversal.

    Args:
        spec: the spec to change.
        name: of the joint.
        friction: level of sliding, level at standstill, speed at which one becomes the other.
        bend: in [rad] or [m].
        machine: the scales of the joint.

    [1] Canudas de Wit, Olsson, Astrom, Lischinsky, "A new model for control of systems with
        friction", IEEE Transactions on Automatic Control 40(3), 1995.
    """
    low, high, speed = friction
    joint, dt = machine.joints[name], spec.option.timestep
    stiffness = high / np.hypot(bend, high * dt**2 / (_RESOLVED * joint.inertia))
    motor = passive_motor(spec, name, "friction")
    damping = min(2.0 * np.sqrt(stiffness * joint.inertia), low / joint.speed)
    motor.dynprm[5:7] = (stiffness, damping)
    motor.biasprm[3:6] = (low, high, speed)
    motor.actdim = 1
    spec.joint(name).frictionloss = 0.0


def bristle_motors(model: mujoco.MjModel) -> Int[np.ndarray, " b"]:
    """Return the motors at joints whose one activation is how far bristles are bent.

    Those that `add_bristles` added to a model, and any like them that it came with.
    """
    motors = model.actuator_dyntype == int(mujoco.mjtDyn.mjDYN_DCMOTOR)
    at_joint = model.actuator_trntype == int(mujoco.mjtTrn.mjTRN_JOINT)
    bent = (model.actuator_dynprm[:, _STIFFNESS] > 0) & (model.actuator_actnum == 1)
    return np.flatnonzero(motors & at_joint & bent)


def loaded(
    model: mujoco.MjModel,
    motors: Int[np.ndarray, " b"],
    qpos: Float[np.ndarray, "W nq"],
    qvel: Float[np.ndarray, "W nv"],
    ctrl: Float[np.ndarray, "W nu"],
) -> Float[np.ndarray, "W b"]:
    """Return how far bristles are bent where nothing of the past is known, in [rad] or [m].

    At rest they carry what would set their joint in motion, up to the level of friction F; straight
    ones would let it go, since they overshoot to twice the load. In motion they are bent by F/σ₀
    against it. Between lies the speed at which they store what the joint moves with,
    m·v²/2 = F²/σ₀.

    Args:
        model: with bristles.
        motors: that hold them.
        qpos: positions.
        qvel: velocities.
        ctrl: controls.
    """
    stiffness = model.actuator_dynprm[motors, _STIFFNESS]
    dof = model.jnt_dofadr[model.actuator_trnid[motors, 0]]
    v = qvel[:, dof]
    low, high, speed = model.actuator_biasprm[motors, _STEADY].T
    most = (low + (high - low) * np.exp(-((v / speed) ** 2))) / stiffness
    load, mass = _loads(model, dof, qpos, qvel, ctrl)
    slides = -np.expm1(-0.5 * mass * v**2 / np.maximum(stiffness * most**2, _LEAST))
    held = np.clip(load / stiffness, -most, most)
    return np.asarray(held + slides * (np.sign(v) * most - held))


def _loads(
    model: mujoco.MjModel,
    dof: Int[np.ndarray, " b"],
    qpos: Float[np.ndarray, "W nq"],
    qvel: Float[np.ndarray, "W nv"],
    ctrl: Float[np.ndarray, "W nu"],
) -> tuple[Float[np.ndarray, "W b"], Float[np.ndarray, "W b"]]:
    """Return the forces that friction must bear to hold some joints, and the inertia each feels.

    Those are (M⁻¹)ₛₛ⁻¹ q̈ₛ, where q̈ is without friction of theirs: against them the joints s do not
    accelerate.
    """
    data = mujoco.MjData(model)
    load, mass = np.zeros((len(qpos), len(dof))), np.zeros((len(qpos), len(dof)))
    units, columns = np.eye(model.nv)[dof], np.zeros((len(dof), model.nv))
    for w in range(len(qpos)):
        data.qpos[:], data.qvel[:], data.ctrl[:] = qpos[w], qvel[w], ctrl[w]
        data.qvel[dof], data.act[:] = 0.0, 0.0
        mujoco.mj_forward(model, data)
        mujoco.mj_solveM(model, data, columns, units)
        load[w] = np.linalg.solve(columns[:, dof], data.qacc[dof])
        mass[w] = 1.0 / np.diagonal(columns[:, dof])
    return load, mass


def bristled(drive: Signal, share: float, bend: float, joint: JointScale, motion: Motion) -> Signal:
    """Return the force of bristles [1] whose level of sliding F is a share of a drive's force.

    s' = (v - |v|·s)/b with s in [-1, 1]; the friction is -(F·s + σ₁·b·s'). As in `add_bristles`,
    the bend b is no less than that at which a step resolves the stiffness F/b, and σ₁ no more than
    F over the joint's speed. The law's memory holds s, which begins as in `loaded`: at rest the
    drive bends them, since they hold less than it gives.

    [1] as in `add_bristles`.
    """
    v, h, level = motion.qvel[joint.name], motion.timestep, share * np.abs(drive)
    b = np.hypot(bend, level * h**2 / (_RESOLVED * joint.inertia))
    before = motion.memory.get("bent")
    if before is None:
        slides = -np.expm1(-0.5 * joint.inertia * v**2 / np.maximum(level * b, _LEAST))
        before = np.sign(drive) + slides * (np.sign(v) - np.sign(drive))
    bent = (before + v * h / b) / (1.0 + np.abs(v) * h / b)  # implicit Euler
    motion.memory["bent"] = bent
    damping = np.minimum(2.0 * np.sqrt(level / b * joint.inertia), level / joint.speed)
    return np.asarray(-(level * bent + damping * (v - np.abs(v) * bent)))

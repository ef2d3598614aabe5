"""Friction that bends before it slips: the bristles of LuGre."""

import mujoco
import numpy as np

from bo_sysid.effects.actuators import passive_motor
from bo_sysid.effects.contract import Motion, Signal
from bo_sysid.effects.machine import JointScale, Machine

STIFF = 1e-4
"""By how much bristles bend before they slip where that is not known, in [rad] or [m]."""

BENT_FINER = (0.6, 1.6)
"""Factors by which the bend that explains most is varied."""

_BENDS = (1e-4, 3e-4, 1e-3, 3e-3)  # of the joint's travel
_BEYOND = 2.0  # times the largest of them, where a fit between them may end
_RESOLVED = 0.1  # of the stiffest spring that a step can follow


def most_bent(joint: JointScale) -> float:
    """Return the largest bend that a fit may end at, in [rad] or [m]."""
    return _BEYOND * bends(joint)[-1]


def bends(joint: JointScale) -> tuple[float, ...]:
    """Return the bends that are tried at a joint, in [rad] or [m]."""
    return tuple(bend * joint.travel for bend in _BENDS)


def add_bristles(
    spec: mujoco.MjSpec,
    name: str,
    friction: tuple[float, float, float],
    bend: float,
    machine: Machine,
) -> None:
    """Put LuGre friction [1] in the place of a joint's dry friction.

    The bristles bend by `bend` before they slip, by more where a step could not resolve their
    stiffness. They are damped against the joint's inertia, but by no more than the Coulomb level at
    the joint's speed: a simulation begins with straight bristles, and damping acts on them at once.

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
    stiffness = min(high / bend, _RESOLVED * joint.inertia / dt**2)
    motor = passive_motor(spec, name, "friction")
    damping = min(2.0 * np.sqrt(stiffness * joint.inertia), low / joint.speed)
    motor.dynprm[5:7] = (stiffness, damping)
    motor.biasprm[3:6] = (low, high, speed)
    motor.actdim = 1
    spec.joint(name).frictionloss = 0.0


def bristled(level: Signal, bend: float, joint: JointScale, motion: Motion) -> Signal:
    """Return the force of bristles [1] whose level of sliding F is given at each instant.

    s' = (v - |v|·s)/b with s in [-1, 1]; the friction is -(F·s + σ₁·b·s'). As in `add_bristles`,
    the bend b is larger where a step could not resolve the stiffness F/b, and σ₁ no more than
    F over the joint's speed. The law's memory holds s, 0 at the start.

    [1] as in `add_bristles`.
    """
    v, h = motion.qvel[joint.name], motion.timestep
    b = np.maximum(bend, level * h**2 / (_RESOLVED * joint.inertia))
    before = np.asarray(motion.memory.get("bent", 0.0))
    bent = (before + v * h / b) / (1.0 + np.abs(v) * h / b)  # implicit Euler
    motion.memory["bent"] = bent
    damping = np.minimum(2.0 * np.sqrt(level / b * joint.inertia), level / joint.speed)
    return np.asarray(-(level * bent + damping * (v - np.abs(v) * bent)))

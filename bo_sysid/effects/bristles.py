"""Presliding: friction that gives way a little before it slips, as the bristles of LuGre do."""

import mujoco
import numpy as np

from bo_sysid.effects.actuators import passive_motor
from bo_sysid.effects.machine import JointScale, Machine
from bo_sysid.effects.parts import Motion, Signal

PRESLIDING_FACTORS = (0.6, 1.6)
"""Factors by which the presliding displacement that explains most is varied."""

_PRESLIDING = (1e-4, 3e-4, 1e-3, 3e-3)  # of the spread of the joint's position
_BEYOND = 2.0  # times the largest of them, where a fit between them may end
_LEAST = 1e-30  # [J] that bristles store
_RESOLVED = 0.5  # k·h²/m of bristles without presliding: a step h follows their oscillation
_BACKED, _RATTLE = 1.5, 0.01  # the same, where dry friction holds beside them, and c/√(k·m)
_REMAINS = 0.005  # of what these hold at standstill more, in motion: none at all has no presliding


def max_presliding(joint: JointScale) -> float:
    """Return the largest presliding displacement that a fit may end at, in [rad] or [m]."""
    return _BEYOND * presliding_grid(joint)[-1]


def presliding_grid(joint: JointScale) -> tuple[float, ...]:
    """Return the presliding displacements that are tried at a joint, in [rad] or [m]."""
    return tuple(presliding * joint.spread for presliding in _PRESLIDING)


def add_bristles(
    spec: mujoco.MjSpec,
    name: str,
    friction: tuple[float, float, float],
    presliding: float,
    machine: Machine,
) -> None:
    """Put LuGre friction [1] in the place of a joint's dry friction.

    The bristles bend by √(b² + b₀²) before they slip, b₀ that at which a step can still resolve
    their stiffness: no b is below what it tells, where nothing would change with it. They are
    damped against the joint's inertia, but by no more than the Coulomb level at the joint's speed:
    more would be felt as friction of its own at every reversal.

    Args:
        spec: the spec to change.
        name: of the joint.
        friction: level of sliding, level at standstill, speed at which one becomes the other.
        presliding: displacement b before it slips, in [rad] or [m].
        machine: the scales of the joint.

    [1] Canudas de Wit, Olsson, Astrom, Lischinsky, "A new model for control of systems with
        friction", IEEE Transactions on Automatic Control 40(3), 1995.
    """
    low, high, _ = friction
    joint, dt = machine.joints[name], spec.option.timestep
    stiffness = high / np.hypot(presliding, high * dt**2 / (_RESOLVED * joint.inertia))
    motor = passive_motor(spec, name, "friction", machine)
    damping = min(2.0 * np.sqrt(stiffness * joint.inertia), low / joint.speed)
    _set_bristles(motor, stiffness, damping, friction)
    spec.joint(name).frictionloss = 0.0


def add_rise(
    spec: mujoco.MjSpec, name: str, excess: float, speed: float, machine: Machine
) -> float:
    """Add bristles to a joint's dry friction that are all of it that a joint loses in motion.

    Dry friction holds beside them, so that they may be as stiff as a step bears, and nearly
    undamped: of eight pairs these left least in two of three motions of a pendulum at rest for half
    of the time, and a tenth more than the least in the third. Bristles in the place of all friction
    rang there, and left 1.6 to 5 times as much.

    Args:
        spec: the spec to change.
        name: of the joint.
        excess: of friction at standstill, in [N m] or [N].
        speed: at which it is lost.
        machine: the scales of the joint.

    Returns:
        How much bristles hold in motion, which is to be taken from the dry friction.
    """
    joint, dt, low = machine.joints[name], spec.option.timestep, _REMAINS * excess
    motor = passive_motor(spec, name, "friction", machine)
    stiffness = _BACKED * joint.inertia / dt**2
    damping = _RATTLE * np.sqrt(stiffness * joint.inertia)
    _set_bristles(motor, stiffness, damping, (low, low + excess, speed))
    return low


def _set_bristles(
    motor: mujoco.MjsActuator,
    stiffness: float,
    damping: float,
    friction: tuple[float, float, float],
) -> None:
    motor.dynprm[5:7] = (stiffness, damping)
    motor.biasprm[3:6] = friction
    motor.actdim = 1


def bristled(
    drive: Signal, share: float, presliding: float, joint: JointScale, motion: Motion
) -> Signal:
    """Return the force of bristles [1] whose level of sliding F is a share of a drive's force.

    s' = (v - |v|·s)/b with s in [-1, 1]; the friction is -(F·s + σ₁·b·s'). As in `add_bristles`,
    b is no less than that at which a step resolves the stiffness F/b, and σ₁ no more than F over
    the joint's speed. The law's memory holds s, which begins as those of a joint do where a
    simulation begins: at rest the drive bends them, since they hold less than it gives.

    [1] as in `add_bristles`.
    """
    v, h, level = motion.qvel[joint.name], motion.timestep, share * np.abs(drive)
    b = np.hypot(presliding, level * h**2 / (_RESOLVED * joint.inertia))
    previous = motion.memory.get("bent")
    if previous is None:
        slides = -np.expm1(-0.5 * joint.inertia * v**2 / np.maximum(level * b, _LEAST))
        previous = np.sign(drive) + slides * (np.sign(v) - np.sign(drive))
    deflection = (previous + v * h / b) / (1.0 + np.abs(v) * h / b)  # implicit Euler
    motion.memory["bent"] = deflection
    damping = np.minimum(2.0 * np.sqrt(level / b * joint.inertia), level / joint.speed)
    return np.asarray(-(level * deflection + damping * (v - np.abs(v) * deflection)))

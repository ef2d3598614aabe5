"""What MuJoCo derives at every compilation, and what flags switch off, written down once.

A machine keeps its gains and its springs when the model's masses turn out to be others. Left as
they are, `dampratio`, `springdamper` and the automatic `springlength` would follow every edit of
mass, inertia, armature or reference position.
"""

import mujoco
import numpy as np

_OFF = mujoco.mjtDisableBit
_FRICTION, _EQUALITY = int(_OFF.mjDSBL_FRICTIONLOSS), int(_OFF.mjDSBL_EQUALITY)
_LIMIT, _GRAVITY = int(_OFF.mjDSBL_LIMIT), int(_OFF.mjDSBL_GRAVITY)
_SPRING, _DAMPER = int(_OFF.mjDSBL_SPRING), int(_OFF.mjDSBL_DAMPER)
_ALL = int(_OFF.mjDSBL_CONSTRAINT)  # stands for friction, equalities, limits and contact


def settle(spec: mujoco.MjSpec, compiled: mujoco.MjModel) -> None:
    """Give a spec the damping of servos and the springs that MuJoCo derived, in place.

    The model stays the same to the last bit.

    Args:
        spec: the spec to change; its elements have the ids of `compiled`.
        compiled: what it compiles to.
    """
    for actuator in spec.actuators:
        if actuator.biasprm[2] > 0:  # a damping ratio, where the actuator is a position servo
            actuator.biasprm[2] = compiled.actuator_biasprm[actuator.id, 2]
    for joint in spec.joints:
        if np.any(np.asarray(joint.springdamper) > 0):
            derived = compiled.joint(joint.id)
            joint.damping[0], joint.stiffness[0] = derived.damping[0], derived.stiffness[0]
            joint.springdamper = np.zeros(2)
    for tendon in spec.tendons:
        if np.all(np.asarray(tendon.springlength) == -1):
            tendon.springlength = compiled.tendon_lengthspring[tendon.id]


def switch_on(spec: mujoco.MjSpec, compiled: mujoco.MjModel) -> None:
    """Write down what a spec's flags switch off as something that is not there, in place.

    Under `<flag constraint="disable"/>`, as dm_control's acrobot has it, friction that is added
    would do nothing, under `gravity` a tilt, and under `spring` a force. The model stays the same
    to the last bit. Limits stay switched off where there are some, since their ranges say how far a
    machine may go.

    Args:
        spec: the spec to change.
        compiled: what it compiles to.
    """
    off = int(spec.option.disableflags)
    if off & _ALL:
        off |= _FRICTION | _EQUALITY | _LIMIT | int(_OFF.mjDSBL_CONTACT)
    if off & _FRICTION:
        for element in (*spec.joints, *spec.tendons):
            element.frictionloss = 0.0
    if off & _EQUALITY:
        for equality in spec.equalities:
            equality.active = False
    if off & _GRAVITY:
        spec.option.gravity = np.zeros(3)
    limited = compiled.jnt_limited.any() or compiled.tendon_limited.any()
    written = _ALL | _FRICTION | _EQUALITY | _GRAVITY | (0 if limited else _LIMIT)
    spec.option.disableflags = off & ~written & ~_without_passive(spec, off)


def _without_passive(spec: mujoco.MjSpec, off: int) -> int:
    """Take the springs or the dampers that flags switch off out of a spec; return the flag.

    Both flags together switch off all passive forces, of a medium as well, and stay; so do those of
    soft bodies.
    """
    passive = off & (_SPRING | _DAMPER)
    if passive not in (_SPRING, _DAMPER) or spec.flexes:
        return 0
    for element in (*spec.joints, *spec.tendons):
        name = "stiffness" if passive == _SPRING else "damping"
        setattr(element, name, np.zeros(3))
    for actuator in spec.actuators if passive == _DAMPER else ():
        actuator.damping = np.zeros(3)
    return passive

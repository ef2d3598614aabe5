"""What MuJoCo derives from masses and poses at every compilation, written down once.

A machine keeps its gains and its springs when the model's masses turn out to be others. Left as
they are, `dampratio`, `springdamper` and the automatic `springlength` would follow every edit of
mass, inertia, armature or reference position.
"""

import mujoco
import numpy as np


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

"""Kinds of joints as compiled models number them, and how many numbers each takes."""

import mujoco
import numpy as np

FREE = int(mujoco.mjtJoint.mjJNT_FREE)
BALL = int(mujoco.mjtJoint.mjJNT_BALL)
SLIDE = int(mujoco.mjtJoint.mjJNT_SLIDE)
HINGE = int(mujoco.mjtJoint.mjJNT_HINGE)
SCALAR = (HINGE, SLIDE)
"""Those of one coordinate."""

QPOS_SIZE = {FREE: 7, BALL: 4, SLIDE: 1, HINGE: 1}
QVEL_SIZE = {FREE: 6, BALL: 3, SLIDE: 1, HINGE: 1}


def settle_springdamper(joint: mujoco.MjsJoint, compiled: mujoco.MjModel) -> None:
    """Give a joint of a spec the stiffness and damping that MuJoCo derives from `springdamper`.

    As long as a joint has it, MuJoCo derives them again, whatever else is written into the spec.

    Args:
        joint: of the spec, changed in place; one without `springdamper` stays as it is.
        compiled: the spec as compiled before any edit.
    """
    if np.any(np.asarray(joint.springdamper) > 0):
        derived = compiled.joint(joint.name)
        joint.damping[0], joint.stiffness[0] = derived.damping[0], derived.stiffness[0]
        joint.springdamper = np.zeros(2)

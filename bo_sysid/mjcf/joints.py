"""Kinds of joints as compiled models number them, and how many numbers each takes."""

import mujoco

FREE = int(mujoco.mjtJoint.mjJNT_FREE)
BALL = int(mujoco.mjtJoint.mjJNT_BALL)
SLIDE = int(mujoco.mjtJoint.mjJNT_SLIDE)
HINGE = int(mujoco.mjtJoint.mjJNT_HINGE)
SCALAR = (HINGE, SLIDE)
"""Those of one coordinate."""

QPOS_SIZE = {FREE: 7, BALL: 4, SLIDE: 1, HINGE: 1}
QVEL_SIZE = {FREE: 6, BALL: 3, SLIDE: 1, HINGE: 1}

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
_METRES = {"qpos": "m", "qvel": "m/s"}


def quaternions(model: mujoco.MjModel) -> tuple[tuple[str, ...], ...]:
    """Return the four channels of the orientation of each free and each ball joint."""
    first = {FREE: 3, BALL: 0}
    turning = np.flatnonzero(np.isin(model.jnt_type, list(first)))
    names = {model.joint(j).name: first[int(model.jnt_type[j])] for j in turning}
    return tuple(tuple(f"qpos.{n}.{i}" for i in range(k, k + 4)) for n, k in names.items())


def joint_units(model: mujoco.MjModel) -> dict[str, str]:
    """Return the units of the position and velocity channels; quaternions have none."""
    units: dict[str, str] = {}
    for j, kind in enumerate(model.jnt_type):
        name, place = model.joint(j).name, "rad" if kind == HINGE else "m"
        if kind in SCALAR:
            units |= {f"qpos.{name}": place, f"qvel.{name}": f"{place}/s"}
            continue
        slides = 3 if kind == FREE else 0
        units |= {f"{k}.{name}.{i}": u for k, u in _METRES.items() for i in range(slides)}
        units |= {f"qvel.{name}.{i}": "rad/s" for i in range(slides, QVEL_SIZE[int(kind)])}
    return units

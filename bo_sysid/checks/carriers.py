"""Which joint carries another about the same axis."""

from collections.abc import Mapping

import mujoco

from bo_sysid.mjcf.joints import HINGE

_ALONG = 0.999  # cosine of two axes that are one direction


def carriers(model: mujoco.MjModel) -> Mapping[str, str]:
    """Return for each hinge the next one towards the base with the same axis, if there is one.

    An encoder that counts from the base shows the angle of both.
    """
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    found: dict[str, str] = {}
    for j in range(model.njnt):
        bodies = _up_to(model, int(model.jnt_bodyid[j]))
        for k in (k for k in reversed(range(j)) if int(model.jnt_bodyid[k]) in bodies):
            hinges = int(model.jnt_type[j]) == HINGE == int(model.jnt_type[k])
            if hinges and data.xaxis[j] @ data.xaxis[k] > _ALONG:
                found[model.joint(j).name] = model.joint(k).name
                break
    return found


def _up_to(model: mujoco.MjModel, body: int) -> set[int]:
    """Return a body and all that carry it."""
    held = set()
    while body:
        held.add(body)
        body = int(model.body_parentid[body])
    return held

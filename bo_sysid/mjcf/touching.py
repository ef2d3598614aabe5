"""Whether parts of a model can come into contact at all."""

import mujoco
import numpy as np


def can_touch(model: mujoco.MjModel) -> bool:
    """Return whether MuJoCo would let any two geoms of a compiled model collide.

    Its rules: no contact within a body or what is welded to it, nor between a body and its parent
    (but the world), nor between excluded bodies, nor where no bits of contype and conaffinity meet.
    """
    if model.opt.disableflags & int(mujoco.mjtDisableBit.mjDSBL_CONTACT):
        return False
    if model.npair:
        return True
    weld = model.body_weldid[model.geom_bodyid]
    parent = model.body_weldid[model.body_parentid[weld]]
    bits = model.geom_contype[:, None] & model.geom_conaffinity
    meet = ((bits | bits.T) != 0) & (weld[:, None] != weld)
    if not model.opt.disableflags & int(mujoco.mjtDisableBit.mjDSBL_FILTERPARENT):
        related = (parent[:, None] == weld) & (weld != 0) & (weld[:, None] != 0)
        meet &= ~(related | related.T)
    bodies = model.geom_bodyid.astype(int)
    signature = np.minimum(bodies[:, None], bodies) * 2**16 + np.maximum(bodies[:, None], bodies)
    return bool((meet & ~np.isin(signature, model.exclude_signature)).any())

"""Which parts of a model can come into contact, and how MuJoCo mixes what two of them ask for."""

from collections.abc import Iterator

import mujoco
import numpy as np
from jaxtyping import Bool, Float, Int

# a flex, which has no geom, is none either
_NO_DISTANCE = (int(mujoco.mjtGeom.mjGEOM_HFIELD), int(mujoco.mjtGeom.mjGEOM_SDF))
_FAR = 1.0  # [m] beyond which distances are not told apart
_NOISE, _APART = 5.0, 1e-4  # times the noise of a distance, and [m], from which geoms are apart
_RARELY = 1e-3  # of the poses, in which they may seem so


def can_touch(model: mujoco.MjModel) -> bool:
    """Return whether MuJoCo would let any two geoms of a compiled model collide."""
    return bool((model.npair and not _off(model)) or partners(model).any())


def _off(model: mujoco.MjModel) -> bool:
    return bool(model.opt.disableflags & int(mujoco.mjtDisableBit.mjDSBL_CONTACT))


def touching(model: mujoco.MjModel, poses: Float[np.ndarray, "W nq"]) -> float:
    """Return the share of poses in which geoms of the model touch."""
    return sum(_touches(model, poses)) / len(poses)


def touched(model: mujoco.MjModel, poses: Float[np.ndarray, "W nq"]) -> Bool[np.ndarray, " W"]:
    """Return in which poses geoms of the model touch."""
    return np.fromiter(_touches(model, poses), bool, len(poses))


def ever_touching(model: mujoco.MjModel, poses: Float[np.ndarray, "W nq"]) -> bool:
    """Return whether geoms of the model touch in any pose."""
    return any(_touches(model, poses))


def _touches(model: mujoco.MjModel, poses: Float[np.ndarray, "W nq"]) -> Iterator[bool]:
    if not can_touch(model):
        yield from [False] * len(poses)
        return
    data = mujoco.MjData(model)
    for pose in poses:
        data.qpos[:] = pose
        mujoco.mj_fwdPosition(model, data)
        yield data.ncon > 0


def comes_and_goes(
    model: mujoco.MjModel,
    poses: Float[np.ndarray, "W nq"],
    moved: Float[np.ndarray, "W nq"],
) -> bool:
    """Return whether any geoms that touch in some poses are apart in others, or none touch here.

    As the tyres of a wheeled robot are not. How far they seem to be apart by the noise of the poses
    alone is told by poses with more such noise.

    Args:
        model: the model.
        poses: positions as they were recorded.
        moved: the same with as much noise again.
    """
    data, found = mujoco.MjData(model), set[tuple[int, int]]()
    for pose in poses:
        data.qpos[:] = pose
        mujoco.mj_fwdPosition(model, data)
        found.update(map(tuple, np.sort(data.contact.geom[: data.ncon], axis=1).tolist()))
    for one, other in found:
        if one < 0 or {model.geom_type[one], model.geom_type[other]} & set(_NO_DISTANCE):
            return True
        apart, noisy = (_distances(model, data, one, other, p) for p in (poses, moved))
        far = apart > _NOISE * np.std(noisy - apart) + _APART
        if far.mean() > _RARELY:
            return True
    return not found  # elsewhere, or between these poses, some do


def _distances(
    model: mujoco.MjModel, data: mujoco.MjData, one: int, other: int, poses: np.ndarray
) -> Float[np.ndarray, " W"]:
    """Return how far two geoms are apart in [m], negative where one is in the other."""
    found = np.empty(len(poses))
    for k, pose in enumerate(poses):
        data.qpos[:] = pose
        mujoco.mj_kinematics(model, data)
        found[k] = mujoco.mj_geomDistance(model, data, one, other, _FAR, None)
    return found


def partners(model: mujoco.MjModel) -> Bool[np.ndarray, "ngeom ngeom"]:
    """Return which geoms can touch, pairs that the model lists left aside.

    None where contacts are switched off. No contact within a body or what is welded to it, nor
    between a body and its parent (but the world), nor between excluded bodies, nor where no bits of
    contype and conaffinity meet.
    Source: MuJoCo documentation, Computation, Collision detection, Filtering.
    """
    kinds, affine = model.geom_contype, model.geom_conaffinity
    touch = ((kinds[:, None] & affine) | (affine[:, None] & kinds)) != 0
    touch &= not _off(model)
    weld = model.body_weldid[model.geom_bodyid]
    parent = model.body_weldid[model.body_parentid[weld]]
    touch &= weld[:, None] != weld
    if not model.opt.disableflags & int(mujoco.mjtDisableBit.mjDSBL_FILTERPARENT):
        child = (weld[:, None] == parent) & (weld[:, None] != 0)
        touch &= ~(child | child.T)
    for signature in model.exclude_signature:
        one, two = (model.geom_bodyid == b for b in divmod(int(signature), 1 << 16))
        touch &= ~(np.outer(one, two) | np.outer(two, one))
    return np.asarray(touch)


def joints_to_contact(model: mujoco.MjModel) -> frozenset[str]:
    """Return the joints that move a geom which can touch another, also in a listed pair."""
    listed = () if _off(model) else (*model.pair_geom1, *model.pair_geom2)
    geoms = (*np.flatnonzero(partners(model).any(axis=1)), *listed)
    bodies = {int(model.geom_bodyid[g]) for g in geoms}
    found: set[str] = set()
    for body in bodies:
        while body:
            first = int(model.body_jntadr[body])
            found.update(model.joint(first + k).name for k in range(model.body_jntnum[body]))
            body = int(model.body_parentid[body])
    return frozenset(found)


def mixed(
    model: mujoco.MjModel, geom: int, others: Int[np.ndarray, " k"]
) -> Float[np.ndarray, "k 10"]:
    """Return what MuJoCo makes of a geom and others of equal priority, sliding friction left aside.

    The larger condim and frictions, and solref and solimp weighted by solmix (the smaller solref
    where one is given directly, as a negative number).
    Source: MuJoCo documentation, Computation, Contact, Parameters.

    Args:
        model: the model.
        geom: number of the geom; what it makes with itself are its own attributes.
        others: numbers of the others.

    Returns:
        Columns condim, two of friction, two of solref, five of solimp.
    """
    own, theirs = model.geom_solmix[geom], model.geom_solmix[others]
    total = own + theirs
    weight = np.where(total > 0, own / np.where(total > 0, total, 1.0), 0.5)[:, None]

    def mean(values: Float[np.ndarray, "n c"]) -> Float[np.ndarray, "k c"]:
        return np.asarray(weight * values[geom] + (1.0 - weight) * values[others])

    condim = np.maximum(model.geom_condim[geom], model.geom_condim[others])[:, None]
    friction = np.maximum(model.geom_friction[geom, 1:], model.geom_friction[others, 1:])
    refs = model.geom_solref
    timed = ((refs[geom, 0] > 0) & (refs[others, 0] > 0))[:, None]
    solref = np.where(timed, mean(refs), np.minimum(refs[geom], refs[others]))
    return np.hstack([condim, friction, solref, mean(model.geom_solimp)])


def take_priority(spec: mujoco.MjSpec, model: mujoco.MjModel, name: str, partner: int) -> None:
    """Let a geom decide on the friction of its contacts; with a partner, nothing else changes.

    The geom of higher priority decides on all attributes of a contact; those but sliding friction
    become what MuJoCo makes of the two as equals (`mixed`).

    Args:
        spec: the spec to change.
        model: the nominal model.
        name: of the geom.
        partner: number of a geom of equal priority.
    """
    geom = spec.geom(name)
    (attributes,) = mixed(model, model.geom(name).id, np.array([partner]))
    geom.priority = int(model.geom_priority.max()) + 1
    geom.condim = int(attributes[0])
    geom.friction[1:], geom.solref, geom.solimp = np.split(attributes[1:], [2, 4])

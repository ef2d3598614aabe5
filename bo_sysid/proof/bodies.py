"""Changes of a plant's body, written into the compiled model and not into its MJCF.

Masses are moved by the parallel-axis theorem, written here a second time and apart from the edits
of the catalogue.
"""

import copy

import mujoco
import numpy as np
from jaxtyping import Float


def copy_model(model: mujoco.MjModel) -> mujoco.MjModel:
    """Return a copy of a compiled model."""
    return copy.copy(model)


def settle(model: mujoco.MjModel) -> None:
    """Bring what MuJoCo derives from masses up to date."""
    mujoco.mj_setConst(model, mujoco.MjData(model))


def add_mass(model: mujoco.MjModel, body: str, mass: float, at: Float[np.ndarray, " 3"]) -> None:
    """Add a point mass to a body, at a position in the body's frame."""
    b = model.body(body).id
    own, centre = float(model.body_mass[b]), model.body_ipos[b].copy()
    total = own + mass
    moved = (own * centre + mass * at) / total
    turn = rotation(model.body_iquat[b])
    inertia = turn @ np.diag(model.body_inertia[b]) @ turn.T
    inertia += own * _point(centre - moved) + mass * _point(at - moved)
    values, axes = np.linalg.eigh(inertia)
    if np.linalg.det(axes) < 0:
        axes[:, 0] *= -1
    model.body_mass[b], model.body_ipos[b], model.body_inertia[b] = total, moved, values
    mujoco.mju_mat2Quat(model.body_iquat[b], axes.ravel())
    settle(model)


def scale_body(model: mujoco.MjModel, body: str, factor: float) -> None:
    """Scale a body's mass, and its inertia along."""
    b = model.body(body).id
    model.body_mass[b] *= factor
    model.body_inertia[b] *= factor
    settle(model)


def add_armature(model: mujoco.MjModel, dof: int, inertia: float) -> None:
    """Add the inertia of a rotor."""
    model.dof_armature[dof] += inertia
    settle(model)


def tilt(model: mujoco.MjModel, about_x: float, about_y: float) -> None:
    """Turn gravity by an angle about the world's x axis, then by one about its y axis."""
    x, y, z = model.opt.gravity
    cx, sx, cy, sy = np.cos(about_x), np.sin(about_x), np.cos(about_y), np.sin(about_y)
    y, z = cx * y - sx * z, sx * y + cx * z
    model.opt.gravity[:] = (cy * x + sy * z, y, cy * z - sy * x)


def end_of(model: mujoco.MjModel, body: str) -> Float[np.ndarray, " 3"] | None:
    """Return where a load is held: the body's site, else where its child begins, else None."""
    b = model.body(body).id
    sites = np.flatnonzero(model.site_bodyid == b)
    if sites.size:
        return np.array(model.site_pos[sites[0]])
    children = [c for c in range(1, model.nbody) if model.body_parentid[c] == b]
    return np.array(model.body_pos[children[0]]) if len(children) == 1 else None


def _point(d: np.ndarray) -> np.ndarray:
    return np.asarray(d @ d * np.eye(3) - np.outer(d, d))


def rotation(quat: np.ndarray) -> np.ndarray:
    """Return a quaternion as a matrix."""
    flat = np.zeros(9)
    mujoco.mju_quat2Mat(flat, quat)
    return flat.reshape(3, 3)

"""The robot as a drawing: outlines of its geoms in a recorded pose, seen from the side.

What MuJoCo knows of a model is enough for a picture; no display and no OpenGL is needed.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import mujoco
import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import ConvexHull, QhullError

from bo_sysid.effects.inertia import payload_name
from bo_sysid.mjcf import Loops, Model
from bo_sysid.mjcf.commands import driven_joint
from bo_sysid.mjcf.joints import HINGE

Points = Float[np.ndarray, "P 3"]

_AROUND = 24  # points around a round shape
_ALIGNED = 0.9  # cosine above which a hinge turns in the picture's plane
_LEVEL = 0.05  # of its width: a machine that is flatter is seen from above
_TURNED, _LIFTED = np.radians(30.0), np.radians(20.0)
_SKIPPED = (int(mujoco.mjtGeom.mjGEOM_PLANE), int(mujoco.mjtGeom.mjGEOM_HFIELD))


@dataclass(frozen=True)
class Posed:
    """A compiled model in a pose.

    Attributes:
        model: compiled, with what only the eye needs.
        data: in the pose.
        channels: of each entry of `qpos`.
        loops: by which joints that no channel tells follow from the others.
    """

    model: mujoco.MjModel
    data: mujoco.MjData
    channels: tuple[str, ...]
    loops: Loops

    @classmethod
    def of(cls, model: Model, pose: Mapping[str, float]) -> "Posed":
        """Put a model into a pose given by position channels.

        Other joints stay where the model is, or follow where a closed chain says so.
        """
        compiled = model.compile(visuals=True)
        silent = [n for n in model.joints if f"qpos.{n}" not in pose]
        loops = Loops.of(model.compile(), silent)
        posed = cls(compiled, mujoco.MjData(compiled), model.qpos_channels, loops)
        posed.move(pose)
        return posed

    def move(self, pose: Mapping[str, float]) -> None:
        """Put the model into another pose of the same channels."""
        for k, channel in enumerate(self.channels):
            self.data.qpos[k] = pose.get(channel, self.data.qpos[k])
        if self.loops.silent:
            self.data.qpos[:] = self.loops.followed(self.data.qpos[None])[0]
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_comPos(self.model, self.data)

    @property
    def geoms(self) -> list[int]:
        """The geoms that are drawn: those of the robot's bodies, not the world around it."""
        m = self.model
        return [
            g for g in range(m.ngeom)
            if m.geom_bodyid[g] and m.geom_type[g] not in _SKIPPED and m.geom_rgba[g, 3] > 0
        ]  # fmt: skip

    @property
    def feet(self) -> list[int]:
        """The joints by which the robot hangs on the world, a floating base's excepted."""
        m = self.model
        turns = m.jnt_type == HINGE
        fixed = m.body_weldid[m.body_parentid[m.jnt_bodyid]] == 0
        single = np.bincount(m.jnt_bodyid, minlength=m.nbody)[m.jnt_bodyid] == 1
        return [int(j) for j in np.flatnonzero(turns & fixed & single)]

    def surface(self, geom: int) -> Points:
        """Return points on a geom's surface, in the world; their hull is its shape."""
        local = _local(self.model, geom)
        turn = self.data.geom_xmat[geom].reshape(3, 3)
        return np.asarray(local @ turn.T + self.data.geom_xpos[geom])

    def joint_place(self, name: str) -> Float[np.ndarray, " 3"]:
        """Return where a joint is, in the world."""
        return np.array(self.data.xanchor[self.model.joint(name).id])


@dataclass(frozen=True)
class Site:
    """A place of a robot that is pointed at.

    Attributes:
        label: what is said of it.
        point: where it is, None for the machine as a whole.
        geoms: that are coloured.
    """

    label: str
    point: Float[np.ndarray, " 3"] | None
    geoms: tuple[int, ...] = ()


def find_site(posed: Posed, kind: str, name: str) -> Site:
    """Return where a site of a finding is; the machine as a whole where it is nowhere.

    A body with a load is pointed at where that is.
    """
    model = posed.model
    joint = _joint_of(model, kind, name)
    if joint is not None:
        return Site(f"{kind} {name}", posed.joint_place(joint))
    if kind == "actuator" and _has(model, mujoco.mjtObj.mjOBJ_ACTUATOR, name):
        return Site(f"{kind} {name}", _acts_at(posed, model.actuator(name).id))
    if kind == "body" and _has(model, mujoco.mjtObj.mjOBJ_BODY, name):
        body = model.body(name).id
        own = tuple(int(g) for g in np.flatnonzero(model.geom_bodyid == body))
        load = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, payload_name(name))
        place = posed.data.xipos[body] if load < 0 else posed.data.xpos[load]
        return Site(f"{kind} {name}", np.array(place), own)
    if kind == "geom" and _has(model, mujoco.mjtObj.mjOBJ_GEOM, name):
        geom = model.geom(name).id
        return Site(f"{kind} {name}", np.array(posed.data.geom_xpos[geom]), (geom,))
    return Site("the machine as a whole" if kind == "world" else f"{kind} {name}", None)


def view(posed: Posed) -> Float[np.ndarray, "2 3"]:
    """Return the picture's directions, right and up: a side view, or from above if it is flat.

    The view is along the axis that most hinges share; where they share none, along the level
    direction in which the machine extends least. It is turned and lifted where a hinge has another
    axis.
    """
    up = np.array([0.0, 0.0, 1.0])
    points = np.concatenate([posed.surface(g) for g in posed.geoms] or [np.zeros((1, 3))])
    spread = points - points.mean(axis=0)
    width = float(np.linalg.norm(np.ptp(points[:, :2], axis=0)))
    axes = posed.data.xaxis[posed.model.jnt_type == HINGE]
    level = axes[np.abs(axes[:, 2]) < 1 - _ALIGNED] if len(axes) else axes
    upright = len(axes) > 0 and (np.abs(axes @ up) > _ALIGNED).mean() > 0.5
    if upright or np.ptp(points[:, 2]) < _LEVEL * width:
        return np.eye(3)[:2]
    if len(level) and (np.abs(level @ level[0]) > _ALIGNED).mean() > 0.5:
        toward = level[0]
    else:
        _, _, directions = np.linalg.svd(spread[:, :2], full_matrices=False)
        toward = np.array([*directions[-1], 0.0])
    right = np.cross(up, toward)
    right = right / np.linalg.norm(right)
    right = right if right[np.argmax(np.abs(right))] > 0 else -right
    onto = np.array([right, up])
    common = np.abs(axes @ np.cross(right, up)) > _ALIGNED
    return onto if common.all() else _oblique(onto)


def _oblique(onto: Float[np.ndarray, "2 3"]) -> Float[np.ndarray, "2 3"]:
    """Return a side view turned about the vertical and lifted, for a machine that is not plane."""
    right, up = onto
    away = np.cross(right, up)
    turned = np.cos(_TURNED) * right + np.sin(_TURNED) * away
    toward = np.cross(turned, up)
    return np.array([turned, np.cos(_LIFTED) * up - np.sin(_LIFTED) * toward])


def outline(points: Points, onto: Float[np.ndarray, "2 3"]) -> Float[np.ndarray, "n 2"]:
    """Return the outline of the hull of some points, projected."""
    flat = points @ onto.T
    try:
        return np.asarray(flat[ConvexHull(flat).vertices])
    except QhullError:  # seen edge on
        return np.asarray(flat)


def _local(model: mujoco.MjModel, geom: int) -> Points:
    """Return points on a geom's surface in its own frame."""
    kind, size = model.geom_type[geom], model.geom_size[geom]
    if kind == mujoco.mjtGeom.mjGEOM_MESH:
        mesh = model.geom_dataid[geom]
        first = model.mesh_vertadr[mesh]
        return np.array(model.mesh_vert[first : first + model.mesh_vertnum[mesh]], float)
    if kind == mujoco.mjtGeom.mjGEOM_BOX:
        corners = [[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]
        return np.asarray(np.array(corners) * size)
    round_, along = ball(), np.array([0.0, 0.0, size[1]])
    if kind == mujoco.mjtGeom.mjGEOM_CAPSULE:
        return np.concatenate([round_ * size[0] - along, round_ * size[0] + along])
    if kind == mujoco.mjtGeom.mjGEOM_CYLINDER:
        ring = round_[np.abs(round_[:, 2]) < 1e-9] * size[0]
        return np.concatenate([ring - along, ring + along])
    if kind == mujoco.mjtGeom.mjGEOM_SPHERE:
        return np.asarray(round_ * size[0])
    return np.asarray(round_ * size)  # an ellipsoid


def ball() -> Points:
    """Return points on the unit sphere, rings of them."""
    turn = np.linspace(0, 2 * np.pi, _AROUND, endpoint=False)
    lift = np.linspace(-0.5 * np.pi, 0.5 * np.pi, _AROUND // 2 + 1)
    a, b = (m.ravel() for m in np.meshgrid(turn, lift))
    return np.stack([np.cos(a) * np.cos(b), np.sin(a) * np.cos(b), np.sin(b)], axis=1)


def _joint_of(model: mujoco.MjModel, kind: str, name: str) -> str | None:
    """Return the joint at which a site is, None where it is at none."""
    if kind == "actuator" and _has(model, mujoco.mjtObj.mjOBJ_ACTUATOR, name):
        return driven_joint(model, model.actuator(name).id)
    if kind == "channel":
        parts = name.split(".")
        kind, name = "joint", parts[1] if len(parts) > 1 else ""
    joint = kind == "joint" and _has(model, mujoco.mjtObj.mjOBJ_JOINT, name)
    return name if joint else None


def _acts_at(posed: Posed, actuator: int) -> Float[np.ndarray, " 3"] | None:
    """Return where an actuator that drives no joint acts: its site or body; None for a tendon."""
    model, data = posed.model, posed.data
    at, target = int(model.actuator_trntype[actuator]), int(model.actuator_trnid[actuator, 0])
    places = {
        int(mujoco.mjtTrn.mjTRN_SITE): data.site_xpos,
        int(mujoco.mjtTrn.mjTRN_BODY): data.xipos,
    }
    return np.array(places[at][target]) if at in places else None


def _has(model: mujoco.MjModel, kind: mujoco.mjtObj, name: str) -> bool:
    return bool(mujoco.mj_name2id(model, kind, name) >= 0)


def depth_order(
    posed: Posed, geoms: Iterable[int], onto: Float[np.ndarray, "2 3"]
) -> Int[np.ndarray, " G"]:
    """Return the geoms, farthest from the eye first."""
    chosen = np.array(list(geoms), int)
    away = np.cross(onto[0], onto[1])
    return chosen[np.argsort(posed.data.geom_xpos[chosen] @ away, kind="stable")]

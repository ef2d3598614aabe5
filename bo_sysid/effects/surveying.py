"""Measuring the scales of a machine from its model and recordings."""

from collections.abc import Mapping, Sequence
from types import MappingProxyType

import mujoco
import numpy as np
from jaxtyping import Float

from bo_sysid.effects.actuator_scales import actuator_scale
from bo_sysid.effects.machine import ActuatorScale, BodyScale, ChannelScale, JointScale, Machine
from bo_sysid.effects.recorded_motion import Motion, motion_of
from bo_sysid.effects.transmitted import transmitted
from bo_sysid.mjcf.compiling import coordinates
from bo_sysid.mjcf.joints import HINGE, SCALAR, SLIDE
from bo_sysid.mjcf.touching import can_touch
from bo_sysid.recording import Recording

_POSES = 20
_INSTANTS = 200
_LONG = 1.5  # times the next extent of a box or mesh, from which it has ends
_FLOOR = 1e-6
_ROUND = (int(mujoco.mjtGeom.mjGEOM_CAPSULE), int(mujoco.mjtGeom.mjGEOM_CYLINDER))


def survey(model: mujoco.MjModel, recordings: Sequence[Recording]) -> Machine:
    """Measure the scales of a machine.

    Forces are scaled by effective inertia times acceleration, and by what the actuators did, also
    through tendons and closed chains.
    Velocities and accelerations come from a Savitzky-Golay filter; they set bounds and probe
    sizes and enter no answer.

    Args:
        model: the compiled nominal model, joints and actuators named.
        recordings: with ``qpos.<joint>`` for each hinge and slide joint.
    """
    names = [model.joint(j).name for j in range(model.njnt)]
    scalar = [
        n
        for j, n in enumerate(names)
        if int(model.jnt_type[j]) in SCALAR and all(f"qpos.{n}" in r.channels for r in recordings)
    ]
    motion = {n: motion_of(recordings, n) for n in scalar}
    actuators = {
        model.actuator(a).name: actuator_scale(model, a, recordings, motion)
        for a in range(model.nactuator)
        if model.actuator_ctrlnum[a] == 1
    }
    inertia, loads = _inertia(model, recordings), _loads(model, motion)
    felt = transmitted(model, recordings)
    joints = {n: _joint(model, n, motion[n], inertia, loads, felt, actuators) for n in scalar}
    bodies = {
        b.name: b
        for b in (_body(model, i) for i in range(1, model.nbody))
        if b.name and b.mass > 1e-9 and model.body_treeid[model.body(b.name).id] >= 0
    }
    known = _predicted(model)
    times = [c.time for r in recordings for c in r.of_kind("qpos").values()]
    scales = _scales(recordings, joints)
    return Machine(
        model,
        float(model.opt.timestep),
        MappingProxyType(joints),
        MappingProxyType(actuators),
        MappingProxyType(bodies),
        tuple(n for n in scales if n in known),
        float(np.median(np.concatenate([np.diff(t) for t in times]))) if times else 0.0,
        float(max((r.duration for r in recordings), default=0.0)),
        MappingProxyType(scales),
        can_touch(model),
    )


def _joint(
    model: mujoco.MjModel,
    name: str,
    motion: Motion,
    inertia: Float[np.ndarray, " nv"],
    loads: Float[np.ndarray, " nv"],
    felt: Float[np.ndarray, "T nv"],
    actuators: Mapping[str, ActuatorScale],
) -> JointScale:
    dof = int(model.joint(name).dofadr[0])
    drives = [a for a in actuators.values() if a.joint == name]
    acceleration = max(float(np.sqrt(np.mean(motion.a**2))), _FLOOR)
    moved = inertia[dof] * acceleration
    spreads = (float(felt[:, dof].std()), *(a.force_std for a in drives))
    force = max([moved, float(loads[dof]), _FLOOR, *(0.3 * s for s in spreads)])
    return JointScale(
        name=name,
        dof=dof,
        hinge=int(model.joint(name).type[0]) == HINGE,
        force=force,
        speed=max(float(np.sqrt(np.mean(motion.v**2))), _FLOOR),
        acceleration=acceleration,
        spread=max(float(motion.q.std()), _FLOOR),
        span=max(float(np.ptp(motion.q)), _FLOOR),
        inertia=float(inertia[dof]),
        actuators=tuple(a.name for a in drives),
        driven=sum(a.force_max for a in drives) + float(np.abs(felt[:, dof]).max()),
        middle=0.5 * float(motion.q.min() + motion.q.max()),
    )


def _inertia(model: mujoco.MjModel, recordings: Sequence[Recording]) -> Float[np.ndarray, " nv"]:
    """Return 1/diag(M⁻¹), the inertia felt at each degree of freedom, over recorded poses."""
    data = mujoco.MjData(model)
    full = np.zeros((model.nv, model.nv))
    found = []
    for r in recordings:
        start, stop = r.span
        for t in np.linspace(start, stop, _POSES):
            for j in range(model.njnt):
                key = f"qpos.{model.joint(j).name}"
                if key in r.channels:
                    data.qpos[model.jnt_qposadr[j]] = r.channels[key].at(np.array([t]))[0]
            mujoco.mj_forward(model, data)
            mujoco.mj_fullM(model, data, full)
            found.append(1.0 / np.maximum(np.diag(np.linalg.inv(full)), 1e-12))
    return np.asarray(np.mean(found, axis=0))


def _loads(model: mujoco.MjModel, motion: Mapping[str, Motion]) -> Float[np.ndarray, " nv"]:
    """Return how much gravity and the motion of all joints load each degree of freedom.

    The larger of the root mean square of M a and the standard deviation of the bias force, over
    instants of the recordings: a joint that friction holds moves little and is loaded all the same.
    """
    data = mujoco.MjData(model)
    carried, biases = [np.zeros(model.nv)], [np.zeros(model.nv)]
    first = next(iter(motion.values()), None)
    for at in np.linspace(0, 1, _INSTANTS, endpoint=False) if first is not None else ():
        acceleration = np.zeros(model.nv)
        for name, m in motion.items():
            k = int(at * len(m.q))
            joint = model.joint(name)
            data.qpos[joint.qposadr[0]], data.qvel[joint.dofadr[0]] = m.q[k], m.v[k]
            acceleration[joint.dofadr[0]] = m.a[k]
        mujoco.mj_forward(model, data)
        force = np.zeros(model.nv)
        mujoco.mj_mulM(model, data, force, acceleration)
        carried.append(force)
        biases.append(data.qfrc_bias.copy())
    inertial = np.sqrt(np.mean(np.square(carried), axis=0))
    return np.asarray(np.maximum(inertial, np.std(biases[1:] or biases, axis=0)))


def _body(model: mujoco.MjModel, i: int) -> BodyScale:
    """Return a body; its tip is its first site, else its farthest child, end of geom or centre."""
    sites = [model.site_pos[k] for k in range(model.nsite) if model.site_bodyid[k] == i]
    points = list(sites[:1])
    if not points:
        points = [model.body_pos[k] for k in range(1, model.nbody) if model.body_parentid[k] == i]
        geoms = np.flatnonzero(model.geom_bodyid == i).tolist()
        points += [end for g in geoms for end in _ends(model, g)]
        points.append(model.body_ipos[i])
    x, y, z = max(points, key=lambda p: float(np.linalg.norm(p)))
    tip = (float(x), float(y), float(z))
    return BodyScale(model.body(i).name, float(model.body_mass[i]), tip, _turned(model, i))


def _turned(model: mujoco.MjModel, i: int) -> bool:
    """Whether a joint of a body, or of one that carries it, is no slide."""
    while i:
        first, count = int(model.body_jntadr[i]), int(model.body_jntnum[i])
        if (model.jnt_type[first : first + count] != SLIDE).any():
            return True
        i = int(model.body_parentid[i])
    return False


def _ends(model: mujoco.MjModel, geom: int) -> tuple[Float[np.ndarray, "3"], ...]:
    """Return the two ends of a long geom in the frame of its body, or the middle of another.

    Ends of a capsule are the centres of its caps, as MJCF's `fromto` gives them.
    """
    middle, half = np.split(model.geom_aabb[geom], 2)
    if int(model.geom_type[geom]) in _ROUND:
        half = np.array([0.0, 0.0, model.geom_size[geom, 1]])
    second, longest = np.sort(half)[1:]
    reach = np.where(half == longest, half, 0.0) if longest > _LONG * second else np.zeros(3)
    axes = np.zeros(9)
    mujoco.mju_quat2Mat(axes, model.geom_quat[geom])
    into = axes.reshape(3, 3)
    return tuple(model.geom_pos[geom] + into @ (middle + s * reach) for s in (1.0, -1.0))


def _scales(
    recordings: Sequence[Recording], joints: Mapping[str, JointScale]
) -> dict[str, ChannelScale]:
    """Return the scales of the channels; units of joints are the model's."""
    if not recordings:
        return {}
    common = [n for n in recordings[0].channels if all(n in r.channels for r in recordings)]
    found = {}
    for name in common:
        values = np.concatenate([r.channels[name].values for r in recordings])
        kind, element = name.split(".", 1)
        unit = recordings[0].channels[name].unit
        if kind in ("qpos", "qvel") and element in joints:
            length = "rad" if joints[element].hinge else "m"
            unit = length if kind == "qpos" else f"{length}/s"
        found[name] = ChannelScale(
            name, unit, float(values.min()), float(values.max()), float(values.std())
        )
    return found


def _predicted(model: mujoco.MjModel) -> set[str]:
    """Return the names of channels that a model predicts."""
    return {
        f"{group}.{name}" if size == 1 else f"{group}.{name}.{i}"
        for group in ("qpos", "qvel", "sensor")
        for name, _, size in coordinates(model, group)
        for i in range(size)
    }

"""Measuring the scales of a machine from its model and recordings."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType

import mujoco
import numpy as np
from jaxtyping import Float
from scipy.signal import savgol_filter

from bo_sysid.effects.machine import ActuatorScale, BodyScale, ChannelScale, JointScale, Machine
from bo_sysid.effects.memory import activation, remembers
from bo_sysid.errors import RecordingError
from bo_sysid.mjcf.commands import ALONG_JOINT, driven_joint, follows, joint_force_limits
from bo_sysid.mjcf.compiling import coordinates
from bo_sysid.mjcf.joints import BALL, HINGE, SCALAR, SLIDE
from bo_sysid.mjcf.touching import can_touch
from bo_sysid.recording import Recording
from bo_sysid.recording.alignment import stretches

_SMOOTHING = 0.062  # [s] length of the filters that give velocities and accelerations for scales
_LEVELS = (99.7, 98.0, 95.0, 90.0, 82.0, 70.0, 50.0)  # percentiles of torque tried as saturation
_LEAST = 0.03  # of the largest torque: less is no saturation
_FEWEST = 5  # samples that the shortest filter needs
_POSES = 20
_INSTANTS = 200
_LONG = 1.5  # times the next extent of a box or mesh, from which it has ends
_FLOOR = 1e-6
_ROUND = (int(mujoco.mjtGeom.mjGEOM_CAPSULE), int(mujoco.mjtGeom.mjGEOM_CYLINDER))
_AFFINE = int(mujoco.mjtBias.mjBIAS_AFFINE)


def survey(model: mujoco.MjModel, recordings: Sequence[Recording]) -> Machine:
    """Measure the scales of a machine.

    Forces are scaled by effective inertia times acceleration, and by what the actuators did.
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
    motion = {n: _motion(recordings, n) for n in scalar}
    actuators = {
        model.actuator(a).name: _actuator(model, a, recordings, motion)
        for a in range(model.nactuator)
        if model.actuator_ctrlnum[a] == 1
    }
    inertia, loads = _inertia(model, recordings), _loads(model, motion)
    joints = {n: _joint(model, n, motion[n], inertia, loads, actuators) for n in scalar}
    bodies = {
        b.name: b
        for b in (_body(model, i) for i in range(1, model.nbody))
        if b.name and b.mass > 1e-9 and model.body_weldid[model.body(b.name).id] > 0
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
        float(max((r.span[1] - r.span[0] for r in recordings), default=0.0)),
        MappingProxyType(scales),
        can_touch(model),
    )


@dataclass(frozen=True)
class _Motion:
    """Position, velocity and acceleration of one joint on even grids, all recordings in a row."""

    times: tuple[np.ndarray, ...]
    q: np.ndarray
    v: np.ndarray
    a: np.ndarray


def _motion(recordings: Sequence[Recording], joint: str) -> _Motion:
    grids, q, v, a = [], [], [], []
    for r in recordings:
        c = r.channels[f"qpos.{joint}"]
        dt = float(np.median(np.diff(c.time)))
        ends = [(c.time[s.start], c.time[s.stop - 1]) for s in stretches(c.time)]
        pieces = [np.arange(first, last, dt) for first, last in ends]
        pieces = [grid for grid in pieces if len(grid) >= _FEWEST]
        if not pieces:
            raise RecordingError(
                f"{r.name}: {len(c.time)} samples of qpos.{joint} tell nothing of how it moves; at "
                f"least {_FEWEST + 1} are needed; leave the recording out"
            )
        grids.append(np.concatenate(pieces))
        for grid in pieces:
            x = np.interp(grid, c.time, c.values)
            half = int(np.clip(round(0.5 * _SMOOTHING / dt), 2, (len(x) - 1) // 4 or 1))
            q.append(x)
            v.append(savgol_filter(x, 2 * half + 1, min(3, 2 * half), deriv=1, delta=dt))
            a.append(savgol_filter(x, 4 * half + 1, min(3, 2 * half), deriv=2, delta=dt))
    return _Motion(tuple(grids), np.concatenate(q), np.concatenate(v), np.concatenate(a))


def _actuator(
    model: mujoco.MjModel, a: int, recordings: Sequence[Recording], motion: Mapping[str, _Motion]
) -> ActuatorScale:
    name, joint, k = model.actuator(a).name, _driven(model, a), int(model.actuator_ctrladr[a])
    affine = int(model.actuator_biastype[a]) == _AFFINE
    b = model.actuator_biasprm[a, :3] if affine else np.zeros(3)
    bare = ActuatorScale(
        name=name,
        joint=joint,
        gear=1.0 if joint is None else float(model.actuator_gear[a, 0]),
        pushes=_pushes(model, a),
        gain=float(model.actuator_gainprm[a, 0]),
        bias=(float(b[0]), float(b[1]), float(b[2])),
        servo=bool(b[1] != 0),
        ctrl_max=0.0,
        ctrl_std=0.0,
        force_max=_FLOOR,
        force_std=0.0,
        levels=(),
        plain=int(model.actuator_gaintype[a]) == int(mujoco.mjtGain.mjGAIN_FIXED)
        and int(model.actuator_biastype[a]) in (int(mujoco.mjtBias.mjBIAS_NONE), _AFFINE),
        jumps=(),
        ctrl_limits=_limits(bool(model.actuator_ctrllimited[k]), model.actuator_ctrlrange[k]),
        force_limits=_force_limits(model, a, joint),
        follows=follows(model, a),
    )
    return _as_used(bare, model, recordings, None if joint is None else motion.get(joint))


def _as_used(
    bare: ActuatorScale,
    model: mujoco.MjModel,
    recordings: Sequence[Recording],
    motion: _Motion | None,
) -> ActuatorScale:
    """Return an actuator with the controls and forces of the recordings.

    Args:
        bare: the actuator as the model has it.
        model: has it.
        recordings: with its control, or without.
        motion: of the joint that it drives, None where there is none or it was not recorded.
    """
    key = f"ctrl.{bare.name}"
    told = [r for r in recordings if key in r.channels]
    known = motion is not None and len(told) == len(recordings)
    times = motion.times if motion is not None and known else [r.channels[key].time for r in told]
    at = list(zip(told, times, strict=True))
    u = np.concatenate([r.channels[key].at(t) for r, t in at]) if at else np.zeros(1)
    acting, acted = bare, u
    if at and remembers(model, a := model.actuator(bare.name).id):
        acting = replace(bare, ctrl_limits=None)
        acted = np.concatenate([activation(model, r, a, t) for r, t in at])
    if motion is not None and known:
        force = acting.force(acted, motion.q, motion.v)
    else:
        unbiased = replace(acting, bias=(0.0, 0.0, 0.0))  # where it is, is not known
        force = unbiased.force(acted, np.zeros(1), np.zeros(1))
    top = max(float(np.abs(force).max()), _FLOOR)
    levels = tuple(min(float(np.percentile(np.abs(force), p)) / top, 0.98) for p in _LEVELS)
    return replace(
        bare,
        ctrl_max=float(np.abs(bare.clipped(u)).max()),
        ctrl_std=float(bare.clipped(u).std()),
        jumps=_jumps(bare, recordings),
        force_max=top,
        force_std=float(force.std()),
        levels=tuple(dict.fromkeys(x for x in levels if x > _LEAST)),
    )


def _limits(limited: bool, ends: Float[np.ndarray, "2"]) -> tuple[float, float] | None:
    return (float(ends[0]), float(ends[1])) if limited else None


def _force_limits(model: mujoco.MjModel, a: int, joint: str | None) -> tuple[float, float] | None:
    """Return the ends of an actuator's force: its own, and those of the joint that it drives."""
    own = _limits(bool(model.actuator_forcelimited[a]), model.actuator_forcerange[a])
    limits = None if joint is None else joint_force_limits(model, joint)
    gear = float(model.actuator_gear[a, 0])
    if limits is None or not gear:
        return own
    low, high = sorted(limit / gear for limit in limits)
    return (low, high) if own is None else (max(own[0], low), min(own[1], high))


def _driven(model: mujoco.MjModel, a: int) -> str | None:
    """Return the hinge or slide joint that an actuator drives, None where there is none."""
    joint = driven_joint(model, a)
    return joint if joint and int(model.joint(joint).type[0]) in SCALAR else None


def _pushes(model: mujoco.MjModel, a: int) -> bool:
    """Whether an actuator makes a force in [N] and no torque.

    On a slide, through a crank, along a spatial tendon, at a site, a body or a free joint.
    """
    at, k = int(model.actuator_trntype[a]), int(model.actuator_trnid[a, 0])
    if at in ALONG_JOINT and int(model.jnt_type[k]) in (*SCALAR, BALL):
        return int(model.jnt_type[k]) == SLIDE
    if at == int(mujoco.mjtTrn.mjTRN_TENDON):
        first = model.tendon_adr[k]
        return int(model.wrap_type[first]) != int(mujoco.mjtWrap.mjWRAP_JOINT)
    if at == int(mujoco.mjtTrn.mjTRN_SLIDERCRANK):
        return True
    return bool(np.any(model.actuator_gear[a, :3]))


def _jumps(a: ActuatorScale, recordings: Sequence[Recording]) -> tuple[float, ...]:
    own = [r.channels[key] for r in recordings if (key := f"ctrl.{a.name}") in r.channels]
    held = [np.diff(a.clipped(channel.values)) for channel in own]
    moved = np.abs(np.concatenate(held)) if held else np.zeros(1)
    moved = moved[moved > 0]
    if not moved.size:
        return ()
    return tuple(float(np.percentile(moved, p)) for p in (100.0, *_LEVELS))


def _joint(
    model: mujoco.MjModel,
    name: str,
    motion: _Motion,
    inertia: Float[np.ndarray, " nv"],
    loads: Float[np.ndarray, " nv"],
    actuators: Mapping[str, ActuatorScale],
) -> JointScale:
    dof = int(model.joint(name).dofadr[0])
    drives = [a for a in actuators.values() if a.joint == name]
    acceleration = max(float(np.sqrt(np.mean(motion.a**2))), _FLOOR)
    moved = inertia[dof] * acceleration
    force = max([moved, float(loads[dof]), _FLOOR, *(0.3 * a.force_std for a in drives)])
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


def _loads(model: mujoco.MjModel, motion: Mapping[str, _Motion]) -> Float[np.ndarray, " nv"]:
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
    return BodyScale(model.body(i).name, float(model.body_mass[i]), (float(x), float(y), float(z)))


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

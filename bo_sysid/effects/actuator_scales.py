"""Measuring what the actuators are, and what they did in the recordings."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import mujoco
import numpy as np
from jaxtyping import Float

from bo_sysid.effects.actuators import within_joint
from bo_sysid.effects.machine import ActuatorScale
from bo_sysid.effects.memory import activation, remembers
from bo_sysid.effects.recorded_forces import forces_along, unseen
from bo_sysid.effects.recorded_motion import Motion
from bo_sysid.mjcf.commands import (
    ALONG_JOINT,
    control_limits,
    driven_joint,
    follows,
    joint_force_limits,
)
from bo_sysid.mjcf.joints import BALL, SCALAR, SLIDE
from bo_sysid.recording import Recording

_LEVELS = (99.7, 98.0, 95.0, 90.0, 82.0, 70.0, 50.0)  # percentiles of torque tried as saturation
_LEAST = 0.03  # of the largest torque: less is no saturation
_INSTANTS = 2000  # at which what a servo at a tendon did is looked at
_FLOOR = 1e-6
_AFFINE = int(mujoco.mjtBias.mjBIAS_AFFINE)


def actuator_scale(
    model: mujoco.MjModel, a: int, recordings: Sequence[Recording], motion: Mapping[str, Motion]
) -> ActuatorScale:
    """Return what an actuator is and did in the recordings.

    Args:
        model: has it.
        a: its number.
        recordings: with its control, or without.
        motion: of the joints that were recorded, by name.
    """
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
        ctrl_limits=control_limits(model, k),
        force_limits=_force_limits(model, a, joint),
        follows=follows(model, a),
    )
    return _as_used(bare, model, recordings, None if joint is None else motion.get(joint))


def _as_used(
    bare: ActuatorScale,
    model: mujoco.MjModel,
    recordings: Sequence[Recording],
    motion: Motion | None,
) -> ActuatorScale:
    """Return an actuator with the controls and forces of the recordings.

    Args:
        bare: the actuator as the model has it.
        model: has it.
        recordings: with its control, or without.
        motion: of the joint that it drives, None where there is none or it was not recorded.
    """
    key = f"ctrl.{bare.name}"
    with_channel = [r for r in recordings if key in r.channels]
    known = motion is not None and len(with_channel) == len(recordings)
    times = (
        motion.times
        if motion is not None and known
        else [r.channels[key].time for r in with_channel]
    )
    at = list(zip(with_channel, times, strict=True))
    u = np.concatenate([r.channels[key].at(t) for r, t in at]) if at else np.zeros(1)
    acting, acted = bare, u
    if at and remembers(model, a := model.actuator(bare.name).id):
        acting = replace(bare, ctrl_limits=None)
        acted = np.concatenate([activation(model, r, a, t) for r, t in at])
    if motion is not None and known:
        force = acting.force(acted, motion.q, motion.v)
    elif any(bare.bias) and with_channel and _seen_whole(model, recordings):
        force = _along_motion(model, model.actuator(bare.name).id, with_channel)
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


def _seen_whole(model: mujoco.MjModel, recordings: Sequence[Recording]) -> bool:
    """Whether recordings tell where the whole machine was."""
    scalar = all(int(kind) in SCALAR for kind in model.jnt_type)
    return scalar and not unseen(model, recordings)


def _along_motion(
    model: mujoco.MjModel, a: int, recordings: Sequence[Recording]
) -> Float[np.ndarray, " n"]:
    """Return the force of an actuator that drives no joint of its own, as a servo at a tendon."""
    count = max(_INSTANTS // len(recordings), 1)
    found = [forces_along(model, r, np.linspace(*r.span, count), [a])[0][:, a] for r in recordings]
    return np.concatenate(found)


def _limits(limited: bool, ends: Float[np.ndarray, "2"]) -> tuple[float, float] | None:
    return (float(ends[0]), float(ends[1])) if limited else None


def _force_limits(model: mujoco.MjModel, a: int, joint: str | None) -> tuple[float, float] | None:
    """Return the ends of an actuator's force: its own, and those of the joint that it drives."""
    own = _limits(bool(model.actuator_forcelimited[a]), model.actuator_forcerange[a])
    along = None if joint is None else joint_force_limits(model, joint)
    return within_joint(own, along, float(model.actuator_gear[a, 0]))


def _driven(model: mujoco.MjModel, a: int) -> str | None:
    """Return the hinge or slide joint that an actuator drives, None where there is none."""
    joint = driven_joint(model, a)
    return joint if joint and int(model.joint(joint).type[0]) in SCALAR else None


def _pushes(model: mujoco.MjModel, a: int) -> bool:
    """Whether an actuator makes a force in [N] and no torque.

    On a slide or along a tendon of slides, through a crank, along a spatial tendon, at a site, a
    body or a free joint.
    """
    at, k = int(model.actuator_trntype[a]), int(model.actuator_trnid[a, 0])
    if at in ALONG_JOINT and int(model.jnt_type[k]) in (*SCALAR, BALL):
        return int(model.jnt_type[k]) == SLIDE
    if at == int(mujoco.mjtTrn.mjTRN_TENDON):
        first = model.tendon_adr[k]
        if int(model.wrap_type[first]) == int(mujoco.mjtWrap.mjWRAP_JOINT):
            return int(model.jnt_type[model.wrap_objid[first]]) == SLIDE
        return True
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

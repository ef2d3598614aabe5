"""What controls do: nothing, or how far they may go, given what a joint bears."""

from collections.abc import Sequence

import mujoco
import numpy as np
from jaxtyping import Bool, Float

from bo_sysid.mjcf.joints import HINGE, SCALAR, joint_units

ALONG_JOINT = (int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT))
"""Transmissions by which an actuator acts on one joint alone."""
LAGS = (int(mujoco.mjtDyn.mjDYN_FILTER), int(mujoco.mjtDyn.mjDYN_FILTEREXACT))
"""Kinds of activation that follow a control as a first-order lag."""
_POSES, _NONE = 4, 1e-9  # looked at for levers, since one may vanish in a pose; no lever


def follows(model: mujoco.MjModel, actuator: int) -> bool:
    """Whether an actuator's force follows from its control, at once or as a first-order lag."""
    return int(model.actuator_dyntype[actuator]) in (int(mujoco.mjtDyn.mjDYN_NONE), *LAGS)


def lags(model: mujoco.MjModel, actuator: int) -> bool:
    """Whether an actuator's force follows from one activation, which lags behind its control."""
    one = int(model.actuator_actnum[actuator]) == 1
    return one and int(model.actuator_dyntype[actuator]) in LAGS


def commands_force(model: mujoco.MjModel, actuator: int) -> bool:
    """Whether what an actuator's control adds to its force is its gain times the control."""
    fixed = int(model.actuator_gaintype[actuator]) == mujoco.mjtGain.mjGAIN_FIXED
    return fixed and follows(model, actuator)


def controlled(model: mujoco.MjModel) -> list[int]:
    """Return the actuator of each control; friction may be an actuator without one."""
    return [a for a, n in enumerate(model.actuator_ctrlnum.tolist()) for _ in range(n)]


def driven_joint(model: mujoco.MjModel, actuator: int) -> str | None:
    """Return the joint that an actuator drives; None where it acts on a tendon, site or body."""
    if int(model.actuator_trntype[actuator]) not in ALONG_JOINT:
        return None
    return str(model.joint(int(model.actuator_trnid[actuator, 0])).name)


def joint_force_limits(model: mujoco.MjModel, joint: str) -> tuple[float, float] | None:
    """Return the least and largest sum of what actuators do along a hinge or slide.

    Args:
        model: the compiled model.
        joint: name of the joint.

    Returns:
        The ends in [N m] or [N], as a URDF's `effort` gives them; None where there is no limit.
    """
    j = model.joint(joint).id
    if not model.jnt_actfrclimited[j]:
        return None
    low, high = model.jnt_actfrcrange[j].tolist()
    return low, high


def other_drives(model: mujoco.MjModel, joint: str) -> tuple[str, ...]:
    """Return the actuators that act on a hinge or slide through a tendon, a site or a body.

    Args:
        model: the compiled model.
        joint: name of the joint.
    """
    others = [a for a in controlled(model) if int(model.actuator_trntype[a]) not in ALONG_JOINT]
    dof, lever = int(model.joint(joint).dofadr[0]), np.zeros(len(model.actuator_trntype))
    if others:
        data, rng = mujoco.MjData(model), np.random.default_rng(0)
        for _ in range(_POSES):
            mujoco.mj_resetData(model, data)
            mujoco.mj_integratePos(model, data.qpos, rng.standard_normal(model.nv), 1.0)
            mujoco.mj_fwdPosition(model, data)
            lever = np.maximum(lever, np.abs(moments(model, data)[:, dof]))
    return tuple(str(model.actuator(a).name) for a in others if lever[a] > _NONE)


def compensating(model: mujoco.MjModel) -> Bool[np.ndarray, " nv"]:
    """Return the degrees of freedom at which actuators give the gravity compensation as well.

    MuJoCo takes it from the passive forces there: inverse dynamics ask the actuators for it.
    """
    return np.asarray(model.jnt_actgravcomp[model.dof_jntid].astype(bool))


def moments(model: mujoco.MjModel, data: mujoco.MjData) -> Float[np.ndarray, "a nv"]:
    """Return the force along each degree of freedom per force of each actuator, at a pose."""
    dense = np.zeros((len(model.actuator_trntype), model.nv))
    mujoco.mju_sparse2dense(
        dense,
        data.actuator_moment.ravel(),
        data.moment_rownnz,
        data.moment_rowadr,
        data.moment_colind.ravel(),
    )
    return dense


def controls_without_gain(model: mujoco.MjModel) -> Bool[np.ndarray, " nu"]:
    """Return which controls do nothing: those of actuators with a bias alone."""
    deaf = ~model.actuator_gainprm.any(axis=1)
    return np.repeat(deaf, model.actuator_ctrlnum)


def clamped(
    model: mujoco.MjModel, ctrl: Float[np.ndarray, "... nu"]
) -> Float[np.ndarray, "... nu"]:
    """Return controls as they act: within their ranges, where a model limits them."""
    ends = [control_limits(model, k) or (-np.inf, np.inf) for k in range(model.nu)]
    low, high = np.array(ends).reshape(-1, 2).T
    return np.asarray(np.clip(ctrl, low, high))


def control_limits(model: mujoco.MjModel, control: int) -> tuple[float, float] | None:
    """Return the ends to which MuJoCo clips a control before it acts, None where it does not."""
    unclipped = model.opt.disableflags & int(mujoco.mjtDisableBit.mjDSBL_CLAMPCTRL)
    if unclipped or not model.actuator_ctrllimited[control]:
        return None
    low, high = model.actuator_ctrlrange[control].tolist()
    return low, high


def command_bounds(
    model: mujoco.MjModel,
    actuator: int,
    position: tuple[float, float] | None,
    effort: float | None,
) -> tuple[float, float]:
    """Return the least and the largest control of an actuator; infinite where nothing limits it.

    Within its control range, a motor is bounded by the effort, |u| ≤ effort / |r g| with gear r and
    gain g, a position servo by the position: without a load it rests at q where
    g u + b0 + b1 r q = 0. A command that says neither is bounded by its range alone: that of an
    integrator is a rate, that of a muscle an excitation.

    Args:
        model: the compiled model.
        actuator: its number; it drives one joint and has a control.
        position: least and largest of the joint in [rad] or [m], None where it has no limit.
        effort: largest of what acts along the joint in [N m] or [N], None where it has no limit.
    """
    low, high = -np.inf, np.inf
    control = int(model.actuator_ctrladr[actuator])
    if model.actuator_ctrllimited[control]:
        low, high = model.actuator_ctrlrange[control]
    gear = float(model.actuator_gear[actuator, 0])
    gain = float(model.actuator_gainprm[actuator, 0])
    scale = abs(gear * gain)
    if is_position_servo(model, actuator) and follows(model, actuator):
        if position is not None and gain:
            b0, b1 = model.actuator_biasprm[actuator, :2].tolist()
            ends = sorted(-(b0 + b1 * gear * x) / gain for x in position)
            low, high = max(low, ends[0]), min(high, ends[1])
    elif effort is not None and scale and commands_force(model, actuator):
        low, high = max(low, -effort / scale), min(high, effort / scale)
    return float(low), float(high)


def common_bounds(
    models: Sequence[mujoco.MjModel],
    actuator: int,
    position: tuple[float, float] | None,
    effort: float | None,
) -> tuple[float, float]:
    """Return the least and the largest control that suit each of several machines.

    Args:
        models: compiled models of one layout.
        actuator: see `command_bounds`.
        position: see `command_bounds`.
        effort: see `command_bounds`.
    """
    low, high = zip(*(command_bounds(m, actuator, position, effort) for m in models), strict=True)
    return max(low), min(high)


def is_position_servo(model: mujoco.MjModel, actuator: int) -> bool:
    """Whether the force of an actuator depends on where its joint is, linearly, as of a spring."""
    affine = int(model.actuator_biastype[actuator]) == mujoco.mjtBias.mjBIAS_AFFINE
    return affine and bool(model.actuator_biasprm[actuator, 1])


def units(model: mujoco.MjModel) -> dict[str, str]:
    """Return the units of channels of hinges and slides, and of controls that have a plain one.

    That is a force or a position of the joint itself: no rate, as of actuators that integrate
    their control, and no voltage, as of motors with a circuit.
    """
    found = joint_units(model)
    for a in controlled(model):
        j, gear = model.actuator_trnid[a, 0], model.actuator_gear[a, 0]
        along = model.actuator_trntype[a] in ALONG_JOINT and model.jnt_type[j] in SCALAR
        rate = model.actuator_dyntype[a] == mujoco.mjtDyn.mjDYN_INTEGRATOR
        fixed = model.actuator_gaintype[a] == mujoco.mjtGain.mjGAIN_FIXED
        if not along or gear != 1 or rate or not fixed:
            continue
        hinge = model.jnt_type[j] == HINGE
        gain, bias = model.actuator_gainprm[a, 0], bias_of(model, a)
        if gain and gain == -bias[1]:
            found[f"ctrl.{model.actuator(a).name}"] = "rad" if hinge else "m"
        elif gain == 1 and not bias.any():
            found[f"ctrl.{model.actuator(a).name}"] = "N m" if hinge else "N"
    return found


def has_bias(model: mujoco.MjModel, actuator: int) -> bool:
    """Whether the force of an actuator depends on more than its control, as that of servos does."""
    return bool(bias_of(model, actuator).any())


def bias_of(model: mujoco.MjModel, actuator: int) -> Float[np.ndarray, " 3"]:
    """Return an actuator's force without a control: b0, and that per position and per speed.

    MuJoCo heeds none of the numbers of an actuator whose biastype is none.
    """
    none = int(model.actuator_biastype[actuator]) == mujoco.mjtBias.mjBIAS_NONE
    return np.zeros(3) if none else np.asarray(model.actuator_biasprm[actuator, :3])

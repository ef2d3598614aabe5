"""Elements of actuation that several effects edit."""

from collections.abc import Callable
from dataclasses import replace

import mujoco
import numpy as np
from jaxtyping import Float

from bo_sysid.effects.contract import Site
from bo_sysid.effects.machine import ActuatorScale, Machine
from bo_sysid.effects.parts import Filter, Motion, Signal
from bo_sysid.mjcf.commands import ALONG_JOINT, joint_force_limits, other_drives
from bo_sysid.mjcf.edits import RangeEdit
from bo_sysid.mjcf.plain import add_plain
from bo_sysid.recording import Channel

_NO_CONTROL = 16  # mjsActuator.ctrlspec of input="none"
_MOTOR_CONSTANT = 1e-6  # must be positive


def actuator_at(site: Site, machine: Machine) -> ActuatorScale:
    """Return what is known of the actuator of a site."""
    return machine.actuators[site.name]


def used(site: Site, machine: Machine) -> bool:
    """Whether the actuator was used, and drives a joint that was recorded or no single joint.

    A propeller acts at a site, others on a tendon, a body or a ball joint.
    """
    a = actuator_at(site, machine)
    return (a.joint is None or a.joint in machine.joints) and a.ctrl_max > 0


def drives(site: Site, machine: Machine) -> bool:
    """Whether the actuator drives one joint that was recorded, and was used."""
    return actuator_at(site, machine).joint is not None and used(site, machine)


def as_edited(spec: mujoco.MjSpec, a: ActuatorScale) -> ActuatorScale:
    """Return an actuator as it is in a spec, in which effects and parameters have changed it."""
    now = spec.actuator(a.name)
    affine = now.biastype == mujoco.mjtBias.mjBIAS_AFFINE
    b0, b1, b2 = now.biasprm[:3].tolist() if affine else (0.0, 0.0, 0.0)
    gear, limits = a.gear, _limits(now.forcelimited, now.forcerange)
    if a.joint is not None:
        gear, joint = float(now.gear[0]), spec.joint(a.joint)
        limits = within_joint(limits, _limits(joint.actfrclimited, joint.actfrcrange), gear)
    return replace(a, gear=gear, gain=float(now.gainprm[0]), bias=(b0, b1, b2), force_limits=limits)


def _limits(limited: mujoco.mjtLimited, ends: Float[np.ndarray, "2"]) -> tuple[float, float] | None:
    """Return the ends of a force in a spec, None where there are none."""
    there = limited != mujoco.mjtLimited.mjLIMITED_FALSE and ends[0] < ends[1]
    return (float(ends[0]), float(ends[1])) if there else None


def within_joint(
    own: tuple[float, float] | None, joint: tuple[float, float] | None, gear: float
) -> tuple[float, float] | None:
    """Return the ends of an actuator's force within those of the joint that it drives.

    Args:
        own: its own ends, None where it has none.
        joint: those along the joint.
        gear: of the actuator.
    """
    if joint is None or not gear:
        return own
    low, high = sorted(end / gear for end in joint)
    return (low, high) if own is None else (max(own[0], low), min(own[1], high))


def affine(site: Site, machine: Machine) -> bool:
    """Whether it drives its joint by a force affine in control, length and velocity."""
    return drives(site, machine) and actuator_at(site, machine).plain


def acting(a: ActuatorScale, motion: Motion) -> Signal:
    """Return what acts in a motion: an actuator's control, or the activation that lags behind."""
    lagging = motion.act.get(a.name)
    return a.clipped(motion.ctrl[a.name]) if lagging is None else lagging


def filter_of(a: ActuatorScale, change: Callable[[Channel, float], Channel]) -> Filter:
    """Return a filter of an actuator's command, which it sees as the model clips it.

    MuJoCo clips a control before anything else, as drives do. What filters make of a clipped
    control lies within its limits, so that another one changes nothing by clipping again.

    Args:
        a: the actuator.
        change: see `Filter`.
    """

    def within_limits(channel: Channel, timestep: float) -> Channel:
        return change(replace(channel, values=a.clipped(channel.values)), timestep)

    return Filter(a.name, within_limits)


def passive_motor(
    spec: mujoco.MjSpec, joint: str, what: str, machine: Machine
) -> mujoco.MjsActuator:
    """Add a `dcmotor` to a joint that has no control and turns no current into force.

    Args:
        spec: the spec to change.
        joint: name of the joint.
        what: what it does, for its name.
        machine: whose model the spec is of.
    """
    _limit_drive_itself(spec, joint, machine)
    name = f"{joint}_{what}"
    if spec.actuator(name) is not None:
        name += f"_{len(spec.actuators)}"
    motor: mujoco.MjsActuator = add_plain(
        spec,
        "actuator",
        name=name,
        trntype=mujoco.mjtTrn.mjTRN_JOINT,
        target=joint,
        dyntype=mujoco.mjtDyn.mjDYN_DCMOTOR,
        gaintype=mujoco.mjtGain.mjGAIN_DCMOTOR,
        biastype=mujoco.mjtBias.mjBIAS_DCMOTOR,
    )
    motor.actearly, motor.actdim = True, 0
    motor.ctrlspec = _NO_CONTROL
    motor.dynprm = np.zeros(10)
    motor.gainprm[:2] = (1.0, _MOTOR_CONSTANT)
    return motor


def _limit_drive_itself(spec: mujoco.MjSpec, joint: str, machine: Machine) -> None:
    """Let a joint's limit of what actuators do bound its one drive, and no passive motor.

    MuJoCo clips the sum of all actuators' forces along a joint to its `actuatorfrcrange`. That of
    several drives, whose sum it bounds, stays.
    """
    limits, own = joint_force_limits(machine.model, joint), spec.joint(joint)
    along = [a for a in spec.actuators if int(a.trntype) in ALONG_JOINT and a.target == joint]
    drives = [a for a in along if a.ctrlspec != _NO_CONTROL and a.gear[0]]
    if limits is None or own.actgravcomp or len(drives) > 1 or other_drives(machine.model, joint):
        return
    for a in drives:
        ends = sorted(limit / a.gear[0] for limit in limits)
        RangeEdit({}, {a.name: (ends[0], ends[1])})(spec)
    own.actfrclimited = mujoco.mjtLimited.mjLIMITED_FALSE


def with_own_bias(spec: mujoco.MjSpec, name: str) -> mujoco.MjsActuator:
    """Return an actuator whose bias can be edited: affine."""
    a = spec.actuator(name)
    if a.biastype == mujoco.mjtBias.mjBIAS_NONE:
        a.biastype, a.biasprm = mujoco.mjtBias.mjBIAS_AFFINE, np.zeros(10)
    return a

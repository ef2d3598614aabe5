"""Actuators that are weaker than the model's, and servos tuned otherwise."""

import re
from collections.abc import Callable

import mujoco
import numpy as np

from bo_sysid.effects.actuators import (
    acting,
    actuator_at,
    affine,
    as_edited,
    used,
    with_own_bias,
)
from bo_sysid.effects.contract import Component, Extent, Magnitudes, Site
from bo_sysid.effects.machine import ActuatorScale, ChannelScale, Machine
from bo_sysid.effects.parts import Force, Motion, Part, Signal
from bo_sysid.effects.registry import effect
from bo_sysid.effects.units import unit_at
from bo_sysid.mjcf.edits import RangeEdit

_SAG = 0.005  # of a supply's voltage: less is no sag


def _gain_extent(site: Site, machine: Machine) -> Extent | None:
    plain = used(site, machine) and actuator_at(site, machine).plain
    return Extent((0.02,), (-0.95,), (3.0,)) if plain else None


@effect(
    "actuator_gain",
    kind="actuator",
    components=(Component("change", "relative"),),
    extent=_gain_extent,
    noun="the output per command",
    sentence="The output of {site} per command differs from the model's by {value}.",
    form="gain and bias",
    evidence="one common scale of everything that the actuator does",
    separation="a known load or gravity torque",
    grouped=True,
)
def actuator_gain(spec: mujoco.MjSpec, site: Site, x: Magnitudes, machine: Machine) -> None:
    """Scale the actuator's force; of a position servo gain and bias together."""
    a = with_own_bias(spec, site.name)
    a.gainprm[0] = a.gainprm[0] * (1.0 + x[0])
    a.biasprm[:3] = np.asarray(a.biasprm[:3]) * (1.0 + x[0])


def _kp(site: Site, machine: Machine) -> float:
    """Return what a servo does per length: its gain is another where its control is no length."""
    return -actuator_at(site, machine).bias[1]


def _kp_extent(site: Site, machine: Machine) -> Extent | None:
    a, kp = actuator_at(site, machine), _kp(site, machine)
    if not (kp > 0 and a.gain > 0 and affine(site, machine)):
        return None
    return Extent((0.02 * kp,), (-0.9 * kp,), (3 * kp,))


@effect(
    "servo_kp",
    kind="actuator",
    components=(Component("stiffness", "N m/rad"),),
    extent=_kp_extent,
    nominal=_kp,
    noun="proportional gain",
    sentence="The proportional gain of {site} differs from the model's by {value}.",
    form="gain and bias",
    evidence="a force in proportion to the servo's position error",
    separation="goals at rest under load",
)
def servo_kp(spec: mujoco.MjSpec, site: Site, x: Magnitudes, machine: Machine) -> None:
    """Change the position bias of a servo by -x[0]; gain and constant bias keep the goal.

    A servo's force is kp (goal - length) with the goal (g u + b) / kp: normalised controls have
    another gain g than kp, and a constant b. All are the actuator's own, per its length: behind a
    gear, the joint has gear² times as much.
    """
    a = with_own_bias(spec, site.name)
    per_control, constant = _goal(a, actuator_at(site, machine))
    a.gainprm[0] = a.gainprm[0] + x[0] * per_control
    a.biasprm[0] = a.biasprm[0] + x[0] * constant
    a.biasprm[1] = a.biasprm[1] - x[0]


def _goal(a: mujoco.MjsActuator, nominal: ActuatorScale) -> tuple[float, float]:
    """Return how a servo's goal grows with its control, and its goal at zero: g / kp and b / kp."""
    gain, constant, kp = float(a.gainprm[0]), float(a.biasprm[0]), -float(a.biasprm[1])
    if not kp:  # a parameter took it away
        gain, constant, kp = nominal.gain, nominal.bias[0], -nominal.bias[1]
    return gain / kp, constant / kp


def _kd(site: Site, machine: Machine) -> float:
    return -actuator_at(site, machine).bias[2]


def _kd_extent(site: Site, machine: Machine) -> Extent | None:
    a = actuator_at(site, machine)
    if not (a.servo and a.gear and affine(site, machine)):
        return None
    speed = machine.joints[a.joint or ""].speed
    scale = max(-a.bias[2], 0.05 * a.force_std / speed / a.gear**2)
    return Extent((0.02 * scale,), (a.bias[2] - 1e-12,), (10 * scale,))


@effect(
    "servo_kd",
    prior=0.5,
    kind="actuator",
    components=(Component("damping", "N m s/rad"),),
    extent=_kd_extent,
    nominal=_kd,
    noun="derivative gain",
    sentence="The derivative gain of {site} differs from the model's by {value}.",
    form="bias",
    evidence="a force in proportion to velocity while the servo is powered",
    separation="an unpowered run, or another derivative gain",
)
def servo_kd(spec: mujoco.MjSpec, site: Site, x: Magnitudes, machine: Machine) -> None:
    """Change the velocity bias of a servo, the actuator's own as in `servo_kp`."""
    a = with_own_bias(spec, site.name)
    a.biasprm[2] = a.biasprm[2] - x[0]


def _saturation_extent(site: Site, machine: Machine) -> Extent | None:
    a = actuator_at(site, machine)
    low, high = a.force_limits or (-np.inf, np.inf)
    if not used(site, machine) or not a.levels or not a.plain or not low <= 0 <= high:
        return None
    lost = tuple(((1.0 - level) * a.force_max,) for level in a.levels)
    return Extent((0.05 * a.force_max,), (0.0,), (0.97 * a.force_max,), lost)


def _limit(site: Site, machine: Machine) -> float:
    """Return the model's limit of the force along the joint, 0 where it has none."""
    a = actuator_at(site, machine)
    return 0.0 if a.force_limits is None else float(np.abs(a.force_limits).max()) * abs(a.gear)


def _saturation_lost(x: Magnitudes, machine: Machine, site: Site) -> dict[str, tuple[float, str]]:
    return {"torque lost": (float(x[0]), unit_at("N m", site, machine))}


@effect(
    "actuator_saturation",
    kind="actuator",
    components=(Component("torque lost", "N m"),),
    extent=_saturation_extent,
    nominal=_limit,
    noun="a torque limit",
    sentence="{site} saturates at {value}; the model gives more.",
    form="forcerange",
    evidence="large commands do no more than smaller ones",
    separation="steps of several sizes",
    threshold=True,
    absolute=lambda x, machine, site: actuator_at(site, machine).force_max - float(x[0]),
    details=_saturation_lost,
)
def actuator_saturation(spec: mujoco.MjSpec, site: Site, x: Magnitudes, machine: Machine) -> None:
    """Limit the force so that x[0] of the largest one used is lost; a tighter limit stays."""
    scale = actuator_at(site, machine)
    gear = as_edited(spec, scale).gear
    most = max(scale.force_max - float(x[0]), 1e-9) / max(abs(gear), 1e-9)
    RangeEdit({}, {site.name: (-most, most)})(spec)


def _back_emf(site: Site, machine: Machine) -> float:
    a = actuator_at(site, machine)
    return -a.bias[2] * a.gear**2


def _back_emf_extent(site: Site, machine: Machine) -> Extent | None:
    a = actuator_at(site, machine)
    if a.servo or not affine(site, machine):
        return None
    scale = a.force_std / machine.joints[a.joint or ""].speed
    nominal = _back_emf(site, machine)
    return Extent((0.05 * scale,), (min(-nominal, 0.0) - 1e-12,), (10 * scale,))


@effect(
    "back_emf",
    prior=0.2,
    kind="actuator",
    components=(Component("coefficient", "N m s/rad"),),
    extent=_back_emf_extent,
    nominal=_back_emf,
    noun="back-EMF",
    sentence="{site} loses torque with speed, by {value}; the model loses none.",
    form="bias",
    evidence="a force in proportion to velocity while the motor is powered",
    separation="an unpowered run",
)
def back_emf(spec: mujoco.MjSpec, site: Site, x: Magnitudes, machine: Machine) -> None:
    """Torque -x[0]·v at the joint, inside the actuator's limits."""
    a, gear = with_own_bias(spec, site.name), as_edited(spec, actuator_at(site, machine)).gear
    if gear:  # a parameter may take it away
        a.biasprm[2] = a.biasprm[2] - float(x[0]) / gear**2


def supply_of(site: Site, machine: Machine) -> str | None:
    """Return the recorded supply voltage of an actuator: its own, else one that names none."""
    volts = [n for n, c in machine.scales.items() if n.startswith("aux.") and _sags(c)]
    owners = {n: _owner(n, machine) for n in volts}
    own = [n for n in volts if owners[n] == site.name]
    return next(iter(own or [n for n in volts if owners[n] is None]), None)


def _owner(channel: str, machine: Machine) -> str | None:
    """Return the actuator that a channel names as a whole; of several the longest name."""
    words = _words(channel)
    named = [
        a
        for a in machine.actuators
        if any(words[k : k + len(_words(a))] == _words(a) for k in range(len(words)))
    ]
    return max(named, key=len, default=None)


def _words(name: str) -> list[str]:
    return re.split(r"[._/-]", name)


def _sags(channel: ChannelScale) -> bool:
    named = channel.unit == "V" or "volt" in channel.name.lower()
    return named and channel.high > 0 and channel.high - channel.low > _SAG * channel.high


def _sag_extent(site: Site, machine: Machine) -> Extent | None:
    supply = supply_of(site, machine)
    if supply is None or not affine(site, machine) or not actuator_at(site, machine).follows:
        return None
    sag = machine.scales[supply].high - machine.scales[supply].low
    return Extent((0.2 * sag,), (0.0,), (4 * sag,))


def _lost_torque(
    a: ActuatorScale, x: Magnitudes, site: Site, machine: Machine
) -> Callable[[Motion], Signal]:
    supply = supply_of(site, machine) or ""
    c, joint = machine.scales[supply], a.joint or ""

    def law(m: Motion) -> Signal:
        sagged = (c.high - m.signals[supply]) / (c.high - c.low)
        force = a.force(acting(a, m), m.qpos[joint], m.qvel[joint])
        return np.asarray(-(x[0] / c.high) * sagged * force)

    return law


def _sag_share(x: Magnitudes, machine: Machine, site: Site) -> dict[str, tuple[float, str]]:
    c = machine.scales[supply_of(site, machine) or ""]
    return {"share of the recorded sag": (float(x[0]) / (c.high - c.low), "relative")}


@effect(
    "voltage_sag",
    kind="actuator",
    components=(Component("sag", "V"),),
    extent=_sag_extent,
    noun="a sagging supply",
    sentence="{site} loses {value} of its supply at the lowest recorded voltage.",
    form="force law with an auxiliary channel",
    evidence="less torque per command while the supply is low",
    separation="the same motion with a full and an empty battery",
    details=_sag_share,
    of_drives=True,
)
def voltage_sag(spec: mujoco.MjSpec, site: Site, x: Magnitudes, machine: Machine) -> Part:
    """The torque falls with the recorded supply V(t), by the share x[0]/Vmax where V is lowest.

    With x[0] = Vmax - Vmin it is in proportion to V(t).
    """
    a = as_edited(spec, actuator_at(site, machine))
    return Force(a.joint or "", _lost_torque(a, x, site, machine))

"""Actuators that are weaker, slower or later than the model's, and servos tuned otherwise."""

import mujoco
import numpy as np
from scipy.signal import lfilter

from bo_sysid.effects.contract import Component, Extent, Filter, Magnitudes, Part, Site
from bo_sysid.effects.machine import ActuatorScale, Machine
from bo_sysid.effects.registry import effect
from bo_sysid.recording import Channel

_LAGS = (0.004, 0.03)
_DELAYS = (0.004, 0.02)
_FASTEST = 1e-5  # [s] a lag below acts as none


def _at(site: Site, machine: Machine) -> ActuatorScale:
    return machine.actuators[site.name]


def _moves(site: Site, machine: Machine) -> bool:
    """Whether the actuator drives one joint and was used."""
    a = _at(site, machine)
    return a.joint in machine.joints and a.ctrl_max > 0


def _gain_extent(site: Site, machine: Machine) -> Extent | None:
    return Extent((0.02,), (-0.95,), (3.0,)) if _moves(site, machine) else None


@effect(
    "actuator_gain",
    kind="actuator",
    components=(Component("change", "relative"),),
    extent=_gain_extent,
    noun="the torque per command",
    sentence="The torque of {site} per command differs from the model's by {value}.",
    evidence="one common scale of everything that the actuator does",
    separation="a known load or gravity torque",
    grouped=True,
)
def actuator_gain(spec: mujoco.MjSpec, site: Site, x: Magnitudes, machine: Machine) -> None:
    """Scale the actuator's force; of a position servo gain and bias together."""
    a = spec.actuator(site.name)
    a.gainprm[0] = a.gainprm[0] * (1.0 + x[0])
    a.biasprm[:3] = np.asarray(a.biasprm[:3]) * (1.0 + x[0])


def _kp(site: Site, machine: Machine) -> float:
    return _at(site, machine).gain


def _kp_extent(site: Site, machine: Machine) -> Extent | None:
    a = _at(site, machine)
    if not (a.servo and _moves(site, machine)):
        return None
    return Extent((0.02 * a.gain,), (-0.9 * a.gain,), (3 * a.gain,))


@effect(
    "servo_kp",
    kind="actuator",
    components=(Component("stiffness", "N m/rad"),),
    extent=_kp_extent,
    nominal=_kp,
    noun="proportional gain",
    sentence="The proportional gain of the servo {site} differs from the model's by {value}.",
    evidence="a force in proportion to the servo's position error",
    separation="goals at rest under load",
)
def servo_kp(spec: mujoco.MjSpec, site: Site, x: Magnitudes, machine: Machine) -> None:
    """Change the gain and the position bias of a servo together."""
    a = spec.actuator(site.name)
    a.gainprm[0] = a.gainprm[0] + x[0]
    a.biasprm[1] = a.biasprm[1] - x[0]


def _kd(site: Site, machine: Machine) -> float:
    return -_at(site, machine).bias[2]


def _kd_extent(site: Site, machine: Machine) -> Extent | None:
    a = _at(site, machine)
    if not (a.servo and _moves(site, machine)):
        return None
    speed = machine.joints[a.joint or ""].speed
    scale = max(-a.bias[2], 0.05 * a.force_std / speed)
    return Extent((0.02 * scale,), (a.bias[2] - 1e-12,), (10 * scale,))


@effect(
    "servo_kd",
    kind="actuator",
    components=(Component("damping", "N m s/rad"),),
    extent=_kd_extent,
    nominal=_kd,
    noun="derivative gain",
    sentence="The derivative gain of the servo {site} differs from the model's by {value}.",
    evidence="a force in proportion to velocity while the servo is powered",
    separation="an unpowered run, or another derivative gain",
)
def servo_kd(spec: mujoco.MjSpec, site: Site, x: Magnitudes, machine: Machine) -> None:
    """Change the velocity bias of a servo."""
    a = spec.actuator(site.name)
    a.biasprm[2] = a.biasprm[2] - x[0]


def _lag_extent(site: Site, machine: Machine) -> Extent | None:
    if not _moves(site, machine):
        return None
    return Extent((_LAGS[0],), (0.0,), (0.5,), tuple((p,) for p in _LAGS))


@effect(
    "actuator_lag",
    kind="actuator",
    components=(Component("time constant", "s"),),
    extent=_lag_extent,
    noun="a lag",
    sentence="{site} follows its command with a time constant of {value}.",
    evidence="roll-off of fast commands",
    separation="commands over two decades of frequency",
)
def actuator_lag(spec: mujoco.MjSpec, site: Site, x: Magnitudes, machine: Machine) -> Part:
    """First-order lag of the command with time constant x[0]."""
    return Filter(site.name, lambda channel, dt: _lagged(channel, float(x[0]), dt))


def _lagged(channel: Channel, lag: float, dt: float) -> Channel:
    """Return the lagged channel on a grid of the time step, each value the mean over its step.

    For an input held at u during a step of length h the state f' = (u - f)/τ has the mean
    u + (f₀ - u)·(τ/h)·(1 - exp(-h/τ)).
    """
    if lag <= _FASTEST:
        return channel
    time = np.arange(channel.time[0], channel.time[-1] + 0.5 * dt, dt)
    u = channel.at(time + 1e-6 * dt)
    gain = -np.expm1(-dt / lag)
    end = lfilter([gain], [1.0, gain - 1.0], u, zi=(1.0 - gain) * u[:1])[0]
    begin = np.concatenate([u[:1], end[:-1]])
    mean = u + (begin - u) * (lag / dt) * gain
    return Channel(time, mean, channel.unit, channel.source, channel.hold)


def _delay_extent(site: Site, machine: Machine) -> Extent | None:
    if not _moves(site, machine):
        return None
    return Extent((_DELAYS[0],), (0.0,), (0.1,), tuple((p,) for p in _DELAYS))


@effect(
    "actuator_delay",
    kind="actuator",
    components=(Component("delay", "s"),),
    extent=_delay_extent,
    noun="a delay",
    sentence="{site} acts on its command {value} later than the model says.",
    evidence="a shift in time that is the same at every frequency",
    separation="commands over two decades of frequency; a sensor with another clock",
)
def actuator_delay(spec: mujoco.MjSpec, site: Site, x: Magnitudes, machine: Machine) -> Part:
    """The command arrives x[0] later."""
    late = max(float(x[0]), 0.0)
    return Filter(
        site.name,
        lambda c, dt: Channel(c.time + late, c.values, c.unit, c.source, c.hold),
    )


def _deadzone_extent(site: Site, machine: Machine) -> Extent | None:
    a = _at(site, machine)
    if a.servo or not _moves(site, machine):
        return None
    return Extent((0.05 * a.ctrl_std,), (0.0,), (0.8 * a.ctrl_std,))


@effect(
    "actuator_deadzone",
    kind="actuator",
    components=(Component("half width", "control units"),),
    extent=_deadzone_extent,
    noun="a dead zone",
    sentence="{site} does not act on commands below {value}.",
    evidence="small commands do nothing, large ones lack a constant",
    separation="reversals while moving; an unpowered run",
)
def actuator_deadzone(spec: mujoco.MjSpec, site: Site, x: Magnitudes, machine: Machine) -> Part:
    """Commands within ±x[0] do nothing; beyond, x[0] is lost."""
    half = float(x[0])
    return Filter(site.name, lambda c, dt: _valued(c, c.values - np.clip(c.values, -half, half)))


def _valued(channel: Channel, values: np.ndarray) -> Channel:
    return Channel(channel.time, values, channel.unit, channel.source, channel.hold)


def _saturation_extent(site: Site, machine: Machine) -> Extent | None:
    a = _at(site, machine)
    if not _moves(site, machine) or not a.levels:
        return None
    lost = tuple(((1.0 - level) * a.force_max,) for level in a.levels)
    return Extent((0.05 * a.force_max,), (0.0,), (0.97 * a.force_max,), lost)


def _saturation_level(x: Magnitudes, machine: Machine, site: Site) -> dict[str, tuple[float, str]]:
    return {"largest torque": (_at(site, machine).force_max - float(x[0]), "N m")}


@effect(
    "actuator_saturation",
    kind="actuator",
    components=(Component("torque lost", "N m"),),
    extent=_saturation_extent,
    noun="a torque limit",
    sentence="{site} saturates: it lacks {value} of the largest torque commanded.",
    evidence="large commands do no more than smaller ones",
    separation="steps of several sizes",
    threshold=True,
    details=_saturation_level,
)
def actuator_saturation(spec: mujoco.MjSpec, site: Site, x: Magnitudes, machine: Machine) -> None:
    """Limit the force so that x[0] of the largest one used is lost."""
    a, scale = spec.actuator(site.name), _at(site, machine)
    most = max(scale.force_max - float(x[0]), 1e-9) / abs(scale.gear)
    a.forcerange = [-most, most]
    a.forcelimited = True

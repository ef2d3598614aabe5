"""Commands that arrive later, slower or not at all: filters before the actuator."""

import mujoco
import numpy as np

from bo_sysid.effects.actuators import actuator_at, filter_of, used
from bo_sysid.effects.contract import Component, Extent, Magnitudes, Site
from bo_sysid.effects.filters import dead_band, delayed, lagged, limited
from bo_sysid.effects.machine import Machine
from bo_sysid.effects.parts import Filter, Part
from bo_sysid.effects.registry import effect

_LAGS = (0.004, 0.03)
_DELAYS = (0.004, 0.02)
_RAMPS = (0.004, 0.015, 0.06)  # [s] that the largest change of a control may take
_APART = 1.5  # ratio of rates that are tried
_MOST_CUT_OUT = 0.95  # of the largest command, within a dead zone
_RESOLVED = 2.0  # steps in the shortest lag that is an activation
_INTERPOLATED = 1  # mjsActuator.interp: between two steps, linearly


def _lag_extent(site: Site, machine: Machine) -> Extent | None:
    if not used(site, machine):
        return None
    return Extent((_LAGS[0],), (0.0,), (0.5,), tuple((p,) for p in _LAGS))


def _lag_filter(site: Site, x: Magnitudes, machine: Machine) -> Filter:
    a = actuator_at(site, machine)
    return filter_of(a, lambda channel, dt: lagged(channel, float(x[0]), dt))


def written_lag(lag: float, timestep: float) -> float:
    """Return the time constant of an activation that lags by `lag` on the whole, both in [s].

    MuJoCo acts with an activation as it was at the beginning of a step; a filter here with its mean
    over the step, which is that of half a step later.
    """
    return lag - 0.5 * timestep


def _write_lag(spec: mujoco.MjSpec, site: Site, x: Magnitudes, machine: Machine) -> Part | None:
    """Write the lag as the actuator's activation, where it has none and the step resolves it."""
    a, lag, dt = spec.actuator(site.name), float(x[0]), spec.option.timestep
    if a.dyntype != mujoco.mjtDyn.mjDYN_NONE or lag < _RESOLVED * dt:
        return _lag_filter(site, x, machine)
    a.dyntype = mujoco.mjtDyn.mjDYN_FILTEREXACT
    a.dynprm[0], a.actearly = written_lag(lag, dt), False  # early, it is ahead by a step
    return None


@effect(
    "actuator_lag",
    kind="actuator",
    components=(Component("time constant", "s"),),
    extent=_lag_extent,
    noun="a lag",
    sentence="{site} follows its command with a time constant of {value}.",
    form="filter; filterexact in a file",
    evidence="roll-off of fast commands",
    separation="commands over two decades of frequency",
    grouped=True,
    in_turn=True,
    written=_write_lag,
)
def actuator_lag(spec: mujoco.MjSpec, site: Site, x: Magnitudes, machine: Machine) -> Part:
    """First-order lag of the command with time constant x[0]."""
    return _lag_filter(site, x, machine)


def _delay_extent(site: Site, machine: Machine) -> Extent | None:
    if not used(site, machine):
        return None
    return Extent((_DELAYS[0],), (0.0,), (0.1,), tuple((p,) for p in _DELAYS))


def _delay_filter(site: Site, x: Magnitudes, machine: Machine) -> Filter:
    a = actuator_at(site, machine)
    return filter_of(a, lambda channel, dt: delayed(channel, max(float(x[0]), 0.0)))


def _write_delay(spec: mujoco.MjSpec, site: Site, x: Magnitudes, machine: Machine) -> Part | None:
    """Write the delay as the actuator's own, interpolated between steps.

    MuJoCo has no command newer than the last step's: a delay of less than a step remains a filter,
    and so does one beside a delay of the model that is not interpolated.
    """
    a, dt = spec.actuator(site.name), spec.option.timestep
    late = a.delay + float(x[0])
    if late < dt or (a.delay and a.interp != _INTERPOLATED):
        return _delay_filter(site, x, machine)
    a.delay, a.nsample, a.interp = late, int(np.ceil(late / dt)) + 1, _INTERPOLATED
    return None


@effect(
    "actuator_delay",
    kind="actuator",
    components=(Component("delay", "s"),),
    extent=_delay_extent,
    noun="a delay",
    sentence="{site} acts on its command {value} later than the model says.",
    form="filter; delay in a file",
    evidence="a shift in time that is the same at every frequency",
    separation="commands over two decades of frequency; a sensor with another clock",
    grouped=True,
    written=_write_delay,
)
def actuator_delay(spec: mujoco.MjSpec, site: Site, x: Magnitudes, machine: Machine) -> Part:
    """The command arrives x[0] later."""
    return _delay_filter(site, x, machine)


def _deadzone_extent(site: Site, machine: Machine) -> Extent | None:
    a = actuator_at(site, machine)
    if a.servo or not used(site, machine):
        return None
    return Extent((0.05 * a.ctrl_std,), (0.0,), (_MOST_CUT_OUT * a.ctrl_max,))


@effect(
    "actuator_deadzone",
    kind="actuator",
    components=(Component("half width", "control units"),),
    extent=_deadzone_extent,
    noun="a dead zone",
    sentence="{site} does not act on commands below {value}.",
    form="filter",
    evidence="small commands do nothing, large ones lack a constant",
    separation="reversals while moving; an unpowered run",
    in_turn=True,
)
def actuator_deadzone(spec: mujoco.MjSpec, site: Site, x: Magnitudes, machine: Machine) -> Part:
    """Commands within ±x[0] do nothing; beyond, x[0] is lost."""
    a = actuator_at(site, machine)
    return filter_of(a, lambda channel, dt: dead_band(channel, float(x[0])))


def _fastest(site: Site, machine: Machine) -> float:
    """Return the rate at which the largest recorded change of the control takes one step."""
    return actuator_at(site, machine).jumps[0] / machine.timestep


def _rate_extent(site: Site, machine: Machine) -> Extent | None:
    jumps = actuator_at(site, machine).jumps
    if not (used(site, machine) and jumps):
        return None
    most = _fastest(site, machine)
    wanted = {j / machine.sampling for j in jumps[1:]} | {jumps[0] / t for t in _RAMPS}
    lost: list[float] = []
    for rate in sorted(wanted, reverse=True):
        if rate < (most - lost[-1] if lost else most) / _APART:
            lost.append(most - rate)
    if not lost:
        return None
    return Extent((lost[0],), (0.0,), (most * (1 - 1e-6),), tuple((x,) for x in lost))


def _rate(x: Magnitudes, machine: Machine, site: Site) -> float:
    return _fastest(site, machine) - float(x[0])


@effect(
    "command_rate",
    kind="actuator",
    components=(Component("rate lost", "control units/s"),),
    extent=_rate_extent,
    noun="a limit of the command's rate",
    sentence="{site} follows its command no faster than {value}.",
    form="filter",
    evidence="large changes of the command arrive as ramps, small ones at once",
    separation="steps of several sizes",
    in_turn=True,
    absolute=_rate,
)
def command_rate(spec: mujoco.MjSpec, site: Site, x: Magnitudes, machine: Machine) -> Part:
    """The command changes no faster than the largest recorded rate less x[0]."""
    rate = max(_rate(x, machine, site), 1e-9)
    a = actuator_at(site, machine)
    return filter_of(a, lambda channel, dt: limited(channel, rate, dt))

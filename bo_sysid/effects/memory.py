"""What actuators with memory make of the controls that were recorded."""

from dataclasses import replace

import mujoco
import numpy as np
from jaxtyping import Float

from bo_sysid.effects.balance import balancing_activations
from bo_sysid.mjcf.commands import LAGS, control_limits
from bo_sysid.recording import Channel, Recording

_INTEGRATOR = int(mujoco.mjtDyn.mjDYN_INTEGRATOR)
_MUSCLE = int(mujoco.mjtDyn.mjDYN_MUSCLE)
_SHORTEST = 1e-9  # [s] of a time constant: less is none
FORGOTTEN = 6.0
"""Time constants after which nothing is left of where a lag began."""
_ROUNDS, _ASIDE = 3, 1e-6  # of balancing; a beginning beside another one


def remembers(compiled: mujoco.MjModel, a: int) -> bool:
    """Whether an actuator has one activation, which lags behind its control or integrates it."""
    kinds = (_INTEGRATOR, *LAGS)
    return int(compiled.actuator_actnum[a]) == 1 and int(compiled.actuator_dyntype[a]) in kinds


def forgets_after(compiled: mujoco.MjModel, a: int) -> float:
    """Return how long in [s] an actuator acts on controls of before its first recorded one.

    Its delay, and as many time constants of a lag, or of a muscle, as leave e⁻⁶ of where it began.
    """
    kind, constants = int(compiled.actuator_dyntype[a]), compiled.actuator_dynprm[a]
    count = 1 if kind in LAGS else 2 if kind == _MUSCLE else 0  # one up, one down
    constant = max(constants[:count], default=0.0)
    return float(compiled.actuator_delay[a]) + FORGOTTEN * max(float(constant), 0.0)


def activation(
    compiled: mujoco.MjModel, recording: Recording, a: int, at: Float[np.ndarray, " W"]
) -> Float[np.ndarray, " W"]:
    """Return the activation of an actuator that remembers at some times in [s].

    A lag begins settled at its first control. An integrator that holds a position begins where its
    forces balance what was recorded on the whole (`balance`), from where its joint is first seen;
    any other begins at 0.
    """
    control = _late(compiled, _held(_clipped(compiled, recording, a)), a)
    ends = _act_range(compiled, a)
    if int(compiled.actuator_dyntype[a]) in LAGS:
        return _lagging(control, float(compiled.actuator_dynprm[a, 0]), ends, at)
    balance = balancing_activations(compiled, recording, a)
    if balance is None:
        return _integral(control, 0.0, ends, at)
    time, act = balance
    control, first = _from(control, float(time[0])), float(act[0])
    for _ in range(_ROUNDS):
        found, perturbed = (_integral(control, first + step, ends, time) for step in (0.0, _ASIDE))
        affected = (
            perturbed != found
        )  # once it is at an end of its range, its beginning is forgotten
        weight = np.hanning(int(affected.sum()) + 2)[
            1:-1
        ]  # momentum at the ends counts for nothing
        first += (
            float(np.average((act - found)[affected], weights=weight)) if affected.any() else 0.0
        )
    return _integral(control, first, ends, at)


def _clipped(compiled: mujoco.MjModel, recording: Recording, a: int) -> Channel:
    """Return the control of an actuator within the range to which it is clamped before it acts."""
    channel = recording.channels[f"ctrl.{compiled.actuator(a).name}"]
    ends = control_limits(compiled, int(compiled.actuator_ctrladr[a]))
    if ends is None:
        return channel
    return replace(channel, values=np.clip(channel.values, *ends))


def _held(channel: Channel) -> Channel:
    """Return a control that is held: an interpolated one at its mean over each interval."""
    if channel.hold != "linear":
        return channel
    means = 0.5 * (channel.values[:-1] + channel.values[1:])
    return replace(channel, values=np.append(means, channel.values[-1]), hold="zero")


def _late(compiled: mujoco.MjModel, channel: Channel, a: int) -> Channel:
    """Return a control when it reaches an activation: later by the actuator's own delay."""
    delay = float(compiled.actuator_delay[a])
    return replace(channel, time=channel.time + delay) if delay else channel


def _lagging(
    channel: Channel, lag: float, ends: tuple[float, float], at: Float[np.ndarray, " W"]
) -> Float[np.ndarray, " W"]:
    """Return f at some times, for τ f' = u - f, from f = u on at the first stamp.

    While u is held, f = u + (f₀ - u) exp(-t/τ), clamped wherever it would leave its range `ends`.
    """
    lag = max(lag, _SHORTEST)
    u, kept = channel.values, np.exp(-np.diff(channel.time) / lag)
    begin = np.empty_like(u)
    begin[0] = min(max(u[0], ends[0]), ends[1])
    for k, share in enumerate(kept.tolist()):
        begin[k + 1] = min(max(u[k] + (begin[k] - u[k]) * share, ends[0]), ends[1])
    row = np.clip(np.searchsorted(channel.time, at, side="right") - 1, 0, None)
    since = np.maximum(at - channel.time[row], 0.0)
    return np.asarray(np.clip(u[row] + (begin[row] - u[row]) * np.exp(-since / lag), *ends))


def _act_range(compiled: mujoco.MjModel, a: int) -> tuple[float, float]:
    """Return the least and the largest activation of an actuator; infinite without a range."""
    if not compiled.actuator_actlimited[a]:
        return -np.inf, np.inf
    low, high = compiled.actuator_actrange[a]
    return float(low), float(high)


def _integral(
    channel: Channel, first: float, ends: tuple[float, float], at: Float[np.ndarray, " W"]
) -> Float[np.ndarray, " W"]:
    """Return the integral of a held channel at some times, clamped wherever it would leave a range.

    Args:
        channel: a rate.
        first: the integral at the channel's first stamp.
        ends: its least and its largest value.
        at: `W` times in [s].
    """
    low, high = ends
    begin = np.empty(len(channel.time))
    begin[0] = min(max(first, low), high)
    for k, change in enumerate((channel.values[:-1] * np.diff(channel.time)).tolist()):
        begin[k + 1] = min(max(begin[k] + change, low), high)
    row = np.clip(np.searchsorted(channel.time, at, side="right") - 1, 0, None)
    since = at - channel.time[row]
    return np.asarray(np.clip(begin[row] + channel.values[row] * since, low, high))


def _from(channel: Channel, first: float) -> Channel:
    """Return a held channel from a time in [s] on; all of it where it begins later."""
    row = int(np.searchsorted(channel.time, first, side="right")) - 1
    if row < 0:
        return channel
    time = np.concatenate([[first], channel.time[row + 1 :]])
    return replace(channel, time=time, values=channel.values[row:])

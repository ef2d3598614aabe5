"""What lies between a command and the force: filters over a whole recorded control.

Each returns a channel. Where its values move between two stamps in a way of their own, the filter
works on a grid of the simulation's time step `dt` and gives the mean over each step, held, so that
the answer does not depend on the step.
"""

from dataclasses import replace

import numpy as np
from jaxtyping import Float
from scipy.signal import lfilter

from bo_sysid.recording import Channel, control_steps

_FASTEST = 1e-5  # [s] a lag below acts as none
_LONGEST = 60.0  # [s] that a filter is followed after the last command
_SETTLED = 12.0  # time constants after which exp(-12) = 6e-6 of a change is left


def lagged(channel: Channel, lag: float, dt: float) -> Channel:
    """Return the output of a first-order lag with time constant `lag` in [s].

    For an input held at u during a step of length h the state f' = (u - f)/τ has the mean
    u + (f₀ - u)·(τ/h)·(1 - exp(-h/τ)).
    """
    if lag <= _FASTEST:
        return channel
    time, u = _gridded(channel, dt, _SETTLED * lag)
    gain = -np.expm1(-dt / lag)
    end = lfilter([gain], [1.0, gain - 1.0], u, zi=(1.0 - gain) * u[:1])[0]
    begin = np.concatenate([u[:1], end[:-1]])
    mean = u + (begin - u) * (lag / dt) * gain
    return replace(channel, time=time, values=mean, hold="zero")


def delayed(channel: Channel, delay: float) -> Channel:
    """Return the channel `delay` later, in [s]."""
    return replace(channel, time=channel.time + delay)


def dead_band(channel: Channel, half: float) -> Channel:
    """Return the channel without what lies within ± `half` of zero: a dead zone."""
    return replace(channel, values=channel.values - np.clip(channel.values, -half, half))


def limited(channel: Channel, rate: float, dt: float) -> Channel:
    """Return the channel followed no faster than `rate`, in its units per second.

    A step that begins at y and reaches its input u after the time t ≤ h has the mean
    u + (y - u)·t/(2h); one that does not reach it, y ± rate·h/2.
    """
    time, u = _gridded(channel, dt, float(np.ptp(channel.values)) / rate)
    return replace(channel, time=time, values=_ramped(u, rate * dt), hold="zero")


def _ramped(u: Float[np.ndarray, " S"], most: float) -> Float[np.ndarray, " S"]:
    mean = np.empty_like(u)
    y = float(u[0])
    for k, goal in enumerate(u.tolist()):
        gap = goal - y
        if abs(gap) <= most:
            mean[k] = goal - 0.5 * gap * abs(gap) / most
            y = goal
        else:
            move = most if gap > 0 else -most
            mean[k] = y + 0.5 * move
            y += move
    return mean


def _gridded(
    channel: Channel, dt: float, settles: float
) -> tuple[Float[np.ndarray, " S"], Float[np.ndarray, " S"]]:
    """Return the mean of a channel over each step of a grid that begins with its first stamp.

    The grid goes on after the last stamp for `settles` in [s]. Stamps may lie anywhere between its
    points, as in every log with jitter: a command that changes within a step counts for its part.
    """
    begin, end = channel.time[0], channel.time[-1] + min(settles, _LONGEST)
    steps = int(np.ceil((end - begin) / dt + 0.5)) + 1
    return begin + dt * np.arange(steps), control_steps(channel, channel.time[:1], steps, dt)[0]

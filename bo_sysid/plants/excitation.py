"""Controls that move a machine enough to identify it."""

import mujoco
import numpy as np
from numpy.typing import ArrayLike
from scipy.signal import lfilter

from bo_sysid.errors import UserError
from bo_sysid.plants.environment import control_range

Range = tuple[np.ndarray, np.ndarray]
"""Least and largest of each of several numbers."""
_TONES = 8  # sines an actuator


def multisine(
    model: mujoco.MjModel,
    duration: float,
    timestep: float,
    *,
    amplitude: float = 0.8,
    band: tuple[float, float] = (0.2, 3.0),
    seed: int = 0,
    within: Range | None = None,
) -> np.ndarray:
    """Return sums of sines with random phases, with other frequencies for every actuator.

    The crest is scaled to `amplitude`: u_j(t) = c_j + h_j A s_j(t) / max|s_j|, with c_j and h_j
    the middle and the half-width of actuator j's control range.

    Args:
        model: whose actuators are driven.
        duration: in [s].
        timestep: between two rows, in [s].
        amplitude: share of the control range, in (0, 1].
        band: lowest and highest frequency in [Hz].
        seed: of frequencies and phases.
        within: least and largest of what drives the machine, by default the control range.

    Returns:
        `S x nu` controls, in the units of the actuators.

    Raises:
        UserError: an argument is out of its range.
        ModelError: an actuator has no control range.
    """
    low, high = within or control_range(model)
    _check(amplitude, duration, timestep)
    if not 0 < band[0] < band[1] < 0.5 / timestep:
        raise UserError(
            f"excitation: band {band} Hz must lie between 0 and half the control rate, "
            f"{0.5 / timestep:g} Hz"
        )
    rng = np.random.default_rng(seed)
    t = np.arange(round(duration / timestep)) * timestep
    edges = np.geomspace(*band, _TONES * len(low) + 1)
    # interleaved bands: every actuator covers the whole range and shares no frequency
    frequency = rng.uniform(edges[:-1], edges[1:]).reshape(_TONES, len(low)).T
    phase = rng.uniform(0, 2 * np.pi, frequency.shape)
    s = np.sin(2 * np.pi * frequency[:, :, None] * t + phase[:, :, None]).sum(axis=1)
    s /= np.abs(s).max(axis=1, keepdims=True)
    return _within(s.T, low, high, amplitude)


def smooth_random(
    model: mujoco.MjModel,
    duration: float,
    timestep: float,
    *,
    amplitude: float = 0.8,
    correlation: float = 0.1,
    seed: int = 0,
    within: Range | None = None,
) -> np.ndarray:
    """Return random controls with a correlation time, bounded by tanh.

    A stationary Ornstein-Uhlenbeck process: x_{k+1} = a x_k + sqrt(1 - a^2) w_k with
    a = exp(-timestep / correlation) and w_k standard normal.

    Args:
        model: whose actuators are driven.
        duration: in [s].
        timestep: between two rows, in [s].
        amplitude: share of the control range, in (0, 1].
        correlation: correlation time in [s].
        seed: of the draws.
        within: least and largest of what drives the machine, by default the control range.

    Returns:
        `S x nu` controls, in the units of the actuators.

    Raises:
        UserError: an argument is out of its range.
        ModelError: an actuator has no control range.
    """
    low, high = within or control_range(model)
    _check(amplitude, duration, timestep)
    if not correlation > 0:
        raise UserError(f"excitation: correlation time is {correlation} s; it must be positive")
    w = np.random.default_rng(seed).standard_normal((round(duration / timestep), len(low)))
    a = np.exp(-timestep / correlation)
    # x[k] = a x[k - 1] + √(1 - a²) w[k] from x[0] = w[0]: standard normal at all times
    rest, _ = lfilter([np.sqrt(1 - a * a)], [1, -a], w[1:], axis=0, zi=a * w[:1])
    x = np.concatenate([w[:1], rest])
    return _within(np.tanh(x), low, high, amplitude)


def _within(unit: ArrayLike, low: np.ndarray, high: np.ndarray, amplitude: float) -> np.ndarray:
    return np.asarray((low + high) / 2 + (high - low) / 2 * amplitude * np.asarray(unit))


def _check(amplitude: float, duration: float, timestep: float) -> None:
    if not 0 < amplitude <= 1:
        raise UserError(f"excitation: amplitude is {amplitude:g}; it must be in (0, 1]")
    if not duration >= 2 * timestep > 0:
        raise UserError(
            f"excitation: {duration:g} s is shorter than two control steps of {timestep:g} s; it "
            "lasts as long as an episode (a task's time_limit), or as plant.record.seconds says"
        )

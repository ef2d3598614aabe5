"""Sensor noise of a channel, estimated from the recording itself.

Third differences remove what is locally a parabola and leave white noise, amplified by √20. Their
scale is Huber's (Robust Statistics, 1981, proposal 2), which hardly heeds the few places where the
signal itself jumps: σ solves E min(z²/20, k²σ²) = β σ² with β = E min(u², k²) of a standard Gaussian
u. The median absolute deviation would lie on the lattice of a quantised channel, 10 % off and more.
For uneven stamps the third difference becomes the third divided difference, scaled so that the
squares of its weights sum to one: the same estimate, exact for parabolas on any grid.
"""

from math import sqrt

import numpy as np

from bo_sysid.arrays import Samples, Times
from bo_sysid.recording.value import Recording

_REPEATED = 0.1  # share of samples that equal the one before, from which on a channel is coarse
_CUT = 1.5  # deviations beyond which a value counts no further
_BETA = 0.7785  # E min(u², _CUT²) of a standard Gaussian u
_ITERATIONS = 50  # of a contraction
_GAP = 2.0  # four samples that span more than this many medians lie across a gap


def noise_sigma(time: Times, values: Samples) -> float:
    """Return the standard deviation of the white noise of a measured channel.

    Samples across gaps are left out. A coarsely quantised channel that moves slowly shows the same
    value again and again and seems free of noise; σ is therefore at least q/√12, the deviation of a
    rounding error, with the resolution q the smallest step between values that occur. A signal that
    bends within three samples counts as noise: for fast motion the estimate is an upper bound.

    Args:
        time: `T` increasing stamps in [s].
        values: `T` samples.

    Returns:
        σ in the unit of `values`; 0 for a channel that never moves or has fewer than 4 samples.
    """
    if len(values) < 4:
        return 0.0
    stamps = np.stack([time[i : len(time) - 3 + i] for i in range(4)], axis=1)
    samples = np.stack([values[i : len(values) - 3 + i] for i in range(4)], axis=1)
    span = stamps[:, 3] - stamps[:, 0]
    whole = span <= _GAP * np.median(span)
    # weights of the third divided difference, 1 / ∏_{j≠i} (t_i − t_j), to unit length
    offsets = (stamps[:, :, None] - stamps[:, None, :]) / span[:, None, None]
    weights = 1.0 / np.prod(offsets + np.eye(4), axis=2)
    weights /= np.linalg.norm(weights, axis=1, keepdims=True)
    third = np.sum(weights * (samples - samples[:, :1]), axis=1)[whole]
    return max(_huber_scale(third), _resolution(values) / sqrt(12))


def _huber_scale(z: Samples) -> float:
    """Return the scale σ of values about 0 that solves mean min(z², k²σ²) = β σ²."""
    square, scale = z**2, float(np.mean(z**2))
    for _ in range(_ITERATIONS):
        scale = float(np.minimum(square, _CUT**2 * scale).mean()) / _BETA
    return sqrt(scale)


def _resolution(values: Samples) -> float:
    """Return the smallest step between values that occur; 0 where few samples repeat."""
    if np.mean(np.diff(values) == 0) < _REPEATED:
        return 0.0
    steps = np.diff(np.unique(values))
    steps = steps[steps > 1e-9 * np.ptp(values)]  # the same value, rounded otherwise
    return float(steps.min()) if steps.size else 0.0


def sensor_noise(recording: Recording) -> dict[str, float]:
    """Return σ of every measured channel by name, in the channel's unit; see `noise_sigma`."""
    measured = {n: c for n, c in recording.channels.items() if c.hold == "none"}
    return {name: noise_sigma(c.time, c.values) for name, c in measured.items()}

"""Sensor noise of a channel, estimated from the recording itself.

Differences of order n remove what is locally a polynomial below n and leave white noise. On even
and uneven stamps alike they are divided differences, z = Σ wᵢ xᵢ with wᵢ ∝ 1 / ∏_{j≠i} (tᵢ - tⱼ)
and Σ wᵢ² = 1, so that z has the variance of the noise. Its scale is Huber's (Robust Statistics,
1981, proposal 2), which hardly heeds the few places where the signal itself jumps:
mean min(z², k²σ²) = β σ² with β = E min(u², k²) of a standard Gaussian u. (The median absolute
deviation would lie on the lattice of a quantised channel, 6 to 25 % off.) Order 3 serves most
logs. Slow logs of fast motion bend within four samples and that looks like noise; there a higher
order shows less.
"""

from math import sqrt

import numpy as np
from jaxtyping import Float
from numpy.lib.stride_tricks import sliding_window_view

from bo_sysid.arrays import Samples, Times
from bo_sysid.recording.value import Recording

MOVES = 15.0
"""Standard deviations of its noise that a channel's range exceeds where it shows motion."""
_REPEATED = 0.1  # share of samples that equal the one before, from which on a channel is coarse
CUT = 1.5
"""Deviations beyond which a difference counts no further."""
BETA = 0.7785
"""E min(u², CUT²) of a standard Gaussian u."""
_ITERATIONS = 50  # of a contraction
_DRAWS = 20  # of each sample, for the scale of noise of changing size
_ORDERS = (3, 4, 5, 6, 7)
_LESS = 0.95  # of the estimate so far, for the next order to be believed
_GAP = 2.0  # samples that span more than this many medians lie across a gap


def noise_sigma(time: Times, values: Samples) -> float:
    """Return the standard deviation of the white noise of a measured channel.

    Samples across gaps are left out. A coarsely quantised channel that moves slowly shows the same
    value again and again and seems free of noise; σ is therefore at least q/√12, the deviation of a
    rounding error, with the resolution q the smallest step between values that occur. What bends
    too fast for the highest order counts as noise: there the estimate is an upper bound.

    Args:
        time: `T` increasing stamps in [s].
        values: `T` samples.

    Returns:
        σ in the unit of `values`; 0 for a channel that never moves or has fewer than 4 samples.
    """
    if len(values) < _ORDERS[0] + 1:
        return 0.0
    sigma = _huber_scale(differences(*runs(time, values, _ORDERS[0] + 1)))
    for order in _ORDERS[1:]:
        if len(values) < 2 * order:
            break
        less = _huber_scale(differences(*runs(time, values, order + 1)))
        if less > _LESS * sigma:
            break
        sigma = less
    return max(sigma, resolution(values) / sqrt(12))


def runs(
    time: Times, values: Samples, count: int
) -> tuple[Float[np.ndarray, "D n"], Float[np.ndarray, "D n"]]:
    """Return the stamps and the values of every `count` samples in a row, but across gaps."""
    stamps, samples = (sliding_window_view(x, count) for x in (time, values))
    span = stamps[:, -1] - stamps[:, 0]
    whole = span <= _GAP * np.median(span)
    return stamps[whole], samples[whole]


def differences(
    stamps: Float[np.ndarray, "D n"], samples: Float[np.ndarray, "D n"]
) -> Float[np.ndarray, " D"]:
    """Return the divided differences of order n - 1 of runs, with weights of unit length."""
    span = stamps[:, -1] - stamps[:, 0]
    offsets = (stamps[:, :, None] - stamps[:, None, :]) / span[:, None, None]
    weights = 1.0 / np.prod(offsets + np.eye(stamps.shape[1]), axis=2)
    weights /= np.linalg.norm(weights, axis=1, keepdims=True)
    return np.asarray(np.sum(weights * (samples - samples[:, :1]), axis=1))


def _huber_scale(z: Float[np.ndarray, " D"]) -> float:
    """Return the scale σ of values about 0 that solves mean min(z², k²σ²) = β σ²."""
    square, scale = z**2, float(np.mean(z**2))
    for _ in range(_ITERATIONS):
        scale = float(np.minimum(square, CUT**2 * scale).mean()) / BETA
    return sqrt(scale)


def resolution(values: Samples) -> float:
    """Return the smallest step between values that occur; 0 where few samples repeat."""
    if np.mean(np.diff(values) == 0) < _REPEATED:
        return 0.0
    steps = np.diff(np.unique(values))
    steps = steps[steps > 1e-9 * np.ptp(values)]  # the same value, rounded otherwise
    return float(steps.min()) if steps.size else 0.0


def underrated(sizes: Float[np.ndarray, " T"]) -> float:
    """Return by what factor `noise_sigma` falls short of the rms of noise of changing size.

    To a robust scale large noise here and there is a signal that jumps.

    Args:
        sizes: `T` standard deviations of the noise, sample by sample, in any unit.
    """
    drawn = sizes * np.random.default_rng(0).standard_normal((_DRAWS, len(sizes)))
    return sqrt(float(np.mean(sizes**2))) / max(_huber_scale(drawn.ravel()), 1e-300)


def sensor_noise(recording: Recording) -> dict[str, float]:
    """Return σ of every measured channel by name, in the channel's unit; see `noise_sigma`."""
    measured = {n: c for n, c in recording.channels.items() if c.hold == "none"}
    return {name: noise_sigma(c.time, c.values) for name, c in measured.items()}

"""Noise of a moving channel whose samples are not taken when their stamps say.

Many logs are stamped when they are written. A channel of speed v that is sampled δt beside its
stamp is off by v δt, so that with δt of deviation τ its noise has the variance

    σ² + τ² v²,

which divided differences show (`noise`): their squares grow with the square of the local slope.
Stamps that say when samples were taken show nothing of it, however much they jitter.
"""

from dataclasses import dataclass
from math import sqrt

import numpy as np
from jaxtyping import Float
from scipy.optimize import nnls

from bo_sysid.arrays import Samples, Times
from bo_sysid.recording.alignment import Sampling
from bo_sysid.recording.noise import BETA, CUT, differences, resolution, runs

_RUN = 6  # samples in a row, of which a difference is made
_FEWEST = 50  # samples of a channel
_SURE = 4.0  # standard deviations of that correlation; 200 right logs had 1.7 at most, late ones 7
_LITTLE = 1e-3  # of an interval, that stamps must jitter by
_MOST = 1.5  # times the jitter of the stamps, that τ is at most
_ITERATIONS = 30  # of a contraction
_TINY = 1e-12  # of the mean square, that a variance is at least


@dataclass(frozen=True)
class TimingNoise:
    """Noise of σ at rest and √(σ² + τ² v²) in motion.

    Attributes:
        sigma: σ in the channel's unit.
        late: τ in [s].
    """

    sigma: float
    late: float


def timing_noise(time: Times, values: Samples) -> TimingNoise | None:
    """Return the noise of a channel whose stamps jitter beside its samples; None without it.

    It is there where squares of differences grow with the square of the slope: where their
    correlation r, times the root of the number of independent differences, exceeds `_SURE`. As in
    `noise_sigma` each square counts up to that of `CUT` deviations, and σ is at least that of a
    rounding error. τ is no larger than the jitter of the stamps explains.

    Args:
        time: `T` increasing stamps in [s].
        values: `T` samples.
    """
    if len(values) < _FEWEST:
        return None
    sampling = Sampling.of(time)
    jitter = sampling.jitter / sqrt(2)
    if jitter < _LITTLE * sampling.median_dt:
        return None
    stamps, samples = runs(time, values, _RUN)
    square, slope = differences(stamps, samples) ** 2, _slopes(stamps, samples)
    if not square.any() or not np.ptp(slope):
        return None
    alike = _shares(square, np.ones((len(square), 1)))[0]
    r = np.corrcoef(np.minimum(square, CUT**2 * alike), slope**2)[0, 1]
    sigma, late = np.sqrt(_shares(square, np.stack([np.ones_like(slope), slope**2], axis=1)))
    independent = len(square) / _RUN  # neighbours share all samples but one
    if r * sqrt(independent) < _SURE or late > _MOST * jitter:
        return None
    return TimingNoise(max(float(sigma), resolution(values) / sqrt(12)), float(late))


def speeds(time: Times, values: Samples) -> Samples:
    """Return the speed of a channel at its samples, by lines through some in a row."""
    stamps, samples = runs(time, values, _RUN)
    return np.asarray(np.interp(time, stamps.mean(axis=1), _slopes(stamps, samples)))


def _slopes(
    stamps: Float[np.ndarray, "D n"], samples: Float[np.ndarray, "D n"]
) -> Float[np.ndarray, " D"]:
    """Return the slope of the line through each run by least squares."""
    offsets = stamps - stamps.mean(axis=1, keepdims=True)
    return np.asarray((offsets * samples).sum(axis=1) / (offsets**2).sum(axis=1))


def _shares(
    square: Float[np.ndarray, " D"], parts: Float[np.ndarray, "D k"]
) -> Float[np.ndarray, " k"]:
    """Return the shares of parts of the variance that are likeliest.

    Fisher scoring: least squares of the squares on the parts, weighted by the variance so far.
    """
    variance = np.full(len(square), square.mean())
    for _ in range(_ITERATIONS):
        counted = np.minimum(square, CUT**2 * variance) / BETA
        shares, _ = nnls(parts / variance[:, None], counted / variance)
        variance = np.maximum(parts @ shares, _TINY * square.mean())
    return np.asarray(shares)

"""Positions and velocities at the starts of windows, by local polynomials."""

from dataclasses import dataclass

import mujoco
import numpy as np
from jaxtyping import Float, Int

from bo_sysid.arrays import Times
from bo_sysid.recording.alignment import stretches
from bo_sysid.simulation.state import tangent_difference

_HALF_WIDTHS = (2, 3, 5, 7, 10, 15, 20)
_DEGREE = 3
_TOLERATED = 1.15  # growth of the residual that a wider smoother may cost


@dataclass(frozen=True)
class Smoothed:
    """A local polynomial fit of the positions about some instants.

    Attributes:
        offset: `W x nv` correction of the recorded position in the tangent space, [m] or [rad].
        velocity: `W x nv` velocity in [m/s] or [rad/s].
        samples: number of samples that the fit used.
    """

    offset: Float[np.ndarray, "W nv"]
    velocity: Float[np.ndarray, "W nv"]
    samples: int


def smooth(
    model: mujoco.MjModel,
    time: Times,
    qpos: Float[np.ndarray, "T nq"],
    index: Int[np.ndarray, " W"],
) -> Smoothed:
    """Estimate position and velocity at some samples from their neighbours.

    A cubic in time is fitted by least squares to the samples about each index, in the tangent
    space of the joints at the recorded position; uneven stamps are used as they are. The width is
    the largest whose residual stays within 15 % of the narrowest one's, so that noise is averaged
    where the motion is smooth and nothing is smeared where it is not. Neighbours beyond a pause are
    none.

    Args:
        model: gives the joints.
        time: `T` stamps in [s].
        qpos: `T x nq` recorded positions.
        index: `W` samples.
    """
    fits = [
        _fit(model, time, qpos, index, half) for half in _HALF_WIDTHS if 2 * half + 1 <= len(time)
    ]
    if not fits:
        fits = [_fit(model, time, qpos, index, (len(time) - 1) // 2)]
    limit = _TOLERATED * max(fits[0][1], np.finfo(float).tiny)
    return [fit for fit, residual in fits if residual <= limit][-1]


def _fit(
    model: mujoco.MjModel,
    time: Times,
    qpos: Float[np.ndarray, "T nq"],
    index: Int[np.ndarray, " W"],
    half: int,
) -> tuple[Smoothed, float]:
    """Return the fit of one width and its residual per degree of freedom, root mean square."""
    begin, end = _stretch(time, index)
    count = min(2 * half + 1, len(time))
    first = np.clip(index - half, begin, np.maximum(end - count, begin))
    rows = first[:, None] + np.arange(count)
    inside = rows < end[:, None]  # W x K
    rows = np.minimum(rows, len(time) - 1)
    t = np.where(inside, time[rows] - time[index][:, None], 0.0)
    scale = np.abs(t).max(axis=1, keepdims=True)
    scale[scale == 0] = 1.0  # a sample by itself
    powers = np.arange(min(_DEGREE, count - 1) + 1)
    used = inside[..., None] & (powers < inside.sum(axis=1)[:, None, None])
    basis = np.where(used, (t / scale)[..., None] ** powers, 0.0)  # W x K x (degree + 1)
    moved = tangent_difference(model, qpos[rows], qpos[index][:, None])  # W x K x nv
    moved = np.where(inside[..., None], moved, 0.0)
    coefficients = np.linalg.pinv(basis) @ moved
    residual = moved - basis @ coefficients
    spare = max(count - len(powers), 1)
    rms = float(np.sqrt((residual**2).sum(axis=1).mean() / spare))
    velocity = coefficients[:, 1] / scale if count > 1 else np.zeros_like(coefficients[:, 0])
    return Smoothed(coefficients[:, 0], velocity, count), rms


def _stretch(
    time: Times, index: Int[np.ndarray, " W"]
) -> tuple[Int[np.ndarray, " W"], Int[np.ndarray, " W"]]:
    """Return the first row of the stretch between pauses that each sample is in, and of the next.

    Nobody knows how a machine moved in a pause.
    """
    begins = np.array([s.start for s in stretches(time)] + [len(time)])
    own = np.searchsorted(begins, index, side="right")
    return begins[own - 1], begins[own]

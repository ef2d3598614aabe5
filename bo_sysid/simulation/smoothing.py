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
        samples: `nv` numbers of samples that the fits used.
    """

    offset: Float[np.ndarray, "W nv"]
    velocity: Float[np.ndarray, "W nv"]
    samples: Int[np.ndarray, " nv"]


def smooth(
    model: mujoco.MjModel,
    time: Times,
    qpos: Float[np.ndarray, "T nq"],
    index: Int[np.ndarray, " W"],
) -> Smoothed:
    """Estimate position and velocity at some samples from their neighbours.

    A cubic in time is fitted by least squares to the samples about each index, in the tangent
    space of the joints at the recorded position; uneven stamps are used as they are. The width is
    the largest whose residual stays within 15 % of the narrowest one's, and by chance a little
    more, for each degree of freedom by itself: a slow joint that is noisy is averaged over longer
    than a quick one beside it. Neighbours beyond a pause are none.

    Args:
        model: gives the joints.
        time: `T` stamps in [s].
        qpos: `T x nq` recorded positions.
        index: `W` samples.
    """
    halves = [h for h in _HALF_WIDTHS if 2 * h + 1 <= len(time)] or [(len(time) - 1) // 2]
    offset, velocity, left = (
        np.stack(part)
        for part in zip(*(_fit(model, time, qpos, index, h) for h in halves), strict=True)
    )
    by_chance = 1.0 + 1.0 / np.sqrt(2 * max(len(index), 1))  # of the narrowest's one spare sample
    limit = _TOLERATED * by_chance * np.maximum(left[0], np.finfo(float).tiny)
    chosen = np.array([np.flatnonzero(column)[-1] for column in (left <= limit).T], int)
    joints = np.arange(left.shape[1])
    samples = np.array([min(2 * halves[k] + 1, len(time)) for k in chosen], int)
    return Smoothed(offset[chosen, :, joints].T, velocity[chosen, :, joints].T, samples)


def _fit(
    model: mujoco.MjModel,
    time: Times,
    qpos: Float[np.ndarray, "T nq"],
    index: Int[np.ndarray, " W"],
    half: int,
) -> tuple[Float[np.ndarray, "W nv"], Float[np.ndarray, "W nv"], Float[np.ndarray, " nv"]]:
    """Return offsets and velocities by one width, and what it leaves, root mean square by column.

    Squares are divided by the samples that the cubic leaves free.
    """
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
    rms = np.sqrt((residual**2).sum(axis=1).mean(axis=0) / spare)
    velocity = coefficients[:, 1] / scale if count > 1 else np.zeros_like(coefficients[:, 0])
    return coefficients[:, 0], velocity, rms


def _stretch(
    time: Times, index: Int[np.ndarray, " W"]
) -> tuple[Int[np.ndarray, " W"], Int[np.ndarray, " W"]]:
    """Return the first row of the stretch between pauses that each sample is in, and of the next.

    Nobody knows how a machine moved in a pause.
    """
    begins = np.array([s.start for s in stretches(time)] + [len(time)])
    own = np.searchsorted(begins, index, side="right")
    return begins[own - 1], begins[own]

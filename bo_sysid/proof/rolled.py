"""What every plant of the proof returns, and what it asks for while it runs."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import ceil
from typing import TypeAlias

import numpy as np
from jaxtyping import Float

from bo_sysid.proof.physics import Physics

Command: TypeAlias = Callable[[int, Sequence[float]], Sequence[float]]
"""(row k, positions as the encoders tell them at row k) -> control applied from row k on."""


class PlantDiverged(Exception):  # noqa: N818 - an outcome of a draw, not a defect
    """The plant left every bound; the case is drawn anew."""


@dataclass(frozen=True)
class Rolled:
    """One trajectory of a plant, free of noise.

    Attributes:
        time: `T` in [s].
        qpos: `T x n` true positions.
        qvel: `T x n` true velocities.
        ctrl: `T x m` commands; row k applies from time k on.
        read: `T x n` what perfect encoders with the plant's own errors tell.
    """

    time: Float[np.ndarray, " T"]
    qpos: Float[np.ndarray, "T n"]
    qvel: Float[np.ndarray, "T n"]
    ctrl: Float[np.ndarray, "T m"]
    read: Float[np.ndarray, "T n"]


def encoder_readings(
    physics: Physics, states: np.ndarray, timestep: float, rotor: np.ndarray | None = None
) -> list[float]:
    """Return what the encoders say at the last row.

    Args:
        physics: of the plant.
        states: `k x 2n` positions and velocities so far.
        timestep: between two rows in [s].
        rotor: `k x 2` position and velocity of the rotor, where there is one.
    """
    n = states.shape[1] // 2
    readings = []
    for dof, encoder in enumerate(physics.encoders):
        turned = rotor is not None and physics.transmission and physics.transmission.dof == dof
        pair = states[:, [dof, n + dof]]
        if rotor is not None and turned and encoder.motor_side:
            pair = rotor
        x = pair[-1, 0]
        if encoder.delay > 0 and len(pair) > 1:
            near = pair[-2 - ceil(encoder.delay / timestep) :] if len(pair) > 2 else pair
            clock = np.arange(len(near)) * timestep
            x = hermite(clock, near[:, 0], near[:, 1], clock[-1:] - encoder.delay)[0]
        readings.append(float((1.0 + encoder.scale) * x + encoder.offset))
    return readings


def rolled(
    physics: Physics,
    time: np.ndarray,
    states: np.ndarray,
    ctrl: np.ndarray,
    rotor: np.ndarray | None = None,
) -> Rolled:
    """Return a trajectory with what its encoders tell.

    Args:
        physics: of the plant.
        time: `T` in [s].
        states: `T x 2n` positions and velocities.
        ctrl: `T x m`.
        rotor: `T x 2` position and velocity of the rotor, where there is one.
    """
    n = states.shape[1] // 2
    q, v = states[:, :n], states[:, n:]
    read = np.empty_like(q)
    for dof, encoder in enumerate(physics.encoders):
        x, slope = q[:, dof], v[:, dof]
        turned = physics.transmission is not None and physics.transmission.dof == dof
        if rotor is not None and turned and encoder.motor_side:
            x, slope = rotor[:, 0], rotor[:, 1]
        late = x if encoder.delay == 0 else hermite(time, x, slope, time - encoder.delay)
        read[:, dof] = (1.0 + encoder.scale) * late + encoder.offset
    return Rolled(time, q, v, ctrl, read)


def hermite(
    time: Float[np.ndarray, " T"],
    x: Float[np.ndarray, " T"],
    slope: Float[np.ndarray, " T"],
    at: Float[np.ndarray, " S"],
) -> Float[np.ndarray, " S"]:
    """Interpolate with the cubic that has the given values and slopes; held before the start.

    For the one time of a step it takes a third of what `scipy.interpolate.CubicHermiteSpline` does.
    """
    at = np.maximum(at, time[0])
    k = np.clip(np.searchsorted(time, at, side="right") - 1, 0, time.size - 2)
    h = time[k + 1] - time[k]
    s = (at - time[k]) / h
    return np.asarray(
        (1 + 2 * s) * (1 - s) ** 2 * x[k]
        + s**2 * (3 - 2 * s) * x[k + 1]
        + h * s * (1 - s) ** 2 * slope[k]
        - h * s**2 * (1 - s) * slope[k + 1]
    )

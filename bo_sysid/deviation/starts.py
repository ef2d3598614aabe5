"""Starts as nuisance parameters: the state at the start of a window is fitted, not measured."""

import numpy as np
from jaxtyping import Float

from bo_sysid.simulation import Simulator, State, Windows

_STEP_POSITION = 1e-6  # finite-difference steps in [m] or [rad] and in [m/s] or [rad/s]
_STEP_VELOCITY = 1e-4
_ITERATIONS = 3
_SHORTER, _TRIES = 0.3, 3  # factor by which a step that does not help is shortened
_GAIN = 1e-4  # relative decrease of the total cost at which the iteration has converged


def fit_starts(
    simulator: Simulator,
    point: Float[np.ndarray, " d"],
    windows: Windows,
    weight: Float[np.ndarray, " c"],
) -> Windows:
    """Return the windows with the starts that fit them best at one candidate.

    Gauss-Newton on position and velocity of each window by itself: x ← x + t J⁺ W (y - F(x)),
    J by finite differences through the simulator at the first guess, and kept (the chord method).
    A step is accepted window by window, where it lowers that window's residual; a window in which
    the simulation diverges keeps its start.

    Args:
        simulator: predicts.
        point: the candidate.
        windows: `W` windows, with a first guess of their starts.
        weight: `c` weights W of the channels.
    """
    dof = windows.start.qvel.shape[1]
    start = windows.start
    residual, cost = _cost(simulator, point, windows, [start], weight)[0]
    inverse = np.linalg.pinv(_jacobian(simulator, point, windows, start, residual, weight, dof))
    for _ in range(_ITERATIONS):
        step = (inverse @ residual[..., None])[..., 0]
        moved, residual, after = _search(
            simulator, point, windows, start, step, weight, residual, cost
        )
        runs = np.isfinite(cost)
        gain = float((cost[runs] - after[runs]).sum())
        little = _GAIN * float(cost[runs].sum())
        start, cost = moved, after
        if gain <= little:
            break
    return windows.with_start(start)


def _search(
    simulator: Simulator,
    point: Float[np.ndarray, " d"],
    windows: Windows,
    start: State,
    step: Float[np.ndarray, "W n"],
    weight: Float[np.ndarray, " c"],
    residual: Float[np.ndarray, "W m"],
    cost: Float[np.ndarray, " W"],
) -> tuple[State, Float[np.ndarray, "W m"], Float[np.ndarray, " W"]]:
    """Shorten the step of each window until its cost falls; return starts, residuals and costs."""
    scale = np.ones(len(cost))
    residual, cost = residual.copy(), cost.copy()
    taken = np.zeros(len(cost))
    for _ in range(_TRIES):
        waiting = taken == 0
        if not waiting.any():
            break
        trial = simulator.moved(start, np.where(waiting, scale, taken)[:, None] * step)
        new_residual, new_cost = _cost(simulator, point, windows, [trial], weight)[0]
        better = waiting & (new_cost < cost)
        residual[better], cost[better] = new_residual[better], new_cost[better]
        taken[better] = scale[better]
        scale[~better] *= _SHORTER
    return simulator.moved(start, taken[:, None] * step), residual, cost


def _cost(
    simulator: Simulator,
    point: Float[np.ndarray, " d"],
    windows: Windows,
    starts: list[State],
    weight: Float[np.ndarray, " c"],
) -> list[tuple[Float[np.ndarray, "W m"], Float[np.ndarray, " W"]]]:
    """Return for each set of starts the weighted residuals and their sums of squares."""
    points = np.repeat(point[None], len(starts), axis=0)
    out = []
    for prediction in simulator.predictions(points, windows, starts):
        residual = np.nan_to_num(windows.residual(prediction.values) * weight, nan=0.0)
        flat = residual.reshape(len(windows), -1)
        cost = np.where(prediction.diverged, np.inf, (flat**2).sum(axis=1))
        out.append((np.where(prediction.diverged[:, None], 0.0, flat), cost))
    return out


def _jacobian(
    simulator: Simulator,
    point: Float[np.ndarray, " d"],
    windows: Windows,
    start: State,
    residual: Float[np.ndarray, "W m"],
    weight: Float[np.ndarray, " c"],
    dof: int,
) -> Float[np.ndarray, "W m n"]:
    """Return how the weighted prediction changes with the start, by finite differences.

    A start that makes a window diverge gives no slope: that window does not move along it.
    """
    size = np.repeat([_STEP_POSITION, _STEP_VELOCITY], dof)
    starts = [simulator.moved(start, np.tile(row, (len(start), 1))) for row in np.diag(size)]
    moved = _cost(simulator, point, windows, starts, weight)
    columns = [
        np.where(np.isfinite(cost)[:, None], (residual - r) / h, 0.0)
        for (r, cost), h in zip(moved, size, strict=True)
    ]
    return np.stack(columns, axis=-1)

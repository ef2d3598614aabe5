"""What the model's time step does to the parameters that are found."""

import mujoco
import numpy as np
import pandas as pd
from jaxtyping import Float

from bo_sysid.arrays import Point
from bo_sysid.deviation import Deviation
from bo_sysid.identify.problem import Problem

_STEP = 0.01  # of a parameter's range, for its column
_MOST = 200_000  # predicted numbers that are looked at
_RUNGE_KUTTA, _RK4 = int(mujoco.mjtIntegrator.mjINT_RK4), 4  # an integrator, and its order
_RCOND = 1e-3  # of the largest singular value: smaller ones are taken as zero


def step_shift(problem: Problem, best: Point) -> Float[np.ndarray, " d"]:
    """Return how far the model's time step moves each parameter away from the machine's.

    A model whose step h is coarse is fitted with parameters that make up for it,

        β̂ - β ≈ κ J⁺ (F_{h/2}(β̂) - F_h(β̂)),

    with J the response of the whitened predictions F_h to the parameters. κ is 2 since the error of
    an integrator of first order, as MuJoCo's Euler's and implicit ones are, halves with the step;
    that of order p falls to 1/2ᵖ, and κ = 1/(1 - 1/2ᵖ). Where starts are
    nuisances they are fitted to the recordings, anew at each parameter vector and time step.

    Args:
        problem: what was searched.
        best: `d` values of the candidate that was found.

    Returns:
        `d` differences in the parameters' units, 0 for those without an order.
    """
    own, step = problem.deviation, problem.deviation.windows.timestep
    shift = np.zeros(len(best))
    free = [k for k in range(len(best)) if k not in problem.candidates.categories]
    every = own.windows.observed.size // _MOST + 1
    there = _whitened(own, best, every)
    finer = _whitened(problem.at_timestep(step / 2), best, every)
    low, high = problem.candidates.bounds
    sizes = _STEP * (high - low) * np.where(best > (low + high) / 2, -1.0, 1.0)
    moved = [_whitened(own, best + size, every) for size in np.diag(sizes)[free]]
    finite = np.isfinite([there, finer, *moved]).all(axis=0)
    if not (free and finite.any()):
        return shift
    columns = np.stack([(m - there)[finite] for m in moved], axis=1)
    solved = np.linalg.lstsq(columns, (finer - there)[finite], rcond=_RCOND)[0]
    order = _RK4 if problem.model.compile().opt.integrator == _RUNGE_KUTTA else 1
    shift[free] = solved * sizes[free] / (1 - 0.5**order)
    return shift


def _whitened(deviation: Deviation, point: Point, every: int) -> Float[np.ndarray, " n"]:
    """Return each n-th prediction in units of its scale, NaN where a window diverged."""
    prediction = deviation.prediction(point)
    values = prediction.values / deviation.whitening.scale
    values = np.where(np.isfinite(deviation.windows.observed), values, 0.0)
    return np.where(prediction.diverged[:, None, None], np.nan, values).ravel()[::every]


def step_notes(problem: Problem, best: Point, parameters: pd.DataFrame) -> list[str]:
    """Return in words which parameters the time step moves by more than half of their interval.

    Args:
        problem: what was searched.
        best: the candidate that was found.
        parameters: name, unit, low95 and high95 of each.
    """
    step, notes = problem.deviation.windows.timestep, []
    rows = parameters[["name", "unit", "low95", "high95"]].to_numpy()
    for (name, unit, low, high), shift in zip(rows, step_shift(problem, best), strict=True):
        if abs(shift) > (high - low) / 2:
            notes.append(
                f"the model's time step of {1e3 * step:g} ms moves {name} by about {shift:+.2g}"
                f"{f' {unit}' if unit else ''}, which its interval does not tell: a smaller "
                "timestep in the model's <option> helps"
            )
    return notes

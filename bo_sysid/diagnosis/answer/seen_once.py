"""Where in the recordings more is left than noise leaves, too rarely to say what acts there."""

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.stats import chi2

from bo_sysid.diagnosis.sets.fit import Fit
from bo_sysid.diagnosis.windows.problem import Problem
from bo_sysid.diagnosis.windows.projection import project

_CHANCE = 1e-6  # that noise alone leaves as much in any of the windows
_FEW, _MOST = 0.1, 0.8  # share of the windows at most, that hold that share of all that is left
_LISTED = 3  # places


def seen_once(problem: Problem, Q: Float[np.ndarray, "W R k"], fit: Fit) -> str:
    """Return where few windows leave more than noise leaves, in words; empty if none does.

    A force law is believed where it predicts windows that it was not fitted to: what acts once is
    in none of them. Under noise alone the squares that a window leaves, in σ², have a χ²
    distribution with as many degrees of freedom as it has observations beyond its start. It is
    scaled to the median window, since noise may be larger than was estimated, and a push of three
    thousand σ² leaves a trace of itself in what is fitted to all.

    Args:
        problem: all windows.
        Q: orthonormal bases of what the start of each window does.
        fit: the answer.
    """
    squares = (project(Q, fit.residual) ** 2).sum(axis=1)
    dof = np.maximum((problem.weight > 0).sum(axis=(1, 2)) - problem.start_size, 1)
    usual = max(float(np.median(squares / chi2.median(dof))), 1.0)
    rare = _holding_most(squares / usual - dof)
    by_chance = chi2.sf(squares / usual, dof) * len(squares)
    if rare.mean() > _FEW or (by_chance[rare] > _CHANCE).any():
        return ""
    size, elsewhere = _rms(squares, dof, rare), _rms(squares, dof, ~rare)
    places = _places(problem, rare)
    more = f" and {len(places) - _LISTED} more" if len(places) > _LISTED else ""
    return (
        f"{'; '.join(places[:_LISTED])}{more}: there the model misses the recording by {size:.2g} "
        f"sensor sigmas, and by {elsewhere:.2g} elsewhere. What acts there, or disturbed the "
        "machine, was seen too rarely to tell: record that motion several times."
    )


def _holding_most(left: Float[np.ndarray, " W"]) -> Bool[np.ndarray, " W"]:
    """Return which windows hold most of all that is left, as few as do."""
    left = np.maximum(left, 0.0)
    order = np.argsort(-left)
    enough = int(np.searchsorted(np.cumsum(left[order]), _MOST * left.sum())) + 1
    rare = np.zeros(len(left), bool)
    rare[order[:enough]] = True
    return rare


def _rms(
    squares: Float[np.ndarray, " W"], dof: Int[np.ndarray, " W"], of: Bool[np.ndarray, " W"]
) -> float:
    """Return the root mean square per degree of freedom of some windows."""
    return float(np.sqrt(squares[of].sum() / dof[of].sum()))


def _places(problem: Problem, rare: Bool[np.ndarray, " W"]) -> list[str]:
    """Return the stretches of neighbouring windows in words: "log-a, 12.4 to 12.8 s"."""
    w, found = problem.windows, list[tuple[str, float, float]]()
    last = (w.step[:, -1] + w.fraction[:, -1]) * w.timestep  # [s] from the start of a window
    for k in np.flatnonzero(rare):
        name, first, end = problem.recordings[w.recording[k]].name, w.time[k], w.time[k] + last[k]
        if found and found[-1][0] == name and first <= found[-1][2] + last[k]:
            found[-1] = (name, found[-1][1], end)
        else:
            found.append((name, first, end))
    return [f"{name}, {first:.3g} to {end:.3g} s" for name, first, end in found]

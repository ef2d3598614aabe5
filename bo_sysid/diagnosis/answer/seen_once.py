"""Where in the recordings more is left than noise leaves: once in a while, or in a part.

A force law is believed where it predicts windows that it was not fitted to. What acts once is in
none of them, and what acts from some time on is in some and not in others.
"""

import numpy as np
import pandas as pd
from jaxtyping import Bool, Float, Int
from scipy.stats import chi2

from bo_sysid.diagnosis.sets.fit import Fit
from bo_sysid.diagnosis.windows.problem import Problem
from bo_sysid.diagnosis.windows.projection import project

_CHANCE = 1e-6  # that noise alone leaves as much in any of the windows
_FEW, _MOST = 0.1, 0.8  # share of the windows at most, that hold that share of all that is left
_LISTED = 3  # places
_ENDS = (0.1, 0.9)  # quantiles of the windows' levels: quiet ones lie nearer to the lower
_LOUDER = 3.0  # times what most others leave, that most windows of a stretch leave
_PURE = 0.9  # share of loud windows in a stretch
_SOME = 5  # windows in a stretch, and elsewhere, at least
_MOVES = 0.5  # of each channel's motion in a stretch, that is elsewhere at least


def seen_once(problem: Problem, Q: Float[np.ndarray, "W R k"], fit: Fit) -> str:
    """Return where few windows leave more than noise leaves, in words; empty if none does.

    Under noise alone the squares that a window leaves, in σ², have a χ²
    distribution with as many degrees of freedom as it has observations beyond its start. It is
    scaled to the median window, since noise may be larger than was estimated, and a push of three
    thousand σ² leaves a trace of itself in what is fitted to all.

    Args:
        problem: all windows.
        Q: orthonormal bases of what the start of each window does.
        fit: the answer.
    """
    squares, dof = _left(problem, Q, fit)
    usual = max(float(np.median(squares / chi2.median(dof))), 1.0)
    rare = _holding_most(squares / usual - dof)
    by_chance = np.asarray(chi2.sf(squares / usual, dof)) * len(squares)
    if rare.mean() > _FEW or (by_chance[rare] > _CHANCE).any():
        return ""
    return (
        f"{_misses(problem, rare, squares, dof)} What acts there, or disturbed the machine, was "
        "seen too rarely to tell: record that motion several times."
    )


def seen_in_a_part(problem: Problem, Q: Float[np.ndarray, "W R k"], fit: Fit) -> str:
    """Return which stretch of each recording leaves more than noise leaves; empty if none does.

    A load that was picked up, or a bolt that came loose, makes another machine of it. It is told
    where all that moves there moves elsewhere as well: what a joint lacks shows in no rest of it.

    Args:
        problem: all windows.
        Q: orthonormal bases of what the start of each window does.
        fit: the answer.
    """
    squares, dof = _left(problem, Q, fit)
    level = np.sqrt(squares / dof)
    loud = level > np.sqrt(np.prod(np.quantile(level, _ENDS)))
    part = np.zeros(len(level), bool)
    for own in (problem.windows.recording == r for r in np.unique(problem.windows.recording)):
        at = np.flatnonzero(own & loud)
        part[at.min(initial=len(level)) : at.max(initial=-1) + 1] = True
    if min(part.sum(), (~part).sum()) < _SOME or loud[part].mean() < _PURE:
        return ""
    reach = np.ma.ptp(np.ma.masked_invalid(problem.windows.observed), axis=1)
    moved = pd.DataFrame(reach.filled(np.nan))
    here, elsewhere = moved[part].median(), moved[~part].median()
    louder = np.median(level[part]) >= _LOUDER * np.median(level[~part])
    if not louder or (elsewhere < _MOVES * here).any():
        return ""
    return (
        f"{_misses(problem, part, squares, dof)} Something differs in that part, such as a load "
        "that was picked up: diagnose it as a recording of its own."
    )


def _misses(
    problem: Problem,
    where: Bool[np.ndarray, " W"],
    squares: Float[np.ndarray, " W"],
    dof: Int[np.ndarray, " W"],
) -> str:
    """Return in words where some windows are, and how much they and the others leave."""
    places = _places(problem, where)
    more = f" and {len(places) - _LISTED} more" if len(places) > _LISTED else ""
    return (
        f"{'; '.join(places[:_LISTED])}{more}: there the model misses the recording by "
        f"{_rms(squares, dof, where):.2g} sensor sigmas, and by {_rms(squares, dof, ~where):.2g} "
        "elsewhere."
    )


def _left(
    problem: Problem, Q: Float[np.ndarray, "W R k"], fit: Fit
) -> tuple[Float[np.ndarray, " W"], Int[np.ndarray, " W"]]:
    """Return the squares that each window leaves in [sigma²], and its degrees of freedom."""
    squares = (project(Q, fit.residual) ** 2).sum(axis=1)
    dof = (problem.weight > 0).sum(axis=(1, 2)) - problem.start_size
    return np.asarray(squares), np.asarray(np.maximum(dof, 1))


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

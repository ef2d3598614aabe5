"""Zooming: a new discrete set B around the mass of P, where the stated one is too coarse.

P shrinks to a point as the search goes on, P_boot does not: its width is what the recordings leave
uncertain. So the last set alone gives the minimum, and all sets together the uncertainty.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial import cKDTree

from bo_sysid.arrays import Points, Probabilities
from bo_sysid.belief.bootstrap import credible_interval
from bo_sysid.belief.rows import RowIndex
from bo_sysid.deviation import Evaluation
from bo_sysid.identify.search import History
from bo_sysid.parameters import CandidateSet, Parameter

MASS = 0.999  # of P that the new box must hold
WORTHWHILE = 0.8  # a box that keeps more than this share of every side is no zoom
_SAME = 1e-6  # of a cell: nearer candidates are one
_FINE = 0.1  # share of P_boot's 95 % interval below which a finer spacing adds nothing
_FINEST = 1e-6  # of the stated range, the same where the recordings are explained exactly


@dataclass(frozen=True)
class Level:
    """One set that was searched.

    Attributes:
        candidates: the set.
        history: what was evaluated of it.
    """

    candidates: CandidateSet
    history: History


def joined(levels: Sequence[Level]) -> tuple[Level, Points]:
    """Return the candidates and evaluations of all levels as one, and what each stands for.

    Args:
        levels: the stated set first, each other one inside the one before.

    Returns:
        The joined level, in the bounds of the stated set, each candidate once; and `N x d` sides
        of the box that each candidate stands for: those of the finest set that has it inside.
    """
    first, everything = levels[0].candidates, [level.candidates.points for level in levels]
    points = np.concatenate(everything)
    points = points[np.sort(np.unique(RowIndex.of(points).find(points)))]
    whole = CandidateSet(first.parameters, points)
    cells = np.tile(first.cell, (len(points), 1))
    for level in levels[1:]:
        cells[_inside(points, level.candidates, first)] = level.candidates.cell
    index = RowIndex.of(points)
    rows = np.concatenate(
        [index.find(level.candidates.points[level.history.rows]) for level in levels]
    )
    rows, once = np.unique(rows, return_index=True)
    evaluations = [level.history.evaluation for level in levels]
    evaluation = Evaluation(
        np.concatenate([e.deviation for e in evaluations])[once],
        np.concatenate([e.contributions for e in evaluations])[once],
        np.concatenate([e.diverged for e in evaluations])[once],
    )
    return Level(whole, History(rows, evaluation, np.full(len(rows), np.nan))), cells


def _inside(points: Points, finer: CandidateSet, stated: CandidateSet) -> Bool[np.ndarray, " N"]:
    """Return which points have finer ones on every side; a bound of the stated set has none."""
    (low, high), (least, most) = finer.bounds, stated.bounds
    slack = _SAME * finer.cell
    above = (points > low + slack) | (low == least)
    below = (points < high - slack) | (high == most)
    return np.asarray((above & below).all(axis=1))


def is_fine_enough(candidates: CandidateSet, known: CandidateSet, bootstrap: Probabilities) -> bool:
    """Return whether the spacing is at most a tenth of the 95 % interval of P_boot.

    That holds for every parameter; where the interval is nearly a point, a spacing of 1e-6 of the
    stated range will do. P itself shrinks with every evaluation: it would never end the
    refinement.

    Args:
        candidates: the set that was searched last.
        known: all sets that were searched, joined: a zoomed box may be narrower than the interval.
        bootstrap: P_boot of each of `known`.
    """
    low, high = credible_interval(known.points, bootstrap, 0.95)
    least = _FINEST * np.ptp(known.bounds, axis=0)
    return bool((candidates.cell <= np.maximum(_FINE * (high - low), least)).all())


def zoomed(
    candidates: CandidateSet, history: History, probabilities: Probabilities, seed: int
) -> tuple[CandidateSet, History] | None:
    """Return a finer candidate set in the box that holds the mass of P.

    The box is that of the most probable candidates that together hold 99.9 % of P, widened by one
    cell of the present set, so that their neighbours are in it. Evaluated candidates inside it are
    taken along as rows of the new set, with their deviations.

    Returns:
        The new set and what is known of it; None where the box would not shrink.
    """
    low, high = _box(candidates, probabilities)
    sides = candidates.bounds[1] - candidates.bounds[0]
    if (high - low >= WORTHWHILE * sides).all():
        return None
    parameters = tuple(
        replace(p, low=float(a), high=float(b)) if p.ordered else p
        for p, a, b in zip(candidates.parameters, low, high, strict=True)
    )
    fresh = _same_kind(candidates, parameters, seed)
    points = candidates.points[history.rows]
    slack = _SAME * candidates.cell
    inside = ((points >= low - slack) & (points <= high + slack)).all(axis=1)
    old = history.evaluation
    known = Evaluation(old.deviation[inside], old.contributions[inside], old.diverged[inside])
    count = int(inside.sum())
    new = fresh.points
    if count:  # a grid in the box may hit what was evaluated, but for rounding
        # categories, which have no cell, differ by more than that in shares of their range
        unit = np.where(fresh.cell > 0, fresh.cell, np.ptp(fresh.bounds, axis=0))
        distance = cKDTree(points[inside] / unit).query(new / unit)[0]
        new = new[distance > _SAME]
    new = _on_values_of(candidates.points, new, fresh.cell)
    together = CandidateSet(parameters, np.concatenate([points[inside], new]), fresh.spacing)
    return together, History(np.arange(count), known, np.full(count, np.nan))


def _on_values_of(
    known: Float[np.ndarray, "M d"], new: Float[np.ndarray, "N d"], cell: Float[np.ndarray, " d"]
) -> Float[np.ndarray, "N d"]:
    """Return new candidates with the values that known ones have, where they are but for rounding.

    The mass that P and P_boot give to a value would be split between two that differ by rounding.
    """
    made = new.copy()
    for k in np.flatnonzero(cell):
        values = np.unique(known[:, k])
        after = np.clip(np.searchsorted(values, made[:, k]), 1, max(len(values) - 1, 1))
        below, above = values[after - 1], values[np.minimum(after, len(values) - 1)]
        near = np.where(made[:, k] - below < above - made[:, k], below, above)
        made[:, k] = np.where(np.abs(near - made[:, k]) < _SAME * cell[k], near, made[:, k])
    return made


def _box(
    candidates: CandidateSet, probabilities: Probabilities
) -> tuple[Float[np.ndarray, " d"], Float[np.ndarray, " d"]]:
    order = np.argsort(-probabilities, kind="stable")
    count = int(np.searchsorted(np.cumsum(probabilities[order]), MASS)) + 1
    held = candidates.points[order[:count]]
    low = np.maximum(held.min(axis=0) - candidates.cell, candidates.bounds[0])
    high = np.minimum(held.max(axis=0) + candidates.cell, candidates.bounds[1])
    whole = list(candidates.categories)  # categories have no neighbourhood to zoom into
    low[whole], high[whole] = candidates.bounds[:, whole]
    return low, high


def _same_kind(
    candidates: CandidateSet, parameters: tuple[Parameter, ...], seed: int
) -> CandidateSet:
    """Return as many candidates in the new box, on a grid where the old ones were on one."""
    if candidates.spacing is not None:
        return CandidateSet.from_grid(parameters)
    return CandidateSet.from_sobol(parameters, len(candidates), seed)

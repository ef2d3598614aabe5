"""Zooming: a new discrete set B around the mass of P, where the stated one is too coarse.

P shrinks to a point as the search goes on, P_boot does not: its width is what the recordings leave
uncertain. So the last set alone gives the minimum, and all sets together the uncertainty.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree

from bo_sysid.arrays import Point, Points, Probabilities
from bo_sysid.belief.bootstrap import BootstrapMinima, bootstrap_minima, credible_interval
from bo_sysid.deviation import Blocks, Evaluation
from bo_sysid.identify.search import History, SearchOutcome
from bo_sysid.parameters import CandidateSet, Parameter

MASS = 0.999  # of P that the new box must hold
WORTHWHILE = 0.8  # a box that keeps more than this share of every side is no zoom
_SAME = 1e-6  # of a cell: nearer candidates are one
_FINE = 0.1  # share of P_boot's 95 % interval below which a finer spacing adds nothing
_FINEST = 1e-6  # of the stated range, the same where the recordings are explained exactly


@dataclass(frozen=True)
class Level:
    """One set that was searched, and how its search ended."""

    candidates: CandidateSet
    outcome: SearchOutcome


def best_of(levels: Sequence[Level]) -> Point:
    """Return the candidate with the smallest Δ of all that were evaluated."""
    lowest = [float(v.outcome.history.evaluation.deviation.min()) for v in levels]
    level = levels[int(np.argmin(lowest))]
    history = level.outcome.history
    return np.asarray(level.candidates.points[history.rows[history.evaluation.deviation.argmin()]])


@dataclass(frozen=True)
class Refined:
    """Every set with a finer one inside it, as one set in the bounds of the stated one.

    Attributes:
        candidates: those of each set outside the box of the next.
        cells: `N x d` sides of the box that each stands for.
        probabilities: P of each.
        bootstrap: P_boot of each.
    """

    candidates: CandidateSet
    cells: Points
    probabilities: Probabilities
    bootstrap: Probabilities


def joined(levels: Sequence[Level], blocks: Blocks, seed: int) -> Refined:
    """Return what is known of the arg-min over all sets, the stated one first.

    Every candidate is judged by the surrogate of its own set: one of all evaluations, which crowd
    around the minimum, would follow Δ badly far from it. P of a finer set is P of its box times P
    within it. In each bootstrap the least of the minima of all sets is the minimum.

    Args:
        levels: each inside the one before.
        blocks: of the recordings.
        seed: of bootstraps and samples.
    """
    parts = [
        _Part(level, np.flatnonzero(~_in_box(level.candidates, finer.candidates)))
        for level, finer in pairwise(levels)
    ]
    parts = [p for p in parts if len(p.rows)]
    parts.append(_Part(levels[-1], np.arange(len(levels[-1].candidates))))
    points = np.concatenate([p.points for p in parts])
    cells = [np.tile(p.level.candidates.cell, (len(p.rows), 1)) for p in parts]
    mass, shares = 1.0, []
    for part in parts:
        shares.append(mass * part.level.outcome.belief.probabilities[part.rows])
        mass -= float(shares[-1].sum())
    minima = [p.minima(blocks, seed) for p in parts]
    first = np.cumsum([0, *(len(p.rows) for p in parts[:-1])])
    winners = np.array([start + m.rows for start, m in zip(first, minima, strict=True)])
    lowest = np.argmin([m.deviations for m in minima], axis=0)
    counts = np.bincount(winners[lowest, np.arange(len(lowest))], minlength=len(points))
    return Refined(
        CandidateSet(levels[0].candidates.parameters, points),
        np.concatenate(cells),
        np.concatenate(shares),
        counts / counts.sum(),
    )


@dataclass(frozen=True)
class _Part:
    """Rows of a set that a finer one does not replace."""

    level: Level
    rows: Int[np.ndarray, " k"]

    @property
    def points(self) -> Points:
        """The candidates in these rows, `k x d`."""
        return np.asarray(self.level.candidates.points[self.rows])

    def minima(self, blocks: Blocks, seed: int) -> BootstrapMinima:
        """Return the minimum over these rows in each bootstrap."""
        outcome, place = self.level.outcome, np.full(len(self.level.candidates), -1)
        place[self.rows] = np.arange(len(self.rows))
        return bootstrap_minima(
            outcome.surrogate,
            self.points,
            place[outcome.history.rows],
            outcome.history.evaluation.contributions,
            blocks.weight,
            groups=blocks.session,
            seed=seed,
        )


def _in_box(candidates: CandidateSet, finer: CandidateSet) -> Bool[np.ndarray, " N"]:
    """Return which candidates lie in the box of a finer set, its sides included."""
    (low, high), slack = finer.bounds, _SAME * candidates.cell
    inside = (candidates.points >= low - slack) & (candidates.points <= high + slack)
    return np.asarray(inside.all(axis=1))


def is_fine_enough(candidates: CandidateSet, found: Refined) -> bool:
    """Return whether the spacing is at most a tenth of the 95 % interval of P_boot.

    That holds for every parameter; where the interval is nearly a point, a spacing of 1e-6 of the
    stated range will do. P itself shrinks with every evaluation: it would never end the
    refinement.

    Args:
        candidates: the set that was searched last.
        found: all sets that were searched: a zoomed box may be narrower than the interval.
    """
    low, high = credible_interval(found.candidates.points, found.bootstrap, 0.95)
    least = _FINEST * np.ptp(found.candidates.bounds, axis=0)
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
    inside = _in_box(candidates, fresh)[history.rows]
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

"""Zooming: a new discrete set B around the mass of P, where the stated one is too coarse."""

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from bo_sysid.arrays import Probabilities
from bo_sysid.deviation import Evaluation
from bo_sysid.identify.search import History
from bo_sysid.parameters import CandidateSet, Parameter

MASS = 0.999  # of P that the new box must hold
WORTHWHILE = 0.8  # a box that keeps more than this share of every side is no zoom


def zoomed(
    candidates: CandidateSet, history: History, probabilities: Probabilities, seed: int
) -> tuple[CandidateSet, History] | None:
    """Return a finer candidate set in the box that holds the mass of P.

    The box is that of the most probable candidates that together hold 99.9 % of P, widened by one
    spacing of the present set. Evaluated candidates inside it are taken along as rows of the new
    set, with their deviations.

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
    inside = ((points >= low) & (points <= high)).all(axis=1)
    old = history.evaluation
    known = Evaluation(old.deviation[inside], old.contributions[inside], old.diverged[inside])
    joined = CandidateSet(parameters, np.concatenate([points[inside], fresh.points]), fresh.spacing)
    count = int(inside.sum())
    return joined, History(np.arange(count), known, np.full(count, np.nan))


def _box(
    candidates: CandidateSet, probabilities: Probabilities
) -> tuple[Float[np.ndarray, " d"], Float[np.ndarray, " d"]]:
    order = np.argsort(-probabilities, kind="stable")
    count = int(np.searchsorted(np.cumsum(probabilities[order]), MASS)) + 1
    held = candidates.points[order[:count]]
    sides = candidates.bounds[1] - candidates.bounds[0]
    spacing = sides / (len(candidates) ** (1 / len(sides)) - 1 + 1e-9)
    low = np.maximum(held.min(axis=0) - spacing, candidates.bounds[0])
    high = np.minimum(held.max(axis=0) + spacing, candidates.bounds[1])
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

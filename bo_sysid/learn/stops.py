"""When the outer loop ends, and when the search within it does.

- `seed`: the search ends when the entropy of P converges; the loop ends when the chosen candidate
  is within ε of argmax P and its value is within r of that of every candidate within ε of it, or
  of the nearest ones where B is spaced wider.
- `zhu`: the search ends when what P leaves open no longer matters for the policy,
  Σ_{P(β) ≥ η} P(β) |V(β) - V(argmax P)| ≤ ε |V(argmax P)|; the loop ends by time out.
  S. Zhu, A. Kimmel, K. E. Bekris, A. Boularias. Fast Model Identification via Physics Engines for
  Data-Efficient Policy Search. IJCAI 2018.
- `timeout`: the entropy ends the search, time out the loop.

`seed` also ends where P has converged to the chosen candidate and the trajectory of the very policy
that was learned on it left it there: another one would repeat it. Time out is `learn.trajectories`;
it ends every loop. Distances are the largest over parameters, in shares of the bounds; two values
of a parameter without an order are at the distance of its bounds.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.stats import t as student_t

from bo_sysid.arrays import Probabilities
from bo_sysid.learn.values import Estimate, Values
from bo_sysid.parameters import CandidateSet

Valued = Callable[[Int[np.ndarray, " K"], int], Values]
"""Values the present policy on rows of B, over that many times `learn.episodes` episodes."""

MOST_NEIGHBOURS = 32
MOST_PROBABLE = 32
AGAIN = 4  # times the episodes, over which neighbours are valued again
_FARTHEST = 0.25  # share of the bounds within which a candidate may be a neighbour
_LEVEL = 0.05  # of the tests of all neighbours together
_LEAST_MASS = 0.5  # of P that candidates above η must hold for the value-guided sum to be used


@dataclass(frozen=True)
class Verdict:
    """Whether a rule says stop, why, and the numbers behind it.

    Attributes:
        stop: whether the loop ends.
        sentence: why, or why not.
        figures: JSON values by name.
        budget_exhausted: whether it ends because all trajectories are used; more let it resume.
    """

    stop: bool
    sentence: str
    figures: Mapping[str, Any] = field(default_factory=dict)
    budget_exhausted: bool = False


class Rule(NamedTuple):
    """A stop rule.

    Attributes:
        guided: the search is ended by values instead of entropy.
        near: the loop is ended by the two conditions on distance and value.
    """

    guided: bool
    near: bool


STOP_RULES: Mapping[str, Rule] = {
    "seed": Rule(guided=False, near=True),
    "zhu": Rule(guided=True, near=False),
    "timeout": Rule(guided=False, near=False),
}
"""Rules by the name that studies give them."""


def distances(candidates: CandidateSet, row: int) -> Float[np.ndarray, " N"]:
    """Return the distance of each candidate from one: largest over parameters, in shares."""
    farthest: np.ndarray = _distance_by_parameter(candidates, row).max(axis=1)
    return farthest


def _distance_by_parameter(candidates: CandidateSet, row: int) -> Float[np.ndarray, "N d"]:
    """Return how far each candidate is from one in each parameter, in shares of the bounds."""
    low, high = candidates.bounds
    away = np.abs(candidates.points - candidates.points[row]) / (high - low)
    whole = list(candidates.categories)
    away[:, whole] = away[:, whole] > 0
    return np.asarray(away)


def neighbours(
    candidates: CandidateSet, row: int, epsilon: float, most: int = MOST_NEIGHBOURS
) -> Int[np.ndarray, " k"]:
    """Return the rows within `epsilon` of a row, itself left out, or else the nearest ones.

    B may be spaced wider than `epsilon`; candidates a quarter of the bounds away are none that a
    policy is compared on. Where there are more than `most`, those farthest in all parameters
    together (the corners): the values of a smooth V differ most there.
    """
    distance = distances(candidates, row)
    distance[row] = np.inf
    nearest = float(distance.min())
    reach = max(epsilon, nearest if nearest <= _FARTHEST else 0.0)
    rows = np.flatnonzero(distance <= reach + 1e-9)
    away = np.linalg.norm(_distance_by_parameter(candidates, row)[rows], axis=1)
    order: np.ndarray = np.argsort(-np.round(away, 9), kind="stable")
    return np.asarray(rows[order[:most]], int)


def near_enough(
    candidates: CandidateSet,
    chosen: int,
    best: int,
    epsilon: float,
    r: float,
    valued: Valued,
) -> Verdict:
    """Return whether both conditions of the seed method hold.

    |argmax P - β_t| ≤ ε, and |V(β_t) - V(β')| ≤ r |V(β_t)| for every β' within ε of β_t, or the
    nearest ones where none is.

    V is known with an error only, and the largest of many noisy differences lies beyond any bound.
    The second condition fails where a difference is beyond the bound by a one-sided t-test of
    paired episodes at 5 %, shared among the neighbours (Bonferroni). The neighbours of which the
    test leaves it open are valued again over more episodes; one that is still open then counts as
    within, if its standard error is no larger than the bound.

    Args:
        candidates: the set B.
        chosen: row of β_t.
        best: row of argmax P.
        epsilon: in shares of the bounds.
        r: relative.
        valued: values the policy on rows; called only where the first condition holds.
    """
    away = float(distances(candidates, chosen)[best])
    figures: dict[str, Any] = {"distance": away}
    if away > epsilon + 1e-12:
        text = f"argmax P is {away:.3g} of the bounds away from the chosen candidate"
        return Verdict(False, f"{text}, more than {epsilon:g}.", figures)
    around = neighbours(candidates, chosen, epsilon)
    values = valued(np.concatenate([[chosen], around]), 1)
    own = values.value(0)
    figures |= {"value": own._asdict(), "neighbours": len(around)}
    if not len(around):
        return Verdict(
            True, "argmax P is the chosen candidate; no other is near enough to compare.", figures
        )
    if not own.mean and not any(d.mean for d in _differences(values)):
        text = "The policy is worth nothing on any candidate nearby, which says nothing of them."
        return Verdict(False, text, figures)
    allowed = r * abs(own.mean)
    differences = _refined_differences(values, chosen, around, allowed, valued)
    agree, text = _agreement(differences, allowed)
    worst, episodes = max(differences, key=lambda d: abs(d[0].mean))
    figures |= {
        "largest_difference": worst._asdict(),
        "allowed": allowed,
        "episodes": episodes,
    }
    numbers = (
        f"Over {_which(candidates, chosen, around, epsilon)} the policy's return differs by "
        f"{abs(worst.mean):.3g} ± {worst.half_width:.2g} at most (95 %, {episodes} paired episodes)"
    )
    return Verdict(agree, f"{numbers}, {text} {allowed:.3g}, {r:g} of it (r).", figures)


def _which(
    candidates: CandidateSet, chosen: int, around: Int[np.ndarray, " k"], epsilon: float
) -> str:
    """Return in words which candidates are compared."""
    farthest = float(distances(candidates, chosen)[around].max())
    if farthest <= epsilon + 1e-9:
        return f"all candidates within {epsilon:g} of the bounds (epsilon)"
    return f"the nearest candidates, {farthest:.3g} of the bounds away (epsilon is {epsilon:g}),"


_Difference = tuple[Estimate, int]
"""A difference of values, and over how many paired episodes."""


def _refined_differences(
    values: Values, chosen: int, around: Int[np.ndarray, " k"], allowed: float, valued: Valued
) -> list[_Difference]:
    """Return the difference of each neighbour, over more episodes where the test leaves it open."""
    differences = [(d, values.episodes) for d in _differences(values)]
    among = len(around)
    if any(_beyond(*d, allowed, among) for d in differences):
        return differences
    open_ = [k for k, d in enumerate(differences) if not _within(*d, allowed, among)]
    if open_:
        again = valued(np.concatenate([[chosen], around[open_]]), AGAIN)
        for k, d in zip(open_, _differences(again), strict=True):
            differences[k] = (d, again.episodes)
    return differences


def _agreement(differences: list[_Difference], allowed: float) -> tuple[bool, str]:
    """Return whether the values differ by no more than is allowed, and the words for it."""
    if any(_beyond(*d, allowed, len(differences)) for d in differences):
        return False, "more than"
    if max(d.error for d, _ in differences) > allowed:
        return False, "too uncertain to be told from"
    if all(_within(*d, allowed, len(differences)) for d in differences):
        return True, "within"
    return True, "not significantly more than"


def _differences(values: Values) -> list[Estimate]:
    """Return the first model's value minus that of each other one."""
    return [values.difference(0, k) for k in range(1, len(values.returns))]


def _beyond(d: Estimate, episodes: int, allowed: float, among: int) -> bool:
    """Return whether a difference is significantly larger than what is allowed."""
    return abs(d.mean) - _reach(d, episodes, among) > allowed


def _within(d: Estimate, episodes: int, allowed: float, among: int) -> bool:
    """Return whether a difference is significantly smaller than what is allowed."""
    return abs(d.mean) + _reach(d, episodes, among) <= allowed


def _reach(d: Estimate, episodes: int, among: int) -> float:
    if episodes < 2:
        return np.inf
    return float(student_t.ppf(1 - _LEVEL / among, episodes - 1)) * d.error


def value_guided(
    probabilities: Probabilities, epsilon: float, eta: float, valued: Valued
) -> Verdict:
    """Return whether what P leaves open matters no longer for the policy.

    Σ_{P(β) ≥ η} P(β) |V(β) - V(argmax P)| ≤ ε |V(argmax P)|. Where candidates below η hold more
    than half of P, or the policy is worth nothing on any of them, the sum says nothing and the
    search goes on.
    """
    order = np.argsort(-probabilities, kind="stable")[:MOST_PROBABLE]
    rows = order[probabilities[order] >= eta]
    mass = float(probabilities[rows].sum())
    if mass < _LEAST_MASS:
        text = f"candidates of at least {eta:g} hold {mass:.2g} of P"
        return Verdict(False, text, {"mass": mass})
    values = valued(rows, 1)
    differences = np.array([abs(values.difference(k, 0).mean) for k in range(len(rows))])
    errors = np.array([values.difference(k, 0).error for k in range(1, len(rows))])
    total = float(probabilities[rows] @ differences)
    own = values.value(0)
    figures = {
        "mass": mass,
        "expected_difference": total,
        "error": float(probabilities[rows[1:]] @ errors) if len(rows) > 1 else 0.0,
        "value": own._asdict(),
    }
    if len(rows) > 1 and not own.mean and not differences.any():
        return Verdict(False, "the policy is worth nothing wherever P is open", figures)
    allowed = epsilon * abs(own.mean)
    text = f"the expected difference of value is {total:.3g}; {allowed:.3g} is allowed"
    return Verdict(total <= allowed, text, figures)

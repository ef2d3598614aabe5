"""When the outer loop ends, and when the search within it does.

- `seed`: the search ends when the entropy of P settles; the loop ends when the chosen candidate is
  within ε of argmax P and its value is within r of that of every candidate within ε of it.
- `zhu`: the search ends when what P leaves open no longer matters for the policy,
  Σ_{P(β) ≥ η} P(β) |V(β) - V(argmax P)| ≤ ε |V(argmax P)|; the loop ends by time out.
  S. Zhu, A. Kimmel, K. E. Bekris, A. Boularias. Fast Model Identification via Physics Engines for
  Data-Efficient Policy Search. IJCAI 2018.
- `timeout`: the entropy ends the search, time out the loop.

Time out is `learn.trajectories`; it ends every loop. Distances are the largest over parameters, in
shares of the bounds.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from bo_sysid.arrays import Probabilities
from bo_sysid.learn.values import Values
from bo_sysid.parameters import CandidateSet

Valued = Callable[[Int[np.ndarray, " K"]], Values]
"""Values the present policy on rows of B."""

MOST_NEIGHBOURS = 64
MOST_PROBABLE = 32
_LEAST_MASS = 0.5  # of P that candidates above η must hold for the value-guided sum to say anything


@dataclass(frozen=True)
class Verdict:
    """Whether a rule says stop, why, and the numbers behind it.

    Attributes:
        stop: whether the loop ends.
        sentence: why, or why not.
        figures: JSON values by name.
    """

    stop: bool
    sentence: str
    figures: Mapping[str, Any] = field(default_factory=dict)


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
    low, high = candidates.bounds
    away: np.ndarray = np.abs(candidates.points - candidates.points[row]) / (high - low)
    farthest: np.ndarray = away.max(axis=1)
    return farthest


def neighbours(
    candidates: CandidateSet, row: int, epsilon: float, most: int = MOST_NEIGHBOURS
) -> Int[np.ndarray, " k"]:
    """Return the rows within `epsilon` of a row, itself left out.

    Where there are more than `most`, the farthest: values differ most there.
    """
    away = distances(candidates, row)
    rows = np.flatnonzero(away <= epsilon + 1e-12)
    rows = rows[rows != row]
    order: np.ndarray = np.argsort(-away[rows], kind="stable")[:most]
    return np.asarray(rows[order], int)


def near_enough(
    candidates: CandidateSet,
    chosen: int,
    best: int,
    epsilon: float,
    r: float,
    valued: Valued,
) -> Verdict:
    """Return whether both conditions of the seed method hold.

    |argmax P - β_t| ≤ ε, and |V(β_t) - V(β')| ≤ r |V(β_t)| for every β' within ε of β_t.

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
    told = valued(np.concatenate([[chosen], around]))
    own = told.value(0)
    figures |= {"value": own._asdict(), "neighbours": len(around)}
    if not len(around):
        return Verdict(
            True, f"argmax P is the chosen candidate; none other is within {epsilon:g}.", figures
        )
    apart = [told.difference(0, k) for k in range(1, len(around) + 1)]
    worst = max(apart, key=lambda d: abs(d.mean))
    allowed = r * abs(own.mean)
    if not own.mean and not worst.mean:
        text = "The policy is worth nothing on any candidate nearby, which says nothing of them."
        return Verdict(False, text, figures)
    figures |= {"largest_difference": worst._asdict(), "allowed": allowed}
    numbers = f"differs by {abs(worst.mean):.3g} ± {worst.error:.2g} within {epsilon:g}"
    if abs(worst.mean) <= allowed:
        return Verdict(
            True, f"The value {numbers}, which is within {r:g} of {own.mean:.4g}.", figures
        )
    return Verdict(False, f"The value {numbers}, more than {r:g} of {own.mean:.4g}.", figures)


def value_guided(
    probabilities: Probabilities, epsilon: float, eta: float, valued: Valued
) -> Verdict:
    """Return whether what P leaves open matters no longer for the policy.

    Σ_{P(β) ≥ η} P(β) |V(β) - V(argmax P)| ≤ ε |V(argmax P)|. Where candidates below η hold more
    than half of P, the sum says nothing and the search goes on.
    """
    order = np.argsort(-probabilities, kind="stable")[:MOST_PROBABLE]
    rows = order[probabilities[order] >= eta]
    mass = float(probabilities[rows].sum())
    if mass < _LEAST_MASS:
        text = f"candidates of at least {eta:g} hold {mass:.2g} of P"
        return Verdict(False, text, {"mass": mass})
    told = valued(rows)
    apart = np.array([abs(told.difference(k, 0).mean) for k in range(len(rows))])
    errors = np.array([told.difference(k, 0).error for k in range(1, len(rows))])
    total = float(probabilities[rows] @ apart)
    own = told.value(0)
    figures = {
        "mass": mass,
        "expected_difference": total,
        "error": float(probabilities[rows[1:]] @ errors) if len(rows) > 1 else 0.0,
        "value": own._asdict(),
    }
    allowed = epsilon * abs(own.mean)
    text = f"the expected difference of value is {total:.3g}; {allowed:.3g} is allowed"
    return Verdict(total <= allowed, text, figures)

"""Rates with their uncertainty, and whether stated probabilities are true."""

from dataclasses import dataclass

import numpy as np
import pandas as pd
from jaxtyping import Bool, Float
from scipy.stats import binomtest

_DRAWS = 2000
_PER_BIN = 15  # cases in a bin, at least, where there are so many
_MOST_BINS = 10


def clopper_pearson(right: int, of: int, level: float = 0.95) -> tuple[float, float]:
    """Return the exact two-sided interval of a rate (Clopper and Pearson 1934).

    Args:
        right: how often it happened.
        of: among how many.
        level: of confidence.
    """
    if not of:
        return 0.0, 1.0
    low, high = binomtest(right, of).proportion_ci(level, method="exact")
    return float(low), float(high)


@dataclass(frozen=True)
class Reliability:
    """Stated probabilities beside how often they were right.

    Attributes:
        bins: columns low, high, n, stated, right, lower, upper.
        error: mean over cases of abs(stated - right) by bins.
        expected: what perfect calibration would give with these probabilities and this count.
        cases: their number.
    """

    bins: pd.DataFrame
    error: float
    expected: float
    cases: int

    @property
    def excess(self) -> float:
        """The error above its expectation under perfect calibration."""
        return self.error - self.expected


def reliability(stated: Float[np.ndarray, " n"], right: Bool[np.ndarray, " n"]) -> Reliability:
    """Compare stated probabilities with what happened, in bins of equal count.

    Small samples look uncalibrated even where every probability is true: the error is set beside
    its mean over draws of outcomes with exactly the stated probabilities, in the same bins.
    """
    n = len(stated)
    columns = ["low", "high", "n", "stated", "right", "lower", "upper"]
    if n == 0:
        return Reliability(pd.DataFrame(columns=columns), float("nan"), float("nan"), 0)
    order = np.argsort(stated, kind="stable")
    groups = np.array_split(order, int(np.clip(n // _PER_BIN, 1, _MOST_BINS)))
    rows = []
    for group in groups:
        hits = int(right[group].sum())
        p = stated[group]
        rows.append(
            (p.min(), p.max(), len(group), p.mean(), hits / len(group),
             *clopper_pearson(hits, len(group)))
        )  # fmt: skip
    rng = np.random.default_rng(0)
    drawn = rng.random((_DRAWS, n)) < stated
    expected = np.mean([_error(stated, d, groups) for d in drawn])
    table = pd.DataFrame(rows, columns=columns)
    return Reliability(table, _error(stated, right, groups), float(expected), n)


def _error(stated: np.ndarray, right: np.ndarray, groups: list[np.ndarray]) -> float:
    gaps = [abs(stated[g].mean() - right[g].mean()) * len(g) for g in groups]
    return float(np.sum(gaps) / len(stated))

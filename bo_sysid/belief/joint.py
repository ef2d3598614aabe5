"""Joint posterior samples of one Gaussian process over a large discrete set.

Two steps make sampling affordable. First, candidates that cannot be the arg-min are dropped by a
bound that holds whatever the correlations are: for any reference candidate r,

    P(β is the arg-min) ≤ P(f(β) ≤ f(r)) = Φ((μ_r − μ_β) / √Var[f(β) − f(r)]),

so the sum of the bounds of what is dropped is a bound on the mass lost. Second, the posterior
covariance of the survivors is factored by a pivoted Cholesky decomposition that stops when what is
left is negligible against every candidate's own standard deviation.

References:
    Harbrecht, Peters & Schneider (2012), On the low-rank approximation by the pivoted Cholesky
    decomposition.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.linalg import cholesky, solve_triangular
from scipy.special import ndtr

from bo_sysid.arrays import Points
from bo_sysid.belief.gp import Conditional

EXACT = 3_000  # up to this many contenders the posterior covariance is factored exactly
RANK = 192  # of the factor beyond that
SUBSET = 2_000  # contenders among which the pivots of that factor are chosen
MASS = 1e-3  # bound on the probability that may be dropped
CHUNK = 65_536  # candidates per block when moments are computed
TOLERANCE = 1e-8  # share of the prior variance at which no further pivot is worth adding
JITTER = 1e-10  # share of the prior variance added before a factorisation


@dataclass(frozen=True)
class Moments:
    """Posterior mean and variance of one member at the candidates.

    Attributes:
        mean: `N`, standardised.
        variance: `N`; exactly 0 where the value is known.
    """

    mean: Float[np.ndarray, " N"]
    variance: Float[np.ndarray, " N"]


def posterior_moments(
    member: Conditional,
    x: Points,
    values: Float[np.ndarray, " n"],
    known: Int[np.ndarray, " k"],
    known_values: Float[np.ndarray, " k"],
) -> Moments:
    """Return the posterior moments at `x`; rows `known` have exactly `known_values`."""
    residual = member.residual(values)
    mean, variance = np.empty(len(x)), np.empty(len(x))
    for start in range(0, len(x), CHUNK):
        block = slice(start, start + CHUNK)
        V = member.whitened(x[block])
        mean[block] = member.mean + residual @ V
        variance[block] = member.variance(V)
    mean[known], variance[known] = known_values, 0.0
    return Moments(mean, variance)


def contenders(
    member: Conditional, x: Points, moments: Moments, mass: float
) -> tuple[Int[np.ndarray, " s"], float]:
    """Return the rows that may be the arg-min, and a bound on the probability of all others.

    The reference is the candidate with the least `mean + standard deviation`.

    Args:
        member: the Gaussian process.
        x: candidates in the unit cube.
        moments: of the member at `x`.
        mass: probability that may be dropped.
    """
    std = np.sqrt(moments.variance)
    reference = int(np.argmin(moments.mean + std))
    covariance = np.zeros(len(x))
    if moments.variance[reference] > 0:
        pivot = x[[reference]]
        w = member.whitened(pivot)
        for start in range(0, len(x), CHUNK):
            block = slice(start, start + CHUNK)
            prior = member.covariance(x[block], pivot)[:, 0]
            covariance[block] = prior - (w.T @ member.whitened(x[block]))[0]
        covariance[moments.variance == 0] = 0.0
    difference = moments.variance + moments.variance[reference] - 2.0 * covariance
    gap = moments.mean[reference] - moments.mean
    sigma = np.sqrt(np.maximum(difference, 1e-300))
    with np.errstate(over="ignore"):
        bound = np.where(difference > 0, ndtr(gap / sigma), gap >= 0)
    bound[reference] = 1.0
    order = np.argsort(bound, kind="stable")
    lost = np.cumsum(bound[order])
    first = int(np.searchsorted(lost, mass, side="right"))
    return np.sort(order[first:]), float(lost[first - 1]) if first else 0.0


@dataclass(frozen=True)
class Contest:
    """One member's joint posterior over the candidates that may be the arg-min.

    Attributes:
        rows: `s` rows whose value is uncertain.
        mean: `s` posterior means there.
        factor: `r x s` matrix `F`; `FᵀF` is the posterior covariance of `rows`.
        floor: least value that is known exactly; +inf where none is.
        holders: the rows that have it.
        lost: bound on the probability of all other candidates.
        exact: whether `factor` is exact.
    """

    rows: Int[np.ndarray, " s"]
    mean: Float[np.ndarray, " s"]
    factor: Float[np.ndarray, "r s"]
    floor: float
    holders: Int[np.ndarray, " h"]
    lost: float
    exact: bool

    def tally(self, draws: Float[np.ndarray, "b s"], size: int) -> Float[np.ndarray, " N"]:
        """Return how often each of `size` candidates is the arg-min of joint samples at `rows`."""
        counts = np.zeros(size)
        below = draws.min(axis=1, initial=np.inf) < self.floor
        if below.any():
            winners = self.rows[draws[below].argmin(axis=1)]
            counts += np.bincount(winners, minlength=size)
        if len(self.holders):
            counts[self.holders] += (~below).sum() / len(self.holders)
        return counts


def contest(
    member: Conditional,
    x: Points,
    values: Float[np.ndarray, " n"],
    known: Int[np.ndarray, " k"],
    known_values: Float[np.ndarray, " k"],
    rng: np.random.Generator,
) -> Contest:
    """Drop the candidates that cannot be the arg-min and factor the covariance of the others."""
    moments = posterior_moments(member, x, values, known, known_values)
    rows, lost = contenders(member, x, moments, MASS)
    sure = rows[moments.variance[rows] == 0]
    rows = rows[moments.variance[rows] > 0]
    floor = float(moments.mean[sure].min(initial=np.inf))
    return Contest(
        rows=rows,
        mean=moments.mean[rows],
        factor=covariance_factor(member, x[rows], moments.variance[rows], rng),
        floor=floor,
        holders=sure[moments.mean[sure] == floor],
        lost=lost,
        exact=len(rows) <= EXACT,
    )


def covariance_factor(
    member: Conditional,
    x: Points,
    variance: Float[np.ndarray, " s"],
    rng: np.random.Generator,
) -> Float[np.ndarray, "r s"]:
    """Return a factor of the posterior covariance at `x`: exact up to `EXACT` points."""
    if len(x) <= EXACT:
        return dense_factor(member, x, variance)
    subset = rng.choice(len(x), SUBSET, replace=False)
    return low_rank_factor(member, x, variance, rank=RANK, subset=subset)


def dense_factor(
    member: Conditional, x: Points, variance: Float[np.ndarray, " s"]
) -> Float[np.ndarray, "s s"]:
    """Return an upper factor `F` with `FᵀF` the posterior covariance at `x`."""
    V = member.whitened(x)
    covariance = member.covariance(x, x) - V.T @ V
    # rounding leaves eigenvalues of about -1e-15 s²; the jitter is far below any variance of note
    for jitter in (1e-12, 1e-10, 1e-8):
        covariance[np.diag_indices(len(x))] = variance + jitter * member.outputscale
        try:
            factor: Float[np.ndarray, "s s"] = cholesky(covariance, check_finite=False)
        except np.linalg.LinAlgError:
            continue
        return factor
    raise np.linalg.LinAlgError("the posterior covariance is not positive definite")


def low_rank_factor(
    member: Conditional,
    x: Points,
    variance: Float[np.ndarray, " s"],
    *,
    rank: int,
    subset: Int[np.ndarray, " k"],
) -> Float[np.ndarray, "r s"]:
    """Return a factor `F` of at most `rank` rows with `FᵀF ≈` the posterior covariance at `x`.

    Pivots are chosen among the rows `subset` by the pivoted Cholesky decomposition; the factor is
    then completed for all rows at once (the Nyström approximation at the pivots), which needs
    matrix products only.
    """
    pivots = subset[_pivots(member, x[subset], variance[subset], rank)]
    V = member.whitened(x)
    at_pivots = V[:, pivots]
    corner = member.covariance(x[pivots], x[pivots]) - at_pivots.T @ at_pivots
    corner[np.diag_indices(len(pivots))] += JITTER * member.outputscale
    cross = member.covariance(x[pivots], x) - at_pivots.T @ V
    factor: Float[np.ndarray, "r s"] = solve_triangular(
        cholesky(corner, lower=True, check_finite=False), cross, lower=True, check_finite=False
    )
    return factor


def _pivots(
    member: Conditional, x: Points, variance: Float[np.ndarray, " s"], rank: int
) -> Int[np.ndarray, " r"]:
    """Return the pivots of the Cholesky decomposition of the posterior covariance at `x`."""
    V = member.whitened(x)
    n, rank = len(V), min(rank, len(x))
    rows = np.empty((n + rank, len(x)))
    rows[:n] = V
    left = variance.copy()
    chosen: list[int] = []
    for j in range(rank):
        pivot = int(np.argmax(left))
        if left[pivot] <= TOLERANCE * member.outputscale:
            break
        column = member.covariance(x, x[[pivot]])[:, 0]
        column -= rows[: n + j].T @ rows[: n + j, pivot]
        rows[n + j] = column / np.sqrt(left[pivot])
        left = np.maximum(left - rows[n + j] ** 2, 0.0)
        chosen.append(pivot)
        left[chosen] = 0.0
    return np.array(chosen, dtype=np.intp)

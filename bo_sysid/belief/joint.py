"""Joint posterior samples of one Gaussian process over a large discrete set.

Two steps make sampling affordable. First, candidates that cannot be the arg-min are dropped by a
bound that holds whatever the correlations are: for any reference candidate r,

    P(β is the arg-min) ≤ P(f(β) ≤ f(r)) = Φ((μ_r − μ_β) / √Var[f(β) − f(r)]),

so the sum of the bounds of what is dropped is a bound on the mass lost. Second, where many
candidates are left, their posterior covariance is factored at low rank by a pivoted Cholesky
decomposition. Which pivots are taken decides: with the usual choice, the candidate with the most
variance left, distributions of the arg-min were 0.1 to 0.2 away from the exact one in total
variation at rank 192; with that variance times the candidate's bound, at rank 96, no further than
two exact runs are from each other (4 dimensions, 10⁵ candidates, 60 evaluations).

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
from bo_sysid.belief.gp import ConditionedGP

EXACT = 3_000  # candidates up to which the posterior covariance is always factored exactly
DENSE = 800  # contenders up to which it is exact in larger sets too
RANK = 128  # of the factor beyond that
SUBSET = 2_000  # pivots are chosen among as many likely and as many random contenders
MASS = 1e-3  # bound on the probability that may be dropped
CHUNK = 1024  # candidates per block when moments are computed
TOLERANCE = 1e-8  # share of the prior variance at which no further pivot is worth adding
JITTERS = (1e-12, 1e-10, 1e-8)  # shares of the prior variance added before a factorisation
TIED = 1e-9  # of standardised values: those that are known and nearer differ by rounding


@dataclass(frozen=True)
class PosteriorMoments:
    """Posterior mean and variance of one member at the candidates.

    Attributes:
        mean: `N`, standardised.
        variance: `N`; exactly 0 where the value is known.
    """

    mean: Float[np.ndarray, " N"]
    variance: Float[np.ndarray, " N"]


def posterior_moments(
    member: ConditionedGP,
    x: Points,
    values: Float[np.ndarray, " n"],
    known: Int[np.ndarray, " k"],
    known_values: Float[np.ndarray, " k"],
) -> PosteriorMoments:
    """Return the posterior moments at `x`; rows `known` have exactly `known_values`.

    Args:
        member: the Gaussian process.
        x: `N x d` candidates in the unit cube.
        values: `n` standardised values at the member's points.
        known: `k` rows of `x` whose value is known.
        known_values: their `k` standardised values.
    """
    residual = member.residual(values)
    mean, variance = np.empty(len(x)), np.empty(len(x))
    for start in range(0, len(x), CHUNK):
        block = slice(start, start + CHUNK)
        V = member.whitened(x[block])
        mean[block] = member.mean + residual @ V
        variance[block] = member.variance(V)
    mean[known], variance[known] = known_values, 0.0
    return PosteriorMoments(mean, variance)


def contenders(
    member: ConditionedGP, x: Points, moments: PosteriorMoments, mass: float
) -> tuple[Int[np.ndarray, " s"], Float[np.ndarray, " s"], float]:
    """Return the rows that may be the arg-min, their bounds, and the sum of all other bounds.

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
        w = member.weights(member.whitened(pivot))[:, 0]
        for start in range(0, len(x), CHUNK):
            block = slice(start, start + CHUNK)
            prior = member.covariance(x[block], pivot)[:, 0]
            covariance[block] = prior - w @ member.covariance(member.points, x[block])
        covariance[moments.variance == 0] = 0.0
    difference = moments.variance + moments.variance[reference] - 2.0 * covariance
    gap = moments.mean[reference] - moments.mean
    sigma = np.sqrt(np.maximum(difference, 1e-300))
    with np.errstate(over="ignore"):
        bound = np.where(difference > 0, ndtr(gap / sigma), gap >= -TIED)
    bound[reference] = 1.0
    rows, lost = keep_largest(bound, mass)
    return rows, bound[rows], lost


def keep_largest(
    bound: Float[np.ndarray, " m"], mass: float
) -> tuple[Int[np.ndarray, " s"], float]:
    """Drop the least bounds that add up to at most `mass`; return the other rows, and that sum."""
    order = np.argsort(bound, kind="stable")
    lost = np.cumsum(bound[order])
    first = int(np.searchsorted(lost, mass, side="right"))
    return np.sort(order[first:]), float(lost[first - 1]) if first else 0.0


@dataclass(frozen=True)
class ArgminPosterior:
    """One member's joint posterior over the candidates that may be the arg-min.

    Attributes:
        rows: `s` rows whose value is uncertain.
        mean: `s` posterior means there.
        factor: `r x s` matrix `F`; `FᵀF` is the posterior covariance of `rows` where `exact`, else
            its low-rank approximation, which lacks some of the variance on the diagonal.
        floor: least value that is known exactly; +inf where none is.
        incumbents: the rows that have it, up to rounding.
        lost: bound on the probability of all other candidates.
        exact: whether `FᵀF` is the posterior covariance up to jitter, not of low rank.
    """

    rows: Int[np.ndarray, " s"]
    mean: Float[np.ndarray, " s"]
    factor: Float[np.ndarray, "r s"]
    floor: float
    incumbents: Int[np.ndarray, " h"]
    lost: float
    exact: bool

    def tally(self, draws: Float[np.ndarray, "b s"], size: int) -> Float[np.ndarray, " N"]:
        """Return how often each of `size` candidates is the arg-min of joint samples at `rows`."""
        counts, below = np.zeros(size), 0
        if len(self.rows):
            least = draws.argmin(axis=1)
            wins = draws[np.arange(len(draws)), least] < self.floor
            counts += np.bincount(self.rows[least[wins]], minlength=size)
            below = int(wins.sum())
        if len(self.incumbents):
            counts[self.incumbents] += (len(draws) - below) / len(self.incumbents)
        return counts


def argmin_posterior(
    member: ConditionedGP,
    x: Points,
    values: Float[np.ndarray, " n"],
    known: Int[np.ndarray, " k"],
    known_values: Float[np.ndarray, " k"],
    rng: np.random.Generator,
) -> ArgminPosterior:
    """Drop the candidates that cannot be the arg-min and factor the covariance of the others."""
    moments = posterior_moments(member, x, values, known, known_values)
    rows, bound, lost = contenders(member, x, moments, MASS)
    known_here = moments.variance[rows] == 0
    sure, rows, bound = rows[known_here], rows[~known_here], bound[~known_here]
    exact = len(rows) <= (EXACT if len(x) <= EXACT else DENSE)
    floor = float(moments.mean[sure].min(initial=np.inf))
    return ArgminPosterior(
        rows=rows,
        mean=moments.mean[rows],
        factor=covariance_factor(
            member, x[rows], moments.variance[rows], None if exact else bound, rng
        ),
        floor=floor,
        incumbents=sure[moments.mean[sure] <= floor + TIED],
        lost=lost,
        exact=exact,
    )


def covariance_factor(
    member: ConditionedGP,
    x: Points,
    variance: Float[np.ndarray, " s"],
    weight: Float[np.ndarray, " s"] | None,
    rng: np.random.Generator,
) -> Float[np.ndarray, "r s"]:
    """Return a factor `F` with `FᵀF` the posterior covariance at `x`, or near it at low rank.

    Args:
        member: the Gaussian process.
        x: points in the unit cube.
        variance: posterior variances there.
        weight: how much each point matters to a factor of low rank; None for an exact one.
        rng: of the points that may become pivots.
    """
    if weight is None:
        return dense_factor(member, x, variance)
    likely = np.argsort(-weight, kind="stable")[:SUBSET]
    anywhere = rng.choice(len(x), min(SUBSET, len(x)), replace=False)
    subset = np.union1d(likely, anywhere)
    chosen = _pivots(member, x[subset], variance[subset], weight[subset], RANK)
    return nystrom_factor(member, x, x[subset[chosen]])


def dense_factor(
    member: ConditionedGP, x: Points, variance: Float[np.ndarray, " s"]
) -> Float[np.ndarray, "s s"]:
    """Return an upper factor `F` with `FᵀF` the posterior covariance at `x`."""
    V = member.whitened(x)
    return _upper_cholesky(member, member.covariance(x, x) - V.T @ V, variance)


def _upper_cholesky(
    member: ConditionedGP, covariance: Float[np.ndarray, "s s"], variance: Float[np.ndarray, " s"]
) -> Float[np.ndarray, "s s"]:
    """Return an upper factor of a posterior covariance with this diagonal, and the least jitter.

    Rounding leaves eigenvalues of about -1e-15 s²; the jitter is far below any variance of note.
    """
    for jitter in JITTERS:
        covariance[np.diag_indices(len(variance))] = variance + jitter * member.outputscale
        try:
            factor: Float[np.ndarray, "s s"] = cholesky(covariance, check_finite=False)
        except np.linalg.LinAlgError:
            continue
        return factor
    raise np.linalg.LinAlgError("the posterior covariance is not positive definite")


def nystrom_factor(
    member: ConditionedGP, x: Points, pivots: Float[np.ndarray, "r d"]
) -> Float[np.ndarray, "r s"]:
    """Return the Nyström factor `F`: one row a pivot, `FᵀF` exact between pivots and any point.

    It is the pivoted Cholesky decomposition completed for all points at once, in single precision:
    `F = L⁻¹ C(pivots, x)` with `L Lᵀ = C(pivots, pivots)` and C the posterior covariance.
    """
    at_pivots = member.whitened(pivots)
    corner = member.covariance(pivots, pivots) - at_pivots.T @ at_pivots
    L = _upper_cholesky(member, corner, np.diagonal(corner).copy()).T
    # F = L⁻¹ (k(pivots, x) - Vᵀ L_n⁻¹ k(points, x)), as one product
    left = solve_triangular(
        L,
        np.concatenate([np.eye(len(pivots)), -member.weights(at_pivots).T], axis=1),
        lower=True,
        check_finite=False,
    )
    both = np.concatenate([pivots, member.points])
    factor = np.empty((len(pivots), len(x)), dtype=np.float32)
    for start in range(0, len(x), CHUNK):
        factor[:, start : start + CHUNK] = left @ member.covariance(both, x[start : start + CHUNK])
    return factor


def _pivots(
    member: ConditionedGP,
    x: Points,
    variance: Float[np.ndarray, " s"],
    weight: Float[np.ndarray, " s"],
    rank: int,
) -> Int[np.ndarray, " r"]:
    """Return the points that leave the least weighted variance, chosen one after the other."""
    V = member.whitened(x)
    n, rank = len(V), min(rank, len(x))
    rows = np.empty((n + rank, len(x)))
    rows[:n] = V
    left = variance.copy()
    chosen: list[int] = []
    for j in range(rank):
        pivot = int(np.argmax(left * weight))
        if left[pivot] <= TOLERANCE * member.outputscale:
            break
        column = member.covariance(x, x[[pivot]])[:, 0]
        column -= rows[: n + j].T @ rows[: n + j, pivot]
        rows[n + j] = column / np.sqrt(left[pivot])
        left = np.maximum(left - rows[n + j] ** 2, 0.0)
        chosen.append(pivot)
        left[chosen] = 0.0
    return np.array(chosen, dtype=np.intp)

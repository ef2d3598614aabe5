"""P_boot: the arg-min of Δ over bootstraps of the recordings, the uncertainty about the machine.

Δ is a mean over blocks of the recordings. Resampling the blocks gives another Δ at every evaluated
candidate at once; the posterior mean is linear in the warped Δ, so all bootstraps are conditioned
on together, and to each one joint posterior sample adds what the surrogate does not know between
the evaluated candidates. Where there are several sessions they are resampled first, then the blocks
within each: what differs between sessions is not visible within one.

From n units n − 1 are drawn: then the variance of the resampled mean is unbiased (with n it is
(n − 1)/n of the right one, half of it for two sessions). With S sessions of n blocks that holds for
the variance between sessions, τ². The variance σ² of blocks within them is in the session means
already and is counted again with the blocks: the variance of the resampled mean is

    τ²/S + σ²/(S n) · (1 + S/(S − 1) · (n − 1)/n).

Where sessions agree, intervals are therefore too wide. With few sessions, percentile intervals are
too narrow compared with Student's t; drawing sessions whole would leave only that second error.

References:
    Künsch (1989), The jackknife and the bootstrap for general stationary observations.
    Rao & Wu (1988), Resampling inference with complex survey data.
    Davison & Hinkley (1997), Bootstrap methods and their application, 3.8.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.special import ndtr

from bo_sysid.arrays import Points, Probabilities, Rows
from bo_sysid.belief.argmin import CELLS, ArgminBelief, samples_per_member
from bo_sysid.belief.gp import ConditionedGP
from bo_sysid.belief.joint import CHUNK, DENSE, EXACT, MASS, TIED, covariance_factor, keep_largest
from bo_sysid.belief.surrogate import Surrogate

UPPER_BOUND_SIGMAS = 5.0  # standard deviations above a mean: the minimum hardly ever exceeds that


@dataclass(frozen=True)
class BootstrapMinima:
    """The least Δ in each bootstrap of the recordings.

    Attributes:
        rows: the candidate that has it.
        deviations: its value, comparable between searches that draw the same bootstraps.
        mass_lost: bound on the probability of the candidates that were left out of the sampling.
    """

    rows: Int[np.ndarray, " b"]
    deviations: Float[np.ndarray, " b"]
    mass_lost: float


def bootstrap_argmin(
    surrogate: Surrogate,
    candidates: Points,
    rows: Rows,
    contributions: Float[np.ndarray, "n blocks"],
    weights: Float[np.ndarray, " blocks"],
    *,
    samples: int = 2048,
    seed: int = 0,
    groups: Int[np.ndarray, " blocks"] | None = None,
) -> ArgminBelief:
    """Return the probability of each candidate to be the arg-min of Δ on other recordings.

    Args:
        surrogate: of Δ; its n points are the evaluated candidates.
        candidates: `N x d`, the set B.
        rows: the row of B of each of the surrogate's points, -1 where it is not in B.
        contributions: mean deviation of each evaluated candidate on each block, so that
            `Δ = contributions @ weights / weights.sum()`.
        weights: of each block in Δ: its number of transitions, or its share of the windows.
        samples: number of bootstraps.
        seed: of bootstraps and samples.
        groups: session of each block; None where all are of one session.

    Raises:
        ValueError: shapes do not agree, or there are fewer than two blocks.
    """
    found = bootstrap_minima(
        surrogate, candidates, rows, contributions, weights,
        samples=samples, seed=seed, groups=groups,
    )  # fmt: skip
    counts = np.bincount(found.rows, minlength=len(candidates))
    return ArgminBelief(counts / samples, "bootstrap", found.mass_lost)


def bootstrap_minima(
    surrogate: Surrogate,
    candidates: Points,
    rows: Rows,
    contributions: Float[np.ndarray, "n blocks"],
    weights: Float[np.ndarray, " blocks"],
    *,
    samples: int = 2048,
    seed: int = 0,
    groups: Int[np.ndarray, " blocks"] | None = None,
) -> BootstrapMinima:
    """Return the least Δ of each bootstrap and where it is; see `bootstrap_argmin`.

    Bootstraps follow from `seed` alone: sets with surrogates of their own can be compared.
    """
    rows = np.asarray(rows, dtype=np.intp)
    contributions = np.asarray(contributions, dtype=float)
    _check(surrogate, candidates, rows, contributions, weights)
    rng = np.random.default_rng(seed)
    groups = np.zeros(len(weights), dtype=int) if groups is None else np.asarray(groups)
    drawn = resample(groups, samples, rng) * weights
    deviations = contributions @ drawn.T / drawn.sum(axis=1)
    values = surrogate.standardise(surrogate.warp(deviations))
    x = surrogate.unit(candidates)
    in_set = np.flatnonzero(rows >= 0)
    winners, lowest, lost = np.empty(samples, dtype=np.intp), np.empty(samples), 0.0
    edges = np.cumsum(np.append(0, samples_per_member(surrogate.weights, samples)))
    for member, start, stop in zip(surrogate.members, edges[:-1], edges[1:], strict=True):
        if stop > start:
            mine = values[:, start:stop]
            winners[start:stop], lowest[start:stop], dropped = _minima(
                member, x, mine, mine[in_set], rows[in_set], rng
            )
            lost += dropped * (stop - start) / samples
    return BootstrapMinima(winners, surrogate.deviations(lowest), lost)


def resample(
    groups: Int[np.ndarray, " blocks"], samples: int, rng: np.random.Generator
) -> Int[np.ndarray, "samples blocks"]:
    """Return how often each block is drawn in each bootstrap.

    One session: all blocks but one are drawn with replacement. Several: all sessions but one are
    drawn with replacement, and as many blocks within each as it has.
    """
    sessions, session = np.unique(groups, return_inverse=True)
    blocks = len(groups)
    if len(sessions) == 1:
        return rng.multinomial(blocks - 1, np.full(blocks, 1 / blocks), size=samples)
    chosen = rng.multinomial(
        len(sessions) - 1, np.full(len(sessions), 1 / len(sessions)), size=samples
    )
    drawn = np.zeros((samples, blocks), dtype=int)
    for s in range(len(sessions)):
        mine = np.flatnonzero(session == s)
        drawn[:, mine] = rng.multinomial(
            chosen[:, s] * len(mine), np.full(len(mine), 1 / len(mine))
        )
    return drawn


def credible_interval(
    points: Points, probabilities: Probabilities, level: float = 0.95
) -> Float[np.ndarray, "2 d"]:
    """Return the central interval of each parameter that holds at least `level` of P.

    Args:
        points: `N x d` candidates.
        probabilities: `N`, sums to 1.
        level: between 0 and 1.
    """
    if not 0 < level < 1:
        raise ValueError(f"level {level} must be between 0 and 1")
    tail = 0.5 * (1.0 - level)
    bounds = np.empty((2, points.shape[1]))
    for k, column in enumerate(np.asarray(points, dtype=float).T):
        order = np.argsort(column)
        mass = np.cumsum(probabilities[order])
        # half a rounding error of the sum must not move a quantile to the next candidate
        at = np.searchsorted(mass, np.array([tail, 1.0 - tail]) * mass[-1] - 1e-12)
        bounds[:, k] = column[order[at]]
    return bounds


def cell_interval(
    candidates: Points,
    cells: Points,
    probabilities: Probabilities,
    bounds: Float[np.ndarray, "2 d"],
) -> Float[np.ndarray, "2 d"]:
    """Return the 95 % interval of each parameter where a candidate stands for its cell.

    Args:
        candidates: `N x d`.
        cells: `N x d` sides of the box that each stands for.
        probabilities: `N`, sums to 1.
        bounds: `2 x d`, beyond which no interval goes.
    """
    half = cells / 2
    low = credible_interval(candidates - half, probabilities)[0]
    high = credible_interval(candidates + half, probabilities)[1]
    return np.asarray(np.clip([low, high], *bounds))


def _minima(
    member: ConditionedGP,
    x: Points,
    values: Float[np.ndarray, "n b"],
    known_values: Float[np.ndarray, "k b"],
    known_rows: Int[np.ndarray, " k"],
    rng: np.random.Generator,
) -> tuple[Int[np.ndarray, " b"], Float[np.ndarray, " b"], float]:
    """Return the arg-min of one joint sample for each bootstrap, its value, and the mass lost."""
    residual = member.residual(values)
    open_rows, bound, lost = _open_rows(member, x, residual, known_values, known_rows)
    V = member.whitened(x[open_rows])
    exact = len(open_rows) <= (EXACT if len(x) <= EXACT else DENSE)
    factor = covariance_factor(
        member, x[open_rows], member.variance(V), None if exact else bound, rng
    )
    labels = np.concatenate([open_rows, known_rows])
    winners, lowest = np.empty(values.shape[1], dtype=np.intp), np.empty(values.shape[1])
    step = max(1, CELLS // len(labels))
    for start in range(0, len(winners), step):
        some = slice(start, start + step)
        draws = rng.standard_normal((len(winners[some]), len(factor))) @ factor
        draws += member.mean + residual[:, some].T @ V
        everything = np.concatenate([draws, known_values[:, some].T], axis=1)
        winners[some] = labels[_lowest(everything, rng)]
        lowest[some] = everything.min(axis=1)
    return winners, lowest, lost


def _lowest(values: Float[np.ndarray, "b m"], rng: np.random.Generator) -> Int[np.ndarray, " b"]:
    """Return the column of the least value in each row, one of them at random where several are.

    Candidates that recordings do not distinguish are equal in all, up to rounding: by a parameter
    without effect, or along a valley of two that compensate each other.
    """
    columns: Int[np.ndarray, " b"] = values.argmin(axis=1)
    tied = values <= values[np.arange(len(values)), columns][:, None] + TIED
    several = tied.sum(axis=1) > 1
    lots = np.where(tied[several], rng.random(tied[several].shape), -1.0)
    columns[several] = lots.argmax(axis=1)
    return columns


def _open_rows(
    member: ConditionedGP,
    x: Points,
    residual: Float[np.ndarray, "n b"],
    known_values: Float[np.ndarray, "k b"],
    known_rows: Int[np.ndarray, " k"],
) -> tuple[Int[np.ndarray, " s"], Float[np.ndarray, " s"], float]:
    """Return the uncertain rows that may be an arg-min, their bounds, and the sum of the others'.

    In each bootstrap a candidate is the arg-min only if it is below the best evaluated candidate
    or, where none is known in this set, below a level that the minimum hardly ever exceeds.
    """
    uncertain = np.setdiff1d(np.arange(len(x)), known_rows)
    blocks = [uncertain[i : i + CHUNK] for i in range(0, len(uncertain), CHUNK)]

    def moments(
        block: Int[np.ndarray, " m"],
    ) -> tuple[Float[np.ndarray, "m b"], Float[np.ndarray, "m 1"]]:
        V = member.whitened(x[block])
        std = np.sqrt(np.maximum(member.variance(V), 1e-300))
        return member.mean + V.T @ residual, std[:, None]

    if len(known_rows):
        level = known_values.min(axis=0)
    else:
        upper = [
            (mean + UPPER_BOUND_SIGMAS * std).min(axis=0) for mean, std in map(moments, blocks)
        ]
        level = np.min(upper, axis=0)
    bound = np.empty(0)
    for mean, std in map(moments, blocks):
        bound = np.append(bound, ndtr((level - mean) / std).mean(axis=1))
    kept, lost = keep_largest(bound, MASS)
    return uncertain[kept], bound[kept], lost


def _check(
    surrogate: Surrogate,
    candidates: Points,
    rows: Rows,
    contributions: Float[np.ndarray, "n blocks"],
    weights: Float[np.ndarray, " blocks"],
) -> None:
    n = len(surrogate.points)
    if rows.shape != (n,) or contributions.shape != (n, len(weights)):
        raise ValueError(
            f"{n} evaluated points need {n} rows and contributions of shape {n} x "
            f"{len(weights)} blocks; got {rows.shape} and {contributions.shape}"
        )
    if len(weights) < 2:
        raise ValueError("one block cannot be resampled; cut the recordings into two or more")
    inside = rows >= 0
    if not np.array_equal(candidates[rows[inside]], surrogate.points[inside]):
        raise ValueError("rows must be those of the surrogate's points, in their order")

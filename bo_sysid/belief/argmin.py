"""The belief: the probability of each candidate to be the arg-min of Δ over B."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.special import entr

from bo_sysid.arrays import Points, Probabilities
from bo_sysid.belief.joint import EXACT, ArgminPosterior, argmin_posterior
from bo_sysid.belief.rows import RowIndex
from bo_sysid.belief.surrogate import Surrogate

CELLS = 16_000_000  # samples x candidates drawn at a time
SAMPLES, SAMPLES_LARGE = 4096, 8192


@dataclass(frozen=True)
class ArgminBelief:
    """P(β), the probability that β is the arg-min of Δ over B on the recordings.

    It is not the uncertainty about the machine: see `bo_sysid.belief.bootstrap`.

    Attributes:
        probabilities: `N`, sums to 1.
        estimator: how it was computed.
        mass_lost: bound on the probability of the candidates that were left out of the sampling.
    """

    probabilities: Probabilities
    estimator: str
    mass_lost: float

    @property
    def entropy(self) -> float:
        """`−Σ P log P` in nats."""
        return float(entr(self.probabilities).sum())

    @property
    def best(self) -> int:
        """The row with the largest probability."""
        return int(self.probabilities.argmax())


def argmin_probability(
    surrogate: Surrogate, candidates: Points, *, samples: int | None = None, seed: int = 0
) -> ArgminBelief:
    """Return the probability of each candidate to be the arg-min of Δ.

    Joint posterior samples of the warped Δ over B are drawn from every member of the ensemble in
    proportion to its weight, and the arg-mins are counted. Candidates that were evaluated
    keep the value that was computed. Equal rows share their probability.

    Args:
        surrogate: of Δ.
        candidates: `N x d`, in the units of the surrogate's points.
        samples: number of joint samples; 4096, and 8192 over sets that are too large for an exact
            factor, where P can be spread over more candidates.
        seed: of the samples.
    """
    if samples is None:
        samples = SAMPLES if len(candidates) <= EXACT else SAMPLES_LARGE
    index = RowIndex.of(candidates)
    first = index.find(candidates)
    unique, where = np.unique(first, return_inverse=True)
    probabilities, lost, exact = _distinct(surrogate, candidates[unique], samples, seed)
    shared = probabilities / np.bincount(where)
    return ArgminBelief(shared[where], "exact" if exact else "low-rank", lost)


def evaluated_rows(
    surrogate: Surrogate, candidates: Points
) -> tuple[Int[np.ndarray, " k"], Float[np.ndarray, " k"]]:
    """Return the rows of `candidates` whose Δ is known, and their standardised values.

    Args:
        surrogate: of Δ, given the evaluations.
        candidates: `N x d`, in the units of the surrogate's points.
    """
    rows = RowIndex.of(candidates).find(surrogate.points)
    rows, place = np.unique(rows, return_index=True)
    keep = rows >= 0
    return rows[keep], surrogate.standardised[place[keep]]


def argmin_posteriors(
    surrogate: Surrogate, candidates: Points, seed: int
) -> Iterator[ArgminPosterior]:
    """Yield the joint posterior of each member over the candidates that may be the arg-min."""
    x = surrogate.unit(candidates)
    known, known_values = evaluated_rows(surrogate, candidates)
    for number, member in enumerate(surrogate.members):
        rng = np.random.default_rng((seed, number))
        yield argmin_posterior(member, x, surrogate.standardised, known, known_values, rng)


def samples_per_member(weights: Float[np.ndarray, " M"], samples: int) -> Int[np.ndarray, " M"]:
    """Return how many of `samples` each member gets, in proportion to its weight."""
    edges = np.round(np.cumsum(weights) / weights.sum() * samples).astype(int)
    return np.diff(edges, prepend=0)


def _distinct(
    surrogate: Surrogate, candidates: Points, samples: int, seed: int
) -> tuple[Probabilities, float, bool]:
    """Return P over distinct candidates, the bound on the mass lost, and whether P is exact."""
    counts, lost, exact = np.zeros(len(candidates)), 0.0, True
    shares = samples_per_member(surrogate.weights, samples)
    posteriors = argmin_posteriors(surrogate, candidates, seed)
    for number, (posterior, share) in enumerate(zip(posteriors, shares, strict=True)):
        rng = np.random.default_rng((seed, number, 1))
        lost += posterior.lost * share / samples
        exact &= posterior.exact
        step = 2 * max(1, CELLS // max(len(posterior.rows), 1))
        for start in range(0, share, step):
            size = min(step, share - start)
            normals = rng.standard_normal(((size + 1) // 2, len(posterior.factor)))
            noise = normals.astype(posterior.factor.dtype) @ posterior.factor
            counts += posterior.tally(posterior.mean + noise, len(counts))
            counts += posterior.tally(posterior.mean - noise[: size // 2], len(counts))
    return counts / counts.sum(), lost, exact

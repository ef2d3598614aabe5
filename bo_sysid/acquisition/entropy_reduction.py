"""One-step look-ahead: by how much an evaluation is expected to lower the entropy of P.

    α(β) = H[P] − E_y[ H[P | f(β) = y] ],    f = g(Δ)

The outcomes y are Gauss–Hermite nodes of the ensemble's predictive distribution. Joint posterior
samples f are carried to the posterior given an outcome by the Matheron rule,
`f + Cov(·, β) (y − f(β)) / σ²(β)`, and the members are weighed by how likely they make y. The same
samples are used before and after, so that their noise cancels in the difference.

References:
    Hennig & Schuler (2012), Entropy search for information-efficient global optimization.
    Wilson et al. (2021), Pathwise conditioning of Gaussian processes (the Matheron rule).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float, Int
from scipy.special import entr
from scipy.stats import norm

from bo_sysid.acquisition.context import SelectionContext
from bo_sysid.acquisition.rows import RowAcquisition, Values, from_table
from bo_sysid.belief.argmin import argmin_posteriors
from bo_sysid.belief.joint import ArgminPosterior

NODES = 7
SAMPLES = 1024  # over all members
MOST = 64  # candidates looked ahead to: those with the largest P
_LESS = 1e-6  # [nat] than the least of these, for all others


@dataclass(frozen=True)
class _Sampled:
    """Joint samples of one member, with its weight and its place of each row of B (-1: none)."""

    weight: float
    posterior: ArgminPosterior
    draws: Float[np.ndarray, "b s"]
    place: Int[np.ndarray, " N"]

    def gain(self, row: int) -> Float[np.ndarray, " s"]:
        """Return by how much the samples move with the value of the candidate `row`.

        That is not at all where this member has excluded it: nothing that it cares for changes.
        """
        at = self.place[row]
        if at < 0:
            return np.zeros(len(self.posterior.rows))
        covariance = self.posterior.factor[:, at] @ self.posterior.factor
        return np.asarray(covariance / covariance[at])

    def given(
        self, row: int, outcome: float, gain: Float[np.ndarray, " s"]
    ) -> Float[np.ndarray, " N"]:
        """Return P of this member if the candidate `row`, of this gain, had the value `outcome`."""
        at = self.place[row]
        if at < 0:
            return self.before
        moved = self.draws + (outcome - self.draws[:, [at]]) * gain
        moved[:, at] = outcome
        counts = self.posterior.tally(moved, len(self.place))
        return np.asarray(counts / counts.sum())

    @cached_property
    def before(self) -> Float[np.ndarray, " N"]:
        """P of this member as it is."""
        counts = self.posterior.tally(self.draws, len(self.place))
        return np.asarray(counts / counts.sum())


def table(context: SelectionContext) -> Values:
    """Return the expected decrease of the entropy in nats.

    Candidates that are not looked ahead to have 0, or less where sampling puts any other at or
    below 0: they are never preferred.
    """
    members = _sampled(context)
    weights = np.array([m.weight for m in members])
    now = float(entr(weights @ np.array([m.before for m in members])).sum())
    means, deviations = context.moments()
    surrogate = context.surrogate
    means, deviations = surrogate.standardise(means), deviations / surrogate.scale
    open_rows = np.setdiff1d(np.flatnonzero(context.belief.probabilities), context.evaluated)
    likely = open_rows[np.argsort(-context.belief.probabilities[open_rows], kind="stable")[:MOST]]
    decreases = [
        now - _expected_entropy(members, int(row), means[:, row], deviations[:, row])
        for row in likely
    ]
    values = np.full(len(context.candidates), min([0.0, *(d - _LESS for d in decreases)]))
    values[likely] = decreases
    return values


def _sampled(context: SelectionContext) -> list[_Sampled]:
    """Return joint samples of every member."""
    rng = context.generator()
    size = max(1, SAMPLES // len(context.surrogate.members))
    found = []
    posteriors = argmin_posteriors(context.surrogate, context.candidates, context.seed)
    for weight, posterior in zip(context.surrogate.weights, posteriors, strict=True):
        normals = rng.standard_normal((size, len(posterior.factor)))
        draws = posterior.mean + normals @ posterior.factor
        place = np.full(len(context.candidates), -1)
        place[posterior.rows] = np.arange(len(posterior.rows))
        found.append(_Sampled(float(weight), posterior, draws, place))
    return found


def _expected_entropy(
    members: Sequence[_Sampled],
    row: int,
    mean: Float[np.ndarray, " M"],
    std: Float[np.ndarray, " M"],
) -> float:
    """Return the entropy of P expected after the evaluation of one candidate."""
    weights = np.array([m.weight for m in members])
    centre = weights @ mean
    spread = np.sqrt(weights @ (std**2 + (mean - centre) ** 2))
    nodes, shares = np.polynomial.hermite_e.hermegauss(NODES)
    gains = [m.gain(row) for m in members]  # of all outcomes: they cost more than an outcome does
    expected = 0.0
    for node, share in zip(nodes, shares / shares.sum(), strict=True):
        outcome = float(centre + spread * node)
        likelihood = np.asarray(norm.logpdf(outcome, mean, np.maximum(std, 1e-6)))
        posterior_weights = weights * np.exp(likelihood - likelihood.max())
        posterior_weights = posterior_weights / posterior_weights.sum()
        P = sum(
            w * m.given(row, outcome, gain)
            for w, m, gain in zip(posterior_weights, members, gains, strict=True)
            if w > 1e-6
        )
        expected += share * float(entr(P).sum())
    return expected


def build(context: SelectionContext) -> RowAcquisition:
    """Return the acquisition for the surrogate of the context."""
    return from_table(context, table)

"""Averaging over the hyperparameters of a Gaussian process by importance sampling.

A point estimate of the hyperparameters makes the belief overconfident. Here the posterior
`p(θ | y)` is explored from several starts with L-BFGS; every mode found becomes a Student-t bump
with the inverse Hessian as its scale (a Laplace approximation with heavier tails); draws from the
mixture of bumps are weighed by `p(θ | y) / q(θ)` and resampled to a few equally probable members
(sampling–importance–resampling). Unlike a plain Laplace approximation this is right for skewed and
multi-modal posteriors, and unlike a Markov chain it costs a few batched Cholesky factorisations.

References:
    Rubin (1988), Using the SIR algorithm to simulate posterior distributions.
    Hvarfner, Hellsten & Nardi (2024), Vanilla Bayesian optimization performs great in high
    dimensions: the √d scaling of the length scales' prior.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from jaxtyping import Float
from scipy.optimize import minimize
from scipy.stats import multivariate_t

from bo_sysid.belief.gp import Kernel, MarginalLikelihood
from bo_sysid.execution import limit_threads

STUDENT_DOF = 5
DRAWS = 256  # importance draws over all modes and kernels
MODE_GAP = 8.0  # modes this far (in log density) below the best are dropped
_STEP = 1e-3  # of θ, for second derivatives


@dataclass(frozen=True)
class Prior:
    """Independent normal priors of `θ = (log ℓ₁ … log ℓ_d, log s²)`."""

    mean: Float[np.ndarray, " p"]
    std: Float[np.ndarray, " p"]

    def __call__(
        self, theta: Float[np.ndarray, "b p"]
    ) -> tuple[Float[np.ndarray, " b"], Float[np.ndarray, "b p"]]:
        """Return the log density up to a constant, and its gradient."""
        z = (theta - self.mean) / self.std
        return -0.5 * (z**2).sum(axis=1), -z / self.std


@dataclass(frozen=True)
class Draw:
    """One member of the ensemble: a kernel and its hyperparameters θ."""

    kernel: Kernel
    theta: Float[np.ndarray, " p"]


@dataclass(frozen=True)
class _Mode:
    """A local maximum of the posterior of θ, with the scale of its Laplace approximation."""

    evidence: MarginalLikelihood
    theta: Float[np.ndarray, " p"]
    log_density: float
    scale: Float[np.ndarray, "p p"]


def _log_posterior(
    evidence: MarginalLikelihood, prior: Prior, theta: Float[np.ndarray, "b p"]
) -> tuple[Float[np.ndarray, " b"], Float[np.ndarray, "b p"]]:
    value, gradient = evidence(theta)
    log_prior, slope = prior(theta)
    return value + log_prior, gradient + slope


def _climb(
    evidence: MarginalLikelihood, prior: Prior, start: Float[np.ndarray, " p"]
) -> tuple[Float[np.ndarray, " p"], float]:
    """Return the maximum of the posterior reached from `start`, and its log density."""

    def negative(theta: Float[np.ndarray, " p"]) -> tuple[float, Float[np.ndarray, " p"]]:
        value, gradient = _log_posterior(evidence, prior, theta[None])
        if not np.isfinite(value[0]):
            return 1e10, np.zeros_like(theta)
        return -float(value[0]), -gradient[0]

    box = list(zip(prior.mean - 5 * prior.std, prior.mean + 5 * prior.std, strict=True))
    found = minimize(
        negative, start, jac=True, method="L-BFGS-B", bounds=box, options={"maxiter": 60}
    )
    return found.x, -float(found.fun)


def _laplace_scale(
    evidence: MarginalLikelihood, prior: Prior, theta: Float[np.ndarray, " p"]
) -> Float[np.ndarray, "p p"]:
    """Return the inverse of the negative Hessian at a mode, at most √2 as wide as the prior."""
    p = len(theta)
    offsets = _STEP * np.concatenate([np.eye(p), -np.eye(p)])
    _, gradient = _log_posterior(evidence, prior, theta + offsets)
    hessian = -(gradient[:p] - gradient[p:]) / (2.0 * _STEP)
    whitened = prior.std[:, None] * (0.5 * (hessian + hessian.T)) * prior.std[None, :]
    eigenvalues, vectors = np.linalg.eigh(whitened)
    # the prior contributes 1 to every curvature; less than that is a plateau of the evidence
    root = prior.std[:, None] * vectors / np.sqrt(np.maximum(eigenvalues, 0.5))
    scale: Float[np.ndarray, "p p"] = root @ root.T
    return scale


def _find_modes(
    evidences: Sequence[MarginalLikelihood], prior: Prior, starts: Float[np.ndarray, "k p"]
) -> list[_Mode]:
    """Return the distinct local maxima that hold a share of the posterior worth sampling."""
    tops: list[tuple[MarginalLikelihood, Float[np.ndarray, " p"], float]] = []
    with limit_threads(1):  # matrices are small, and BLAS threads would spin while they wait
        for evidence, start in product(evidences, starts):
            theta, density = _climb(evidence, prior, start)
            known = any(
                e is evidence and np.all(np.abs(t - theta) < 0.1 * prior.std) for e, t, _ in tops
            )
            if not known:
                tops.append((evidence, theta, density))
    best = max(density for _, _, density in tops)
    return [
        _Mode(evidence, theta, density, _laplace_scale(evidence, prior, theta))
        for evidence, theta, density in tops
        if density > best - MODE_GAP
    ]


def _mixture_draws(
    modes: Sequence[_Mode], prior: Prior, rng: np.random.Generator
) -> tuple[list[Draw], Float[np.ndarray, " K"]]:
    """Return draws from the mixture of the modes' bumps and their log importance weights."""
    mass = np.array([m.log_density + 0.5 * np.linalg.slogdet(m.scale)[1] for m in modes])
    share = np.exp(mass - mass.max())
    share = share / share.sum()
    counts = np.maximum(np.round(DRAWS * share).astype(int), 8)
    found: list[Draw] = []
    weights: list[Float[np.ndarray, " k"]] = []
    for kernel in dict.fromkeys(m.evidence.kernel for m in modes):
        members = [
            (m, int(c)) for m, c in zip(modes, counts, strict=True) if m.evidence.kernel == kernel
        ]
        bumps = [(multivariate_t(m.theta, m.scale, df=STUDENT_DOF), c) for m, c in members]
        theta = np.concatenate(
            [np.reshape(b.rvs(c, random_state=rng), (-1, len(prior.mean))) for b, c in bumps]
        )
        proposal = np.logaddexp.reduce(
            [np.log(c / counts.sum()) + np.atleast_1d(b.logpdf(theta)) for b, c in bumps], axis=0
        )
        value, _ = _log_posterior(members[0][0].evidence, prior, theta)
        found += [Draw(kernel, row) for row in theta]
        weights.append(value - proposal)
    return found, np.concatenate(weights)


def sample_hyperparameters(
    evidences: Sequence[MarginalLikelihood],
    prior: Prior,
    *,
    members: int,
    seed: int,
) -> tuple[tuple[Draw, ...], Float[np.ndarray, " M"], float]:
    """Return members of the ensemble, their weights, which sum to 1, and the log evidence.

    The evidence, `log ∫ p(y | θ) p(θ) dθ` up to a constant of the prior, is the mean of the
    importance weights.

    Args:
        evidences: one `MarginalLikelihood` a kernel family; families compete by their evidence.
        prior: of θ, the same for all families.
        members: how many to resample; equal ones are merged, so fewer may come back.
        seed: of the draws.
    """
    rng = np.random.default_rng(seed)
    spread = np.zeros((3, len(prior.mean)))
    spread[1, :-1], spread[2, :-1] = -1.0, 1.0
    modes = _find_modes(evidences, prior, prior.mean + spread * prior.std)
    found, log_weights = _mixture_draws(modes, prior, rng)
    weights = np.exp(log_weights - log_weights.max())
    evidence = float(log_weights.max() + np.log(weights.mean()))
    weights = weights / weights.sum()
    # systematic resampling: member j at quantile (j + u) / M of the cumulated weights
    quantiles = (np.arange(members) + rng.random()) / members
    rows = np.minimum(np.searchsorted(np.cumsum(weights), quantiles), len(found) - 1)
    kept, counts = np.unique(rows, return_counts=True)
    return tuple(found[k] for k in kept), counts / members, evidence

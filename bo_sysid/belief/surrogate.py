"""The Gaussian-process surrogate of Δ over B, averaged over its hyperparameters.

Δ is modelled on the scale of its logarithm, its root or itself, whichever the evidence prefers. The
arg-min is the same on all three. On recordings that the model can explain almost exactly Δ falls
towards zero like the distance to the truth; its logarithm then has a pole there, which no
stationary process follows, while Δ itself is a cone.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float
from scipy.linalg import solve_triangular

from bo_sysid.arrays import Categories, Deviations, Points
from bo_sysid.belief.encoding import encoded
from bo_sysid.belief.gp import (
    MEAN_VARIANCE,
    ConditionedGP,
    Kernel,
    MarginalLikelihood,
    covariance,
)
from bo_sysid.belief.hyperparameters import Prior, sample_hyperparameters
from bo_sysid.belief.joint import posterior_moments
from bo_sysid.belief.warp import Warp

if TYPE_CHECKING:
    from botorch.models import SingleTaskGP

KERNELS: tuple[Kernel, ...] = ("matern", "rbf")
POWERS = (0.0, 0.5, 1.0)
MEMBERS = 8
NOISE = 1e-6  # variance of the standardised values: Δ on fixed data has none, whatever its range
LENGTHSCALE_MEDIAN = 0.7  # of the prior, in units of the box, times √d
LENGTHSCALE_STD = 0.8
OUTPUTSCALE_MEDIAN = 1.0
OUTPUTSCALE_STD = 1.0


@dataclass(frozen=True)
class Surrogate:
    """An ensemble of Gaussian processes on the warped Δ, `y = g(Δ)`.

    Every member is conditioned on the same evaluations; they differ in kernel, length scales,
    output scale and constant mean, which were drawn from their posterior.

    Attributes:
        points: `n x d` evaluated parameter vectors.
        values: `n` values of y there.
        bounds: `2 x d` lower and upper bounds of B.
        noise: `n` variances of the standardised values, as the members use them.
        warp: g.
        shift: mean of `values`.
        scale: standard deviation of `values`.
        members: the Gaussian processes, over the unit cube, of standardised values.
        weights: `M` probabilities of the members.
        categories: values of each column of `points` that has no order, by column.
    """

    points: Float[np.ndarray, "n d"]
    values: Deviations
    bounds: Float[np.ndarray, "2 d"]
    noise: Deviations
    warp: Warp
    shift: float
    scale: float
    members: tuple[ConditionedGP, ...]
    weights: Float[np.ndarray, " M"]
    categories: Categories = field(default_factory=dict)

    def unit(self, points: Points) -> Float[np.ndarray, "N D"]:
        """Return `points` in the unit cube of the members, categories as columns of their own."""
        return encoded(points, self.bounds, self.categories)

    def standardise(self, values: Float[np.ndarray, "n *b"]) -> Float[np.ndarray, "n *b"]:
        """Return values of y in the units of the members."""
        return (values - self.shift) / self.scale

    def deviations(self, standardised: Float[np.ndarray, "n *b"]) -> Float[np.ndarray, "n *b"]:
        """Return Δ for values in the units of the members."""
        return self.warp.inverse(self.shift + self.scale * standardised)

    @property
    def standardised(self) -> Deviations:
        """The values in the units of the members."""
        return self.standardise(self.values)

    def moments(self, points: Points) -> tuple[Float[np.ndarray, " N"], Float[np.ndarray, " N"]]:
        """Return mean and variance of y at `points`, averaged over the ensemble.

        Args:
            points: `N x d`, in their own units.

        Returns:
            `N` means in the unit of y, and `N` variances in its square.
        """
        x, none = self.unit(points), np.zeros(0, np.intp)
        found = [
            posterior_moments(member, x, self.standardised, none, np.zeros(0))
            for member in self.members
        ]
        means, variances = np.array([m.mean for m in found]), np.array([m.variance for m in found])
        mean = self.weights @ means
        spread = self.weights @ (variances + (means - mean) ** 2)
        return self.shift + self.scale * mean, self.scale**2 * spread

    def only(self, member: int) -> "Surrogate":
        """Return the surrogate of one member alone."""
        return replace(self, members=(self.members[member],), weights=np.ones(1))

    def conditioned(self, points: Points, values: Float[np.ndarray, " k"]) -> "Surrogate":
        """Return the surrogate that would know y at further points, without a new fit.

        The processes stay what they are in units of y; members are weighed by how well they had
        predicted the new values.

        Args:
            points: `k x d` parameter vectors, none of them evaluated before.
            values: `k` values of y there.
        """
        x, k = self.unit(points), len(points)
        y = np.append(self.values, values)
        shift, scale = _standard(y)
        noise = np.append(self.noise, np.full(k, self.noise.min()))
        members, evidence = [], []
        for member in self.members:
            grown = member.extended(x, noise[-k:])
            tail = grown.residual(self.standardise(y))[-k:]
            evidence.append(-0.5 * tail @ tail - np.log(np.diag(grown.chol)[-k:]).sum())
            members.append(grown.rescaled((self.shift - shift) / scale, self.scale / scale))
        weights = self.weights * np.exp(np.array(evidence) - max(evidence))
        return replace(
            self,
            points=np.concatenate([self.points, points]),
            values=y,
            noise=noise * (self.scale / scale) ** 2,
            shift=shift,
            scale=scale,
            members=tuple(members),
            weights=weights / weights.sum(),
        )

    def models(self) -> "tuple[SingleTaskGP, ...]":
        """Return the members as BoTorch models of y over B's own units, in float64.

        They are built with each call: to move one to a GPU moves nobody else's.
        """
        from bo_sysid.belief.models import as_single_task_gp

        return tuple(as_single_task_gp(self, member) for member in self.members)


def fit_surrogate(
    points: Float[np.ndarray, "n d"],
    deviations: Float[np.ndarray, "..."],
    bounds: Float[np.ndarray, "2 d"],
    *,
    members: int = MEMBERS,
    powers: Sequence[float] = POWERS,
    categories: Categories | None = None,
    seed: int = 0,
) -> Surrogate:
    """Fit Gaussian processes to Δ and average over their hyperparameters.

    Args:
        points: evaluated parameter vectors, in their own units.
        deviations: their Δ, `n` values that are not negative.
        bounds: lower and upper bounds of B.
        members: size of the ensemble.
        powers: of Δ, of which the one with the largest evidence is taken; 0 is the logarithm.
        categories: values of each column of `points` that has no order, by column.
        seed: of the sample of hyperparameters.

    Raises:
        ValueError: shapes do not agree, a value is not finite, or bounds have no extent.
    """
    points, bounds = np.asarray(points, dtype=float), np.asarray(bounds, dtype=float)
    deviations = np.asarray(deviations, dtype=float)
    _check(points, deviations, bounds)
    categories = categories or {}
    fits = [_fit(points, deviations, bounds, members, p, categories, seed) for p in powers]
    return max(fits, key=lambda fit: fit[1])[0]


def _fit(
    points: Float[np.ndarray, "n d"],
    deviations: Deviations,
    bounds: Float[np.ndarray, "2 d"],
    members: int,
    power: float,
    categories: Categories,
    seed: int,
) -> tuple[Surrogate, float]:
    """Return the surrogate on one power of Δ, and its log evidence."""
    warp = Warp.of(deviations, power)
    y = warp(deviations)
    shift, scale = _standard(y)
    x = encoded(points, bounds, categories)
    noise = np.full(len(y), NOISE)
    squared = (x.T[:, :, None] - x.T[:, None, :]) ** 2
    evidences = {k: MarginalLikelihood(k, squared, (y - shift) / scale, noise) for k in KERNELS}
    draws, weights, log_evidence = sample_hyperparameters(
        tuple(evidences.values()), default_prior(x.shape[1]), members=members, seed=seed
    )
    rng = np.random.default_rng((seed, 1))
    ensemble = tuple(condition(evidences[draw.kernel], draw.theta, x, rng) for draw in draws)
    surrogate = Surrogate(
        points, y, bounds, noise, warp, shift, scale, ensemble, weights, categories
    )
    return surrogate, log_evidence - len(y) * float(np.log(scale))


def _standard(y: Deviations) -> tuple[float, float]:
    """Return mean and standard deviation as BoTorch's `Standardize` takes them."""
    spread = float(y.std(ddof=1)) if len(y) > 1 else 1.0
    return float(y.mean()), spread if spread > 1e-8 else 1.0


def default_prior(d: int) -> Prior:
    """Return the prior of `θ = (log ℓ₁ … log ℓ_d, log s²)` over the unit cube in d dimensions."""
    lengthscale = np.full(d, np.log(LENGTHSCALE_MEDIAN * np.sqrt(d)))
    return Prior(
        mean=np.append(lengthscale, np.log(OUTPUTSCALE_MEDIAN)),
        std=np.append(np.full(d, LENGTHSCALE_STD), OUTPUTSCALE_STD),
    )


def condition(
    evidence: MarginalLikelihood,
    theta: Float[np.ndarray, " p"],
    x: Float[np.ndarray, "n d"],
    rng: np.random.Generator,
) -> ConditionedGP:
    """Return the Gaussian process of one θ, its constant drawn from the constant's posterior."""
    lengthscales, outputscale = np.exp(theta[:-1]), float(np.exp(theta[-1]))
    K = covariance(evidence.kernel, lengthscales, outputscale, x, x)
    chol = np.linalg.cholesky(K + np.diag(evidence.noise))
    ones_and_values = np.stack([np.ones(len(x)), evidence.values], axis=1)
    whitened = solve_triangular(chol, ones_and_values, lower=True)
    precision = float(whitened[:, 0] @ whitened[:, 0]) + 1.0 / MEAN_VARIANCE
    centre = float(whitened[:, 0] @ whitened[:, 1]) / precision
    mean = centre + float(rng.standard_normal()) / np.sqrt(precision)
    return ConditionedGP(evidence.kernel, lengthscales, outputscale, mean, x, chol)


def _check(
    points: Float[np.ndarray, "n d"],
    deviations: Float[np.ndarray, "..."],
    bounds: Float[np.ndarray, "2 d"],
) -> None:
    if points.ndim != 2 or not len(points) or np.shape(deviations) != (len(points),):
        raise ValueError(
            f"{np.shape(deviations)} deviations do not belong to points {points.shape}: "
            "n points need n deviations, n at least 1"
        )
    wrong = np.flatnonzero(~np.isfinite(deviations) | (deviations < 0))
    if len(wrong):
        raise ValueError(
            f"deviation {deviations[wrong[0]]} of evaluation {wrong[0]} is not a finite number "
            ">= 0; a simulation that diverged must carry its penalty"
        )
    if not np.isfinite(points).all():
        raise ValueError("evaluated points must be finite")
    if bounds.shape != (2, points.shape[1]) or not (bounds[1] > bounds[0]).all():
        raise ValueError(f"bounds {bounds.tolist()} must be a lower row below an upper row")

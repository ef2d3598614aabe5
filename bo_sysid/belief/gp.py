"""Gaussian-process regression on a few hundred points: kernel, evidence, conditioning.

One Gaussian process is `y(x) = c + g(x)`, `g ~ GP(0, s² R(x, x'))` on the unit cube with a
Matérn-5/2 or squared-exponential correlation `R`, one length scale a dimension. The constant
`c ~ N(0, τ²)` is integrated out of the evidence in closed form (Rasmussen & Williams 2006, section
2.7), so that the hyperparameters are `θ = (log ℓ₁ … log ℓ_d, log s²)`. The evidence is batched over
θ: a whole sample of hyperparameters is weighed with one call, which makes averaging affordable.

References:
    Rasmussen & Williams (2006), Gaussian Processes for Machine Learning, equations 2.23–2.26, 4.17,
    5.9, algorithm 2.1.
"""

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from jaxtyping import Float
from scipy.linalg import solve_triangular

Kernel = Literal["matern", "rbf"]
MEAN_VARIANCE = 1.0  # τ², for values standardised to unit variance


def correlation(
    kernel: Kernel, squared: Float[np.ndarray, "*shape"]
) -> Float[np.ndarray, "*shape"]:
    """Return the correlation `R` at scaled squared distances `r²`."""
    if kernel == "rbf":
        return np.exp(-0.5 * squared)
    root = np.asarray(5.0 * squared)
    np.sqrt(root, out=root)
    polynomial = np.asarray(root / 3.0)
    polynomial += 1.0
    polynomial *= root
    polynomial += 1.0  # 1 + r + r²/3
    polynomial *= np.exp(np.negative(root, out=root), out=root)
    return polynomial


def correlation_slope(
    kernel: Kernel, squared: Float[np.ndarray, "*shape"]
) -> Float[np.ndarray, "*shape"]:
    """Return `-2 dR/d(r²)`, which times `Δ_k²/ℓ_k²` is `dR/d log ℓ_k`."""
    if kernel == "rbf":
        return np.exp(-0.5 * squared)
    root = np.sqrt(5.0 * squared)
    return 5.0 / 3.0 * (1.0 + root) * np.exp(-root)


def scaled_squared_distances(
    a: Float[np.ndarray, "n d"], b: Float[np.ndarray, "m d"], lengthscales: Float[np.ndarray, " d"]
) -> Float[np.ndarray, "n m"]:
    """Return `Σ_k (a_k − b_k)² / ℓ_k²`."""
    # from the middle of the unit cube, which keeps the cancellation below small
    u, v = (a - 0.5) / lengthscales, (b - 0.5) / lengthscales
    squared = (-2.0 * u) @ v.T
    squared += (u**2).sum(axis=1)[:, None]
    squared += (v**2).sum(axis=1)
    return np.asarray(np.maximum(squared, 0.0, out=squared))


def covariance(
    kernel: Kernel,
    lengthscales: Float[np.ndarray, " d"],
    outputscale: float,
    a: Float[np.ndarray, "m d"],
    b: Float[np.ndarray, "k d"],
) -> Float[np.ndarray, "m k"]:
    """Return the prior covariance `s² R(a, b)`."""
    return outputscale * correlation(kernel, scaled_squared_distances(a, b, lengthscales))


@dataclass(frozen=True)
class MarginalLikelihood:
    """The evidence of hyperparameters θ for fixed data.

    Attributes:
        kernel: family of the correlation.
        squared: `d x n x n` squared coordinate differences of the points.
        values: `n` standardised values.
        noise: `n` variances of the values.
    """

    kernel: Kernel
    squared: Float[np.ndarray, "d n n"]
    values: Float[np.ndarray, " n"]
    noise: Float[np.ndarray, " n"]

    def __call__(
        self, theta: Float[np.ndarray, "b p"]
    ) -> tuple[Float[np.ndarray, " b"], Float[np.ndarray, "b p"]]:
        """Return `log p(y | θ)` and its gradient for a batch of θ; -inf where K is not positive."""
        inverse_squares = np.exp(-2.0 * theta[:, :-1])
        s2 = np.exp(theta[:, -1])[:, None, None]
        distances = np.einsum("bk,kij->bij", inverse_squares, self.squared)
        R, slope = correlation(self.kernel, distances), correlation_slope(self.kernel, distances)
        n = len(self.values)
        noise = np.zeros((n, n))
        np.fill_diagonal(noise, self.noise)
        K = s2 * R + noise
        try:
            chol = np.linalg.cholesky(K)
        except np.linalg.LinAlgError:
            return self._one_by_one(theta)
        inverse = np.linalg.inv(K)
        ones = inverse.sum(axis=2)  # K⁻¹ 1
        precision = ones.sum(axis=1) + 1.0 / MEAN_VARIANCE
        alpha = inverse @ self.values
        centre = alpha.sum(axis=1) / precision
        beta = alpha - centre[:, None] * ones
        log_determinant = 2.0 * np.log(np.diagonal(chol, axis1=1, axis2=2)).sum(axis=1)
        value = -0.5 * (
            beta @ self.values + log_determinant + np.log(precision * MEAN_VARIANCE)
        ) - 0.5 * n * np.log(2.0 * np.pi)
        projected = inverse - ones[:, :, None] * ones[:, None, :] / precision[:, None, None]
        W = beta[:, :, None] * beta[:, None, :] - projected
        gradient = np.empty_like(theta)
        gradient[:, :-1] = (
            0.5 * np.einsum("bij,kij->bk", W * (s2 * slope), self.squared) * inverse_squares
        )
        gradient[:, -1] = 0.5 * (W * (s2 * R)).sum(axis=(1, 2))
        return value, gradient

    def _one_by_one(
        self, theta: Float[np.ndarray, "b p"]
    ) -> tuple[Float[np.ndarray, " b"], Float[np.ndarray, "b p"]]:
        """Evaluate each θ by itself where the covariance of one of the batch is not positive."""
        if len(theta) == 1:
            return np.full(1, -np.inf), np.zeros_like(theta)
        parts = [self(row[None]) for row in theta]
        return np.concatenate([p[0] for p in parts]), np.concatenate([p[1] for p in parts])


@dataclass(frozen=True)
class ConditionedGP:
    """A Gaussian process with fixed hyperparameters, conditioned on data.

    Attributes:
        kernel: family of the correlation.
        lengthscales: `d`, in units of the unit cube.
        outputscale: `s²`.
        mean: the constant `c`.
        points: `n x d` in the unit cube.
        chol: lower Cholesky factor `L` of `K + diag(noise)`.
    """

    kernel: Kernel
    lengthscales: Float[np.ndarray, " d"]
    outputscale: float
    mean: float
    points: Float[np.ndarray, "n d"]
    chol: Float[np.ndarray, "n n"]

    def extended(
        self, x: Float[np.ndarray, "k d"], noise: Float[np.ndarray, " k"]
    ) -> "ConditionedGP":
        """Return the process conditioned on values at further points `x` as well."""
        V = self.whitened(x)
        corner = np.linalg.cholesky(self.covariance(x, x) - V.T @ V + np.diag(noise))
        n, k = V.shape
        chol = np.zeros((n + k, n + k))
        chol[:n, :n], chol[n:, :n], chol[n:, n:] = self.chol, V.T, corner
        return replace(self, points=np.concatenate([self.points, x]), chol=chol)

    def rescaled(self, shift: float, scale: float) -> "ConditionedGP":
        """Return the process of `shift + scale · y`."""
        return replace(
            self,
            outputscale=self.outputscale * scale**2,
            mean=shift + scale * self.mean,
            chol=self.chol * scale,
        )

    def covariance(
        self, a: Float[np.ndarray, "m d"], b: Float[np.ndarray, "k d"]
    ) -> Float[np.ndarray, "m k"]:
        """Return the prior covariance `s² R(a, b)`."""
        return covariance(self.kernel, self.lengthscales, self.outputscale, a, b)

    def whitened(self, x: Float[np.ndarray, "m d"]) -> Float[np.ndarray, "n m"]:
        """Return `V = L⁻¹ k(points, x)`: posterior covariances are `k(x, x') − VᵀV'`."""
        return np.asarray(
            solve_triangular(
                self.chol, self.covariance(self.points, x), lower=True, check_finite=False
            )
        )

    def weights(self, V: Float[np.ndarray, "n m"]) -> Float[np.ndarray, "n m"]:
        """Return `L⁻ᵀ V`: `Vᵀ V'` is that transposed times `k(points, x')`."""
        return np.asarray(solve_triangular(self.chol, V, lower=True, trans="T", check_finite=False))

    def residual(self, values: Float[np.ndarray, "n *b"]) -> Float[np.ndarray, "n *b"]:
        """Return `L⁻¹ (y − c)`; the posterior mean at x is `c + Vᵀ` times it. Batched over `b`."""
        return np.asarray(
            solve_triangular(self.chol, values - self.mean, lower=True, check_finite=False)
        )

    def draw(
        self,
        x: Float[np.ndarray, "m d"],
        values: Float[np.ndarray, " n"],
        rng: np.random.Generator,
    ) -> Float[np.ndarray, " m"]:
        """Return one joint posterior sample at `x`, given the values at the points."""
        V = self.whitened(x)
        covariance = self.covariance(x, x) - V.T @ V
        eigenvalues, vectors = np.linalg.eigh(covariance)
        noise = vectors @ (np.sqrt(np.maximum(eigenvalues, 0.0)) * rng.standard_normal(len(x)))
        return np.asarray(self.mean + self.residual(values) @ V + noise)

    def variance(self, V: Float[np.ndarray, "n m"]) -> Float[np.ndarray, " m"]:
        """Return the posterior variances at the points whose whitened covariances are `V`."""
        return np.asarray(np.maximum(self.outputscale - np.einsum("nm,nm->m", V, V), 0.0))

"""Steps of Gauss and Newton within bounds, and Broyden's update of the Jacobian between them."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float

_MOVE = 3.0  # times its size, that a magnitude may move at once at the cost of one variance
_TINY = 1e-12


@dataclass(frozen=True)
class LeastSquares:
    """The squares |y - S δ|² of a change δ of magnitudes within bounds.

    Attributes:
        S: `W x R x p` what each magnitude changes, starts of windows projected out.
        y: `W x R` what is left, the same.
        theta: `p` magnitudes from which they change.
        low: `p` least values.
        high: `p` largest values.
        probe: `p` sizes that say something of each.
    """

    S: Float[np.ndarray, "W R p"]
    y: Float[np.ndarray, "W R"]
    theta: Float[np.ndarray, " p"]
    low: Float[np.ndarray, " p"]
    high: Float[np.ndarray, " p"]
    probe: Float[np.ndarray, " p"]

    def step(self, ridge: float, variance: float = 0.0) -> Float[np.ndarray, " p"]:
        """Return the Gauss-Newton step; magnitudes that it would push out of bounds stay.

        With a variance damped as Levenberg and Marquardt do, in units of the magnitudes: it
        minimises |y - S δ|² + variance Σ (δ / 3 size)². What acts in second order alone (a tilt out
        of the plane that a machine moves in) has a column next to nothing, which asks for moves far
        beyond what it holds for, and no share of such a step serves the others.

        Args:
            ridge: on unit columns.
            variance: of the squared residual; 0 for an undamped step.
        """
        scale, gram, g = self._normal
        move = _MOVE * np.maximum(np.abs(self.theta), np.abs(self.probe))
        G = gram + np.diag(ridge + variance / (move * scale) ** 2)
        theta, free = self.theta, np.ones(len(scale), bool)
        step = np.zeros(len(scale))
        for _ in range(len(scale)):
            step = np.zeros(len(scale))
            if not free.any():
                break
            step[free] = np.linalg.solve(G[np.ix_(free, free)], g[free]) / scale[free]
            down = (theta + step < self.low) & (theta <= self.low + _TINY)
            up = (theta + step > self.high) & (theta >= self.high - _TINY)
            bad = free & (down | up)
            if not bad.any():
                break
            free &= ~bad
        return np.nan_to_num(step)

    @cached_property
    def _normal(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Lengths of the columns, and the normal equations of unit columns, for any damping."""
        A = self.S.reshape(-1, self.S.shape[-1])
        scale = np.sqrt((A**2).sum(axis=0)) + _TINY
        A = A / scale
        return scale, A.T @ A, A.T @ self.y.ravel()

    def promised(self, step: Float[np.ndarray, " p"]) -> float:
        """Return how much smaller the squares are after a step: yᵀy - |y - S δ|²."""
        change = self.S @ step
        return float((change * (2.0 * self.y - change)).sum())


def broyden(
    S: Float[np.ndarray, "W R p"], moved: Float[np.ndarray, " p"], seen: Float[np.ndarray, "W R"]
) -> Float[np.ndarray, "W R p"]:
    """Return the Jacobian, changed least in units of its columns, that reproduces a step."""
    scaled = moved * (S**2).sum(axis=(0, 1))
    denominator = float(scaled @ moved)
    if denominator <= 0:
        return S
    return np.asarray(S + (seen - S @ moved)[..., None] * (scaled / denominator))

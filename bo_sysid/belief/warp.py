"""The scale on which Δ is modelled: a power of it, or its logarithm."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

ZERO = 1e-3  # Δ = 0 is taken as this share of the smallest positive Δ, to have a logarithm


@dataclass(frozen=True)
class Warp:
    """The increasing function `g(Δ) = ((Δ/u)^p − 1) / p`, or `log(Δ/u)` where p = 0.

    With u the geometric mean of the values at hand the volume that g takes up is the same for every
    p, so that likelihoods of the warped values can be compared between powers.

    Attributes:
        power: p, 0 for the logarithm.
        unit: u, in units of Δ.
        floor: Δ below it is taken for it.

    References:
        Box & Cox (1964), An analysis of transformations, equation 4.
    """

    power: float
    unit: float
    floor: float

    @classmethod
    def of(cls, deviations: Float[np.ndarray, " n"], power: float) -> "Warp":
        """Return the warp of given power for deviations that were checked."""
        positive = deviations[deviations > 0]
        floor = float(ZERO * positive.min()) if len(positive) else 1.0
        floor = max(floor, float(np.finfo(float).tiny))
        unit = float(np.exp(np.log(np.maximum(deviations, floor)).mean()))
        return cls(power, unit, floor)

    def __call__(self, deviations: Float[np.ndarray, "n *b"]) -> Float[np.ndarray, "n *b"]:
        """Return g(Δ)."""
        ratio = np.maximum(deviations, self.floor) / self.unit
        if self.power == 0:
            return np.asarray(np.log(ratio))
        return np.asarray((ratio**self.power - 1.0) / self.power)

    def inverse(self, values: Float[np.ndarray, "n *b"]) -> Float[np.ndarray, "n *b"]:
        """Return the Δ of values of g; 0 where no Δ has so low a value."""
        if self.power == 0:
            return np.asarray(self.unit * np.exp(values))
        return np.asarray(
            self.unit * np.maximum(1.0 + self.power * values, 0.0) ** (1.0 / self.power)
        )

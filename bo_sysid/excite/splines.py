"""Corrections of controls that no few tones can say: cubic B-splines with equal knots."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.interpolate import BSpline

from bo_sysid.excite.fourier import Series

_DEGREE = 3
_KNOTS = 8.0  # a second


@dataclass(frozen=True)
class Splines:
    """Controls u_a(t) = m_a + h_a (r_a + base_a(t) + w(t) Σ_k c_ak B_k(t)), w a series' fade.

    Attributes:
        series: gives middle, half width, rest, time and fade.
        base: `R x nu` distances of the controls to rest, in units of half widths.
        basis: `R x n` values of the splines.
    """

    series: Series
    base: Float[np.ndarray, "R nu"]
    basis: Float[np.ndarray, "R n"]

    @classmethod
    def on(cls, series: Series, controls: Float[np.ndarray, "R nu"]) -> "Splines":
        """Return corrections of some controls."""
        count = max(round(_KNOTS * series.seconds), _DEGREE + 1)
        inner = np.linspace(0, series.seconds, count - _DEGREE + 1)
        knots = np.concatenate([[0.0] * _DEGREE, inner, [series.seconds] * _DEGREE])
        basis = BSpline.design_matrix(series.time, knots, _DEGREE).toarray()
        return cls(series, series.unit(controls), basis)

    @property
    def size(self) -> int:
        """Number of coefficients."""
        return int(self.base.shape[1] * self.basis.shape[1])

    def unit(self, c: Float[np.ndarray, "K p"]) -> Float[np.ndarray, "K R nu"]:
        """Return the distances to rest of K rows of coefficients, in half widths, not clipped."""
        size = c.reshape(len(c), self.base.shape[1], self.basis.shape[1])
        added = self.basis @ np.swapaxes(size, 1, 2)
        return np.asarray(self.base + self.series.fade[:, None] * added)

    def controls(self, c: Float[np.ndarray, "K p"]) -> Float[np.ndarray, "K R nu"]:
        """Return the controls of K rows of coefficients, kept within their ranges."""
        return self.series.scaled(self.unit(c))

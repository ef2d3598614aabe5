"""The motion along which laws are evaluated, and a smooth deviation from it."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float
from numpy.polynomial import legendre

_DEGREE, _SAMPLES = 7, 3  # of the polynomial of a deviation; samples per degree, at least


@dataclass(frozen=True)
class Along:
    """The motion along which the model is linearised, as laws see it: `W x M` each."""

    qpos: Mapping[str, Float[np.ndarray, "W M"]]
    qvel: Mapping[str, Float[np.ndarray, "W M"]]
    ctrl: Mapping[str, Float[np.ndarray, "W M"]]
    signals: Mapping[str, Float[np.ndarray, "W M"]]
    time: Float[np.ndarray, "W M"]
    timestep: float
    act: Mapping[str, Float[np.ndarray, "W M"]]
    memory: dict[str, Any] = field(default_factory=dict)

    @property
    def anew(self) -> "Along":
        """The same with an empty memory, for another law."""
        return replace(self, memory={})


def smoothed(
    time: Float[np.ndarray, "W H"],
    values: Float[np.ndarray, "W H"],
    seen: Bool[np.ndarray, "W H"],
    at: Float[np.ndarray, "W M"],
) -> tuple[Float[np.ndarray, "W M"], Float[np.ndarray, "W M"]]:
    """Return a polynomial through the values that are seen in each window, and its rate.

    By least squares, of degree 7 or less, by the window with most samples. It is zero where a
    window has far fewer: what is not known to deviate does not.
    """
    count = seen.sum(axis=1, keepdims=True)
    degree = min(_DEGREE, int(count.max(initial=0)) // _SAMPLES)
    seen = seen & (count >= _SAMPLES * degree)
    length = max(float(time.max()), float(at.max()), 1e-9)
    basis = legendre.legvander(2 * time / length - 1, degree) * seen[..., None]
    weights = (np.linalg.pinv(basis) @ (values * seen)[..., None])[..., 0]
    rates = legendre.legder(weights, scl=2 / length, axis=1)
    z = 2 * at / length - 1

    def sums(w: Float[np.ndarray, "W k"]) -> Float[np.ndarray, "W M"]:
        return np.asarray((legendre.legvander(z, w.shape[1] - 1) @ w[..., None])[..., 0])

    return sums(weights), sums(rates)

"""Controls as finite Fourier series, faded in and out."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

FADE = 0.5  # [s] at both ends
_SPREAD = 4.0  # largest ratio of highest to lowest base frequency that is tried


@dataclass(frozen=True)
class Series:
    """The form of a trajectory of controls: u_a(t) = m_a + w(t) h_a Σ_k (A sin + B cos)(2π f_k t).

    Frequencies are those of all harmonics times one common stretch, which is optimised too.

    Attributes:
        middle: `nu` controls at rest.
        half: `nu` half widths of the controls' ranges.
        frequencies: `K` in [Hz].
        seconds: length.
        interval: time between two controls in [s].
    """

    middle: Float[np.ndarray, " nu"]
    half: Float[np.ndarray, " nu"]
    frequencies: Float[np.ndarray, " K"]
    seconds: float
    interval: float

    @property
    def size(self) -> int:
        """Number of coefficients: two for each actuator and frequency, and the stretch."""
        return 2 * len(self.half) * len(self.frequencies) + 1

    @property
    def time(self) -> Float[np.ndarray, " R"]:
        """Time of each row of controls, in [s]."""
        return np.arange(round(self.seconds / self.interval)) * self.interval

    def controls(self, x: Float[np.ndarray, " p"]) -> Float[np.ndarray, "R nu"]:
        """Return the controls of some coefficients, kept within their ranges."""
        t = self.time
        stretch = _SPREAD ** np.tanh(x[-1])
        phase = 2 * np.pi * stretch * self.frequencies * t[:, None]
        waves = np.concatenate([np.sin(phase), np.cos(phase)], axis=1)
        unit = waves @ x[:-1].reshape(len(self.half), -1).T
        fade = np.clip(np.minimum(t, self.seconds - t) / FADE, 0.0, 1.0)
        smooth = fade * fade * (3.0 - 2.0 * fade)
        return np.asarray(self.middle + self.half * np.clip(smooth[:, None] * unit, -1.0, 1.0))

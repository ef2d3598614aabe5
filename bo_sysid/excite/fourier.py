"""Controls as finite Fourier series, faded in and out."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

FADE = 0.5  # [s] at both ends
_UNBOUNDED = 1.0  # control range of an actuator that nothing limits


@dataclass(frozen=True)
class Series:
    """The form of controls: u_a(t) = m_a + h_a (r_a + w(t) Σ_k (A sin + B cos)(2π f_k t)).

    Coefficients are all A and B, actuator by actuator, and then K shifts that move the frequencies
    between their neighbours: f_k = f⁰_k r^tanh(shift), r the ratio of two base frequencies.

    Attributes:
        middle: `nu` middles of the controls' ranges.
        half: `nu` half widths of them.
        frequencies: `K` base frequencies in [Hz], in geometric progression.
        seconds: length.
        interval: time between two controls in [s].
        rest: `nu` distances r of the controls at rest from the middles, in units of half widths.
    """

    middle: Float[np.ndarray, " nu"]
    half: Float[np.ndarray, " nu"]
    frequencies: Float[np.ndarray, " K"]
    seconds: float
    interval: float
    rest: Float[np.ndarray, " nu"] | float = 0.0

    @property
    def waves(self) -> int:
        """Number of coefficients that scale the motion."""
        return 2 * len(self.half) * len(self.frequencies)

    @property
    def size(self) -> int:
        """Number of coefficients: two for each actuator and frequency, and the shifts."""
        return self.waves + len(self.frequencies)

    @property
    def at_rest(self) -> Float[np.ndarray, " nu"]:
        """Controls at rest, in their units."""
        return np.asarray(self.middle + self.half * self.rest)

    @property
    def time(self) -> Float[np.ndarray, " R"]:
        """Time of each row of controls, in [s]."""
        return np.arange(round(self.seconds / self.interval)) * self.interval

    @property
    def fade(self) -> Float[np.ndarray, " R"]:
        """What every row is multiplied by: from 0 to 1 and back, smooth at both ends of a ramp."""
        t = self.time
        ramp = np.clip(np.minimum(t, self.seconds - t) / FADE, 0.0, 1.0)
        return np.asarray(ramp * ramp * (3.0 - 2.0 * ramp))

    def controls(self, x: Float[np.ndarray, "K p"]) -> Float[np.ndarray, "K R nu"]:
        """Return the controls of K rows of coefficients, kept within their ranges."""
        count, tones = len(x), len(self.frequencies)
        ratio = self.frequencies[1] / self.frequencies[0] if tones > 1 else 2.0
        frequency = self.frequencies * ratio ** np.tanh(x[:, self.waves :])
        phase = 2 * np.pi * self.time[:, None] * frequency[:, None]
        waves = np.concatenate([np.sin(phase), np.cos(phase)], axis=2)
        size = x[:, : self.waves].reshape(count, len(self.half), 2 * tones)
        return self.scaled(self.fade[:, None] * (waves @ np.swapaxes(size, 1, 2)))

    def scaled(self, unit: Float[np.ndarray, "*K R nu"]) -> Float[np.ndarray, "*K R nu"]:
        """Return controls in their units from their distances to rest in units of half widths.

        They are clipped to their ranges.
        """
        return np.asarray(self.middle + self.half * np.clip(self.rest + unit, -1.0, 1.0))

    def unit(self, controls: Float[np.ndarray, "*K R nu"]) -> Float[np.ndarray, "*K R nu"]:
        """Return the distances of controls to rest in units of half widths."""
        return np.asarray((controls - self.middle) / self.half - self.rest)


def ranges(
    low: Float[np.ndarray, " nu"], high: Float[np.ndarray, " nu"]
) -> tuple[Float[np.ndarray, " nu"], Float[np.ndarray, " nu"]]:
    """Return middle and half width of each control's range; ±1 where it has no ends."""
    bounded = np.isfinite(low) & np.isfinite(high)
    low, high = np.where(bounded, low, -_UNBOUNDED), np.where(bounded, high, _UNBOUNDED)
    return 0.5 * (low + high), 0.5 * (high - low)

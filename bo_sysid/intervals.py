"""How sure numbers are, and how that is said."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.stats import beta
from scipy.stats import t as student

_OFF_CENTRE = 0.05  # of half an interval, by which its value lies beside the middle
_UNSPOKEN = ("relative", "fraction", "fraction of the load torque", "coefficient", "–")
"""Units of pure numbers, which sentences say otherwise."""


def half_width(error: ArrayLike, count: ArrayLike) -> np.ndarray:
    """Return half of the 95 % interval of means, by Student's t.

    Args:
        error: their standard errors.
        count: how many independent samples each is the mean of; infinitely many where unknown.
    """
    freedom = np.maximum(np.asarray(count, float) - 1, 1)
    return np.asarray(student.ppf(0.975, freedom) * error)


def upper_bound(count: int, of: int, level: float = 0.95) -> float:
    """Return the exact one-sided upper bound of a rate; 1 where nothing was counted."""
    return 1.0 if count >= of else float(beta.ppf(level, count + 1, of - count))


@dataclass(frozen=True)
class Quantity:
    """A number with its 95 % interval."""

    value: float
    unit: str
    interval: tuple[float, float]


def amount(quantity: Quantity) -> str:
    """Return "0.151 ± 0.002 N m": the uncertainty with one digit, two where it begins with 1.

    An interval that ends at a bound is said by its ends: "0.001 (0 to 0.004) s".
    """
    low, high = quantity.interval
    half = 0.5 * (high - low)
    spoken_unit = "" if quantity.unit in _UNSPOKEN else f" {quantity.unit}"
    if half <= 0 or not np.isfinite(half):
        return f"{quantity.value:.4g}{spoken_unit}"
    exponent = int(np.floor(np.log10(half)))
    digits = -exponent + (1 if half / 10.0**exponent < 2 else 0)
    factor, sign = 1.0, ""
    if quantity.unit == "relative":
        factor, sign, spoken_unit, digits = 100.0, "+", " %", digits - 2

    def said(value: float, sign: str = "") -> str:
        return f"{_rounded(factor * value, digits) + 0.0:{sign}.{max(digits, 0)}f}"

    if abs(quantity.value - 0.5 * (low + high)) > _OFF_CENTRE * half:
        return f"{said(quantity.value, sign)} ({said(low)} to {said(high)}){spoken_unit}"
    return f"{said(quantity.value, sign)} ± {said(half)}{spoken_unit}"


def _rounded(value: float, digits: int) -> float:
    """Return a number to so many digits behind the point, before it where they are negative."""
    return round(value, digits) if digits < 0 else value

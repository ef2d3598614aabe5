"""How sure a mean of a few samples is."""

import numpy as np
from numpy.typing import ArrayLike
from scipy.stats import t as student


def half_width(error: ArrayLike, count: ArrayLike) -> np.ndarray:
    """Return half of the 95 % interval of means, by Student's t.

    Args:
        error: their standard errors.
        count: how many independent samples each is the mean of; infinitely many where unknown.
    """
    freedom = np.maximum(np.asarray(count, float) - 1, 1)
    return np.asarray(student.ppf(0.975, freedom) * error)

"""From rows of B to the cube in which distances are measured, categories included.

A column without an order is replaced by one indicator column a category, scaled by 1/√2: any two
categories are then 1 apart where their length scales are equal, whatever their codes. With a length
scale for each indicator (ℓ_a, ℓ_b) the squared distance of categories a and b is (ℓ_a⁻² + ℓ_b⁻²)/2:
a category can be unlike all others. It is a Euclidean embedding, so that every stationary kernel on
it stays positive definite, and a product of a kernel of the ordered columns and one of the category
for the squared exponential.

References:
    Garrido-Merchán & Hernández-Lobato (2020), Dealing with categorical and integer-valued variables
    in Bayesian optimization with Gaussian processes.
"""

import numpy as np
from jaxtyping import Float

from bo_sysid.arrays import Categories, Points

INDICATOR_SCALE = 1.0 / np.sqrt(2.0)  # puts any two categories at distance 1


def encoded(
    points: Points, bounds: Float[np.ndarray, "2 d"], categories: Categories
) -> Float[np.ndarray, "N D"]:
    """Return points in the unit cube, the indicators of categories last.

    Args:
        points: `N x d`.
        bounds: lower and upper bounds of the ordered columns.
        categories: values of each column without an order, by column.

    Raises:
        ValueError: such a column has a value that is none of its categories.
    """
    low, high = bounds
    scaled = np.asarray((points - low) / (high - low))
    if not categories:
        return scaled
    ordered = [k for k in range(points.shape[1]) if k not in categories]
    parts = [scaled[:, ordered]]
    for column, values in categories.items():
        is_value = points[:, [column]] == values
        if not is_value.any(axis=1).all():
            wrong = points[~is_value.any(axis=1), column][0]
            raise ValueError(f"column {column}: {wrong} is none of the categories {values}")
        parts.append(INDICATOR_SCALE * is_value)
    return np.concatenate(parts, axis=1)

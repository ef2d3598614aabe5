"""The bins into which pictures of a belief put the values of a parameter."""

import numpy as np
from jaxtyping import Float

_BARS = 101
_GRID = 500  # levels from which on values are no grid, and bins are even
_EVEN = 40  # bins of these
_ALONE = 0.1  # of a value that is the only one, between the edges about it


def bin_edges(values: Float[np.ndarray, " n"]) -> Float[np.ndarray, " e"]:
    """Return the edges of bins, in the unit of the values.

    They lie between the levels of a grid, with as many levels in each bin (the last may have
    fewer), so that a flat belief looks flat.
    """
    levels = np.unique(values)
    if len(levels) == 1:
        half = 0.5 * _ALONE * (abs(float(levels[0])) or 1.0)
        return np.array([levels[0] - half, levels[0] + half])
    if len(levels) > _GRID:
        return np.linspace(levels[0], levels[-1], _EVEN + 1)
    between = (levels[:-1] + levels[1:]) / 2
    ends = levels[0] - (between[0] - levels[0]), levels[-1] + (levels[-1] - between[-1])
    each = -(-len(levels) // _BARS)
    return np.concatenate([[ends[0]], between[each - 1 :: each], [ends[1]]])

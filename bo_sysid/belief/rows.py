"""Identity of candidates: which rows of a matrix are bit-for-bit rows of another.

A candidate is its row of B. Points that come back from elsewhere (BoTorch hands `forward` copies of
the rows it was given) are found again by exact equality, never by distance.
"""

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float, Int


def _as_bytes(points: Float[np.ndarray, "N d"]) -> np.ndarray:
    """Return each row as one scalar of its bytes, 0.0 for -0.0, which numpy sorts and compares."""
    rows = np.ascontiguousarray(points + 0.0)
    return rows.view(np.dtype((np.void, rows.itemsize * rows.shape[1])))[:, 0]


@dataclass(frozen=True)
class RowIndex:
    """Looks up rows of a fixed matrix by exact equality.

    Attributes:
        points: `N x d` rows, in float64 (float32 rows are represented exactly).
    """

    points: Float[np.ndarray, "N d"]
    _sorted: np.ndarray = field(repr=False)
    _order: Int[np.ndarray, " N"] = field(repr=False)

    @classmethod
    def of(cls, points: Float[np.ndarray, "N d"]) -> "RowIndex":
        """Build the index of `points`."""
        points = np.asarray(points, dtype=np.float64)
        rows = _as_bytes(points)
        order = np.argsort(rows, kind="stable")
        return cls(points, rows[order], order)

    def find(self, queries: Float[np.ndarray, "m d"]) -> Int[np.ndarray, " m"]:
        """Return the first row equal to each query, -1 where there is none."""
        queries = np.asarray(queries, dtype=np.float64)
        place = np.searchsorted(self._sorted, _as_bytes(queries), side="left")
        rows = self._order[np.minimum(place, len(self._order) - 1)]
        known = (self.points[rows] == queries).all(axis=1)
        return np.where(known, rows, -1)

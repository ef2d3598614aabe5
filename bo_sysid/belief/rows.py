"""Identity of candidates: which rows of a matrix are bit-for-bit rows of another.

A candidate is its row of B. Points that come back from elsewhere (BoTorch hands `forward` copies of
the rows it was given) are found again by exact equality, never by distance.
"""

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float, Int, UInt64

_MIX = np.uint64(0x9E3779B97F4A7C15)  # 2^64 / golden ratio: spreads neighbouring bit patterns


def _hash_rows(points: Float[np.ndarray, "N d"]) -> UInt64[np.ndarray, " N"]:
    """Return one 64-bit hash a row; equal rows have equal hashes (0.0 and -0.0 are equal)."""
    bits = np.ascontiguousarray(points + 0.0).view(np.uint64)
    code = np.zeros(len(points), dtype=np.uint64)
    for column in bits.T:
        code = (code ^ column) * _MIX
        code ^= code >> np.uint64(29)
    return code


@dataclass(frozen=True)
class RowIndex:
    """Looks up rows of a fixed matrix by exact equality.

    Attributes:
        points: `N x d` rows, in float64 (float32 rows are represented exactly).
    """

    points: Float[np.ndarray, "N d"]
    _codes: UInt64[np.ndarray, " N"] = field(repr=False)
    _order: Int[np.ndarray, " N"] = field(repr=False)

    @classmethod
    def of(cls, points: Float[np.ndarray, "N d"]) -> "RowIndex":
        """Build the index of `points`."""
        points = np.asarray(points, dtype=np.float64)
        codes = _hash_rows(points)
        order = np.argsort(codes, kind="stable")
        return cls(points, codes[order], order)

    def find(self, queries: Float[np.ndarray, "m d"]) -> Int[np.ndarray, " m"]:
        """Return the first row equal to each query, -1 where there is none."""
        queries = np.asarray(queries, dtype=np.float64)
        codes = _hash_rows(queries)
        place = np.searchsorted(self._codes, codes, side="left")
        rows = self._order[np.minimum(place, len(self._order) - 1)]
        known = (self.points[rows] == queries).all(axis=1)
        return np.where(known, rows, -1)

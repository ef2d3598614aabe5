"""What a regression with ridges predicts in blocks that it was not fitted to."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from bo_sysid.diagnosis.fit import by_block

RIDGES = (1e-5, 1e-3, 3e-2, 0.3, 2.0)
"""On columns of length one at most; what is left out says which."""


@dataclass(frozen=True)
class LeftOut:
    """The normal equations of a regression, block by block.

    Attributes:
        G: `B x k x k` inner products of the columns in each block.
        b: `B x k` those of the columns with what is to be predicted.
    """

    G: Float[np.ndarray, "B k k"]
    b: Float[np.ndarray, "B k"]

    @classmethod
    def of(
        cls,
        A: Float[np.ndarray, "W R k"],
        y: Float[np.ndarray, "W R"],
        block: Int[np.ndarray, " W"],
    ) -> "LeftOut":
        """Return the normal equations of `A x = y`, by the block of each window."""
        G, b, _ = by_block(A, y, block)
        return cls(G, b)

    def gain(
        self, law: Sequence[int], named: Sequence[int], ridge_of_named: float = np.inf
    ) -> tuple[float, float]:
        """Return by how much squared residuals fall in left-out blocks, and with which ridge.

        Args:
            law: the columns on which the ridges are tried.
            named: columns beside them.
            ridge_of_named: the most that is laid on those.
        """
        own = [*law, *named]
        G, b = self.G[np.ix_(range(len(self.G)), own, own)], self.b[:, own]
        whole, sum_b = G.sum(axis=0), b.sum(axis=0)
        best, at = -np.inf, RIDGES[0]
        for ridge in RIDGES:
            penalty = np.full(len(own), min(ridge, ridge_of_named))
            penalty[: len(law)] = ridge
            x = np.linalg.solve(whole - G + np.diag(penalty), (sum_b - b)[..., None])[..., 0]
            gain = 2 * (x * b).sum() - np.einsum("bi,bij,bj->", x, G, x)
            if gain > best:
                best, at = float(gain), ridge
        return best, at

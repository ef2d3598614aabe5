"""What a regression with ridges predicts in blocks that it was not fitted to."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

RIDGES = (1e-5, 1e-3, 3e-2, 0.3, 2.0)
"""On columns of length one at most; what is left out says which."""
_SEED = 0  # of the signs


@dataclass(frozen=True)
class LeftOut:
    """The normal equations of a regression, block by block.

    Attributes:
        G: `B x k x k` inner products of the columns in each block.
        b: `B x k x s` inner products of the columns with the target, first; then with the target
            after random sign flips of its windows, which leave nothing to predict.
    """

    G: Float[np.ndarray, "B k k"]
    b: Float[np.ndarray, "B k s"]

    @classmethod
    def of(
        cls,
        A: Float[np.ndarray, "W R k"],
        y: Float[np.ndarray, "W R"],
        block: Int[np.ndarray, " W"],
        draws: int = 0,
    ) -> "LeftOut":
        """Return the normal equations of `A x = y`, by the block of each window.

        Args:
            A: columns.
            y: what is to be predicted.
            block: number of each window's block.
            draws: s - 1 draws of signs.
        """
        signs = np.ones((len(y), 1 + draws))
        signs[:, 1:] = np.random.default_rng(_SEED).choice([-1.0, 1.0], (len(y), draws))
        count, k = int(block.max()) + 1, A.shape[-1]
        G, b = np.zeros((count, k, k)), np.zeros((count, k, 1 + draws))
        for i in range(count):
            own = block == i
            flat = A[own].reshape(-1, k)
            G[i] = flat.T @ flat
            b[i] = np.einsum("wrk,wr->wk", A[own], y[own]).T @ signs[own]
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
        gains = self._gains(law, named, ridge_of_named)[:, 0]
        best = int(gains.argmax())
        return float(gains[best]), RIDGES[best]

    def against_chance(
        self, law: Sequence[int], named: Sequence[int]
    ) -> tuple[float, Float[np.ndarray, " draws"]]:
        """Return the same gain, and that of each draw of signs: what a law gains by chance.

        A force that follows a law pushes alike wherever the law says so; disturbances, and noise in
        recorded commands, do not know the sign of a window.
        """
        gains = self._gains(law, named, np.inf).max(axis=0)
        return float(gains[0]), gains[1:]

    def _gains(
        self, law: Sequence[int], named: Sequence[int], ridge_of_named: float
    ) -> Float[np.ndarray, "r s"]:
        """Return by how much squared residuals fall in left-out blocks, by ridge and by draw."""
        own = [*law, *named]
        G, b = self.G[np.ix_(range(len(self.G)), own, own)], self.b[:, own]
        whole, sum_b = G.sum(axis=0), b.sum(axis=0)
        found = []
        for ridge in RIDGES:
            penalty = np.full(len(own), min(ridge, ridge_of_named))
            penalty[: len(law)] = ridge
            x = np.linalg.solve(whole - G + np.diag(penalty), sum_b - b)
            found.append((x * (2 * b - G @ x)).sum(axis=(0, 1)))
        return np.array(found)

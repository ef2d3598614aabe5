"""Acquisitions over a discrete set: values by row, and the choice of the best row."""

from collections.abc import Callable
from typing import TypeAlias

import numpy as np
import torch
from botorch.acquisition import AcquisitionFunction
from botorch.models.model import Model
from botorch.optim import optimize_acqf_discrete
from botorch.utils.transforms import t_batch_mode_transform
from jaxtyping import Float, Int
from torch import Tensor

from bo_sysid.acquisition.context import SelectionContext
from bo_sysid.arrays import Points, Rows
from bo_sysid.belief.rows import RowIndex

Values: TypeAlias = Float[np.ndarray, " N"]

FANTASIES = 4  # outcomes of pending evaluations that are averaged over


class RowAcquisition(AcquisitionFunction):
    """An acquisition whose values at all rows of B are known when it is built.

    `forward` looks rows up by exact equality, so the points it is given must be rows of the
    candidates, not the result of a transform. Pending rows have the value -inf.
    """

    def __init__(
        self,
        candidates: Tensor,
        values: Tensor,
        model: Model | None = None,
        values_given_pending: Callable[[Rows], Tensor] | None = None,
    ) -> None:
        """Keep the table.

        Args:
            candidates: `N x d`, the set B.
            values: `N` values of the acquisition.
            model: the model behind the values, where there is one.
            values_given_pending: returns the `N` values while rows of B are pending; by default
                `values`.
        """
        super().__init__(model=model)
        self.register_buffer("candidates", candidates)
        self.register_buffer("values", values.to(candidates))
        self.register_buffer("_present", self.values)
        self._index, self._indexed = self._indexed_rows(), self.candidates.dtype
        self._values_given_pending = values_given_pending
        self.set_X_pending(None)

    def set_X_pending(self, X_pending: Tensor | None = None) -> None:  # noqa: N802 - BoTorch's name
        """Take note of points `m x d` that are being evaluated; None for none."""
        super().set_X_pending(X_pending)
        self._present = self.values
        if self.X_pending is None:
            return
        rows = self.rows(self.X_pending)
        if self._values_given_pending is not None:
            self._present = self._values_given_pending(rows.cpu().numpy()).to(self.values)
        self._present = self._present.index_fill(0, rows, -torch.inf)

    def rows(self, X: Tensor) -> Tensor:
        """Return the rows of B that the points `... x d` are.

        Raises:
            ValueError: a point is not a row of B.
        """
        if self.candidates.dtype != self._indexed:  # the module was cast, and its rows with it
            self._index, self._indexed = self._indexed_rows(), self.candidates.dtype
        points = X.detach().cpu().double().numpy().reshape(-1, X.shape[-1])
        found = self._index.find(points)
        if (found < 0).any():
            raise ValueError(
                f"point {points[found < 0][0].tolist()} is not a candidate; candidates are looked "
                "up by exact equality and must not pass through a transform"
            )
        return torch.as_tensor(found, device=X.device).reshape(X.shape[:-1])

    def _indexed_rows(self) -> RowIndex:
        return RowIndex.of(self.candidates.detach().cpu().double().numpy())

    @t_batch_mode_transform(expected_q=1, assert_output_shape=False)  # type: ignore[untyped-decorator]
    def forward(self, X: Tensor) -> Tensor:
        """Return the values of rows of B: `b x 1 x d` → `b`.

        Raises:
            ValueError: a point is no row of B.
        """
        found: Tensor = self._present[self.rows(X).squeeze(-1)]
        return found


def fantasised(
    context: SelectionContext, table: Callable[[SelectionContext], Values]
) -> Callable[[Rows], Tensor]:
    """Return what gives the table while rows are pending: its mean over what they may turn out."""

    def values(rows: Rows) -> Tensor:
        tables = [table(context.after(rows, seed)) for seed in range(FANTASIES)]
        return torch.tensor(np.mean(tables, axis=0))

    return values


def from_table(
    context: SelectionContext, table: Callable[[SelectionContext], Values]
) -> RowAcquisition:
    """Return the acquisition whose values at all rows follow from the context."""
    values = torch.tensor(table(context))
    return RowAcquisition(context.choices, values, values_given_pending=fantasised(context, table))


def pick(acquisition: AcquisitionFunction, candidates: Points, excluded: Rows) -> int:
    """Return the row with the largest value among those that are not excluded.

    Args:
        acquisition: maps `b x 1 x d` to `b`.
        candidates: `N x d`, the set B.
        excluded: rows that must not be picked (the evaluated ones); rows equal to them are not
            picked either.

    Raises:
        ValueError: every candidate is excluded.
    """
    return int(pick_batch(acquisition, candidates, excluded, 1)[0])


def pick_batch(
    acquisition: AcquisitionFunction, candidates: Points, excluded: Rows, q: int
) -> Int[np.ndarray, " q"]:
    """Return `q` different rows, each chosen with those before it pending; fewer if B has fewer.

    Args:
        acquisition: maps `b x 1 x d` to `b`.
        candidates: `N x d`, the set B.
        excluded: as in `pick`.
        q: how many.

    Returns:
        The rows, the first choice first.

    Raises:
        ValueError: every candidate is excluded.
    """
    candidates = np.asarray(candidates, dtype=float)
    index = RowIndex.of(candidates)
    first = index.find(candidates)
    excluded = np.asarray(excluded, dtype=np.intp)
    free = np.flatnonzero(~np.isin(first, first[excluded]))
    free = free[first[free] == free]  # one of several equal rows is enough
    if not len(free):
        raise ValueError("every candidate has been evaluated: there is nothing left to pick")
    chosen, _ = optimize_acqf_discrete(
        acquisition, q=min(q, len(free)), choices=torch.tensor(candidates[free])
    )
    return index.find(chosen.numpy())

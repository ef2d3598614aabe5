"""Candidates that fill the box evenly: those nearest to the points of a Sobol sequence."""

import numpy as np
import torch
from scipy.stats import qmc
from torch import Tensor

from bo_sysid.acquisition.context import SelectionContext
from bo_sysid.acquisition.rows import RowAcquisition
from bo_sysid.arrays import Rows


def build(context: SelectionContext) -> RowAcquisition:
    """Return minus the distance, in the unit cube, to the next point of the sequence.

    The sequence is one for the whole search; its k-th point is used when k candidates have been
    evaluated or are pending.
    """
    low, high = context.surrogate.bounds
    x = (context.candidates - low) / (high - low)

    def nearness(used: int) -> Tensor:
        sequence = qmc.Sobol(x.shape[1], rng=np.random.default_rng(context.seed))
        if used:
            sequence.fast_forward(used)
        return -torch.tensor(np.linalg.norm(x - sequence.random(1), axis=1))

    def pending(rows: Rows) -> Tensor:
        return nearness(len(context.evaluated) + len(rows))

    return RowAcquisition(
        context.choices, nearness(len(context.evaluated)), values_given_pending=pending
    )

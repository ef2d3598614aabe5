"""Candidates that fill the box evenly: those nearest to the points of a Sobol sequence."""

import numpy as np
import torch
from scipy.stats import qmc

from bo_sysid.acquisition.context import SelectionContext
from bo_sysid.acquisition.rows import RowAcquisition


def build(context: SelectionContext) -> RowAcquisition:
    """Return minus the distance, in the unit cube, to the next point of the sequence.

    The sequence is one for the whole search; its k-th point is used when k candidates have been
    evaluated.
    """
    x = context.surrogate.unit(context.candidates)
    sequence = qmc.Sobol(x.shape[1], rng=np.random.default_rng(context.seed))
    if len(context.evaluated):
        sequence.fast_forward(len(context.evaluated))
    target = sequence.random(1)
    return RowAcquisition(context.choices, -torch.tensor(np.linalg.norm(x - target, axis=1)))

"""The candidate whose expected log Δ is least, `α(β) = −E[log Δ(β)]`."""

import torch

from bo_sysid.acquisition.context import SelectionContext
from bo_sysid.acquisition.rows import RowAcquisition


def build(context: SelectionContext) -> RowAcquisition:
    """Return the acquisition for the surrogate of the context."""
    mean, _ = context.surrogate.moments(context.candidates)
    return RowAcquisition(context.choices, -torch.tensor(mean))

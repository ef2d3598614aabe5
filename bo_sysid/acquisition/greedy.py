"""Greedy choice: the candidate that is most probably the arg-min, `α(β) = P(β)`."""

import torch

from bo_sysid.acquisition.context import SelectionContext
from bo_sysid.acquisition.rows import RowAcquisition


def build(context: SelectionContext) -> RowAcquisition:
    """Return the acquisition for the belief of the context."""
    return RowAcquisition(context.choices, torch.tensor(context.belief.probabilities))

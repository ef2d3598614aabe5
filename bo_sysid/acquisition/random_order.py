"""Candidates in random order: what any rule must beat."""

import torch

from bo_sysid.acquisition.context import SelectionContext
from bo_sysid.acquisition.rows import RowAcquisition


def build(context: SelectionContext) -> RowAcquisition:
    """Return an acquisition with a random value for each candidate."""
    return RowAcquisition(
        context.choices, torch.tensor(context.generator().random(len(context.candidates)))
    )

"""The candidate whose expected Δ is least, `α(β) = −E[g(Δ(β))]`, on the surrogate's scale g."""

import numpy as np

from bo_sysid.acquisition.context import SelectionContext
from bo_sysid.acquisition.rows import RowAcquisition, Values, from_table


def table(context: SelectionContext) -> Values:
    """Return minus the mean over the ensemble."""
    mean, _ = context.moments()
    return np.asarray(-context.surrogate.weights @ mean)


def build(context: SelectionContext) -> RowAcquisition:
    """Return the acquisition for the surrogate of the context."""
    return from_table(context, table)

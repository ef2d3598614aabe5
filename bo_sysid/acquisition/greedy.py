"""Greedy choice: the candidate that is most probably the arg-min, `α(β) = P(β)`."""

from bo_sysid.acquisition.context import SelectionContext
from bo_sysid.acquisition.rows import RowAcquisition, Values, from_table


def table(context: SelectionContext) -> Values:
    """Return P of each candidate."""
    return context.belief.probabilities


def build(context: SelectionContext) -> RowAcquisition:
    """Return the acquisition for the belief of the context."""
    return from_table(context, table)

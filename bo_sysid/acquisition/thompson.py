"""Thompson sampling: the arg-min of one joint posterior sample of Δ over B.

References:
    Thompson (1933), On the likelihood that one unknown probability exceeds another in view of the
    evidence of two samples.
"""

import numpy as np

from bo_sysid.acquisition.context import SelectionContext
from bo_sysid.acquisition.rows import RowAcquisition, Values, from_table
from bo_sysid.belief.argmin import argmin_posteriors


def table(context: SelectionContext) -> Values:
    """Return minus one joint sample, of a member drawn by its weight.

    Candidates that cannot be the arg-min are not sampled; they rank below all others.
    """
    rng = context.generator()
    surrogate = context.surrogate
    drawn = int(rng.choice(len(surrogate.members), p=surrogate.weights))
    posterior = next(argmin_posteriors(surrogate.only(drawn), context.candidates, context.seed))
    rows = np.append(posterior.rows, posterior.incumbents)
    known = np.full(len(posterior.incumbents), posterior.floor)
    noise = rng.standard_normal(len(posterior.factor)) @ posterior.factor
    sample = np.append(posterior.mean + noise, known)
    values = np.full(len(context.candidates), -sample.max() - 1.0)
    values[rows] = -sample
    return values


def build(context: SelectionContext) -> RowAcquisition:
    """Return the acquisition for the surrogate of the context."""
    return from_table(context, table)

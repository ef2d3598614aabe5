"""Knowledge gradient over a discrete set: the expected decrease of the least posterior mean.

    α(β) = min_b μ(b) − E_z[ min_b ( μ(b) + z Cov(b, β)/σ(β) ) ],    z ~ N(0, 1)

BoTorch's `qKnowledgeGradient` is a one-shot acquisition, which cannot be optimised over a discrete
set; here all pairs (b, β) are computed at once.

References:
    Frazier, Powell & Dayanik (2009), The knowledge-gradient policy for correlated normal beliefs.
"""

import numpy as np
from jaxtyping import Float, Int
from scipy.special import ndtri

from bo_sysid.acquisition.context import SelectionContext
from bo_sysid.acquisition.rows import RowAcquisition, Values, from_table
from bo_sysid.belief.argmin import argmin_posteriors
from bo_sysid.belief.joint import ArgminPosterior

NODES = 32  # equally probable values of z; the least mean has kinks in z
MOST = 2_000  # candidates of a member's posterior that are considered, by least mean − deviation


def table(context: SelectionContext) -> Values:
    """Return the expected decrease of the least mean, averaged over the ensemble."""
    surrogate = context.surrogate
    values = np.zeros(len(context.candidates))
    posteriors = argmin_posteriors(surrogate, context.candidates, context.seed)
    for weight, posterior in zip(surrogate.weights, posteriors, strict=True):
        rows, decrease = expected_decrease(posterior)
        values[rows] += weight * surrogate.scale * decrease
    return values


def expected_decrease(
    posterior: ArgminPosterior,
) -> tuple[Int[np.ndarray, " k"], Float[np.ndarray, " k"]]:
    """Return rows of B and by how much evaluating each lowers one member's expected least mean."""
    std = np.sqrt(np.einsum("rs,rs->s", posterior.factor, posterior.factor))
    kept = np.sort(np.argsort(posterior.mean - std, kind="stable")[:MOST])
    factor, mean = posterior.factor[:, kept], posterior.mean[kept]
    # column β: change of the means per unit of z; nothing follows from what is known already
    slopes = np.divide(
        factor.T @ factor, std[kept], out=np.zeros((len(kept),) * 2), where=std[kept] > 0
    )
    expected = np.zeros(len(kept))
    for z in ndtri((np.arange(NODES) + 0.5) / NODES):
        lowest = (mean[:, None] + z * slopes).min(axis=0, initial=np.inf)
        expected += np.minimum(lowest, posterior.floor) / NODES
    now = min(float(mean.min(initial=np.inf)), posterior.floor)
    return posterior.rows[kept], now - expected


def build(context: SelectionContext) -> RowAcquisition:
    """Return the acquisition for the surrogate of the context."""
    return from_table(context, table)

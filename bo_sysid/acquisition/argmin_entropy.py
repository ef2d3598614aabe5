"""The contribution of a candidate to the entropy of the arg-min distribution.

    α(β) = −P(β) log P(β),    P(β) = Pr[β = argmin_b Δ(b)]

References:
    Zhu, Kimmel, Bekris & Boularias (2018), Fast model identification via physics engines for
    data-efficient policy search (greedy entropy search).
    Hennig & Schuler (2012), Entropy search for information-efficient global optimization.
"""

from collections.abc import Callable

import torch
from botorch.models.model import Model
from botorch.sampling.base import MCSampler
from botorch.sampling.get_sampler import get_sampler
from scipy.special import entr
from torch import Tensor

from bo_sysid.acquisition.context import SelectionContext
from bo_sysid.acquisition.rows import RowAcquisition, Values, fantasised
from bo_sysid.arrays import Rows

_SAMPLES = 1024  # joint samples where no sampler is given


class ArgminEntropyContribution(RowAcquisition):
    """`−P log P` over a discrete set, in nats.

    P is a property of the whole set, so it is computed once, here, and `forward` looks it up.
    Pending rows have the value -inf: their contribution will be resolved by their evaluation. What
    they do to the contributions of the others is given by `values_given_pending`.
    """

    def __init__(
        self,
        model: Model | None,
        candidates: Tensor,
        probabilities: Tensor | None = None,
        sampler: MCSampler | None = None,
        values_given_pending: Callable[[Rows], Tensor] | None = None,
    ) -> None:
        """Compute the values.

        Args:
            model: of the function whose arg-min is sought; needed without `probabilities`.
            candidates: `N x d`, the set B.
            probabilities: `N` values of P; by default counted in joint samples of the model's
                posterior over all candidates at once.
            sampler: draws them; by default 1 024 of BoTorch's `get_sampler`, with a fixed seed.
            values_given_pending: returns the `N` values while rows of B are pending; by default
                they do not change.
        """
        if probabilities is None:
            if model is None:
                raise ValueError("either a model or probabilities are needed")
            probabilities = _count_minima(model, candidates, sampler)
        elif probabilities.shape != candidates.shape[:1]:
            raise ValueError(
                f"probabilities {tuple(probabilities.shape)} do not belong to candidates "
                f"{tuple(candidates.shape)}"
            )
        values = -torch.xlogy(probabilities, probabilities)
        super().__init__(candidates, values, model, values_given_pending)


def _count_minima(model: Model, candidates: Tensor, sampler: MCSampler | None) -> Tensor:
    """Return how often each candidate is the minimum of a joint sample, ties split."""
    with torch.no_grad():
        posterior = model.posterior(candidates)
        sampler = sampler or get_sampler(posterior, torch.Size([_SAMPLES]), seed=0)
        draws = sampler(posterior).squeeze(-1)
    lowest = (draws == draws.min(dim=-1, keepdim=True).values).to(candidates)
    shares: Tensor = lowest / lowest.sum(dim=-1, keepdim=True)
    return shares.mean(dim=0)


def table(context: SelectionContext) -> Values:
    """Return `−P log P` of each candidate."""
    P = context.belief.probabilities
    return entr(P)


def build(context: SelectionContext) -> ArgminEntropyContribution:
    """Return the acquisition for the belief of the context."""
    return ArgminEntropyContribution(
        None,
        context.choices,
        torch.tensor(context.belief.probabilities),
        values_given_pending=fantasised(context, table),
    )

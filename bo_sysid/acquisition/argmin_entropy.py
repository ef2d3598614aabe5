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
from scipy.special import entr
from torch import Tensor

from bo_sysid.acquisition.context import SelectionContext
from bo_sysid.acquisition.rows import RowAcquisition, Values, fantasised
from bo_sysid.arrays import Rows


class ArgminEntropyContribution(RowAcquisition):
    """`−P log P` over a discrete set, in nats.

    P is a property of the whole set, so it is computed once, here, and `forward` looks it up.
    Pending rows have the value -inf: their contribution will be resolved by their evaluation. What
    they do to the contributions of the others is told by `pending`.
    """

    def __init__(
        self,
        model: Model | None,
        candidates: Tensor,
        probabilities: Tensor | None = None,
        samples: int = 1024,
        pending: Callable[[Rows], Tensor] | None = None,
    ) -> None:
        """Compute the values.

        Args:
            model: of the function whose arg-min is sought; needed without `probabilities`.
            candidates: `N x d`, the set B.
            probabilities: `N` values of P; by default counted in joint samples of the model's
                posterior over all candidates at once.
            samples: number of joint samples.
            pending: returns the `N` values while rows of B are pending; by default they do not
                change.
        """
        if probabilities is None:
            if model is None:
                raise ValueError("either a model or probabilities are needed")
            probabilities = _count_minima(model, candidates, samples)
        elif probabilities.shape != candidates.shape[:1]:
            raise ValueError(
                f"probabilities {tuple(probabilities.shape)} do not belong to candidates "
                f"{tuple(candidates.shape)}"
            )
        values = -torch.xlogy(probabilities, probabilities)
        super().__init__(candidates, values, model, pending)


def _count_minima(model: Model, candidates: Tensor, samples: int) -> Tensor:
    """Return how often each candidate is the minimum of a joint sample, ties split."""
    with torch.no_grad():
        draws = model.posterior(candidates).rsample(torch.Size([samples])).squeeze(-1)
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
        pending=fantasised(context, table),
    )

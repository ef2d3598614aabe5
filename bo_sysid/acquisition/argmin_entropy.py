"""The contribution of a candidate to the entropy of the arg-min distribution.

    α(β) = −P(β) log P(β),    P(β) = Pr[β = argmin_b Δ(b)]

References:
    Zhu, Kimmel, Bekris & Boularias (2018), Fast model identification via physics engines for
    data-efficient policy search (greedy entropy search).
    Hennig & Schuler (2012), Entropy search for information-efficient global optimization.
"""

import torch
from botorch.models.model import Model
from torch import Tensor

from bo_sysid.acquisition.context import SelectionContext
from bo_sysid.acquisition.rows import RowAcquisition


class ArgminEntropyContribution(RowAcquisition):
    """`−P log P` over a discrete set, in nats.

    P is a property of the whole set, so it is computed once, here, and `forward` looks it up.
    Pending rows have the value -inf: their contribution will be resolved by their evaluation.
    """

    def __init__(
        self,
        model: Model | None,
        candidates: Tensor,
        probabilities: Tensor | None = None,
        samples: int = 1024,
    ) -> None:
        """Compute the values.

        Args:
            model: of the function whose arg-min is sought; needed without `probabilities`.
            candidates: `N x d`, the set B.
            probabilities: `N` values of P; by default counted in joint samples of the model's
                posterior over all candidates at once.
            samples: number of joint samples.
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
        super().__init__(candidates, -torch.xlogy(probabilities, probabilities), model)


def _count_minima(model: Model, candidates: Tensor, samples: int) -> Tensor:
    """Return how often each candidate is the minimum of a joint sample, ties split."""
    with torch.no_grad():
        draws = model.posterior(candidates).rsample(torch.Size([samples])).squeeze(-1)
    lowest = (draws == draws.min(dim=-1, keepdim=True).values).to(candidates)
    shares: Tensor = lowest / lowest.sum(dim=-1, keepdim=True)
    return shares.mean(dim=0)


def build(context: SelectionContext) -> ArgminEntropyContribution:
    """Return the acquisition for the belief of the context."""
    probabilities = torch.tensor(context.belief.probabilities)
    return ArgminEntropyContribution(None, context.choices, probabilities)

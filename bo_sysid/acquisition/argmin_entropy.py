"""The contribution of a candidate to the entropy of the arg-min distribution.

    α(β) = −P(β) log P(β),    P(β) = Pr[β = argmin_b Δ(b)]

References:
    Zhu, Kimmel, Bekris & Boularias (2018), Fast model identification via physics engines for
    data-efficient policy search (greedy entropy search).
    Hennig & Schuler (2012), Entropy search for information-efficient global optimization.
"""

from collections.abc import Callable

import torch
from botorch.acquisition.objective import PosteriorTransform
from botorch.exceptions import UnsupportedError
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
        posterior_transform: PosteriorTransform | None = None,
        maximize: bool = False,
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
            posterior_transform: makes one output of a model of several.
            maximize: seek the arg-max of the model, as of a problem that is negated.

        Raises:
            UnsupportedError: the model has several outputs, and no transform makes one of them.
        """
        if probabilities is None:
            if model is None:
                raise ValueError("either a model or probabilities are needed")
            if model.num_outputs > 1 and posterior_transform is None:
                raise UnsupportedError(
                    "P of the arg-min is that of one output: a model of "
                    f"{model.num_outputs} needs a posterior_transform"
                )
            with torch.no_grad():
                posterior = model.posterior(candidates, posterior_transform=posterior_transform)
                sampler = sampler or get_sampler(posterior, torch.Size([_SAMPLES]), seed=0)
                draws = sampler(posterior).squeeze(-1)
            probabilities = _share_of_minima(-draws if maximize else draws).to(candidates)
        elif probabilities.shape != candidates.shape[:1]:
            raise ValueError(
                f"probabilities {tuple(probabilities.shape)} do not belong to candidates "
                f"{tuple(candidates.shape)}"
            )
        values = -torch.xlogy(probabilities, probabilities)
        super().__init__(candidates, values, model, values_given_pending)


def _share_of_minima(draws: Tensor) -> Tensor:
    """Return how often each candidate is the minimum of `samples x N` joint draws, ties split."""
    lowest = (draws == draws.min(dim=-1, keepdim=True).values).to(draws)
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

"""Expected improvement of Δ over the best evaluated candidate, averaged over the ensemble.

    α(β) = log Σ_m w_m EI_m(β),    EI_m(β) = E_m[max(0, f_best − f(β))],    f = g(Δ)

References:
    Ament, Daulton, Eriksson, Balandat & Bakshy (2023), Unexpected improvements to expected
    improvement for Bayesian optimization.
"""

from collections.abc import Sequence

import torch
from botorch.acquisition import AcquisitionFunction, LogExpectedImprovement
from botorch.acquisition.logei import qLogExpectedImprovement
from botorch.acquisition.objective import LinearMCObjective
from botorch.models.model import Model
from botorch.sampling import SobolQMCNormalSampler
from botorch.utils.transforms import t_batch_mode_transform
from torch import Tensor

from bo_sysid.acquisition.context import SelectionContext

SAMPLES = 256  # where points are pending


class EnsembleLogExpectedImprovement(AcquisitionFunction):
    """`log Σ w EI` of BoTorch's analytic EI; with pending points of its Monte Carlo form."""

    def __init__(
        self,
        models: Sequence[Model],
        weights: Tensor,
        best_f: Tensor | float,
        seed: int,
    ) -> None:
        """Keep the ensemble.

        Args:
            models: the M members, each of the function that is to be minimised.
            weights: `M` weights of the members, which add up to 1.
            best_f: the least value so far.
            seed: of the samples where points are pending.
        """
        super().__init__(model=models[0])
        self._models = torch.nn.ModuleList(models)
        self.register_buffer("_best", torch.as_tensor(best_f).to(weights))
        self._seed = seed
        self.register_buffer("_log_weights", weights.log())
        self.set_X_pending(None)

    def set_X_pending(self, X_pending: Tensor | None = None) -> None:  # noqa: N802 - BoTorch's name
        """Take note of points `m x d` that are being evaluated; None for none."""
        super().set_X_pending(X_pending)
        if self.X_pending is None:
            self._members = torch.nn.ModuleList(
                LogExpectedImprovement(model, self._best, maximize=False) for model in self._models
            )
            return
        self._members = torch.nn.ModuleList(
            qLogExpectedImprovement(
                model,
                -self._best,
                sampler=SobolQMCNormalSampler(torch.Size([SAMPLES]), seed=self._seed),
                objective=LinearMCObjective(-torch.ones(1).to(self._best)),
                X_pending=self.X_pending,
            )
            for model in self._models
        )

    @t_batch_mode_transform(expected_q=1, assert_output_shape=False)  # type: ignore[untyped-decorator]
    def forward(self, X: Tensor) -> Tensor:
        """Return the values of the points: `b x 1 x d` → `b`."""
        values = torch.stack([member(X) for member in self._members], dim=-1)
        return torch.logsumexp(values + self._log_weights, dim=-1)


def build(context: SelectionContext) -> EnsembleLogExpectedImprovement:
    """Return the acquisition for the surrogate of the context."""
    surrogate = context.surrogate
    return EnsembleLogExpectedImprovement(
        surrogate.models(),
        torch.tensor(surrogate.weights),
        float(surrogate.values.min()),
        seed=context.seed,
    )

"""The deviation as a BoTorch test problem over the candidate set B."""

import torch
from botorch.test_functions.base import BaseTestProblem
from torch import Tensor

from bo_sysid.deviation.measure import Deviation
from bo_sysid.parameters import CandidateSet


class DeviationProblem(BaseTestProblem):
    """Δ(β) to be minimised over a discrete set.

    Args:
        deviation: evaluates Δ.
        candidates: the set B. Categories are points of their range, as every other value is.
        noise_std: standard deviation of noise that is added to Δ; None for none.
        negate: return -Δ, for acquisitions that maximise.

    Attributes:
        candidates: `N x d` tensor of the candidates, float64; a candidate's identity is its row.
    """

    def __init__(
        self,
        deviation: Deviation,
        candidates: CandidateSet,
        noise_std: float | None = None,
        negate: bool = False,
    ) -> None:
        self.dim = len(candidates.parameters)
        self.continuous_inds = list(range(self.dim))
        self._bounds = [(p.low, p.high) for p in candidates.parameters]
        super().__init__(noise_std, negate, dtype=torch.float64)
        self.deviation = deviation
        self.register_buffer("candidates", torch.tensor(candidates.points, dtype=torch.float64))

    def _evaluate_true(self, X: Tensor) -> Tensor:
        """Return Δ for `batch_shape x d` parameter vectors, as a `batch_shape` tensor."""
        points = X.detach().double().cpu().numpy().reshape(-1, self.dim)
        return torch.tensor(self.deviation(points).deviation).reshape(X.shape[:-1]).to(X)

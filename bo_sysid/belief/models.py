"""The members of a surrogate as BoTorch models, for the acquisitions that BoTorch implements."""

import torch
from botorch.models import SingleTaskGP
from botorch.models.transforms import Normalize, Standardize
from botorch.models.transforms.input import InputTransform
from gpytorch.kernels import MaternKernel, RBFKernel, ScaleKernel
from gpytorch.means import ConstantMean
from gpytorch.settings import min_fixed_noise
from torch import Tensor

from bo_sysid.belief.encoding import INDICATOR_SCALE
from bo_sysid.belief.gp import ConditionedGP
from bo_sysid.belief.surrogate import Surrogate

LEAST_NOISE = 1e-12  # variance, in standardised units


def as_single_task_gp(surrogate: Surrogate, member: ConditionedGP) -> SingleTaskGP:
    """Return the `SingleTaskGP` on y = g(Δ) that has the member's hyperparameters.

    Inputs are normalised with the bounds of B and outputs standardised inside the model, so its
    posterior is in the units of `points` and y.
    """
    base = RBFKernel if member.kernel == "rbf" else MaternKernel
    # the noise of values that are known exactly is what the members have, however small
    with min_fixed_noise(double_value=LEAST_NOISE):
        model = SingleTaskGP(
            torch.tensor(surrogate.points),
            torch.tensor(surrogate.values)[:, None],
            train_Yvar=torch.tensor(surrogate.noise * surrogate.scale**2)[:, None],
            covar_module=ScaleKernel(base(ard_num_dims=len(member.lengthscales))),
            mean_module=ConstantMean(),
            input_transform=_cube(surrogate),
            outcome_transform=Standardize(m=1),
        ).double()
    model.covar_module.base_kernel.lengthscale = torch.tensor(member.lengthscales)
    model.covar_module.outputscale = member.outputscale
    model.mean_module.constant = member.mean
    return model.eval()


def _cube(surrogate: Surrogate) -> InputTransform:
    bounds = torch.tensor(surrogate.bounds)
    if not surrogate.categories:
        return Normalize(d=bounds.shape[1], bounds=bounds)
    return Encoded(bounds, {k: torch.tensor(v) for k, v in surrogate.categories.items()})


class Encoded(InputTransform):
    """Scales to the unit cube, with categories as indicators: `bo_sysid.belief.encoding`."""

    def __init__(self, bounds: Tensor, categories: dict[int, Tensor]) -> None:
        """Keep bounds `2 x d` and the values of each column without an order."""
        super().__init__()
        self.transform_on_train = self.transform_on_eval = self.transform_on_fantasize = True
        self.is_one_to_many = False
        self.register_buffer("bounds", bounds)
        self._categories = categories

    def transform(self, X: Tensor) -> Tensor:
        """Return `batch_shape x q x d` points as `batch_shape x q x D`."""
        scaled = (X - self.bounds[0]) / (self.bounds[1] - self.bounds[0])
        ordered = [k for k in range(X.shape[-1]) if k not in self._categories]
        parts = [scaled[..., ordered]]
        for column, values in self._categories.items():
            parts.append(INDICATOR_SCALE * (X[..., [column]] == values.to(X)).to(X))
        return torch.cat(parts, dim=-1)

"""The members of a surrogate as BoTorch models, for the acquisitions that BoTorch implements."""

import torch
from botorch.models import SingleTaskGP
from botorch.models.transforms import Normalize, Standardize
from gpytorch.kernels import MaternKernel, RBFKernel, ScaleKernel
from gpytorch.means import ConstantMean

from bo_sysid.belief.gp import Conditional
from bo_sysid.belief.surrogate import Surrogate


def as_single_task_gp(surrogate: Surrogate, member: Conditional) -> SingleTaskGP:
    """Return the `SingleTaskGP` on y = g(Δ) that has the member's hyperparameters.

    Inputs are normalised with the bounds of B and outputs standardised inside the model, so its
    posterior is in the units of `points` and y.
    """
    d = surrogate.points.shape[1]
    base = RBFKernel if member.kernel == "rbf" else MaternKernel
    model = SingleTaskGP(
        torch.tensor(surrogate.points),
        torch.tensor(surrogate.values)[:, None],
        train_Yvar=torch.tensor(surrogate.noise * surrogate.scale**2)[:, None],
        covar_module=ScaleKernel(base(ard_num_dims=d)),
        mean_module=ConstantMean(),
        input_transform=Normalize(d=d, bounds=torch.tensor(surrogate.bounds)),
        outcome_transform=Standardize(m=1),
    ).double()
    model.covar_module.base_kernel.lengthscale = torch.tensor(member.lengthscales)
    model.covar_module.outputscale = member.outputscale
    model.mean_module.constant = member.mean
    return model.eval()

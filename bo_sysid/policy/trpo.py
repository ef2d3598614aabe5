"""Trust region policy optimisation: one update of a Gaussian policy.

Schulman et al. 2015, "Trust region policy optimization": maximise the surrogate
L(theta) = E[ A pi_theta(a|s) / pi_old(a|s) ] while the mean KL divergence stays below a bound.
Schulman et al. 2016, "High-dimensional continuous control using generalized advantage estimation".

Convention of the KL divergence: by default it is averaged over action dimensions, and so is the
damping that is added to its Hessian, as in sb3-contrib; `average_kl=False` sums over them, which at
equal numbers makes much smaller steps. What is constrained is KL(new || old), as in sb3-contrib;
Schulman et al. constrain KL(old || new). The two agree to second order in the step: their Hessians
at the old policy are equal.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float

from bo_sysid.policy.fisher import Fisher
from bo_sysid.policy.network import LOG_2PI, GaussianPolicy
from bo_sysid.policy.settings import TrustRegion

Product = Callable[[torch.Tensor], torch.Tensor]

_SOLVED = 1e-10  # squared norm of a residual of conjugate gradients that counts as none


class Batch(NamedTuple):
    """What was collected with the old policy, float32.

    Attributes:
        observations: `B x o`, normalised.
        actions: `B x a`, as drawn, not clipped.
        advantages: `B`.
    """

    observations: torch.Tensor
    actions: torch.Tensor
    advantages: torch.Tensor


class Update(NamedTuple):
    """What an update did.

    Attributes:
        theta: the new parameters; the old ones where the line search failed.
        kl: mean KL divergence of the new policy.
        improvement: of the surrogate.
        cg_residual: norm of the residual of conjugate gradients over that of the gradient.
        trials: of the line search; 1 where the full step was taken.
        accepted: whether the line search found a step.
    """

    theta: torch.Tensor
    kl: float
    improvement: float
    cg_residual: float
    trials: int
    accepted: bool


def advantages(
    rewards: Float[np.ndarray, "T n"],
    values: Float[np.ndarray, "T n"],
    next_values: Float[np.ndarray, "T n"],
    ended: Bool[np.ndarray, "T n"],
    discount: float,
    decay: float,
) -> Float[np.ndarray, "T n"]:
    """Return generalised advantage estimates, `T x n`.

    With delta_t = r_t + gamma V(s'_t) - V(s_t), A_t = delta_t + gamma lambda A_{t+1}, where the sum
    stops at the end of an episode.

    Args:
        rewards: `T x n`.
        values: `T x n`, of the observations that were acted on.
        next_values: `T x n`, of the observations that the actions led to: zero after a termination,
            the value of the last observation after a truncation.
        ended: `T x n`, the episode ended with this step, for good or by the time limit.
        discount: gamma.
        decay: lambda.
    """
    delta = rewards + discount * next_values - values
    carry = discount * decay * ~ended
    result: np.ndarray = np.empty_like(delta)
    running = np.zeros_like(delta[0])
    for t in reversed(range(len(delta))):
        running = delta[t] + carry[t] * running
        result[t] = running
    return result


def normalised(advantage: torch.Tensor) -> torch.Tensor:
    """Return advantages with mean zero and standard deviation one."""
    return (advantage - advantage.mean()) / (advantage.std() + 1e-8)


def mean_actions(
    policy: GaussianPolicy, theta: torch.Tensor, observations: torch.Tensor
) -> torch.Tensor:
    """Return the mean actions, `B x a`."""
    x = observations
    layers = policy.network.layers(theta)
    for weight, bias in layers[:-1]:
        x = torch.tanh(torch.addmm(bias, x, weight.T))
    weight, bias = layers[-1]
    return torch.addmm(bias, x, weight.T)


def log_probability(
    actions: torch.Tensor, means: torch.Tensor, log_std: torch.Tensor
) -> torch.Tensor:
    """Return the log densities of `B x a` actions, `B`."""
    z = (actions - means) * torch.exp(-log_std)
    return -0.5 * (z * z).sum(dim=1) - log_std.sum() - 0.5 * LOG_2PI * len(log_std)


def kl_divergence(
    means: torch.Tensor,
    log_std: torch.Tensor,
    old_means: torch.Tensor,
    old_log_std: torch.Tensor,
    *,
    average: bool,
) -> torch.Tensor:
    """Return the mean over rows of KL(new || old), averaged or summed over action dimensions."""
    ratio = torch.exp(2 * (log_std - old_log_std))
    distance = ((means - old_means) * torch.exp(-old_log_std)) ** 2
    each = 0.5 * (ratio + distance - 1) - (log_std - old_log_std)
    return each.mean() if average else each.sum(dim=1).mean()


def surrogate(
    batch: Batch, log_probabilities: torch.Tensor, old_log_probabilities: torch.Tensor
) -> torch.Tensor:
    """Return E[ A pi / pi_old ]."""
    return (batch.advantages * torch.exp(log_probabilities - old_log_probabilities)).mean()


def surrogate_gradient(policy: GaussianPolicy, theta: torch.Tensor, batch: Batch) -> torch.Tensor:
    """Return the gradient of the surrogate at the old policy, float64."""
    theta = theta.clone().requires_grad_(True)
    means = mean_actions(policy, theta, batch.observations)
    new = log_probability(batch.actions, means, policy.log_std(theta))
    (gradient,) = torch.autograd.grad(surrogate(batch, new, new.detach()), theta)
    return gradient.to(torch.float64)


def conjugate_gradient(
    product: Product, b: torch.Tensor, steps: int
) -> tuple[torch.Tensor, torch.Tensor]:
    """Solve A x = b approximately, starting from zero.

    Args:
        product: returns A v for a vector v; A symmetric and positive definite.
        b: right-hand side.
        steps: most steps; fewer where the squared norm of the residual falls below `_SOLVED`.

    Returns:
        x, and the residual b - A x.
    """
    x, residual = torch.zeros_like(b), b.clone()
    direction, squared = b.clone(), torch.dot(b, b)
    for _ in range(steps):
        if squared < _SOLVED:
            break
        image = product(direction)
        step = squared / torch.dot(direction, image)
        x += step * direction
        residual -= step * image
        before, squared = squared, torch.dot(residual, residual)
        direction = residual + (squared / before) * direction
    return x, residual


def update(
    policy: GaussianPolicy, theta: torch.Tensor, batch: Batch, settings: TrustRegion
) -> Update:
    """Return the policy's parameters after one trust region step.

    Args:
        policy: layout of the parameters.
        theta: parameters of the policy that collected the batch, float32; not changed.
        batch: what was collected, with normalised advantages.
        settings: of the step.
    """
    gradient = surrogate_gradient(policy, theta, batch)
    fisher = Fisher(
        policy,
        theta,
        batch.observations,
        damping=settings.damping,
        average=settings.average_kl,
    )
    direction, residual = conjugate_gradient(fisher, gradient, settings.cg_steps)
    curvature = torch.dot(direction, gradient - residual)  # x' F x, since F x = b - r
    relative = float(residual.norm() / gradient.norm()) if gradient.any() else 0.0
    if not float(curvature) > 0:
        return Update(theta, 0.0, 0.0, relative, 0, False)
    full = direction * torch.sqrt(2 * settings.kl / curvature)
    return line_search(policy, theta, full, batch, settings)._replace(cg_residual=relative)


@torch.no_grad()
def line_search(
    policy: GaussianPolicy,
    theta: torch.Tensor,
    full: torch.Tensor,
    batch: Batch,
    settings: TrustRegion,
) -> Update:
    """Return the longest of the shrinking steps that improves the surrogate within the bound.

    Args:
        policy: layout of the parameters.
        theta: old parameters.
        full: the longest step, float64.
        batch: what the surrogate and the KL divergence are computed on.
        settings: bound, shrinking factor and number of trials.
    """
    old_means, old_log_std = mean_actions(policy, theta, batch.observations), policy.log_std(theta)
    old = log_probability(batch.actions, old_means, old_log_std)
    before = float(surrogate(batch, old, old))
    for trial in range(settings.backtracks):
        new_theta = theta + (settings.shrink**trial * full).to(theta.dtype)
        means = mean_actions(policy, new_theta, batch.observations)
        log_std = policy.log_std(new_theta)
        new = log_probability(batch.actions, means, log_std)
        improvement = float(surrogate(batch, new, old)) - before
        kl = float(
            kl_divergence(means, log_std, old_means, old_log_std, average=settings.average_kl)
        )
        if kl < settings.kl and improvement > 0:
            return Update(new_theta, kl, improvement, np.nan, trial + 1, True)
    return Update(theta, 0.0, 0.0, np.nan, settings.backtracks, False)

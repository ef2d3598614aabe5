"""The update's parts against truth: finite differences, double backward, direct solves."""

import numpy as np
import pytest
import torch

from bo_sysid.policy.fisher import Fisher
from bo_sysid.policy.network import GaussianPolicy
from bo_sysid.policy.settings import TrustRegion
from bo_sysid.policy.trpo import (
    Batch,
    advantages,
    conjugate_gradient,
    kl_divergence,
    line_search,
    log_probability,
    mean_actions,
    normalised,
    surrogate,
    surrogate_gradient,
    update,
)

POLICY = GaussianPolicy.of_size(5, 3, (16, 12))


@pytest.fixture
def theta():
    rng = np.random.default_rng(0)
    theta = POLICY.initial(rng)
    theta += 0.2 * rng.standard_normal(theta.size).astype(np.float32)
    return torch.from_numpy(theta)


@pytest.fixture
def batch(theta):
    rng = torch.Generator().manual_seed(1)
    observations = torch.randn(600, 5, generator=rng)
    noise = torch.randn(600, 3, generator=rng)
    actions = mean_actions(POLICY, theta, observations) + torch.exp(POLICY.log_std(theta)) * noise
    return Batch(observations, actions, normalised(noise[:, 0] + observations[:, 1]))


def kl_at(new, old, observations, average):
    """The KL divergence by torch's own distributions."""
    p = torch.distributions.Normal(
        mean_actions(POLICY, new, observations), POLICY.log_std(new).exp()
    )
    q = torch.distributions.Normal(
        mean_actions(POLICY, old, observations), POLICY.log_std(old).exp()
    )
    each = torch.distributions.kl_divergence(p, q)
    return each.mean() if average else each.sum(dim=1).mean()


def double_backward(theta, observations, v, average):
    new = theta.clone().requires_grad_(True)
    kl = kl_at(new, theta, observations, average)
    (gradient,) = torch.autograd.grad(kl, new, create_graph=True)
    (product,) = torch.autograd.grad(gradient @ v, new)
    return product


@pytest.mark.parametrize("average", [True, False])
@pytest.mark.parametrize("chunk", [64, 4096])
def test_the_fisher_product_is_the_hessian_of_the_kl(theta, batch, average, chunk, monkeypatch):
    monkeypatch.setattr("bo_sysid.policy.fisher.CHUNK", chunk)
    theta, observations = theta.double(), batch.observations.double()
    fisher = Fisher(POLICY, theta, observations, damping=0.0, average=average)
    for seed in range(3):
        v = torch.randn(POLICY.size, generator=torch.Generator().manual_seed(seed)).double()
        expected = double_backward(theta, observations, v, average)
        torch.testing.assert_close(fisher(v), expected, rtol=1e-10, atol=1e-12)
        # and the divergence itself grows as half the quadratic form
        step = 1e-3 * v / v.norm()
        half = 0.5 * step @ expected * (1e-3 / v.norm())
        kl = kl_at(theta + step, theta, observations, average)
        assert float(kl) == pytest.approx(float(half), rel=0.02)


def test_the_fisher_product_is_damped_and_single_precision_suffices(theta, batch):
    v = torch.randn(POLICY.size, generator=torch.Generator().manual_seed(3)).double()
    exact = Fisher(POLICY, theta.double(), batch.observations.double(), damping=0.0, average=True)
    damped = Fisher(POLICY, theta, batch.observations, damping=0.1, average=True)
    torch.testing.assert_close(damped(v), exact(v) + 0.1 * v, rtol=1e-4, atol=1e-6)


def test_kl_and_log_probability_are_torchs(theta, batch):
    new = theta + 0.05 * torch.randn(POLICY.size, generator=torch.Generator().manual_seed(2))
    for average in (True, False):
        own = kl_divergence(
            mean_actions(POLICY, new, batch.observations),
            POLICY.log_std(new),
            mean_actions(POLICY, theta, batch.observations),
            POLICY.log_std(theta),
            average=average,
        )
        expected = kl_at(new, theta, batch.observations, average)
        assert float(own) == pytest.approx(float(expected), rel=1e-5)
    normal = torch.distributions.Normal(
        mean_actions(POLICY, theta, batch.observations), POLICY.log_std(theta).exp()
    )
    own = log_probability(
        batch.actions, mean_actions(POLICY, theta, batch.observations), POLICY.log_std(theta)
    )
    torch.testing.assert_close(own, normal.log_prob(batch.actions).sum(dim=1))


def test_the_gradient_is_that_of_the_surrogate(theta, batch):
    exact = Batch(*(b.double() for b in batch))
    theta = theta.double()

    def value(at):
        new = log_probability(
            exact.actions, mean_actions(POLICY, at, exact.observations), POLICY.log_std(at)
        )
        old = log_probability(
            exact.actions, mean_actions(POLICY, theta, exact.observations), POLICY.log_std(theta)
        )
        return surrogate(exact, new, old)

    gradient = surrogate_gradient(POLICY, theta, exact)
    for k in (0, 40, 150, POLICY.size - 1):
        step = torch.zeros(POLICY.size, dtype=torch.float64)
        step[k] = 1e-6
        slope = (value(theta + step) - value(theta - step)) / 2e-6
        assert float(gradient[k]) == pytest.approx(float(slope), abs=1e-8)


def test_conjugate_gradients_solve_and_report_their_residual():
    rng = np.random.default_rng(0)
    root = rng.standard_normal((30, 30))
    A = torch.from_numpy(root @ root.T + np.eye(30))
    b = torch.from_numpy(rng.standard_normal(30))
    x, residual = conjugate_gradient(lambda v: A @ v, b, 60)
    torch.testing.assert_close(x, torch.linalg.solve(A, b), rtol=1e-5, atol=1e-6)
    x, residual = conjugate_gradient(lambda v: A @ v, b, 7)
    torch.testing.assert_close(residual, b - A @ x)
    # of all vectors in the Krylov space, x minimises the quadratic: the residual is orthogonal
    krylov = torch.stack([torch.linalg.matrix_power(A, k) @ b for k in range(7)])
    krylov /= krylov.norm(dim=1, keepdim=True)
    assert float((krylov @ residual).abs().max()) < 1e-8
    assert not conjugate_gradient(lambda v: A @ v, torch.zeros(30, dtype=torch.float64), 5)[0].any()


def test_advantages_are_the_sums_that_define_them():
    rng = np.random.default_rng(0)
    T, n, discount, decay = 12, 3, 0.97, 0.9
    rewards, values, following = rng.standard_normal((3, T, n))
    ended = rng.uniform(size=(T, n)) < 0.25
    result = advantages(rewards, values, following, ended, discount, decay)
    for i in range(n):
        for t in range(T):
            total, weight = 0.0, 1.0
            for k in range(t, T):
                delta = rewards[k, i] + discount * following[k, i] - values[k, i]
                total += weight * delta
                if ended[k, i]:
                    break
                weight *= discount * decay
            assert result[t, i] == pytest.approx(total, abs=1e-12)


def test_a_step_stays_within_the_bound_and_improves(theta, batch):
    for bound in (1e-3, 0.02):
        settings = TrustRegion(kl=bound, damping=1e-4, cg_steps=40)
        done = update(POLICY, theta, batch, settings)
        assert done.accepted
        assert done.improvement > 0
        kl = float(kl_at(done.theta, theta, batch.observations, True))
        assert done.kl == pytest.approx(kl, rel=1e-4)
        assert 0.5 * bound < kl < bound
        assert done.cg_residual < 0.05


def test_the_step_is_the_natural_gradient(theta, batch):
    settings = TrustRegion(kl=1e-6, damping=0.01, cg_steps=400, average_kl=False)
    done = update(POLICY, theta, batch, settings)
    identity = torch.eye(POLICY.size, dtype=torch.float64)
    fisher = Fisher(
        POLICY, theta.double(), batch.observations.double(), damping=0.01, average=False
    )
    F = torch.stack([fisher(v) for v in identity])
    gradient = surrogate_gradient(POLICY, theta, batch)
    natural = torch.linalg.solve(F, gradient)
    step = (done.theta - theta).double()
    cosine = step @ natural / (step.norm() * natural.norm())
    assert float(cosine) > 0.9999


def test_averaging_over_3_dimensions_allows_3_times_the_summed_kl(theta, batch):
    average = update(POLICY, theta, batch, TrustRegion(kl=0.01, damping=0.1))
    total = update(POLICY, theta, batch, TrustRegion(kl=0.03, damping=0.3, average_kl=False))
    torch.testing.assert_close(average.theta, total.theta, rtol=1e-4, atol=1e-6)
    assert total.kl == pytest.approx(3 * average.kl, rel=1e-3)
    strict = update(POLICY, theta, batch, TrustRegion(kl=0.01, average_kl=False))
    assert strict.kl / 3 < 0.5 * average.kl


def test_the_line_search_backtracks_and_restores(theta, batch):
    settings = TrustRegion(kl=1e-3)
    step = (update(POLICY, theta, batch, settings).theta - theta).double()
    long = line_search(POLICY, theta, 3 * step, batch, settings)
    assert long.accepted
    assert long.trials > 3
    assert 0.5e-3 < long.kl < 1e-3
    worse = line_search(POLICY, theta, -step, batch, settings)
    assert (worse.accepted, worse.kl, worse.improvement) == (False, 0.0, 0.0)
    assert worse.trials == 10
    torch.testing.assert_close(worse.theta, theta, rtol=0, atol=0)


def test_without_advantages_the_policy_stays(theta, batch):
    done = update(POLICY, theta, batch._replace(advantages=torch.zeros(600)), TrustRegion())
    assert not done.accepted
    torch.testing.assert_close(done.theta, theta, rtol=0, atol=0)

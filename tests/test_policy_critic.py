"""The critic and the statistics against independent implementations."""

import numpy as np
import pytest
import torch

from bo_sysid.policy.critic import Critic
from bo_sysid.policy.network import GaussianPolicy, Network
from bo_sysid.policy.normalisation import Normaliser, ReturnScale, RunningMoments
from bo_sysid.policy.settings import CriticFit

NETWORK = Network((4, 10, 8, 1))


def as_torch(network, theta):
    modules = []
    for weight, bias in network.layers(theta):
        linear = torch.nn.Linear(weight.shape[1], weight.shape[0])
        linear.weight.data[:] = torch.from_numpy(weight.copy())
        linear.bias.data[:] = torch.from_numpy(bias.copy())
        modules += [linear, torch.nn.Tanh()]
    return torch.nn.Sequential(*modules[:-1])


def flat(module):
    return np.concatenate([p.detach().numpy().ravel() for p in module.parameters()])


@pytest.fixture
def data():
    rng = np.random.default_rng(0)
    x = rng.standard_normal((300, 4)).astype(np.float32)
    return x, np.sin(2 * x[:, 0]) + x[:, 1]


def test_outputs_are_torchs(data):
    theta = NETWORK.initial(np.random.default_rng(1), 1.0)
    expected = as_torch(NETWORK, theta)(torch.from_numpy(data[0])).detach().numpy()
    np.testing.assert_allclose(NETWORK(theta, data[0]), expected, rtol=0, atol=1e-6)


def test_fitting_is_torchs_adam_on_the_same_minibatches(data):
    theta = NETWORK.initial(np.random.default_rng(1), 1.0)
    critic, module = Critic(NETWORK, theta), as_torch(NETWORK, theta)
    adam = torch.optim.Adam(module.parameters(), lr=1e-3, eps=1e-5)
    x, y = torch.from_numpy(data[0]), torch.from_numpy(data[1].astype(np.float32))
    rng = np.random.default_rng(5)
    losses = []
    for _ in range(4):
        order = torch.from_numpy(rng.permutation(300))
        for rows in torch.split(order, 64):
            loss = ((module(x[rows])[:, 0] - y[rows]) ** 2).mean()
            adam.zero_grad()
            loss.backward()
            adam.step()
            losses.append((float(loss.detach()), len(rows)))
    own = critic.fit(
        x.numpy(), y.numpy(), CriticFit(epochs=4, minibatch=64), np.random.default_rng(5)
    )
    np.testing.assert_allclose(critic.theta, flat(module), rtol=0, atol=2e-6)
    assert own == pytest.approx(sum(v * n for v, n in losses[-5:]) / 300, rel=1e-4)


def test_a_critic_learns_and_goes_on_from_its_state(data):
    x, y = data[0], data[1].astype(np.float32)
    settings = CriticFit(epochs=30, minibatch=32)
    whole = Critic(NETWORK, NETWORK.initial(np.random.default_rng(1), 1.0))
    first = whole.fit(x, y, settings, np.random.default_rng(1))
    state = whole.get_state()
    second = whole.fit(x, y, settings, np.random.default_rng(2))
    assert second < first < float(np.var(y))
    resumed = Critic(NETWORK, np.zeros(NETWORK.size, np.float32))
    resumed.set_state(state)
    assert resumed.fit(x, y, settings, np.random.default_rng(2)) == second
    np.testing.assert_array_equal(resumed.theta, whole.theta)


def test_initial_layers_are_orthogonal_with_their_gain():
    policy = GaussianPolicy.of_size(4, 2, (10, 8))
    theta = policy.initial(np.random.default_rng(0), log_std=-0.5)
    gains = [2.0, 2.0, 0.01**2]
    for (weight, bias), gain in zip(policy.network.layers(theta), gains, strict=True):
        small = weight @ weight.T if weight.shape[0] <= weight.shape[1] else weight.T @ weight
        np.testing.assert_allclose(small, gain * np.eye(len(small)), atol=1e-6)
        assert not bias.any()
    np.testing.assert_allclose(policy.log_std(theta), -0.5)


def test_moments_of_parts_are_those_of_the_whole():
    x = np.random.default_rng(0).normal(3.0, 2.0, (1000, 3))
    moments = RunningMoments.of_size(3)
    for part in np.split(x, [10, 11, 400]):
        moments.add(part)
    np.testing.assert_allclose(moments.mean, x.mean(axis=0), rtol=1e-6)
    np.testing.assert_allclose(moments.variance, x.var(axis=0), rtol=1e-5)
    frozen = Normaliser.of(moments, clip=1.5)
    moments.add(100 + x)
    z = frozen(x)
    assert z.dtype == np.float32
    assert np.abs(z).max() == 1.5
    inside = np.abs(z) < 1.5
    np.testing.assert_allclose(
        z[inside], ((x - x.mean(axis=0)) / x.std(axis=0))[inside], rtol=0, atol=1e-5
    )


def test_rewards_are_scaled_by_the_spread_of_discounted_returns():
    rng = np.random.default_rng(0)
    rewards, ended = rng.standard_normal((50, 2)), rng.uniform(size=(50, 2)) < 0.1
    scale = ReturnScale(0.9, np.zeros(2))
    parts = [scale(rewards[:20], ended[:20]), scale(rewards[20:], ended[20:])]
    sums = np.zeros((50, 2))
    for i in range(2):
        running = 0.0
        for t in range(50):
            running = 0.9 * running + rewards[t, i]
            sums[t, i] = running
            if ended[t, i]:
                running = 0.0
    np.testing.assert_allclose(parts[0], rewards[:20] / sums[:20].std(), rtol=1e-4)
    np.testing.assert_allclose(parts[1], rewards[20:] / sums.std(), rtol=1e-4)

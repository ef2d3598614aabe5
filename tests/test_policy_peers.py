"""The same algorithm as sb3-contrib's TRPO, shown on its own buffer and weights."""

import warnings

import numpy as np
import pytest
import torch

from bo_sysid.policy.critic import Critic
from bo_sysid.policy.network import GaussianPolicy, Network
from bo_sysid.policy.normalisation import Normaliser
from bo_sysid.policy.settings import CriticFit, TrustRegion
from bo_sysid.policy.trpo import Batch, advantages, normalised, update

with warnings.catch_warnings():
    warnings.simplefilter("ignore")
    reason = "the peers' packages are not installed"
    sb3_contrib = pytest.importorskip("sb3_contrib", reason=reason)
    from gymnasium import Env, spaces
    from gymnasium.wrappers import TimeLimit
    from stable_baselines3.common.callbacks import BaseCallback
    from stable_baselines3.common.env_util import make_vec_env
    from stable_baselines3.common.vec_env import VecNormalize

pytestmark = pytest.mark.filterwarnings("ignore")
ENVIRONMENTS, STEPS, LIMIT = 8, 256, 100


class Drift(Env):
    """A noisy linear system with 6 observations and 3 actions; every fifth episode terminates."""

    observation_space = spaces.Box(-np.inf, np.inf, (6,))
    action_space = spaces.Box(-1, 1, (3,))

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self._state = self.np_random.standard_normal(6)
        self._falls = self.np_random.uniform() < 0.2
        self._time = 0
        return self._state.astype(np.float32), {}

    def step(self, action):
        self._time += 1
        pull = np.concatenate([action, np.sin(action)])
        self._state = 0.95 * self._state + 0.2 * pull + 0.05 * self.np_random.standard_normal(6)
        reward = -float(np.square(self._state).sum()) + 0.3 * float(action[0])
        done = self._falls and self._time == LIMIT // 2
        return self._state.astype(np.float32), reward, done, False, {}


class Finals(BaseCallback):
    """Remembers the value of every observation that a time limit cut off."""

    def _on_step(self):
        for i, (done, info) in enumerate(
            zip(self.locals["dones"], self.locals["infos"], strict=True)
        ):
            if done and info.get("TimeLimit.truncated", False):
                final = torch.as_tensor(info["terminal_observation"])[None]
                with torch.no_grad():
                    value = float(self.model.policy.predict_values(final))
                self.following[self.locals["n_steps"], i] = value
        self.ended[self.locals["n_steps"]] = self.locals["dones"]
        return True

    def _on_rollout_start(self):
        self.following = np.zeros((STEPS, ENVIRONMENTS))
        self.ended = np.zeros((STEPS, ENVIRONMENTS), bool)


@pytest.fixture(scope="module")
def peer():
    """A TRPO of sb3-contrib after one update, with a fresh buffer from its second policy."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        environment = VecNormalize(
            make_vec_env(
                Drift,
                ENVIRONMENTS,
                seed=0,
                wrapper_class=TimeLimit,
                wrapper_kwargs={"max_episode_steps": LIMIT},
            )
        )
        model = sb3_contrib.TRPO(
            "MlpPolicy", environment, n_steps=STEPS, target_kl=0.02, seed=0, device="cpu"
        )
        model.learn(ENVIRONMENTS * STEPS)
        finals = Finals()
        _, callback = model._setup_learn(ENVIRONMENTS * STEPS, finals, reset_num_timesteps=False)
        model.collect_rollouts(environment, callback, model.rollout_buffer, STEPS)
    return model, finals


def theta_of(model):
    policy = model.policy
    parts = [policy.mlp_extractor.policy_net[0], policy.mlp_extractor.policy_net[2]]
    parts.append(policy.action_net)
    flat = [p.detach().ravel() for layer in parts for p in (layer.weight, layer.bias)]
    return torch.cat([*flat, policy.log_std.detach()]).clone()


def critic_of(model):
    """Return a critic with the weights of sb3's, and with the state of its Adam."""
    policy = model.policy
    layers = [policy.mlp_extractor.value_net[0], policy.mlp_extractor.value_net[2]]
    layers.append(policy.value_net)
    parameters = [p for layer in layers for p in (layer.weight, layer.bias)]
    states = [policy.optimizer.state[p] for p in parameters]

    def flat(tensors):
        return torch.cat([t.detach().ravel() for t in tensors]).numpy().copy()

    critic = Critic(Network((6, 64, 64, 1)), flat(parameters))
    critic.set_state(
        {
            "theta": critic.theta.copy(),
            "first": flat(s["exp_avg"] for s in states),
            "second": flat(s["exp_avg_sq"] for s in states),
            "steps": states[0]["step"].numpy(),
        }
    )
    return critic


def test_observations_are_normalised_alike(peer):
    model, _ = peer
    environment = model.get_env()
    normaliser = Normaliser(
        environment.obs_rms.mean, np.sqrt(environment.obs_rms.var + environment.epsilon)
    )
    x = np.random.default_rng(0).normal(0, 3, (100, 6))
    np.testing.assert_allclose(normaliser(x), environment.normalize_obs(x), rtol=0, atol=5e-7)


def test_advantages_agree(peer):
    model, finals = peer
    buffer = model.rollout_buffer
    assert finals.following.any()
    assert (finals.ended & (finals.following == 0)).any()
    last = torch.as_tensor(model._last_obs)
    with torch.no_grad():
        after = model.policy.predict_values(last).numpy().ravel()
    following = np.concatenate([buffer.values[1:], after[None]])
    following[finals.ended] = finals.following[finals.ended]
    # sb3 adds the bootstrapped value to the reward; ours keeps them apart
    rewards = buffer.rewards - model.gamma * finals.following
    own = advantages(rewards, buffer.values, following, finals.ended, model.gamma, model.gae_lambda)
    np.testing.assert_allclose(own, buffer.advantages, rtol=0, atol=1e-6)


def test_step_kl_and_critic_agree(peer):
    model, _ = peer
    buffer = model.rollout_buffer

    def rows(array):
        return torch.from_numpy(np.array(array).reshape(STEPS * ENVIRONMENTS, -1))

    observations, targets = rows(buffer.observations), rows(buffer.returns)[:, 0]
    batch = Batch(observations, rows(buffer.actions), normalised(rows(buffer.advantages)[:, 0]))
    policy, before = GaussianPolicy.of_size(6, 3, (64, 64)), theta_of(model)
    own = update(policy, before, batch, TrustRegion(kl=0.02, damping=0.1, cg_steps=15))
    critic = critic_of(model)

    model.train()
    step, theirs = (own.theta - before).double(), (theta_of(model) - before).double()
    cosine = float(step @ theirs / (step.norm() * theirs.norm()))
    assert cosine > 0.99999
    assert float(step.norm() / theirs.norm()) == pytest.approx(1, abs=1e-5)
    assert own.kl == pytest.approx(model.logger.name_to_value["train/kl_divergence_loss"], abs=1e-6)
    assert own.trials == 1

    critic.fit(observations.numpy(), targets.numpy(), CriticFit(), np.random.default_rng(0))
    with torch.no_grad():
        values = model.policy.predict_values(observations)[:, 0]
    error = float(((values - targets) ** 2).mean())
    ours = float(np.square(critic.values(observations.numpy()) - targets.numpy()).mean())
    assert ours == pytest.approx(error, rel=0.03)

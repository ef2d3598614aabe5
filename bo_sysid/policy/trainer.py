"""One iteration of training: collect, estimate advantages, update policy and critic."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
import torch
from threadpoolctl import threadpool_limits

from bo_sysid.errors import StudyError
from bo_sysid.plants.environment import Environment
from bo_sysid.policy.critic import Critic, CriticFit
from bo_sysid.policy.network import GaussianPolicy, Network
from bo_sysid.policy.normalisation import Moments, Normaliser, ReturnScale
from bo_sysid.policy.rollout import Rollout, collect
from bo_sysid.policy.trpo import Batch, TrustRegion, advantages, normalised, update


@dataclass(frozen=True)
class TrpoSettings:
    """Settings of a training run; the defaults learn dm-control's cheetah and swimmer.

    Attributes:
        batch: control steps an iteration, over all environments.
        discount: gamma.
        decay: lambda of the advantages.
        hidden: units of the hidden layers, of policy and critic alike.
        log_std: logarithm of the policy's initial standard deviation, in units of half the
            control range.
        clip: largest absolute normalised observation and scaled reward.
        region: settings of the policy's update.
        critic: settings of the critic's fit.

    Raises:
        StudyError: a number is out of its range.
    """

    batch: int = 20_000
    discount: float = 0.99
    decay: float = 0.95
    hidden: tuple[int, ...] = (64, 64)
    log_std: float = 0.0
    clip: float = 10.0
    region: TrustRegion = field(default_factory=TrustRegion)
    critic: CriticFit = field(default_factory=CriticFit)

    def __post_init__(self) -> None:
        for name, value, low, high in (
            ("discount", self.discount, 0.0, 1.0),
            ("decay", self.decay, 0.0, 1.0),
            ("kl", self.region.kl, 1e-9, np.inf),
            ("damping", self.region.damping, 0.0, np.inf),
        ):
            if not low <= value <= high:
                raise StudyError(f"policy: {name} is {value}; it must be from {low:g} to {high:g}")
        if self.batch < 2 or min(self.hidden, default=0) < 1:
            raise StudyError(
                f"policy: batch {self.batch} must be at least 2, hidden {self.hidden} not empty"
            )


class Iteration(NamedTuple):
    """What is logged of one iteration.

    Attributes:
        iteration: number, from 1.
        steps: control steps so far.
        batch_return: mean reward of the batch times the length of an episode.
        episodes: that ended in the batch after a whole episode.
        episode_return: their mean return; NaN where none ended.
        kl: mean KL divergence of the update.
        improvement: of the surrogate.
        cg_residual: of conjugate gradients, relative to the gradient.
        trials: of the line search.
        accepted: whether the line search found a step.
        explained_variance: 1 - Var[target - value] / Var[target], before the critic's fit.
        critic_loss: mean squared error of the critic after its fit.
        std: mean standard deviation of the policy.
    """

    iteration: int
    steps: int
    batch_return: float
    episodes: int
    episode_return: float
    kl: float
    improvement: float
    cg_residual: float
    trials: int
    accepted: bool
    explained_variance: float
    critic_loss: float
    std: float


class Trainer:
    """Everything that changes while a policy is trained, one iteration at a time.

    All draws come from generators seeded with (seed, iteration, purpose), so that a trainer that
    went on from `get_state` ends with the same policy to the last bit.

    Args:
        environment: of training; a batch holds equally many steps of each of its episodes.
        settings: of the algorithm.
        seed: of the networks, actions and shuffles.
        threads: 2 or more fit the critic while the policy is updated. Results do not depend on it.

    Raises:
        StudyError: the batch is not a multiple of the number of environments.
    """

    def __init__(
        self,
        environment: Environment,
        settings: TrpoSettings | None = None,
        *,
        seed: int = 0,
        threads: int = 1,
    ) -> None:
        self.settings = settings or TrpoSettings()
        if self.settings.batch % environment.n:
            raise StudyError(
                f"policy: batch {self.settings.batch} must be a multiple of the {environment.n} "
                "environments"
            )
        self.environment, self.seed = environment, seed
        self._parallel = threads > 1
        o, hidden = environment.observation_size, self.settings.hidden
        rng = np.random.default_rng((seed, 0, 0))
        self.policy = GaussianPolicy.of_size(o, environment.action_size, hidden)
        self.theta = self.policy.initial(rng, self.settings.log_std)
        value = Network((o, *hidden, 1))
        self.critic = Critic(value, value.initial(rng, last_gain=1.0))
        self.moments = Moments.of_size(o)
        self._scale = ReturnScale(
            self.settings.discount, np.zeros(environment.n), self.settings.clip
        )
        self._sums = np.zeros(environment.n)
        self._lengths = np.zeros(environment.n, np.int64)
        self.iterations = 0
        self._observation = environment.reset()

    @property
    def steps(self) -> int:
        """The control steps so far."""
        return self.iterations * self.settings.batch

    def normaliser(self) -> Normaliser:
        """Return the observations' statistics as they are now, frozen."""
        return Normaliser.of(self.moments, self.settings.clip)

    def iterate(self) -> Iteration:
        """Collect a batch, update policy and critic, and return what is to be logged."""
        with threadpool_limits(1):  # spinning BLAS threads would halve the simulation's speed
            return self._iterate()

    def _iterate(self) -> Iteration:
        settings = self.settings
        rngs = [np.random.default_rng((self.seed, self.iterations + 1, k)) for k in range(2)]
        rollout, self._observation = collect(
            self.environment,
            self._observation,
            self.policy,
            self.theta,
            self.normaliser(),
            settings.batch // self.environment.n,
            rngs[0],
        )
        self.moments.add(rollout.observations.reshape(-1, rollout.observations.shape[2]))
        values, advantage = self._estimate(rollout)
        targets = (advantage + values).ravel().astype(np.float32)
        o, a = rollout.normalised.shape[2], rollout.actions.shape[2]
        inputs = rollout.normalised.reshape(-1, o)
        batch = Batch(
            torch.from_numpy(inputs),
            torch.from_numpy(rollout.actions.reshape(-1, a)),
            normalised(torch.from_numpy(advantage.ravel().astype(np.float32))),
        )
        with ThreadPoolExecutor(1) as pool:
            fit = pool.submit(self.critic.fit, inputs, targets, settings.critic, rngs[1])
            if not self._parallel:
                fit.result()
            done = update(self.policy, torch.from_numpy(self.theta), batch, settings.region)
            loss = fit.result()
        self.theta = done.theta.numpy()
        self.iterations += 1
        episodes = self._episodes(rollout)
        return Iteration(
            iteration=self.iterations,
            steps=self.steps,
            batch_return=float(rollout.rewards.mean()) * self.environment.episode_steps,
            episodes=len(episodes),
            episode_return=float(np.mean(episodes)) if episodes else np.nan,
            kl=done.kl,
            improvement=done.improvement,
            cg_residual=done.cg_residual,
            trials=done.trials,
            accepted=done.accepted,
            explained_variance=_explained(values.ravel(), targets),
            critic_loss=loss,
            std=float(np.exp(self.policy.log_std(self.theta)).mean()),
        )

    def _estimate(self, rollout: Rollout) -> tuple[np.ndarray, np.ndarray]:
        """Return values and advantages, `T x n` each; time limits are bootstrapped."""
        ended = rollout.ended
        rewards = self._scale(rollout.rewards, ended)
        shape = rewards.shape
        values = self.critic.values(
            rollout.normalised.reshape(-1, rollout.normalised.shape[2])
        ).reshape(shape)
        following = np.concatenate([values[1:], self.critic.values(rollout.last)[None]])
        if ended.any():
            following[ended] = self.critic.values(rollout.finals)
        following[rollout.terminated] = 0.0
        advantage = advantages(
            rewards, values, following, ended, self.settings.discount, self.settings.decay
        )
        return values, advantage

    def _episodes(self, rollout: Rollout) -> list[float]:
        """Return the returns of whole episodes that ended; staggered first ones are not whole."""
        returns = []
        for reward, terminated, truncated in zip(
            rollout.rewards, rollout.terminated, rollout.truncated, strict=True
        ):
            self._sums += reward
            self._lengths += 1
            for i in np.flatnonzero(terminated | truncated):
                if terminated[i] or self._lengths[i] == self.environment.episode_steps:
                    returns.append(float(self._sums[i]))
                self._sums[i] = 0.0
                self._lengths[i] = 0
        return returns

    def get_state(self) -> dict[str, np.ndarray]:
        """Return copies of all that `set_state` needs to go on exactly from here."""
        groups = {
            "critic": self.critic.get_state(),
            "moments": self.moments.get_state(),
            "scale": self._scale.get_state(),
            "environment": self.environment.get_state(),
        }
        state = {f"{g}.{name}": a for g, group in groups.items() for name, a in group.items()}
        return state | {
            "theta": self.theta.copy(),
            "sums": self._sums.copy(),
            "lengths": self._lengths.copy(),
            "iterations": np.array(self.iterations),
        }

    def set_state(self, state: dict[str, np.ndarray]) -> None:
        """Go on from `get_state`'s result, of a trainer made with the same arguments."""

        def group(name: str) -> dict[str, np.ndarray]:
            start = f"{name}."
            return {k[len(start) :]: a for k, a in state.items() if k.startswith(start)}

        self.critic.set_state(group("critic"))
        self.moments.set_state(group("moments"))
        self._scale.set_state(group("scale"))
        self._observation = self.environment.set_state(group("environment"))
        self.theta = np.array(state["theta"])
        self._sums[:] = state["sums"]
        self._lengths[:] = state["lengths"]
        self.iterations = int(state["iterations"])


def _explained(values: np.ndarray, targets: np.ndarray) -> float:
    variance = float(np.var(targets))
    return 1 - float(np.var(targets - values)) / variance if variance > 0 else np.nan

"""One iteration of training: collect, estimate advantages, update policy and critic."""

from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from threadpoolctl import threadpool_limits

from bo_sysid.errors import StudyError, UserError
from bo_sysid.plants.environment import Environment
from bo_sysid.policy.critic import Critic
from bo_sysid.policy.network import GaussianPolicy, Network
from bo_sysid.policy.normalisation import Normaliser, ReturnScale, RunningMoments
from bo_sysid.policy.rollout import Rollout, collect
from bo_sysid.policy.settings import TrpoSettings
from bo_sysid.policy.trpo import Batch, Update, advantages, normalised, update


class TrainingIteration(NamedTuple):
    """What is logged of one iteration.

    Attributes:
        iteration: number, from 1.
        steps: control steps so far.
        batch_return: mean reward of the batch times the length of an episode in training.
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
    was restored from `get_state` ends with the same policy to the last bit.

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
        self.moments = RunningMoments.of_size(o)
        self._scale = ReturnScale(
            self.settings.discount, np.zeros(environment.n), self.settings.clip
        )
        self._sums = np.zeros(environment.n)
        self._lengths = np.zeros(environment.n, np.int64)
        self._first = np.ones(environment.n, bool)  # episodes, which may begin in their middle
        self.iterations = 0
        self._observation = environment.reset()

    @property
    def steps(self) -> int:
        """The control steps so far."""
        return self.iterations * self.settings.batch

    def normaliser(self) -> Normaliser:
        """Return the observations' statistics as they are now, frozen."""
        return Normaliser.of(self.moments, self.settings.clip)

    def iterate(self) -> TrainingIteration:
        """Collect a batch, update policy and critic, and return what is to be logged."""
        with threadpool_limits(1):  # spinning BLAS threads would halve the simulation's speed
            return self._iterate()

    def _iterate(self) -> TrainingIteration:
        number = self.iterations + 1
        acting, shuffling = (np.random.default_rng((self.seed, number, k)) for k in range(2))
        rollout, self._observation = collect(
            self.environment,
            self._observation,
            self.policy,
            self.theta,
            self.normaliser(),
            self.settings.batch // self.environment.n,
            acting,
        )
        _require_finite(rollout)
        self.moments.add(rollout.observations.reshape(-1, rollout.observations.shape[2]))
        values, advantage = self._estimate(rollout)
        targets = (advantage + values).astype(np.float32)
        done, loss = self._learn(rollout, advantage, targets, shuffling)
        self.theta, self.iterations = done.theta.numpy(), number
        episodes = self._episodes(rollout)
        return TrainingIteration(
            iteration=number,
            steps=self.steps,
            batch_return=float(rollout.rewards.mean()) * self.environment.episode_steps,
            episodes=len(episodes),
            episode_return=float(np.mean(episodes)) if episodes else np.nan,
            kl=done.kl,
            improvement=done.improvement,
            cg_residual=done.cg_residual,
            trials=done.trials,
            accepted=done.accepted,
            explained_variance=_explained(values, targets),
            critic_loss=loss,
            std=float(np.exp(self.policy.log_std(self.theta)).mean()),
        )

    def _learn(
        self,
        rollout: Rollout,
        advantage: Float[np.ndarray, "T n"],
        targets: Float[np.ndarray, "T n"],
        rng: np.random.Generator,
    ) -> tuple[Update, float]:
        """Update the policy and fit the critic, at once where there are threads for it."""
        inputs = rollout.normalised.reshape(-1, rollout.normalised.shape[2])
        batch = Batch(
            torch.from_numpy(inputs),
            torch.from_numpy(rollout.actions.reshape(len(inputs), -1)),
            normalised(torch.from_numpy(advantage.ravel().astype(np.float32))),
        )
        theta, settings = torch.from_numpy(self.theta), self.settings
        fit = partial(self.critic.fit, inputs, targets.ravel(), settings.critic, rng)
        if not self._parallel:
            return update(self.policy, theta, batch, settings.region), fit()
        with ThreadPoolExecutor(1) as pool:
            fitting = pool.submit(fit)
            return update(self.policy, theta, batch, settings.region), fitting.result()

    def _estimate(
        self, rollout: Rollout
    ) -> tuple[Float[np.ndarray, "T n"], Float[np.ndarray, "T n"]]:
        """Return values and advantages, `T x n` each; time limits are bootstrapped."""
        ended = rollout.ended
        rewards = self._scale(rollout.rewards, ended)
        shape = rewards.shape
        values = self.critic.values(
            rollout.normalised.reshape(-1, rollout.normalised.shape[2])
        ).reshape(shape)
        next_values = np.concatenate([values[1:], self.critic.values(rollout.last)[None]])
        if ended.any():
            next_values[ended] = self.critic.values(rollout.finals)
        next_values[rollout.terminated] = 0.0
        advantage = advantages(
            rewards, values, next_values, ended, self.settings.discount, self.settings.decay
        )
        return values, advantage

    def _episodes(self, rollout: Rollout) -> list[float]:
        """Return the returns of whole episodes that ended.

        The first of each simulation is not whole where it reached the time limit too early: it was
        staggered. Later ones may be shorter, where the task cuts them.
        """
        returns = []
        for reward, terminated, truncated in zip(
            rollout.rewards, rollout.terminated, rollout.truncated, strict=True
        ):
            self._sums += reward
            self._lengths += 1
            for i in np.flatnonzero(terminated | truncated):
                whole = self._lengths[i] == self.environment.episode_steps
                if terminated[i] or whole or not self._first[i]:
                    returns.append(float(self._sums[i]))
                self._sums[i], self._lengths[i], self._first[i] = 0.0, 0, False
        return returns

    def get_state(self) -> dict[str, np.ndarray]:
        """Return copies of all that `set_state` needs to continue exactly from here."""
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
            "first": self._first.copy(),
            "iterations": np.array(self.iterations),
        }

    def set_state(self, state: dict[str, np.ndarray]) -> None:
        """Restore the state of `get_state`, of a trainer made with the same arguments."""

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
        self._first[:] = state["first"]
        self.iterations = int(state["iterations"])


def _require_finite(rollout: Rollout) -> None:
    """Refuse a batch that cannot be learned from.

    Raises:
        UserError: the task gave an observation or a reward that is not finite.
    """
    for what, values in (("reward", rollout.rewards), ("observation", rollout.observations)):
        bad = np.argwhere(~np.isfinite(values))
        if len(bad):
            raise UserError(
                f"policy: the task gave a {what} of {values[tuple(bad[0])]} in control step "
                f"{bad[0][0]} of the batch, in simulation {bad[0][1]}; all must be finite"
            )
    # what a step that ended an episode for good led to has no value: it may be anything
    lasting = rollout.finals[~rollout.terminated[rollout.ended]]
    for values, at in ((lasting, "at a time limit"), (rollout.last, "after the last step")):
        if not np.isfinite(values).all():
            raise UserError(
                f"policy: the task gave an observation that is not finite {at} of the batch; "
                "all must be finite"
            )


def _explained(values: Float[np.ndarray, "T n"], targets: Float[np.ndarray, "T n"]) -> float:
    variance = float(np.var(targets))
    return 1 - float(np.var(targets - values)) / variance if variance > 0 else np.nan

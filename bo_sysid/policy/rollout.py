"""Collection of a batch with a stochastic policy, in lock-step."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from bo_sysid.plants.environment import Environment
from bo_sysid.policy.network import GaussianPolicy
from bo_sysid.policy.normalisation import Normaliser


class Rollout(NamedTuple):
    """`T` control steps of `n` environments.

    Attributes:
        observations: `T x n x o`, as observed.
        normalised: `T x n x o`, as the policy saw them, float32.
        actions: `T x n x a`, as drawn, float32.
        rewards: `T x n`.
        terminated: `T x n`, the episode ended for good with this step.
        truncated: `T x n`, the episode reached its time limit with this step.
        finals: `k x o`, for each True of `terminated | truncated`, k in row-major order, the
            normalised observation that the step led to.
        last: `n x o`, the normalised observation that the next batch will begin with.
    """

    observations: Float[np.ndarray, "T n o"]
    normalised: Float[np.ndarray, "T n o"]
    actions: Float[np.ndarray, "T n a"]
    rewards: Float[np.ndarray, "T n"]
    terminated: Bool[np.ndarray, "T n"]
    truncated: Bool[np.ndarray, "T n"]
    finals: Float[np.ndarray, "k o"]
    last: Float[np.ndarray, "n o"]

    @property
    def ended(self) -> Bool[np.ndarray, "T n"]:
        """`T x n`, the episode ended with this step."""
        return np.asarray(self.terminated | self.truncated)


def collect(
    environment: Environment,
    observation: Float[np.ndarray, "n o"],
    policy: GaussianPolicy,
    theta: Float[np.ndarray, " p"],
    normaliser: Normaliser,
    steps: int,
    rng: np.random.Generator,
) -> tuple[Rollout, Float[np.ndarray, "n o"]]:
    """Act for `steps` control steps; episodes continue across calls.

    Args:
        environment: where to act.
        observation: `n x o`, what it last showed.
        policy: layout of the policy's parameters.
        theta: parameters, float32.
        normaliser: of observations, frozen during the batch.
        steps: control steps of each of the `n` environments.
        rng: of the actions.

    Returns:
        What was collected, and the `n x o` observation to continue from.
    """
    n, o = observation.shape
    spread = np.exp(policy.log_std(theta))
    # all draws at once; the noise becomes the actions
    actions = rng.standard_normal((steps, n, policy.actions), dtype=np.float32)
    actions *= spread
    observations = np.empty((steps, n, o))
    seen = np.empty((steps, n, o), np.float32)
    rewards = np.empty((steps, n))
    terminated, truncated = np.zeros((steps, n), bool), np.zeros((steps, n), bool)
    finals = []
    for t in range(steps):
        observations[t] = observation
        seen[t] = normaliser(observation)
        actions[t] += policy.network(theta, seen[t])
        step = environment.step(actions[t])
        rewards[t], terminated[t], truncated[t] = step.reward, step.terminated, step.truncated
        ended = step.terminated | step.truncated
        if ended.any():
            finals.append(step.final[ended])
        observation = step.observation
    ends = normaliser(np.concatenate(finals)) if finals else np.empty((0, o), np.float32)
    rollout = Rollout(
        observations,
        seen,
        actions,
        rewards,
        terminated,
        truncated,
        ends,
        normaliser(observation),
    )
    return rollout, observation

"""Collection of a batch with a stochastic policy, in lock-step."""

from typing import NamedTuple

import numpy as np

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
        finals: for each True of `terminated | truncated`, in row-major order, the normalised
            observation that the step led to.
        last: `n x o`, the normalised observation that the next batch will begin with.
    """

    observations: np.ndarray
    normalised: np.ndarray
    actions: np.ndarray
    rewards: np.ndarray
    terminated: np.ndarray
    truncated: np.ndarray
    finals: np.ndarray
    last: np.ndarray

    @property
    def ended(self) -> np.ndarray:
        """`T x n`, the episode ended with this step."""
        return np.asarray(self.terminated | self.truncated)


def collect(
    environment: Environment,
    observation: np.ndarray,
    policy: GaussianPolicy,
    theta: np.ndarray,
    normaliser: Normaliser,
    steps: int,
    rng: np.random.Generator,
) -> tuple[Rollout, np.ndarray]:
    """Act for `steps` control steps; episodes go on across calls.

    Args:
        environment: where to act.
        observation: `n x o`, what it last showed.
        policy: layout of the policy's parameters.
        theta: parameters, float32.
        normaliser: of observations, frozen during the batch.
        steps: control steps of each of the `n` environments.
        rng: of the actions.

    Returns:
        What was collected, and the `n x o` observation to go on from.
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
        if step.final is not step.observation:
            finals.append(step.final[step.terminated | step.truncated])
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

"""The value V^π(β) of a policy on many models, by common random numbers.

Episode k has the same start on every model, so that the difference between two models is that of
pairs of episodes; its standard error is that of the mean of these differences.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import mujoco
import numpy as np
from jaxtyping import Float

from bo_sysid.intervals import half_width
from bo_sysid.learn.scene import Scene
from bo_sysid.plants.environment import episode_returns
from bo_sysid.plants.plant import Act
from bo_sysid.plants.python_task import PythonTask

_SIMULATIONS = 256  # at once; more fall out of the processor's cache
VALUE_SEED = 1_000_003  # starts of valuation are none of those of training


class Estimate(NamedTuple):
    """A mean and its standard error, in the unit of the samples.

    Attributes:
        mean: of the samples.
        error: standard error of the mean; infinite for one sample.
        samples: number of independent samples.
    """

    mean: float
    error: float
    samples: int

    @classmethod
    def of(cls, samples: Float[np.ndarray, " E"]) -> "Estimate":
        """Return the mean of `E` independent samples; the error of a single one is infinite."""
        count = len(samples)
        error = float(samples.std(ddof=1) / np.sqrt(count)) if count > 1 else np.inf
        return cls(float(samples.mean()), error, count)

    @property
    def half_width(self) -> float:
        """Half the width of the 95 % interval, in the unit of the samples."""
        return float(half_width(self.error, self.samples))


@dataclass(frozen=True)
class Values:
    """Returns of one policy on K models, episode k from the same start on each.

    Attributes:
        returns: `K x E` undiscounted sums of rewards, in the task's unit of reward.
    """

    returns: Float[np.ndarray, "K E"]

    @property
    def episodes(self) -> int:
        """The number of paired episodes."""
        return int(self.returns.shape[1])

    def value(self, model: int) -> Estimate:
        """Return V on one model."""
        return Estimate.of(self.returns[model])

    def difference(self, model: int, other: int) -> Estimate:
        """Return V on one model minus V on another, of paired episodes."""
        return Estimate.of(self.returns[model] - self.returns[other])


def values(
    scene: Scene,
    models: Sequence[mujoco.MjModel],
    act: Act,
    *,
    threads: int = 1,
    times: int = 1,
) -> Values:
    """Return the returns of a policy on models, `times learn.episodes` episodes on each.

    The first episodes do not depend on `times`.

    Args:
        scene: task, number of episodes and seed.
        models: the `K` models.
        act: returns `n x a` actions in [-1, 1] for `n x o` observations.
        threads: of the simulation.
        times: multiple of `learn.episodes`, E = `times learn.episodes`.
    """
    episodes, seed = times * scene.study.learn.episodes, scene.seed + VALUE_SEED
    if isinstance(scene.task, PythonTask):
        each = [episode_returns(scene.environment(m, episodes, seed=seed), act) for m in models]
        return Values(np.array(each))
    at_once = max(_SIMULATIONS // episodes, 1)
    parts = []
    for first in range(0, len(models), at_once):
        group = models[first : first + at_once]
        environment = scene.environment(
            [m for m in group for _ in range(episodes)],
            len(group) * episodes,
            seed=seed,
            threads=threads,
            common=episodes,
        )
        parts.append(episode_returns(environment, act).reshape(len(group), episodes))
    return Values(np.concatenate(parts))

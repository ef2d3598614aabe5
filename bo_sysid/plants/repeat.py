"""Action repeat: a task whose actions are held for several of its control steps."""

import mujoco
import numpy as np

from bo_sysid.plants.simulations import Simulations
from bo_sysid.plants.tasks.base import Start, VectorTask


class RepeatedTask(VectorTask):
    """A task in which every action is held for `repeat` control steps and earns all their rewards.

    Exploration with independent noise in every action reaches further where actions last longer.

    Args:
        task: the task.
        repeat: control steps of the task an action, at least 1.
    """

    def __init__(self, task: VectorTask, repeat: int) -> None:
        self.task, self.repeat = task, repeat * task.repeat
        self.control_timestep = repeat * task.control_timestep
        self.time_limit = task.time_limit
        self.goal_size = task.goal_size  # type: ignore[misc] # a class variable of most tasks
        self.settle_time = task.settle_time  # type: ignore[misc]
        self.rewarded = task.rewarded  # type: ignore[misc]

    def draw_start(self, model: mujoco.MjModel, rng: np.random.Generator) -> Start:
        """Draw where an episode begins, as the task does."""
        return self.task.draw_start(model, rng)

    def get_observation(self, sims: Simulations) -> np.ndarray:
        """Return the task's observations."""
        return self.task.get_observation(sims)

    def get_reward(self, sims: Simulations) -> np.ndarray:
        """Return the task's rewards of the last of the repeated control steps."""
        return self.task.get_reward(sims)

    def is_terminated(self, sims: Simulations) -> np.ndarray:
        """Return which episodes the task has ended."""
        return self.task.is_terminated(sims)

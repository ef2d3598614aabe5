"""What a vectorised task is, and the registry of those that are known."""

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

import mujoco
import numpy as np

from bo_sysid.errors import StudyError, nearest
from bo_sysid.plants.simulations import Simulations


@dataclass(frozen=True)
class Start:
    """Where an episode begins.

    Attributes:
        qpos: `nq` positions.
        qvel: `nv` velocities; zero where not given.
        goal: `g` quantities of the task for this episode (see `Simulations.goal`).
    """

    qpos: np.ndarray
    qvel: np.ndarray | None = None
    goal: np.ndarray | None = None


class VectorTask(ABC):
    """Start distribution, observation and reward of a task, for many simulations at once.

    Attributes:
        control_timestep: time between two actions in [s], a multiple of the model's time step.
        time_limit: length of an episode in [s]. Reaching it truncates, it does not terminate.
        repeat: equal parts of `control_timestep` of which each earns a reward; see
            `bo_sysid.plants.repeat`.
        goal_size: how many numbers `Start.goal` has.
        settle_time: time in [s] to simulate without control before an episode begins.
        rewarded: whether there is a reward to learn from.
    """

    control_timestep: float
    time_limit: float
    repeat: int = 1
    goal_size: ClassVar[int] = 0
    settle_time: ClassVar[float] = 0.0
    rewarded: ClassVar[bool] = True

    @property
    def name(self) -> str:
        """What it is called in messages."""
        return type(self).__name__

    @abstractmethod
    def draw_start(self, model: mujoco.MjModel, rng: np.random.Generator) -> Start:
        """Draw where an episode begins."""

    @abstractmethod
    def get_observation(self, sims: Simulations) -> np.ndarray:
        """Return the `n x o` observations at the present state; they may be a live view."""

    @abstractmethod
    def get_reward(self, sims: Simulations) -> np.ndarray:
        """Return the `n` rewards of the step that led to the present state.

        It is asked once a part of a step, and may change `sims.goal`, on which the next depends.
        """

    def is_terminated(self, sims: Simulations) -> np.ndarray:
        """Return which of the `n` episodes have ended for good; none by default.

        It is asked once an action, after `get_reward` of the last of its parts.
        """
        return np.zeros(len(sims), bool)


class WrappedTask(VectorTask):
    """A task around another one, which does what this one does not say otherwise.

    Args:
        task: the task within.
    """

    def __init__(self, task: VectorTask) -> None:
        self.task, self.repeat = task, task.repeat
        self.control_timestep, self.time_limit = task.control_timestep, task.time_limit
        self.goal_size = task.goal_size  # type: ignore[misc] # a class variable of most tasks
        self.settle_time = task.settle_time  # type: ignore[misc]
        self.rewarded = task.rewarded  # type: ignore[misc]

    @property
    def name(self) -> str:
        """What the task is called in messages."""
        return self.task.name

    def draw_start(self, model: mujoco.MjModel, rng: np.random.Generator) -> Start:
        """Draw where an episode begins, as the task does."""
        return self.task.draw_start(model, rng)

    def get_observation(self, sims: Simulations) -> np.ndarray:
        """Return the task's observations."""
        return self.task.get_observation(sims)

    def get_reward(self, sims: Simulations) -> np.ndarray:
        """Return the task's rewards."""
        return self.task.get_reward(sims)

    def is_terminated(self, sims: Simulations) -> np.ndarray:
        """Return which episodes the task has ended."""
        return self.task.is_terminated(sims)


_TASKS: dict[tuple[str, str], VectorTask] = {}


def register(domain: str, name: str, *args: object) -> Callable[[type], type]:
    """Return a decorator that registers a task class, made with `args`, as `domain` `name`."""

    def add(cls: type) -> type:
        _TASKS[domain, name] = cls(*args)
        return cls

    return add


def registered() -> tuple[tuple[str, str], ...]:
    """Return domain and name of every vectorised task."""
    return tuple(sorted(_TASKS))


def find_task(domain: str, name: str) -> VectorTask:
    """Return a vectorised task.

    Raises:
        StudyError: there is none of this name.
    """
    try:
        return _TASKS[domain, name]
    except KeyError:
        known = [" ".join(key) for key in _TASKS]
        raise StudyError(
            f"task: no vectorised task '{domain} {name}'; {nearest(f'{domain} {name}', known)}"
        ) from None

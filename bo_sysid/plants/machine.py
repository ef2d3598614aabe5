"""What a plant moves: one simulated machine, however it is simulated."""

from collections.abc import Sequence
from typing import NamedTuple, Protocol, runtime_checkable

import mujoco
import numpy as np
from jaxtyping import Float

from bo_sysid.plants.environment import BatchEnvironment
from bo_sysid.plants.tasks.base import Start, VectorTask
from bo_sysid.simulation.lockstep import ForceLaw

TRACED = ("qpos", "qvel", "act", "ctrl", "qacc_warmstart")


class Applied(NamedTuple):
    """What one control step led to.

    Attributes:
        rows: `k x ...` "time" and the fields of `TRACED` after each of the k physics steps.
        observation: `1 x o`.
        reward: of the step.
        ended: the task ended the episode for good.
        diverged: the state stopped being finite; the last rows may repeat or restart.
        cut: the task ended the episode, and what would have followed counts, as at a time limit.
    """

    rows: dict[str, np.ndarray]
    observation: np.ndarray
    reward: float
    ended: bool
    diverged: bool
    cut: bool = False


@runtime_checkable
class SteppedMachine(Protocol):
    """One machine that is moved step by step."""

    episode_steps: int
    action_size: int

    @property
    def goal(self) -> np.ndarray:
        """`g` numbers of this episode's goal, such as where a target is; none where unknown."""
        ...

    def skip(self, episodes: int) -> None:
        """Let the next episode be that after the first `episodes`."""
        ...

    def begin(self, start: Start | None) -> np.ndarray:
        """Begin an episode, drawn by the task or as given; return the `1 x o` observation."""
        ...

    def controls(self, actions: np.ndarray) -> np.ndarray:
        """Return the controls of `1 x a` actions in [-1, 1]."""
        ...

    def present(self) -> dict[str, np.ndarray]:
        """Return `1 x ...` "time" and the fields of `TRACED` now."""
        ...

    def apply(self, controls: np.ndarray) -> Applied:
        """Hold controls for one control step."""
        ...


def command_ends(
    machine: SteppedMachine,
) -> tuple[Float[np.ndarray, " a"], Float[np.ndarray, " a"]]:
    """Return the `a` controls of actions that are all -1, and of those that are all 1."""
    ones = np.ones((1, machine.action_size))
    return machine.controls(-ones)[0], machine.controls(ones)[0]


class VectorMachine:
    """A vectorised task with one simulation.

    Args:
        task: the task.
        model: what is simulated.
        seed: of the starts.
        laws: forces stepped with the simulation.
    """

    def __init__(
        self,
        task: VectorTask,
        model: mujoco.MjModel,
        seed: int,
        laws: Sequence[ForceLaw] = (),
    ) -> None:
        self._environment = BatchEnvironment(task, model, 1, seed=seed, laws=laws)
        self.episode_steps = self._environment.episode_steps
        self.action_size = self._environment.action_size

    @property
    def goal(self) -> np.ndarray:
        """`g` numbers of this episode's goal."""
        return np.array(self._environment.sims.goal[0])

    def skip(self, episodes: int) -> None:
        """Let the next episode be that after the first `episodes`."""
        self._environment.skip(episodes)

    def begin(self, start: Start | None) -> np.ndarray:
        """Begin an episode, drawn by the task or as given."""
        return self._environment.reset() if start is None else self._environment.begin([start])

    def controls(self, actions: np.ndarray) -> np.ndarray:
        """Return the controls of `1 x a` actions in [-1, 1]."""
        return self._environment.controls(actions)

    def present(self) -> dict[str, np.ndarray]:
        """Return what `apply` traces, now."""
        return {f: self._environment.sims.field(f).copy() for f in ("time", *TRACED)}

    def apply(self, controls: np.ndarray) -> Applied:
        """Hold controls for one control step."""
        environment, sims = self._environment, self._environment.sims
        sims.ctrl[:] = controls
        parts, reward = [], 0.0
        for _ in range(environment.task.repeat):
            parts.append(sims.trace(environment.substeps, TRACED))
            reward += float(environment.task.get_reward(sims)[0])
        diverged = bool(sims.diverged()[0])
        return Applied(
            {field: np.concatenate([p[field][0] for p in parts]) for field in parts[0]},
            environment.task.get_observation(sims),
            0.0 if diverged else reward,
            bool(environment.task.is_terminated(sims)[0]),
            diverged,
        )

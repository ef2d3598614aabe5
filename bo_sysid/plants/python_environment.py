"""Machines and episodes of a `PythonTask`, one after the other."""

from collections import OrderedDict
from collections.abc import Mapping

import mujoco
import numpy as np

from bo_sysid.errors import UserError
from bo_sysid.plants.environment import Step, episode_steps, physics_steps
from bo_sysid.plants.machine import TRACED, Applied
from bo_sysid.plants.python_task import PythonTask, guarded
from bo_sysid.plants.tasks.base import Start

_BOUND = 1e9  # beyond it a limit of an action is none
_STATE = int(mujoco.mjtState.mjSTATE_INTEGRATION)


class PythonMachine:
    """One machine under a `PythonTask`.

    Args:
        task: the task.
        model: what is simulated, with the visuals that the task may refer to.
        seed: of the starts: that of episode k is drawn with (seed, index, k), where the task has
            the random state of dm_control's suite; a task with a generator of its own is made with
            what follows from (seed, index).
        index: of this machine among several.

    Attributes:
        observed: names of what observations hold, in order, with how many numbers each
            has; none where the task gives an array.
    """

    observed: tuple[str, ...] = ()

    def __init__(self, task: PythonTask, model: mujoco.MjModel, seed: int, index: int = 0) -> None:
        from dm_control.mujoco import wrapper

        self.physics = task.physics.from_model(wrapper.MjModel(model))
        self._name, self._size = task.name, 0
        with guarded(task.name, "__init__"):
            self.task = task.make(_seed(seed, index))
        self._substeps = physics_steps(task.control_timestep, model)
        self.episode_steps = episode_steps(task.time_limit, task.control_timestep)
        self._seed, self._index, self.episodes = seed, index, 0
        with guarded(task.name, "action_spec"):
            spec = self.task.action_spec(self.physics)
        self.action_size = int(np.prod(spec.shape))
        self._low = np.broadcast_to(spec.minimum, spec.shape).astype(float).ravel()
        self._high = np.broadcast_to(spec.maximum, spec.shape).astype(float).ravel()

    @property
    def goal(self) -> np.ndarray:
        """Nothing: what a task in Python aims at is its own."""
        return np.empty(0)

    def skip(self, episodes: int) -> None:
        """Let the next episode be that after the first `episodes`.

        A task with a generator of its own begins all of them, so that it draws as it did.
        """
        if hasattr(self.task, "_random"):
            self.episodes = episodes
        while self.episodes < episodes:
            self.begin()

    def begin(self, start: Start | None = None) -> np.ndarray:
        """Begin an episode, drawn by the task or from the given positions and velocities."""
        if hasattr(self.task, "_random"):
            sequence = np.random.SeedSequence((self._seed, self._index, self.episodes))
            self.task._random = np.random.RandomState(sequence.generate_state(4))
        self.episodes += 1
        with guarded(self._name, "initialize_episode"), self.physics.reset_context():
            self.task.initialize_episode(self.physics)
        if start is not None:
            with self.physics.reset_context():
                self.physics.data.qpos[:] = start.qpos
                self.physics.data.qvel[:] = 0.0 if start.qvel is None else start.qvel
        return self.observe()

    def observe(self, *, diverged: bool = False) -> np.ndarray:
        """Return the `1 x o` observation, all entries in a row as dm_control flattens them.

        Args:
            diverged: it ends an episode whose simulation has failed, and may be anything.

        Raises:
            UserError: it is no array of finite numbers, or has not the size that it had.
        """
        with guarded(self._name, "get_observation"):
            entries = self.task.get_observation(self.physics)
            if isinstance(entries, Mapping):
                names = entries if isinstance(entries, OrderedDict) else sorted(entries)
                if not self.observed:
                    self.observed = tuple(_numbered(n, np.size(entries[n])) for n in names)
                entries = np.concatenate([np.ravel(entries[name]) for name in names])
            if entries is None:
                raise UserError(f"task {self._name}: get_observation returned None")
            row = np.asarray(entries, float).reshape(1, -1)
        if diverged:
            row = np.nan_to_num(row)
        if not np.isfinite(row).all():
            where, value = int(np.argmin(np.isfinite(row))), row[~np.isfinite(row)][0]
            raise UserError(
                f"task {self._name}: number {where} of its observation is {value} after "
                f"{self.physics.data.time:.4g} s; all must be finite"
            )
        self._size = self._size or row.shape[1]
        if row.shape[1] != self._size:
            raise UserError(
                f"task {self._name}: an observation of size {row.shape[1]} after one of size "
                f"{self._size}; it must keep its size"
            )
        return row

    def controls(self, actions: np.ndarray) -> np.ndarray:
        """Return the task's actions, `1 x a`, for actions in [-1, 1].

        Raises:
            UserError: the task's actions are not bounded.
        """
        free = ~(np.abs([self._low, self._high]) < _BOUND).all(axis=0)
        if free.any():
            raise UserError(
                f"task {self._name}: {self._action(int(np.argmax(free)))} has no bounds to learn "
                "within; give the actuator a ctrlrange in the model or an effort under limits, or "
                "the task an action_spec with bounds"
            )
        half = (self._high - self._low) / 2
        return np.asarray((self._low + self._high) / 2 + half * np.clip(actions, -1, 1))

    def _action(self, number: int) -> str:
        """Return in words which action that is: its actuator, where there is one for each."""
        model = self.physics.model
        if self.action_size == model.nu and (name := model.id2name(number, "actuator")):
            return f"its action {number} (actuator {name!r})"
        return f"its action {number}"

    def present(self) -> dict[str, np.ndarray]:
        """Return "time" and the traced fields now, `1 x ...`."""
        data = self.physics.data
        return {f: np.array(getattr(data, f))[None] for f in ("time", *TRACED)}

    def apply(self, controls: np.ndarray) -> Applied:
        """Hold controls for one control step."""
        from dm_control.rl.control import PhysicsError

        with guarded(self._name, "before_step"):
            self.task.before_step(np.ravel(controls), self.physics)
        rows, diverged = [], False
        try:
            for _ in range(self._substeps):
                self.physics.step(1)
                rows.append(self.present())
        except PhysicsError:
            diverged = True
            rows.append(self.present())
        with guarded(self._name, "after_step"):
            self.task.after_step(self.physics)
        # a task may keep what one of these finds for the next: the order is dm_control's
        reward = 0.0 if diverged else self._reward()
        observation = self.observe(diverged=diverged)
        with guarded(self._name, "get_termination"):
            discount = self.task.get_termination(self.physics)  # None goes on
        return Applied(
            {field: np.concatenate([r[field] for r in rows]) for field in rows[0]},
            observation,
            reward,
            discount == 0.0,
            diverged,
            cut=discount not in (None, 0.0),
        )

    def _reward(self) -> float:
        with guarded(self._name, "get_reward"):
            reward = self.task.get_reward(self.physics)
        if reward is None:
            raise UserError(f"task {self._name} gave no reward: get_reward returned None")
        try:
            number = float(np.asarray(reward, float).item())
        except (TypeError, ValueError):
            raise UserError(
                f"task {self._name} gave a reward of {reward!r}; it must be one number"
            ) from None
        if not np.isfinite(number):
            raise UserError(
                f"task {self._name} gave a reward of {number} after "
                f"{self.physics.data.time:.4g} s; it must be finite"
            )
        return number


def _seed(seed: int, index: int) -> int:
    """Return the seed of a task of one machine among several."""
    return int(np.random.SeedSequence((seed, index)).generate_state(1)[0])


def _numbered(name: str, size: int) -> str:
    """Return the name of an entry of an observation, with how many numbers it has if several."""
    return name if size == 1 else f"{name} ({size})"


class PythonEnvironment:
    """Episodes of a `PythonTask`, one after the other; the interface of `BatchEnvironment`.

    What a task remembers in attributes of its own between steps is not part of `get_state`.

    Args:
        task: the task.
        model: of all machines, with visuals.
        n: number of machines.
        seed: of the starts.
        stagger: spread the first episodes' ends evenly over an episode.

    Raises:
        UserError: `n` is below 1, or the task does not fit the model.
    """

    def __init__(
        self,
        task: PythonTask,
        model: mujoco.MjModel,
        n: int,
        *,
        seed: int = 0,
        stagger: bool = False,
    ) -> None:
        if n < 1:
            raise UserError(f"environment: n is {n}; at least 1 simulation is needed")
        self.n = n
        self._stagger = stagger
        self._machines = [PythonMachine(task, model, seed, i) for i in range(n)]
        first = self._machines[0]
        self.episode_steps, self.action_size = first.episode_steps, first.action_size
        self.observation_size = first.begin().shape[1]
        first.episodes = 0
        self._steps = np.zeros(n, np.int64)
        self._observation = np.zeros((n, self.observation_size))

    def reset(self) -> np.ndarray:
        """Begin new episodes in all machines; return the `n x o` observations."""
        self._steps[:] = 0
        if self._stagger:
            self._steps[:] = np.arange(self.n) * self.episode_steps // self.n
        self._observation = np.concatenate([machine.begin() for machine in self._machines])
        return self._observation

    def step(self, actions: np.ndarray) -> Step:
        """Apply `n x a` actions in [-1, 1] for one control step; episodes that end begin anew."""
        outcomes = [m.apply(m.controls(a)) for m, a in zip(self._machines, actions, strict=True)]
        self._steps += 1
        final = np.concatenate([t.observation for t in outcomes])
        terminated = np.array([t.ended or t.diverged for t in outcomes])
        cut = np.array([t.cut for t in outcomes])
        truncated = ((self._steps >= self.episode_steps) | cut) & ~terminated
        observation = final
        if (terminated | truncated).any():
            observation = final.copy()
            for i in np.flatnonzero(terminated | truncated):
                observation[i] = self._machines[i].begin()[0]
                self._steps[i] = 0
        self._observation = observation
        reward = np.array([t.reward for t in outcomes])
        return Step(observation, reward, terminated, truncated, final)

    def get_state(self) -> dict[str, np.ndarray]:
        """Return the physics, the observations, the step counts and the numbers of episodes.

        An observation may hold what the last step left behind, such as a force that was felt.
        """
        return {
            "state": np.stack([m.physics.get_state(_STATE) for m in self._machines]),
            "observation": self._observation.copy(),
            "steps": self._steps.copy(),
            "episodes": np.array([m.episodes for m in self._machines]),
        }

    def set_state(self, state: dict[str, np.ndarray]) -> np.ndarray:
        """Restore the state that `get_state` returned; return the `n x o` observations."""
        self._steps[:] = state["steps"]
        rows = zip(self._machines, state["state"], state["episodes"], strict=True)
        for machine, physics, episodes in rows:
            machine.skip(int(episodes) - 1)
            if machine.episodes < episodes:
                machine.begin()  # what the task draws for this episode, such as a target
            machine.physics.set_state(physics, _STATE)
            machine.physics.forward()
        self._observation = state["observation"].copy()
        return self._observation

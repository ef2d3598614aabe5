"""Many episodes of one task in lock-step, as reinforcement learning wants them."""

from collections.abc import Callable, Sequence
from functools import cached_property
from typing import Any, NamedTuple, Protocol, runtime_checkable

import mujoco
import numpy as np
from jaxtyping import Float

from bo_sysid.errors import ModelError, UserError
from bo_sysid.mjcf.commands import controlled
from bo_sysid.plants.simulations import Simulations
from bo_sysid.plants.tasks.base import Start, VectorTask
from bo_sysid.simulation.lockstep import ForceLaw

_LAW = "law"  # begins the names of what laws know, in a state

# Draws the model of one simulation for its next episode.
ModelDraw = Callable[[np.random.Generator], mujoco.MjModel]


class Step(NamedTuple):
    """What one action of every episode led to.

    Attributes:
        observation: `n x o` to act on next; after the end of an episode, of the next one's start.
        reward: `n` rewards.
        terminated: `n`, the episode ended for good: the value of what follows is zero.
        truncated: `n`, the time limit was reached: what follows has a value.
        final: `n x o` observations that the actions led to, before any new start; the same array
            as `observation` where no episode ended.
    """

    observation: np.ndarray
    reward: np.ndarray
    terminated: np.ndarray
    truncated: np.ndarray
    final: np.ndarray


@runtime_checkable
class Environment(Protocol):
    """What learning and evaluation need; `BatchEnvironment` is the fast one."""

    n: int
    observation_size: int
    action_size: int
    episode_steps: int

    def reset(self) -> np.ndarray:
        """Begin new episodes; return the `n x o` observations."""
        ...

    def step(self, actions: np.ndarray) -> Step:
        """Apply `n x a` actions in [-1, 1] for one control step."""
        ...

    def get_state(self) -> dict[str, np.ndarray]:
        """Return all that a later `set_state` needs to go on exactly from here."""
        ...

    def set_state(self, state: dict[str, np.ndarray]) -> np.ndarray:
        """Restore a state; return the `n x o` observations."""
        ...


class BatchEnvironment:
    """Episodes of a `VectorTask`, simulated on a thread pool.

    Every draw at the start of episode k of simulation i comes from a generator seeded with
    (seed, i, k): results do not depend on threads, on when others begin, or on an interruption,
    and two environments with different models and one seed see the same starts (common random
    numbers).

    Args:
        task: starts, observations, rewards.
        model: the model of all simulations, or one a simulation, or a function that draws one
            for each episode (domain randomisation).
        n: number of simulations.
        seed: of everything that is drawn.
        threads: of the simulation; 0 for all cores. Results do not depend on it.
        stagger: spread the first episodes' ends evenly over an episode, so that later batches
            hold all phases of the task.
        common: simulations i and i + `common` have the same draws: several models, equal starts.
        laws: forces stepped with the simulation, as a plant may have them: slower.

    Raises:
        UserError: `n` or the number of models is wrong, their time steps differ, or the model does
            not fit the task.
    """

    def __init__(
        self,
        task: VectorTask,
        model: mujoco.MjModel | Sequence[mujoco.MjModel] | ModelDraw,
        n: int,
        *,
        seed: int = 0,
        threads: int = 1,
        stagger: bool = False,
        common: int | None = None,
        laws: Sequence[ForceLaw] = (),
    ) -> None:
        if n < 1:
            raise UserError(f"environment: n is {n}; at least 1 simulation is needed")
        self.task, self.n, self._seed, self._stagger = task, n, seed, stagger
        self._stream = np.arange(n) % (common or n)
        self._draw: ModelDraw | None = None
        self._models = self._first_models(model)
        first = self._models[0]
        for m in self._models:
            _require_time_step(first, m)
        self.substeps = physics_steps(task.control_timestep / task.repeat, first)
        self.episode_steps = episode_steps(task.time_limit, task.control_timestep)
        self.action_size = int(first.nu)
        self.sims = Simulations(first, n, task.goal_size, threads)
        if any(m is not first for m in self._models):
            self.sims.set_models(self._models)
        self.sims.set_laws(laws)
        try:  # binds what the task reads; values are not used
            self.observation_size = task.get_observation(self.sims).shape[1]
            task.get_reward(self.sims)
            task.is_terminated(self.sims)
        except KeyError as error:
            raise UserError(f"task {task.name} does not fit the model: {error}") from None
        self._steps = np.zeros(n, np.int64)
        self._episodes = np.zeros(n, np.int64)
        self._observation = np.zeros((n, self.observation_size))

    def _first_models(
        self, model: mujoco.MjModel | Sequence[mujoco.MjModel] | ModelDraw
    ) -> list[mujoco.MjModel]:
        if isinstance(model, mujoco.MjModel):
            return [model] * self.n
        if callable(model):
            self._draw = model
            return [model(self._generator(i, 0, purpose=1)) for i in range(self.n)]
        if len(model) != self.n:
            raise UserError(f"environment: {len(model)} models for {self.n} simulations")
        return list(model)

    def _generator(self, i: int, episode: int, purpose: int = 0) -> np.random.Generator:
        return np.random.default_rng((self._seed, int(self._stream[i]), episode, purpose))

    def reset(self) -> np.ndarray:
        """Begin new episodes in all simulations; return the `n x o` observations."""
        self.sims.begin_laws()
        self._restart(np.arange(self.n))
        if self._stagger:
            self._steps[:] = np.arange(self.n) * self.episode_steps // self.n
        return self._observation

    def begin(self, starts: Sequence[Start]) -> np.ndarray:
        """Begin new episodes from given starts, without settling; return the observations."""
        self.sims.begin_laws()
        self._place(np.arange(self.n), starts, settle=False)
        return self._observation

    @cached_property
    def _control_map(self) -> tuple[np.ndarray, np.ndarray]:
        low, high = control_range(self.sims.model)
        return (low + high) / 2, (high - low) / 2

    def controls(self, actions: np.ndarray) -> np.ndarray:
        """Return the `n x nu` controls of `n x a` actions, clipped to [-1, 1].

        Raises:
            ModelError: an actuator has no control range.
        """
        middle, half = self._control_map
        return np.asarray(middle + half * np.clip(actions, -1.0, 1.0))

    def step(self, actions: np.ndarray) -> Step:
        """Apply `n x a` actions for one control step; episodes that end begin anew."""
        self.sims.ctrl[:] = self.controls(actions)
        self.sims.advance(self.substeps)
        reward = self.task.get_reward(self.sims)
        for _ in range(self.task.repeat - 1):
            self.sims.advance(self.substeps)
            reward = reward + self.task.get_reward(self.sims)
        self._steps += 1
        final = self._observed()
        diverged = self.sims.diverged()
        terminated = self.task.is_terminated(self.sims) | diverged
        truncated = (self._steps >= self.episode_steps) & ~terminated
        if diverged.any():
            reward = np.where(diverged, 0.0, reward)
        self._observation = final
        ended = terminated | truncated
        if ended.any():
            self._restart(np.flatnonzero(ended))
        return Step(self._observation, reward, terminated, truncated, final)

    def _restart(self, rows: np.ndarray) -> None:
        starts = []
        for i in rows.tolist():
            episode = int(self._episodes[i])
            if self._draw is not None:
                self._models[i] = self._draw(self._generator(i, episode, purpose=1))
                _require_time_step(self.sims.model, self._models[i])
            starts.append(self.task.draw_start(self._models[i], self._generator(i, episode)))
        if self._draw is not None:
            self.sims.set_models(self._models)
        self._place(rows, starts, settle=True)

    def _place(self, rows: np.ndarray, starts: Sequence[Start], *, settle: bool) -> None:
        sims = self.sims
        sims.restart(rows)
        for i, start in zip(rows, starts, strict=True):
            sims.qpos[i] = start.qpos
            sims.qvel[i] = 0.0 if start.qvel is None else start.qvel
            if start.goal is not None:
                sims.goal[i] = start.goal
        sims.ctrl[rows] = 0.0
        if settle and self.task.settle_time > 0.0:
            steps = round(self.task.settle_time / sims.model.opt.timestep)
            sims.advance(steps, rows, fields=False)
            sims.field("time")[rows] = 0.0  # the episode's own, which laws see as well
        sims.forward(rows)
        self._steps[rows] = 0
        self._episodes[rows] += 1
        self._observation = self._observed()

    def _observed(self) -> np.ndarray:
        """Return the `n x o` observations; those of a task may be live views."""
        return np.array(self.task.get_observation(self.sims))

    def skip(self, episodes: int) -> None:
        """Let the next episodes be those after the first `episodes` of every simulation."""
        self._episodes[:] = episodes

    def get_state(self) -> dict[str, np.ndarray]:
        """Return copies of all that changes while episodes run."""
        return {
            "state": self.sims.state.copy(),
            "goal": self.sims.goal.copy(),
            "steps": self._steps.copy(),
            "episodes": self._episodes.copy(),
            "observation": self._observation.copy(),
            **{f"{_LAW} {name}": x for name, x in self.sims.law_state().items()},
        }

    def set_state(self, state: dict[str, np.ndarray]) -> np.ndarray:
        """Restore the state that `get_state` returned; return the `n x o` observations."""
        self.sims.state[:] = state["state"]
        self.sims.goal[:] = state["goal"]
        self._steps[:] = state["steps"]
        self._episodes[:] = state["episodes"]
        self._observation = np.array(state["observation"])
        laws = {n.removeprefix(f"{_LAW} "): x for n, x in state.items() if n.startswith(_LAW)}
        self.sims.set_law_state(laws)
        if self._draw is not None:
            for i, episode in enumerate((self._episodes - 1).tolist()):
                self._models[i] = self._draw(self._generator(i, episode, purpose=1))
            self.sims.set_models(self._models)
        return self._observation


def episode_returns(
    environment: Environment, act: Callable[[np.ndarray], np.ndarray]
) -> Float[np.ndarray, " n"]:
    """Return the `n` sums of rewards of one whole episode of every simulation.

    Args:
        environment: begins new episodes first; with equal seeds, those of other models are
            comparable start by start.
        act: returns `n x a` actions for `n x o` observations.
    """
    observation = environment.reset()
    total = np.zeros(environment.n)
    running = np.ones(environment.n, bool)
    while running.any():
        step = environment.step(act(observation))
        total += np.where(running, step.reward, 0.0)
        running &= ~(step.terminated | step.truncated)
        observation = step.observation
    return total


def episode_steps(time_limit: float, control_timestep: float) -> int:
    """Return how many control steps an episode has; of a task without end, the largest integer.

    Args:
        time_limit: of an episode in [s]; infinite where it has no end.
        control_timestep: between two actions in [s].
    """
    steps = time_limit / control_timestep
    return round(steps) if np.isfinite(steps) else int(np.iinfo(np.int64).max)


def _require_time_step(first: mujoco.MjModel, model: mujoco.MjModel) -> None:
    """Refuse a model that does not step as the first one does.

    Raises:
        UserError: their time steps differ.
    """
    a, b = float(first.opt.timestep), float(model.opt.timestep)
    if a != b:
        raise UserError(f"environment: models of time steps {a:g} and {b:g} s cannot step together")


def physics_steps(duration: float, model: mujoco.MjModel) -> int:
    """Return how many physics steps of `model` make `duration` in [s].

    Raises:
        UserError: `duration` is not a multiple of the physics step.
    """
    ratio = duration / float(model.opt.timestep)
    if round(ratio) < 1 or abs(ratio - round(ratio)) > 1e-6:
        raise UserError(
            f"the time step of {model.opt.timestep:g} s must divide {duration:g} s", key="timestep"
        )
    return round(ratio)


def control_range(
    model: mujoco.MjModel,
) -> tuple[Float[np.ndarray, " nu"], Float[np.ndarray, " nu"]]:
    """Return the lower and upper bounds of the `nu` controls, in MuJoCo's units of `ctrl`.

    Raises:
        ModelError: an actuator has no control range.
    """
    free = np.flatnonzero(model.actuator_ctrllimited == 0)
    if free.size:
        name: Any = model.actuator(controlled(model)[int(free[0])]).name
        raise ModelError(
            f"actuator {name!r} has no control range; give it a ctrlrange in the model, or an "
            "effort under limits"
        )
    low, high = np.array(model.actuator_ctrlrange.T)
    return low, high

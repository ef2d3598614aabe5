"""What trajectories are collected from: it hides its parameters, and counts."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
from jaxtyping import Float

from bo_sysid.errors import UserError
from bo_sysid.mjcf import Edit, Model
from bo_sysid.mjcf.commands import clamped
from bo_sysid.plants.environment import episode_returns, physics_steps
from bo_sysid.plants.load import Task, compiled, make_environment
from bo_sysid.plants.machine import SteppedMachine, VectorMachine, command_ends
from bo_sysid.plants.measuring import KINDS, Measuring
from bo_sysid.plants.python_environment import PythonMachine
from bo_sysid.plants.python_task import PythonTask
from bo_sysid.plants.tasks.bare import Bare
from bo_sysid.plants.tasks.base import Start
from bo_sysid.recording.value import Recording
from bo_sysid.simulation.lockstep import ForceLaw

# Returns `n x a` actions in [-1, 1] for `n x o` observations.
Act = Callable[[np.ndarray], np.ndarray]


class PlantError(UserError):
    """A plant was asked for more than its budget, or failed during a trajectory.

    Attributes:
        recording: what was recorded before the failure, where at least two instants were.
    """

    def __init__(self, message: str, recording: Recording | None = None) -> None:
        super().__init__(message)
        self.recording = recording


@dataclass(frozen=True)
class Trajectory:
    """One counted trajectory.

    Attributes:
        name: of its recording.
        steps: control steps.
        reward: sum of rewards; zero where there is no task.
        fault: what went wrong, if anything.
    """

    name: str
    steps: int
    reward: float
    fault: str = ""


class Plant:
    """A model with parameters of its own, or a task on it.

    Nothing but the plant knows its edits and its time step. One roll-out is one trajectory; they
    are counted, and more than `budget` are refused. Evaluation episodes are counted separately.

    Args:
        model: the nominal model, which also names the channels.
        edits: what the plant has differently: parameters and effects, as changes of its spec.
        task: starts, observations and rewards; without one, the plant begins at rest at the first
            keyframe or the reference position.
        name: prefix of the recordings' names.
        timestep: the plant's own time step in [s]; the model's by default.
        control_timestep: time between two rows of controls in [s] where there is no task; the
            model's time step by default.
        noise: standard deviation of the measurement noise, by kind ("qpos") or by channel
            ("qpos.elbow"), in the channel's unit. A policy acts on what is true.
        measured: which of "qpos", "qvel", "act" are recorded, beside the controls.
        budget: most trajectories; no limit by default.
        seed: of starts and noise.
        laws: forces that the plant has, stepped with it.

    Raises:
        PlantError: the budget is not positive.
        ModelError: the edited model does not compile.
        UserError: noise or measured channels are not the model's, or the plant's time step does
            not divide the control step.
    """

    def __init__(
        self,
        model: Model,
        edits: Sequence[Edit] = (),
        *,
        task: Task | None = None,
        name: str = "plant",
        timestep: float | None = None,
        control_timestep: float | None = None,
        noise: Mapping[str, float] | None = None,
        measured: Sequence[str] = KINDS,
        budget: int | None = None,
        seed: int = 0,
        laws: Sequence[ForceLaw] = (),
    ) -> None:
        if budget is not None and budget < 1:
            raise PlantError(f"{name}: budget is {budget}; at least 1 trajectory is needed")
        self.name, self.budget = name, budget
        self._sample = float(model.compile().opt.timestep)
        self.task = task if task is not None else Bare(control_timestep or self._sample)
        self._model = compiled(model, self.task, edits, timestep=timestep)
        self._measuring = Measuring(model, self._model, measured, noise, seed)
        self._laws = tuple(laws)
        self._machine = _machine(self.task, self._model, seed, self._laws)
        self._trajectories: list[Trajectory] = []
        self._evaluations = 0

    @property
    def trajectories(self) -> tuple[Trajectory, ...]:
        """The counted trajectories so far."""
        return tuple(self._trajectories)

    @property
    def evaluations(self) -> int:
        """The number of evaluation episodes so far, which are not trajectories."""
        return self._evaluations

    @property
    def goal(self) -> np.ndarray:
        """`g` numbers of the last trajectory's goal, such as where a target was."""
        return self._machine.goal

    def resume(self, trajectories: Sequence[Trajectory]) -> None:
        """Resume after trajectories that were counted before an interruption.

        The next one is the same as if there had been none.
        """
        self._trajectories = list(trajectories)
        self._machine.skip(len(self._trajectories))

    @property
    def control_timestep(self) -> float:
        """Time between two rows of controls in [s]."""
        return self.task.control_timestep

    @property
    def command_range(self) -> tuple[Float[np.ndarray, " a"], Float[np.ndarray, " a"]]:
        """The lowest and the highest of the `a` commands, or of the actions of a task in Python."""
        return command_ends(self._machine)

    def record(
        self,
        source: np.ndarray | Act,
        *,
        steps: int | None = None,
        start: Start | None = None,
        sample: float | None = None,
        warmstart: bool = False,
    ) -> Recording:
        """Roll out one trajectory and return what was recorded.

        Row k of the recording holds the state at time k and the control applied from time k on;
        the last row repeats the last control.

        Args:
            source: `S x nu` controls in the actuators' units, one row a control step, or a policy;
                where a task in Python has actions of its own, these are the rows.
            steps: control steps; by default all rows of the controls, or one episode.
            start: where to begin; drawn by the task otherwise. A given start does not settle.
            sample: time between two recorded instants in [s]: by default the model's time step,
                so that one-step predictions need no intermediate state. Controls change at the
                control rate in any case.
            warmstart: also record the solver's warm start, as ``aux.qacc_warmstart.<i>``. Without
                it a prediction at the true parameters differs from the recording by the solver's
                tolerance where constraints are active; with it, by nothing.

        Raises:
            PlantError: the budget is spent, the arguments do not fit, or the simulation diverged;
                what was recorded until then is in the error's `recording`.
            UserError: `sample` is not a multiple of the plant's time step.
        """
        if self.budget is not None and len(self._trajectories) >= self.budget:
            raise PlantError(
                f"{self.name}: all {self.budget} trajectories of its budget are spent; raise the "
                "budget, or go on with what was recorded"
            )
        stride = physics_steps(sample or self._sample, self._model)
        control, steps = self._control(source, steps)
        machine = self._machine
        observation = machine.begin(start)
        rows = [machine.present()]
        reward, done, diverged, ended = 0.0, 0, False, False
        while done < steps and not (diverged or ended):
            applied = machine.apply(control(done, observation))
            rows[-1]["ctrl"][-1] = applied.rows["ctrl"][0]  # applied from the last row's time on
            rows.append(applied.rows)
            _, observation, given, ended, diverged, cut = applied
            ended |= cut
            reward += given
            done += 1
        columns = {f: np.concatenate([r[f] for r in rows]) for f in rows[0]}
        # MuJoCo restarts a simulation that fails: its time stops or falls back to zero
        forward = np.diff(columns["time"], prepend=-1.0) > 0
        good = forward.size if forward.all() else int(np.argmin(forward))
        if diverged and good == forward.size:
            good -= len(rows[-1]["time"])  # no restart shows: nothing is sure of this step
        if 1 < good < forward.size:  # of the control that failed nothing is recorded
            columns["ctrl"][good - 1] = columns["ctrl"][good - 2]
        return self._finish_trajectory(columns, good, stride, done, reward, warmstart=warmstart)

    def evaluate(self, act: Act, episodes: int = 10, *, seed: int = 0) -> Float[np.ndarray, " E"]:
        """Return the sums of rewards of whole episodes, `episodes`; these are no trajectories.

        Episodes with one seed have the same starts on every plant with this task.

        Raises:
            PlantError: there is no task to be rewarded for, or it has no end.
        """
        if not self.task.rewarded:
            raise PlantError(f"{self.name}: a plant without a task has no reward to evaluate")
        if not np.isfinite(self.task.time_limit):
            raise PlantError(f"{self.name}: its task has no end, and so no whole episodes")
        self._evaluations += episodes
        environment = make_environment(self.task, self._model, episodes, seed=seed, laws=self._laws)
        return episode_returns(environment, act)

    def _control(
        self, source: np.ndarray | Act, steps: int | None
    ) -> tuple[Callable[[int, np.ndarray], np.ndarray], int]:
        """Return the control at (step, observation), and the number of steps."""
        if callable(source):
            if steps is None and not np.isfinite(self.task.time_limit):
                raise PlantError(f"{self.name}: without a task that ends, say for how many steps")
            act, controls = source, self._machine.controls
            most = self._machine.episode_steps
            return (lambda _, observation: controls(act(observation))), self._count(steps, most)
        rows = np.asarray(source, float)
        size = self._machine.action_size
        if rows.ndim != 2 or rows.shape[1] != size or not len(rows):
            raise PlantError(f"{self.name}: controls {rows.shape} must be S x {size}, S at least 1")
        bad = np.flatnonzero(~np.isfinite(rows).all(axis=1))
        if bad.size:
            raise PlantError(f"{self.name}: controls in row {bad[0]} are not finite")
        return (lambda k, _: rows[k]), self._count(steps, len(rows))

    def _count(self, steps: int | None, most: int) -> int:
        count = most if steps is None else steps
        if not 1 <= count <= most:
            raise PlantError(f"{self.name}: steps is {count}; from 1 to {most} are possible")
        return count

    def _finish_trajectory(
        self,
        rows: dict[str, np.ndarray],
        good: int,
        stride: int,
        steps: int,
        reward: float,
        *,
        warmstart: bool,
    ) -> Recording:
        """Count the trajectory and return its recording of `good` rows; raise if others failed."""
        number = len(self._trajectories)
        name = f"{self.name}-{number}"
        fault = ""
        if good < len(rows["time"]):
            fault = f"{name}: the plant's simulation diverged at {rows['time'][good - 1]:g} s"
        self._trajectories.append(Trajectory(name, steps, reward, fault))
        kept = {f: c[:good:stride] for f, c in rows.items()}
        kept["ctrl"] = clamped(self._model, kept["ctrl"])  # as they acted
        recording = None
        if len(kept["time"]) >= 2:
            recording = self._measuring.recording(name, number, kept, warmstart=warmstart)
        if fault or recording is None:
            raise PlantError(fault or f"{name}: shorter than two recorded instants", recording)
        return recording


def _machine(
    task: Task, model: mujoco.MjModel, seed: int, laws: Sequence[ForceLaw] = ()
) -> SteppedMachine:
    if isinstance(task, PythonTask):
        make_environment(task, model, 1, laws=laws)  # refuses laws
        return PythonMachine(task, model, seed)
    return VectorMachine(task, model, seed, laws)

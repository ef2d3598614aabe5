"""What a study asks to be learned: the task, the model at any candidate, the settings."""

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, replace

import mujoco
import numpy as np

from bo_sysid.arrays import Point, Probabilities
from bo_sysid.errors import UserError
from bo_sysid.excite.beside import simulated_forces
from bo_sysid.mjcf import Edit, Model, parameter_edits
from bo_sysid.parameters import CandidateSet, Parameter
from bo_sysid.plants.build import study_task
from bo_sysid.plants.environment import Environment, ModelDraw, control_range
from bo_sysid.plants.limits import limit_edits, require_ranges
from bo_sysid.plants.load import Task, compiled, make_environment
from bo_sysid.plants.machine import command_ends
from bo_sysid.plants.python_environment import PythonMachine
from bo_sysid.plants.python_task import PythonTask
from bo_sysid.policy.settings import TrpoSettings, TrustRegion
from bo_sysid.simulation import ForceLaw
from bo_sysid.study import Study
from bo_sysid.study.inputs import load_model
from bo_sysid.study.overview import candidate_set
from bo_sysid.study.requirements import require_scales

_ENVIRONMENTS = 80  # most simulations of a training; more fall out of the processor's cache


@dataclass(frozen=True)
class Scene:
    """A study with what `learn` needs of it.

    Attributes:
        study: the study.
        model: its nominal model.
        task: what is learned.
        parameters: what is uncertain.
        candidates: the discrete set B.
        limits: edits that keep commands within the study's limits.
        laws: forces that are no part of the MJCF, as from a diagnosis; stepped with the model.
    """

    study: Study
    model: Model
    task: Task
    parameters: tuple[Parameter, ...]
    candidates: CandidateSet
    limits: tuple[Edit, ...]
    laws: tuple[ForceLaw, ...] = ()

    @classmethod
    def of(cls, study: Study, task: Task | None = None) -> "Scene":
        """Return the scene of a study.

        Args:
            study: the study.
            task: what is learned; by default the study's.

        Raises:
            UserError: there is no task, nothing is uncertain, or something does not fit.
        """
        model = load_model(study)
        require_scales(study, model)
        task = task or study_task(study, model)
        if task is None or not task.rewarded:
            raise study.error(
                ("task",),
                "learn needs a task with a reward: task: {dm_control: {domain: …, task: …}}, or "
                "{file: reach.py, class: Reach}, a dm_control Task",
            )
        if not np.isfinite(task.time_limit):
            raise study.error(
                ("task",), "learn needs a task that ends: a class says its time_limit in s"
            )
        _require_a_step(study, task)
        if study.learn.models == "bootstrap" and isinstance(task, PythonTask):
            raise study.error(
                ("learn", "models"), "bootstrap needs a vectorised task; choose: chosen"
            )
        if study.actuators:
            raise study.error(
                ("actuators", next(iter(study.actuators))),
                "a policy commands the actuators itself, and no law does; write the servo into "
                "the MJCF, or learn with a study without it",
            )
        if not model.controlled:
            raise study.error(("model",), "learn needs actuators; the model has none")
        parameters = study.parameter_set(model)
        if not parameters:
            raise study.error(
                ("parameters",), "learn needs at least one uncertain parameter; the study has none"
            )
        scene = cls(
            study,
            model,
            task,
            parameters,
            candidate_set(study, parameters),
            limit_edits(study, model),
            simulated_forces(study, model, "a policy cannot be learned"),
        )
        _ = scene.settings  # their numbers must be within bounds
        first = scene.compiled(scene.candidates.points[0])
        _require_known_commands(scene)
        if not isinstance(task, PythonTask):
            require_ranges(study, first)
        _require_fit(scene, first)
        if study.plant is None and isinstance(task, PythonTask):
            _require_commands(study, task, first)
        return scene

    @property
    def seed(self) -> int:
        """Seed of everything drawn at random."""
        return self.study.search.seed

    def compiled(self, point: Point) -> mujoco.MjModel:
        """Return the model at a candidate, compiled for the task."""
        edits = parameter_edits(self.model, self.parameters, point)
        return compiled(self.model, self.task, [*edits, *self.limits])

    def environment(
        self,
        model: mujoco.MjModel | Sequence[mujoco.MjModel],
        n: int,
        *,
        seed: int = 0,
        threads: int = 1,
        common: int | None = None,
    ) -> Environment:
        """Return `n` simulations of the task; see `make_environment`."""
        return make_environment(
            self.task,
            model,
            n,
            seed=seed,
            threads=threads,
            common=common,
            laws=self.laws,
        )

    def training(
        self, point: Point, probabilities: Probabilities | None, threads: int
    ) -> Environment:
        """Return the environment that a policy is learned in.

        Args:
            point: the chosen candidate.
            probabilities: `N`, where every episode shall have a model of its own; None for the
                chosen candidate alone.
            threads: of the simulation.
        """
        return make_environment(
            self._training_task,
            self.compiled(point) if probabilities is None else self._draw(probabilities),
            self.environments,
            seed=self.seed,
            threads=threads,
            stagger=True,
            laws=self.laws,
        )

    @property
    def _training_task(self) -> Task:
        """The task with the length that episodes have in training."""
        seconds = self.study.policy.episode
        if seconds is None or seconds >= self.task.time_limit:
            return self.task
        if isinstance(self.task, PythonTask):
            return replace(self.task, time_limit=seconds)
        shorter = copy(self.task)
        shorter.time_limit = seconds
        return shorter

    def _draw(self, probabilities: Probabilities) -> ModelDraw:
        """Return a function that draws a candidate's model; each is compiled once."""
        models: dict[int, mujoco.MjModel] = {}
        edges = np.cumsum(probabilities) / probabilities.sum()

        def draw(rng: np.random.Generator) -> mujoco.MjModel:
            row = min(int(np.searchsorted(edges, rng.random(), side="right")), len(edges) - 1)
            if row not in models:
                models[row] = self.compiled(self.candidates.points[row])
            return models[row]

        return draw

    @property
    def environments(self) -> int:
        """Number of simulations in a training: the most of which a batch is a multiple.

        Where that would be few, as many as are fast: a batch is then a little larger than asked.
        """
        batch = self.study.policy.batch
        most = min(_ENVIRONMENTS, batch // 2)
        even = max(n for n in range(1, most + 1) if batch % n == 0)
        return even if 2 * even > most else most

    @property
    def settings(self) -> TrpoSettings:
        """Settings of the training."""
        policy, n = self.study.policy, self.environments
        return TrpoSettings(
            batch=-(-policy.batch // n) * n,
            discount=policy.discount,
            decay=policy.decay,
            hidden=policy.hidden,
            region=TrustRegion(kl=policy.kl),
        )


def _require_fit(scene: Scene, model: mujoco.MjModel) -> None:
    """Refuse a task that does not fit the model.

    Raises:
        StudyError: it does not.
    """
    try:
        scene.environment(model, 1)
    except UserError as error:
        raise scene.study.error(("task",), str(error)) from None


def _require_a_step(study: Study, task: Task) -> None:
    """Refuse episodes of training that are shorter than a control step of the task.

    Raises:
        StudyError: they are.
    """
    seconds, step = study.policy.episode, task.control_timestep
    if seconds is not None and round(seconds / step) < 1:
        raise study.error(
            ("policy", "episode"),
            f"{seconds:g} s is no control step of the task; it must be at least {step:g} s",
        )


def _require_known_commands(scene: Scene) -> None:
    """Refuse parameters that move a control range: a policy's actions are commands within it.

    Raises:
        StudyError: there is one.
    """
    for k, p in enumerate(scene.parameters):
        point = scene.candidates.points[0].copy()
        ranges = []
        for point[k] in (p.low, p.high):
            ranges.append(scene.compiled(point).actuator_ctrlrange.copy())
        if not np.array_equal(*ranges):
            raise scene.study.error(
                ("parameters",),
                f"{p.name}: a policy's actions are commands within the ctrlrange, which must be "
                "known; where a machine saturates is the forcerange",
            )


def _require_commands(study: Study, task: PythonTask, model: mujoco.MjModel) -> None:
    """Refuse a task whose actions are not the commands of the actuators.

    What runs on a person's machine is the policy's file, and not what a task does to its actions.

    Raises:
        StudyError: they are others, or leave the control ranges.
    """
    machine, ends = PythonMachine(task, model, 0), control_range(model)
    machine.begin()
    for actions, most in zip(command_ends(machine), ends, strict=True):
        given = machine.apply(actions).rows["ctrl"][-1]
        if actions.shape != most.shape or not np.allclose([actions, given], most):
            raise study.error(
                ("task",),
                f"the actions {actions.tolist()} of {task.name} command {given.tolist()}, and the "
                f"actuators' range ends at {most.tolist()}: a policy's file gives a machine its "
                "actions as they are; leave action_spec and scaling to bo-sysid",
            )

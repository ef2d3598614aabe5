"""From a study's `plant:` to the plant, and from the plant to recordings."""

from collections.abc import Callable, Sequence

import numpy as np

from bo_sysid.errors import ModelError, StudyError, UserError, nearest
from bo_sysid.mjcf import Edit, Model, address_edit, parameter_edits
from bo_sysid.plants.effects import realised
from bo_sysid.plants.excitation import Range, multisine, smooth_random
from bo_sysid.plants.limits import limit_edits, limited
from bo_sysid.plants.load import Task, compiled, load_task, make_environment
from bo_sysid.plants.plant import Plant
from bo_sysid.plants.python_task import PythonTask, class_task
from bo_sysid.plants.repeat import RepeatedTask
from bo_sysid.recording import Recording
from bo_sysid.study import Study
from bo_sysid.study.inputs import load_function, load_model

EXCITATIONS: dict[str, Callable[..., np.ndarray]] = {
    "multisine": multisine,
    "random": smooth_random,
}
"""Controls that move a machine, by name."""


def study_task(study: Study, model: Model) -> Task | None:
    """Return the task of a study: its own, else that of its dm_control model, else None.

    Raises:
        StudyError: there is no such task, a user's class is none of dm_control's kind, or a limit
            is of a joint that the model does not have.
    """
    task = _unlimited_task(study, model)
    if isinstance(task, PythonTask) or task is None:
        bound = [x for x, y in study.limits.items() if y.position or y.velocity]
        if bound and task is not None:
            raise study.error(
                ("limits", bound[0]),
                f"limits of position and velocity end episodes of dm_control's tasks alone, not of "
                f"{task.name}: let its get_termination return 0.0 where they are left, and leave "
                "them out here (effort stays)",
            )
        return task
    return limited(task, study, model)


def _unlimited_task(study: Study, model: Model) -> Task | None:
    if study.task is not None and study.task.file is not None:
        cls = load_function(study, f"{study.task.file}:{study.task.class_name}")
        try:
            return class_task(cls, model.compile())
        except StudyError as error:
            raise study.error(("task", "class"), _bare(error)) from None
    named, section = (study.model, "model") if study.task is None else (study.task, "task")
    if not named.dm_control:
        return None
    try:
        task = load_task(named.dm_control.domain, named.dm_control.task)
    except StudyError as error:
        raise study.error((section, "dm_control"), _bare(error)) from None
    repeat = 1 if study.task is None else study.task.repeat
    if repeat > 1 and isinstance(task, PythonTask):
        raise study.error(
            ("task", "repeat"),
            f"{task.name} runs in Python (it is not vectorised), where actions are not repeated",
        )
    return task if isinstance(task, PythonTask) or repeat == 1 else RepeatedTask(task, repeat)


def _bare(error: StudyError) -> str:
    """Return the message of an error about a task, which will be raised with its key."""
    return str(error).removeprefix("task: ")


def foreign_task(study: Study, model: Model) -> str:
    """Return in words that a task of the suite is taken to a model whose joints have other names.

    Vectorised tasks go by the order of joints, as those of a model of one's own may be called.
    """
    own = None if study.task is None else study.task.dm_control
    if own is None or own == study.model.dm_control:
        return ""
    try:
        theirs = Model.from_dm_control(own.domain, own.task).joints
    except ModelError:  # a task that dm_control does not have
        return ""
    if theirs == model.joints:
        return ""
    return (
        f"The task {own.domain} {own.task} is written for the joints {', '.join(theirs)}; it takes "
        f"{', '.join(model.joints)} in their place, in this order."
    )


def build_plant(study: Study, *, budget: int | None = None, seed: int | None = None) -> Plant:
    """Return the simulated machine that a study describes.

    Args:
        study: its `plant:` says what the machine has differently; without one the machine is the
            nominal model.
        budget: most trajectories; no limit by default.
        seed: of starts and noise; the study's by default.

    Raises:
        StudyError: `plant:` names a parameter that the study does not have, or an effect that a
            simulated plant cannot have, or makes a model that does not compile.
    """
    model = load_model(study)
    plant = study.plant
    effects, task = realised(study, model), study_task(study, model)
    _require_same_observation(study, model, task, effects.edits)
    own = [] if plant is None else _parameter_edits(study, model)
    try:
        return Plant(
            model,
            [*own, *effects.edits, *limit_edits(study, model)],
            task=task,
            name="plant",
            timestep=None if plant is None else plant.timestep,
            noise={} if plant is None else dict(plant.noise),
            budget=budget,
            seed=study.search.seed if seed is None else seed,
            laws=effects.laws,
        )
    except StudyError:
        raise
    except UserError as error:
        if plant is None or (error.key == "timestep" and plant.timestep is None):
            raise  # of the model
        key = ("plant", error.key) if error.key else ("plant",)
        raise study.error(key, str(error)) from None


def _require_same_observation(
    study: Study, model: Model, task: Task | None, edits: Sequence[Edit]
) -> None:
    """Refuse effects that a policy would observe otherwise than as motion.

    Raises:
        StudyError: an effect adds a body, and the task observes all of them.
    """
    if task is None or not edits:
        return
    nominal, own = (
        make_environment(task, compiled(model, task, e), 1).observation_size for e in ((), edits)
    )
    if nominal != own:
        raise study.error(
            ("plant", "effects"),
            f"an effect adds a body, and this task observes every body: {own} observations "
            f"instead of {nominal}; choose an effect that adds none, such as link_mass",
        )


def record(
    plant: Plant,
    model: Model,
    count: int,
    *,
    duration: float,
    excitation: str = "random",
    seed: int = 0,
    warmstart: bool = False,
    limits: Sequence[Edit] = (),
) -> tuple[Recording, ...]:
    """Roll a plant out under an excitation and return one recording a trajectory.

    Args:
        plant: the machine.
        model: the nominal model, whose control ranges the excitation keeps.
        count: number of trajectories.
        duration: of each, in [s].
        excitation: "random" or "multisine".
        seed: of the excitations.
        warmstart: also record the solver's warm start, see `Plant.record`.
        limits: edits that narrow the control ranges, see `limit_edits`.

    Raises:
        UserError: there is no such excitation, or the plant refuses.
    """
    if excitation not in EXCITATIONS:
        raise UserError(f"unknown excitation {excitation!r}; {nearest(excitation, EXCITATIONS)}")
    compiled = model.compile(limits)
    made = EXCITATIONS[excitation]
    return tuple(
        plant.record(
            made(
                compiled,
                duration,
                plant.control_timestep,
                seed=seed * 1_009 + number,
                within=driven_within(plant),
            ),
            warmstart=warmstart,
        )
        for number in range(count)
    )


def driven_within(plant: Plant) -> Range | None:
    """Return the bounds of the actions of a task in Python; None where controls drive a plant."""
    return plant.command_range if isinstance(plant.task, PythonTask) else None


def _parameter_edits(study: Study, model: Model) -> Sequence[Edit]:
    """Return the edits of `plant.parameters`: names of the study's parameters, or addresses."""
    assert study.plant is not None  # noqa: S101 - the caller looked
    known = {p.name: p for p in study.parameter_set(model)}
    edits: list[Edit] = []
    for name, value in study.plant.parameters.items():
        if name in known:
            edits += parameter_edits(model, [known[name]], [value])
        elif "[" in name or name.startswith("option."):
            edits.append(address_edit(model, [name], value, "set"))
        else:
            raise study.error(
                ("plant", "parameters", name),
                f"no parameter {name!r}; {nearest(name, known) or 'the study has none'} (or an "
                "MJCF address)",
            )
    return edits

"""Tasks by name, and environments of any kind of task."""

import re
from collections.abc import Sequence

import mujoco

from bo_sysid.errors import UserError
from bo_sysid.mjcf import Edit, Model
from bo_sysid.plants.environment import BatchEnvironment, Environment, ModelDraw
from bo_sysid.plants.python_environment import PythonEnvironment
from bo_sysid.plants.python_task import PythonTask, suite_task
from bo_sysid.plants.tasks import find_task, registered
from bo_sysid.plants.tasks.base import VectorTask
from bo_sysid.simulation.lockstep import ForceLaw

Task = VectorTask | PythonTask
_SHORTEST = 3  # links of a swimmer


def load_task(domain: str, name: str) -> Task:
    """Return a task of dm_control: vectorised where it is known, else with a `notice`.

    "swimmerN" names a swimmer with N links for any N from 3 on, as for `Model.from_dm_control`.

    Raises:
        StudyError: there is no such task.
    """
    swimmer = re.fullmatch(r"swimmer(\d+)", domain if domain != "swimmer" else name)
    if swimmer and int(swimmer[1]) >= _SHORTEST:
        return find_task("swimmer", f"swimmer{_SHORTEST}")  # the task of any number of links
    return find_task(domain, name) if (domain, name) in registered() else suite_task(domain, name)


def compiled(
    model: Model, task: Task, edits: Sequence[Edit] = (), *, timestep: float | None = None
) -> mujoco.MjModel:
    """Compile a model for a task; one in Python may refer to lights and materials."""
    return model.compile(edits, timestep=timestep, visuals=isinstance(task, PythonTask))


def make_environment(
    task: Task,
    model: mujoco.MjModel | Sequence[mujoco.MjModel] | ModelDraw,
    n: int,
    *,
    seed: int = 0,
    threads: int = 1,
    stagger: bool = False,
    common: int | None = None,
    laws: Sequence[ForceLaw] = (),
) -> Environment:
    """Return an environment of `n` simulations of a task; see `BatchEnvironment`.

    Raises:
        UserError: a task in Python is given several models, or force laws.
    """
    if isinstance(task, PythonTask):
        if not isinstance(model, mujoco.MjModel):
            raise UserError(f"task {task.name}: a task in Python takes one model, not several")
        if laws:
            raise UserError(
                f"task {task.name}: force laws cannot be stepped with a task in Python; choose "
                "effects that MJCF can say"
            )
        return PythonEnvironment(task, model, n, seed=seed, stagger=stagger)
    return BatchEnvironment(
        task, model, n, seed=seed, threads=threads, stagger=stagger, common=common, laws=laws
    )

"""Tasks of dm_control that are not vectorised, run through their own Python API: slower.

A task of the suite keeps its own physics class and timing; a task class in a user's file gets
dm_control's plain physics, and may say `control_timestep` and `time_limit` in [s].
"""

import inspect
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from numbers import Real
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from bo_sysid.errors import StudyError, UserError, nearest

_HERE = Path(__file__).parent
_LIBRARIES = "site-packages"  # in the path of code that is not a user's
_STEPS = 1000  # of an episode, where a class does not say how long it is


@dataclass(frozen=True)
class PythonTask:
    """A dm_control `Task` that computes one episode at a time.

    Attributes:
        name: for messages.
        make: returns a fresh task, given the seed of its random state.
        physics: the physics class that it needs.
        control_timestep: time between two actions in [s].
        time_limit: length of an episode in [s]; infinite where it has no end.
        rewarded: whether there is a reward to learn from.
    """

    name: str
    make: Callable[[int], Any]
    physics: Any
    control_timestep: float
    time_limit: float
    rewarded: bool = True

    @property
    def notice(self) -> str:
        """What a person should know about its speed."""
        return (
            f"task {self.name} is not vectorised: it runs in Python, one episode after the other, "
            "ten to a hundred times slower"
        )


def suite_task(domain: str, name: str) -> PythonTask:
    """Return any task of the dm_control suite.

    Raises:
        StudyError: the suite has no such task.
    """
    from dm_control import suite

    known = [f"{d} {t}" for d, t in suite.ALL_TASKS]
    if f"{domain} {name}" not in known:
        raise StudyError(
            f"task: no '{domain} {name}' in dm_control's suite; "
            f"{nearest(f'{domain} {name}', known)}"
        )
    environment = suite.load(domain, name)
    step = environment.control_timestep()

    def make(seed: int) -> Any:
        return suite.load(domain, name, task_kwargs={"random": seed}).task

    limit = float(environment._step_limit) * step
    return PythonTask(f"{domain} {name}", make, type(environment.physics), step, limit)


def class_task(cls: Any, model: mujoco.MjModel) -> PythonTask:
    """Return the task of a user's class.

    Args:
        cls: a dm_control `Task`, made without arguments or with the seed as `random`.
        model: its model, whose time step is the control step unless the class says otherwise.

    Raises:
        StudyError: the class lacks a method of a dm_control `Task`.
    """
    from dm_control.mujoco import Physics

    missing = [
        m
        for m in (
            "initialize_episode",
            "get_observation",
            "get_reward",
            "before_step",
            "after_step",
            "get_termination",
            "action_spec",
        )
        if not callable(getattr(cls, m, None))
    ]
    if missing:
        raise StudyError(
            f"task: class {cls.__name__} is no dm_control Task: it has no {', '.join(missing)}"
        )
    step = _seconds(cls, "control_timestep", model.opt.timestep)
    limit = _seconds(cls, "time_limit", _STEPS * step)
    if not np.isclose(step / model.opt.timestep, max(round(step / model.opt.timestep), 1)):
        raise StudyError(
            f"task: class {cls.__name__} has a control_timestep of {step:g} s; it must be a "
            f"multiple of the model's time step, {model.opt.timestep:g} s"
        )
    seeded = _takes(cls, "random")

    def make(seed: int) -> Any:
        return cls(random=seed) if seeded else cls()

    return PythonTask(cls.__name__, make, Physics, step, limit)


def _seconds(cls: Any, name: str, default: float) -> float:
    """Return an attribute of a class that is a time in [s]."""
    value = getattr(cls, name, default)
    if isinstance(value, bool) or not isinstance(value, Real) or not float(value) > 0:
        raise StudyError(
            f"task: class {cls.__name__} has a {name} of {value!r}; it must be a time in [s] "
            "above 0"
        )
    return float(value)


def _takes(cls: Any, name: str) -> bool:
    """Whether a class is made with an argument of this name."""
    try:
        asked = inspect.signature(cls).parameters
    except (TypeError, ValueError):  # it does not say
        return False
    return name in asked or any(p.kind is p.VAR_KEYWORD for p in asked.values())


@contextmanager
def guarded(task: str, method: str) -> Iterator[None]:
    """Tell what a task's own code raises as an error of the task, with its file and line.

    Raises:
        UserError: the code within raises anything else.
    """
    from dm_control.rl.control import PhysicsError

    try:
        yield
    except (UserError, PhysicsError):
        raise
    except (Exception, SystemExit) as error:
        places = ((Path(f.filename), f.lineno) for f in traceback.extract_tb(error.__traceback__))
        own = [(p, n) for p, n in places if not (_LIBRARIES in p.parts or p.parent == _HERE)]
        where = f" ({own[-1][0].name}, line {own[-1][1]})" if own else ""
        raise UserError(
            f"task {task}: {method} fails: {type(error).__name__}: {error}{where}"
        ) from error

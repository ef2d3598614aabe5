"""From a study to what is simulated: its model, with the laws and forces that are stepped with it.

Whatever simulates a study's machine goes through here, so that no law or force is forgotten.
"""

from collections.abc import Sequence

import numpy as np

from bo_sysid.effects.learned import ELAPSED
from bo_sysid.effects.machine import recorded_inputs
from bo_sysid.errors import UserError, nearest
from bo_sysid.mjcf import Model
from bo_sysid.parameters import Parameter
from bo_sysid.recording import Recording
from bo_sysid.simulation.cutting import cut
from bo_sysid.simulation.lockstep import (
    Controller,
    ForceLaw,
    Law,
    LawInputs,
    LockStep,
    Signal,
    force_laws,
)
from bo_sysid.simulation.rollout import Engine
from bo_sysid.simulation.simulator import MujocoSimulator
from bo_sysid.simulation.windows import Windows
from bo_sysid.study import Study
from bo_sysid.study.inputs import load_function, load_parts
from bo_sysid.study.requirements import require_actuators


def make_simulator(
    study: Study, model: Model, parameters: Sequence[Parameter], *, threads: int = 0
) -> MujocoSimulator:
    """Return the simulator of a study: its model, its parameters, what is stepped with it."""
    return MujocoSimulator(model, tuple(parameters), Engine(threads), study_laws(study, model))


def study_laws(study: Study, model: Model) -> tuple[Controller | ForceLaw, ...]:
    """Return what is stepped with the model: the laws of actuators, and forces beside it.

    Raises:
        StudyError: the model has no such actuator, or the file no such function.
    """
    require_actuators(study, model)
    laws = [Controller(name, study_law(study, name)) for name in study.actuators]
    return (*laws, *force_laws(load_parts(study, model)))


def study_law(study: Study, actuator: str) -> Law:
    """Return the law of one of a study's actuators; what goes wrong in it names file and law.

    Raises:
        StudyError: the file has no such function. Called, it raises one where the law reads a
            channel that it is not handed, raises anything else, or returns no number a simulation.
    """
    stated = study.actuators[actuator]
    function, key = load_function(study, stated.law), ("actuators", actuator)

    def law(inputs: LawInputs) -> Signal:
        try:
            value = np.asarray(function(inputs), float)
        except UserError:
            raise
        except KeyError as error:
            name = str(error.args[0]) if error.args else ""
            handed = [*inputs.signals, *inputs.qpos, *inputs.ctrl]
            raise study.error(
                key,
                f"{stated.law} reads {name!r}, which it is not handed; {nearest(name, handed)} "
                "(channels that a law reads stand under uses)",
            ) from error
        except Exception as error:  # whatever it is, it is for the file's author
            raise study.error(
                key, f"{stated.law} fails: {type(error).__name__}: {error}"
            ) from error
        if value.shape not in ((), inputs.time.shape):
            raise study.error(
                key,
                f"{stated.law} returned an array {value.shape}; it must be one number for each of "
                f"the simulations, {inputs.time.shape}",
            )
        return np.broadcast_to(value, inputs.time.shape)

    return law


def study_windows(
    study: Study,
    model: Model,
    recordings: Sequence[Recording],
    horizon: int,
    timestep: float | None = None,
) -> Windows:
    """Return windows of recordings, with the inputs that a study's laws may read; see `cut`."""
    return cut(
        model,
        recordings,
        horizon=horizon,
        timestep=timestep,
        signals=_signals(study, recordings),
        controlled=tuple(study.actuators),
        parameters=study.parameter_set(model),
    )


def _signals(study: Study, recordings: Sequence[Recording]) -> tuple[str, ...]:
    """Return the recorded inputs that what is stepped with a study's model may read, by channel."""
    signals = {channel for a in study.actuators.values() for channel in a.uses}
    if study.model.beside:
        signals |= {*recorded_inputs(recordings), ELAPSED}
    return tuple(sorted(signals))


def recorded_input(model: Model, laws: Sequence[ForceLaw]) -> str | None:
    """Return a recorded input that a law reads, which a simulation of its own does not have."""
    compiled = model.compile()
    sizes = {"qpos": compiled.nq, "qvel": compiled.nv, "ctrl": compiled.nu}
    views = {name: np.zeros((1, size)) for name, size in sizes.items()}
    try:
        LockStep(
            compiled, tuple(laws), {}, {**views, "qfrc_applied": views["qvel"] * 0}, None
        ).apply(0)
    except KeyError as error:
        return str(error.args[0])
    return None

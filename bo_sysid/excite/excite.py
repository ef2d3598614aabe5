"""An informative trajectory within limits, before there are data."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd

from bo_sysid.effects import Reading
from bo_sysid.errors import UserError
from bo_sysid.excite.beside import simulated_forces
from bo_sysid.excite.design import LEAST, design
from bo_sysid.excite.limits import Limits
from bo_sysid.excite.trial import STANDS, Trial
from bo_sysid.mjcf import Model
from bo_sysid.mjcf.address import resolve
from bo_sysid.parameters import Parameter
from bo_sysid.recording import Recording, stated_for
from bo_sysid.simulation import ForceLaw
from bo_sysid.study import Study
from bo_sysid.study.inputs import load_model, load_parts
from bo_sysid.study.requirements import require_limits, require_scales

NOISE = 1e-3  # [rad] or [m], where the study says nothing
_LONGEST = 3600.0  # [s]
_SHORTEST = 1.0  # [s], half of which fades in and half out
_COARSEST = 0.1  # [s] between two controls; windows of half a second tell


@dataclass(frozen=True)
class Excitation:
    """A trajectory to be run on the machine.

    Attributes:
        controls: time [s] and one column an actuator, held between rows.
        parameters: one row a parameter: name, unit, sigma and of_range as predicted.
        predicted: what the nominal model does under them.
        limits: least and largest value of each of its channels; infinite where there is none.
        used: largest share of a limit that is used, over the drawn parameter vectors.
        notes: what was assumed.
    """

    controls: pd.DataFrame
    parameters: pd.DataFrame
    predicted: Recording
    limits: Mapping[str, tuple[float, float]]
    used: float
    notes: tuple[str, ...]


def excite(
    study: Study,
    *,
    seconds: float = 10.0,
    interval: float = 0.01,
    budget: int = 2400,
    effects: bool = False,
    report: Callable[[int, float], None] | None = None,
) -> Excitation:
    """Return a trajectory that tells a study's parameters, within its limits.

    Args:
        study: model with the forces beside it, parameters and limits; recordings are not read.
        seconds: length of the trajectory, 1 s or more.
        interval: between two controls in [s], 0.1 s at most; the multiple of the model's time step
            that is nearest to it is taken, one step at least.
        budget: number of trajectories that are tried, 28 or more.
        effects: also make friction, damping, armature and springs of all joints tellable.
        report: told the number of trajectories tried and the lowest cost.

    Raises:
        StudyError: there is nothing to be known, the limits allow no motion, or what stands beside
            the model cannot be planned through.
        UserError: the model or an argument is wrong.
    """
    _require(seconds, interval, budget)
    if report is not None:
        report(0, np.inf)
    model = load_model(study)
    _require_controls(study, model)
    _require_steps(study, model)
    laws, notes = _beside(study, model)
    parameters = _parameters(study, model, effects)
    noise = _noise(study, model)
    require_limits(study, model)
    require_scales(study, model)
    limits = Limits.of(model, study.limits)
    trial = Trial(
        model, parameters, limits, noise,
        seconds=seconds, interval=interval, seed=study.search.seed, laws=laws,
    )  # fmt: skip
    notes += _assumed(study, model, trial)
    notes += _resting(model, trial)
    controls = design(trial, budget, study.search.seed, report=report)
    found = trial.information(controls)
    frame = pd.DataFrame(controls, columns=list(model.ctrl_channels))
    frame.insert(0, "time", trial.series.time)
    predicted = trial.recorded(controls)
    return Excitation(
        frame,
        found.table(),
        predicted,
        limits.of_channels(model.ctrl_channels, *trial.commands),
        trial.violation(controls, trial.proof, 0.0),
        tuple(notes),
    )


def _require_steps(study: Study, model: Model) -> None:
    """Refuse a model whose own steps are longer than controls may be apart."""
    step = float(model.compile().opt.timestep)
    if step > _COARSEST:
        raise study.error(
            ("model",),
            f"its time step is {step:g} s; excite sets controls at steps of the model, which must "
            f"be at most {_COARSEST:g} s: <option timestep=…/>",
        )


def _require_controls(study: Study, model: Model) -> None:
    if not model.controlled:
        raise study.error(
            ("model",),
            f"excite plans controls, and {model.source} has no actuator; add its motors (a URDF "
            "has none: save it as MJCF, with <motor joint=…/> under <actuator>)",
        )
    if study.actuators:
        raise study.error(
            ("actuators",), "excite cannot plan through a law in Python; leave it out"
        )


def _parameters(study: Study, model: Model, effects: bool) -> tuple[Parameter, ...]:
    """Return what the trajectory is to tell."""
    parameters = study.parameter_set(model)
    if effects:
        parameters = (*parameters, *catalogue_parameters(model, parameters))
    if not parameters:
        raise study.error(("parameters",), "excite needs parameters to be known (or --effects)")
    return parameters


def _noise(study: Study, model: Model) -> dict[str, float]:
    """Return the standard deviation of each position, as stated or assumed."""
    stated = study.recordings.noise
    return {n: stated_for(n, stated, NOISE) or NOISE for n in model.qpos_channels}


def _assumed(study: Study, model: Model, trial: Trial) -> list[str]:
    """Return what a study does not state, and what is assumed instead."""
    notes = []
    silent = [n for n in model.qpos_channels if not stated_for(n, study.recordings.noise, 0.0)]
    if silent:
        what = "positions" if len(silent) == len(model.qpos_channels) else ", ".join(silent)
        notes.append(
            f"Noise of {what} taken as {1e3 * NOISE:g} mrad (mm); recordings.noise states it."
        )
    unlimited = [j for j in model.joints if j not in study.limits]
    if unlimited:
        notes.append(f"No limits are stated for: {', '.join(unlimited)}.")
    bounded = np.isfinite(np.stack(trial.commands)).all(axis=0)
    free = [a for a, bound in zip(model.controlled, bounded, strict=True) if not bound]
    if free:
        notes.append(
            f"Controls within ±1: neither range nor effort is stated for {', '.join(free)}."
        )
    return notes


def _require(seconds: float, interval: float, budget: int) -> None:
    """Refuse arguments from which nothing can be planned."""
    if not _SHORTEST <= seconds <= _LONGEST:
        raise UserError(
            f"excite: seconds is {seconds:g}; it must be at least {_SHORTEST:g}, since controls "
            f"fade in during half a second and out during another, and at most {_LONGEST:g}"
        )
    if not 0 < interval <= _COARSEST:
        raise UserError(
            f"excite: interval is {interval:g} s; it must be above 0 and at most {_COARSEST:g} s"
        )
    if budget < LEAST:
        raise UserError(
            f"excite: budget is {budget}; at least {LEAST} trajectories are tried, 2400 by default"
        )


def _beside(study: Study, model: Model) -> tuple[tuple[ForceLaw, ...], list[str]]:
    """Return the forces beside the model, and what is to be said of what else stands there.

    Raises:
        StudyError: a force depends on what is only recorded, or a command is changed on its way.
    """
    forces = simulated_forces(study, model, "excite cannot plan")
    parts = load_parts(study, model)
    shown = dict.fromkeys(p.channel for p in parts if isinstance(p, Reading))
    if not shown:
        return forces, []
    return forces, [f"Limits hold for what is, not for what is shown by {', '.join(shown)}."]


def _resting(model: Model, trial: Trial) -> list[str]:
    """Return what is to be said of controls at rest, where some are needed to hold the machine."""
    stands = trial.left <= STANDS
    if trial.hold is None and stands:
        return []
    if trial.hold is None:
        return [
            "Controls rest in the middle of their ranges, under which the model leaves its "
            "reference as soon as the plan begins: with those that hold it, machines within the "
            "bounds of the parameters exceed limits."
        ]
    held = zip(model.controlled, trial.series.at_rest, strict=True)
    which = "hold" if stands else "come nearest to holding"
    return [
        f"Controls rest at {', '.join(f'{a} {u:.4g}' for a, u in held)}, which {which} the model "
        "against gravity and springs. Place the machine at the model's reference, and let go of "
        "it when the plan begins."
    ]


def catalogue_parameters(model: Model, known: Sequence[Parameter]) -> list[Parameter]:
    """Return effects that are one number of a joint, as parameters that are not known yet."""
    compiled = model.compile()
    taken = {t for p in known for a in p.addresses for t in _numbers(model, a)}
    found = []
    for j, name in enumerate(model.joints):
        inertia = float(compiled.dof_M0[compiled.jnt_dofadr[j]])
        for what, unit in (
            ("frictionloss", 1.0), ("damping", 1.0), ("armature", 0.5), ("stiffness", 5.0),
        ):  # fmt: skip
            address = f"joint[{name}].{what}"
            if not taken & set(_numbers(model, address)):
                found.append(Parameter(address, (address,), 0.0, unit * inertia, apply="add"))
    return found


def _numbers(model: Model, address: str) -> list[tuple[str, str, str, int]]:
    """Return the numbers of a model that an address names, however it is written."""
    return [(t.kind, t.element, t.name, t.index) for t in resolve(model, address)]

"""Effects that a plant has and the nominal model lacks.

Those that plain MJCF can say are edits of the plant's spec. Springs, constant forces and cogging,
which the catalogue edits in, are stepped as force laws here, so that a plant does not owe them to
the code that looks for them; so are the forces that MJCF cannot say.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np

from bo_sysid.effects import Effect, Force, Machine, Part, Site, extent_at, survey
from bo_sysid.errors import UserError, nearest
from bo_sysid.mjcf import Edit, Model
from bo_sysid.plants.excitation import smooth_random
from bo_sysid.plants.plant import Plant, PlantError
from bo_sysid.simulation.lockstep import ForceLaw, force_laws
from bo_sysid.simulation.of_study import recorded_input
from bo_sysid.study import Study
from bo_sysid.study.inputs import study_effects

STEPPED = ("joint_spring", "constant_force", "cogging")
_SURVEY = 2.0  # [s] of motion that says how large the machine's forces and speeds are


@dataclass(frozen=True)
class Realised:
    """What makes a plant have its effects.

    Attributes:
        edits: of its spec.
        laws: forces that are stepped with it.
    """

    edits: tuple[Edit, ...] = ()
    laws: tuple[ForceLaw, ...] = ()


def realised(study: Study, model: Model) -> Realised:
    """Return how the plant of a study gets the effects under `plant.effects`.

    Raises:
        StudyError: an effect or a site is not there, or the effect is none of a simulated plant:
            one that adds a joint, changes what a sensor reads, or filters a whole recorded input.
    """
    stated = study.plant.effects if study.plant else ()
    if not stated:
        return Realised()
    try:
        motion = _motion(model)
    except PlantError as error:
        raise study.error(
            ("plant", "effects"),
            f"the model does not bear the {_SURVEY:g} s of random controls that tell how large its "
            f"forces are ({error}); give it a smaller timestep, ctrlrange or gear",
        ) from None
    machine, effects = survey(model.compile(), [motion]), study_effects(study)
    made = [_one(study, model, machine, effects, i) for i in range(len(stated))]
    return Realised(
        tuple(edit for one in made for edit in one.edits),
        tuple(law for one in made for law in one.laws),
    )


def _motion(model: Model) -> Any:
    """Return a recording of the nominal model under random controls: it gives the scales."""
    plant, compiled = Plant(model, name="survey"), model.compile()
    step = plant.control_timestep
    controls = np.zeros((round(_SURVEY / step), compiled.nu))
    if compiled.nu and compiled.actuator_ctrllimited.all():
        controls = smooth_random(compiled, _SURVEY, step)
    return plant.record(controls)


def _one(
    study: Study, model: Model, machine: Machine, effects: Mapping[str, Effect], number: int
) -> Realised:
    assert study.plant is not None  # noqa: S101 - the caller looked
    stated = study.plant.effects[number]
    key = ("plant", "effects", number)
    if stated.effect not in effects:
        raise study.error(
            (*key, "effect"), f"unknown effect {stated.effect!r}; {nearest(stated.effect, effects)}"
        )
    effect = effects[stated.effect]
    if stated.kind != effect.kind:
        raise study.error((*key, "kind"), f"{effect.id} acts on a {effect.kind}, not {stated.kind}")
    site = Site(effect.kind, stated.site or "world")
    if site.name not in machine.names(effect.kind):
        near = nearest(site.name, machine.names(effect.kind))
        raise study.error((*key, "site"), f"no {effect.kind} {site.name!r}; {near}")
    try:
        x = magnitudes(effect, site, machine, stated.value, dict(stated.details))
        return realise(model, effect, site, x, machine)
    except UserError as error:
        raise study.error((*key, error.key) if error.key else key, str(error)) from None


def magnitudes(
    effect: Effect, site: Site, machine: Machine, value: float, details: dict[str, float]
) -> np.ndarray:
    """Return the magnitudes of an effect, in the order of its components.

    `details` names components. A component that is left out is `value` if it is the first and no
    component of a vector is given, else 0; a shape that is left out is the catalogue's probe.

    Raises:
        UserError: a detail is no component, the effect does not apply at the site, or a negative
            magnitude is none that is physical.
    """
    names = [c.name for c in effect.components]
    for name in details:
        if name not in names:
            raise UserError(
                f"{effect.id} has no component {name!r}; {nearest(name, names)}", key="details"
            )
    extent = extent_at(effect, site, machine)
    if extent is None:
        raise UserError(f"{effect.id} does not apply to {site}")
    x = np.zeros(len(names))
    x[effect.linear :] = extent.probe[effect.linear :]
    if not set(names[: effect.vector]) & set(details):
        x[0] = value
    for name, given in details.items():
        x[names.index(name)] = given
    for c, given, low, high in zip(effect.components, x, extent.low, extent.high, strict=True):
        directed = low == -high  # either sign is a direction, and a bound only ends the search
        least = -1.0 if c.unit == "relative" else min(low, 0.0)  # a dead motor is one as well
        if given < least and not directed:
            bound = f"{round(least, 9) + 0.0:g}"
            raise UserError(
                f"{effect.id}: {c.name} is {given:g}; it must be at least {bound}",
                key="details" if c.name in details else "value",
            )
    return x


def realise(model: Model, effect: Effect, site: Site, x: np.ndarray, machine: Machine) -> Realised:
    """Return the edits and the laws of one effect.

    Raises:
        UserError: a simulated plant cannot have it.
    """
    if effect.id in STEPPED and effect.force is not None:
        return Realised(laws=(ForceLaw(site.name, effect.force(site, x, machine)),))

    def edit(spec: mujoco.MjSpec) -> None:
        effect.write(spec, site, x, machine)

    remaining = effect.write(model.spec(), site, x, machine)
    _require_same_coordinates(effect, model, edit)
    laws = _laws(effect, remaining)
    _require_no_inputs(effect, model, laws)
    return Realised((edit,), laws)


def _laws(effect: Effect, parts: Sequence[Part]) -> tuple[ForceLaw, ...]:
    other = [p for p in parts if not isinstance(p, Force)]
    if other:
        what = type(other[0]).__name__.lower()
        raise UserError(
            f"{effect.id} is a {what} of recorded data, which a plant that acts on its own cannot "
            "have; choose an effect that is MJCF or a force (bo-sysid effects lists them)"
        )
    return force_laws(parts)


def _require_no_inputs(effect: Effect, model: Model, laws: Sequence[ForceLaw]) -> None:
    missing = recorded_input(model, laws)
    if missing is not None:
        raise UserError(
            f"{effect.id} reads the recorded input {missing!r}, which a simulated plant does not "
            "have"
        )


def _require_same_coordinates(effect: Effect, model: Model, edit: Edit) -> None:
    nominal, edited = model.compile(), model.compile([edit])
    if (nominal.nq, nominal.nv, nominal.nu) != (edited.nq, edited.nv, edited.nu):
        raise UserError(
            f"{effect.id} adds a joint or an actuator, which a policy would observe; a plant with "
            "a task cannot have it"
        )

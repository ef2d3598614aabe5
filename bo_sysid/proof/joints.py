"""What can be concealed at a joint, as forces: friction, damping, springs, cogging, a rotor."""

from collections.abc import Callable
from math import exp, pi, sin

import numpy as np

from bo_sysid.proof.bodies import add_armature
from bo_sysid.proof.draft import Draft, Place, Realised, realised
from bo_sysid.proof.machine import ProofMachine
from bo_sysid.proof.physics import Bristle, Concealed, ForceAt, Law, Transmission

_YIELDS = (1e-4, 5e-4)  # [rad] presliding before a bristle gives way
_SLIDE_YIELDS = 0.2  # of that at a slide, in m
_BRISTLE_DAMPING = 1e-3  # [s]
_SOFTEST = 15.0  # [rad/s] of a rotor on its gear
_SHARE = 0.05  # of a joint's typical force, from which magnitudes are sought
_MOST = 2.0  # of a joint's typical force or inertia, the most that is concealed


def joints(machine: ProofMachine) -> tuple[str, ...]:
    """Return the joints of a machine that are mechanical: those with limits."""
    return tuple(j for j in machine.model.joints if j in machine.file.limits)


def driven(machine: ProofMachine) -> tuple[str, ...]:
    """Return the joints that an actuator drives."""
    return tuple(j for j in joints(machine) if machine.actuator_on(j) is not None)


def geared(machine: ProofMachine) -> tuple[str, ...]:
    """Return the driven joints whose rotor the model has, for plants of equations of motion."""
    if machine.file.equations is None:
        return ()
    return tuple(j for j in driven(machine) if _rotor(machine, j) > 0)


def log_uniform(rng: np.random.Generator, low: float, high: float) -> float:
    """Draw a number whose logarithm is uniform."""
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def sign(rng: np.random.Generator) -> float:
    """Draw +1 or -1."""
    return float(rng.choice((-1.0, 1.0)))


def bristle(draft: Draft, concealed: Concealed, level: ForceAt) -> None:
    """Add dry friction of a steady level to the joint of `concealed`."""
    d = concealed.details
    dof = draft.machine.dof(concealed.site)
    draft.bristles.append(Bristle(dof, level, d["presliding"], d["bristle damping"]))


def bristle_details(rng: np.random.Generator, place: Place) -> dict[str, float]:
    """Draw the form of dry friction: LuGre's, or Dahl's without damping of the bristle."""
    size = 1.0 if place.unit("rad") == "rad" else _SLIDE_YIELDS
    damping = float(rng.choice((0.0, _BRISTLE_DAMPING)))
    return {"presliding": size * log_uniform(rng, *_YIELDS), "bristle damping": damping}


def _rotor(machine: ProofMachine, joint: str) -> float:
    return float(machine.compiled.dof_armature[machine.dof(joint)])


def _dry(rng: np.random.Generator, place: Place) -> Concealed:
    value, details = _force(place), bristle_details(rng, place)
    return Concealed("dry_friction", "joint", place.site, value, place.unit("N m"), details)


def _stribeck(rng: np.random.Generator, place: Place) -> Concealed:
    value = _force(place)
    details = bristle_details(rng, place) | {
        "coulomb": value * rng.uniform(0.5, 2.0),
        "speed": float(place.scales.speed[place.dof]) * log_uniform(rng, 0.08, 0.4),
    }
    return Concealed("stribeck_friction", "joint", place.site, value, place.unit("N m"), details)


def _compose_stribeck(draft: Draft, c: Concealed) -> None:
    dof, d = draft.machine.dof(c.site), c.details
    coulomb, excess, speed = d["coulomb"], c.value, d["speed"]
    bristle(draft, c, lambda t, q, v, load: coulomb + excess * exp(-((v[dof] / speed) ** 2)))


def _loaded(rng: np.random.Generator, place: Place) -> Concealed:
    details = bristle_details(rng, place)
    return Concealed("load_dependent_friction", "joint", place.site, 0.1, "fraction", details)


def _compose_loaded(draft: Draft, c: Concealed) -> None:
    dof, share = draft.machine.dof(c.site), c.value
    bristle(draft, c, lambda t, q, v, load: share * abs(load[dof]))


def _plain(
    id: str,
    unit: str,
    start: Callable[[Place], float],
    law: Callable[[int, Concealed], ForceAt],
    signed: bool = False,
    details: Callable[[np.random.Generator, Place], dict[str, float]] = lambda rng, place: {},
) -> None:
    """Register a force at any joint that follows from the motion at once."""

    def draw(rng: np.random.Generator, place: Place) -> Concealed:
        value = start(place) * (sign(rng) if signed else 1.0)
        extra = details(rng, place)
        return Concealed(id, "joint", place.site, value, place.unit(unit), extra)

    def compose(draft: Draft, c: Concealed) -> None:
        dof = draft.machine.dof(c.site)
        draft.laws.append(Law(dof, law(dof, c)))

    realised(Realised(id, joints, draw, compose, lambda place: _MOST / _SHARE * start(place)))


def _periods(rng: np.random.Generator, place: Place) -> dict[str, float]:
    span = float(place.scales.span[place.dof])
    low, high = 4.0 / span, (32.0 if place.unit("rad") == "rad" else 60.0 / span)
    return {"periods": log_uniform(rng, low, max(high, 1.5 * low)), "phase": rng.uniform(-pi, pi)}


def _cogging(dof: int, c: Concealed) -> ForceAt:
    size, periods, phase = c.value, c.details["periods"], c.details["phase"]
    return lambda t, q, v, load: size * sin(periods * q[dof] + phase)


def _rest(rng: np.random.Generator, place: Place) -> dict[str, float]:
    centre, travel = place.scales.centre[place.dof], place.scales.travel[place.dof]
    return {"rest angle": float(centre + travel * rng.uniform(-1, 1))}


def _spring(dof: int, c: Concealed) -> ForceAt:
    stiffness, rest = c.value, c.details["rest angle"]
    return lambda t, q, v, load: -stiffness * (q[dof] - rest)


def _force(place: Place) -> float:
    return _SHARE * float(place.scales.force[place.dof])


def most_force(place: Place) -> float:
    """Return the largest force that is concealed at a joint."""
    return _MOST / _SHARE * _force(place)


def _per_speed(place: Place) -> float:
    return _force(place) / float(place.scales.speed[place.dof])


def _armature(rng: np.random.Generator, place: Place) -> Concealed:
    value = _SHARE * float(place.scales.inertia[place.dof])
    return Concealed("armature", "joint", place.site, value, place.unit("kg m²"))


def _backlash(rng: np.random.Generator, place: Place) -> Concealed:
    stiff = _stiffness(rng, place)
    details = {"stiffness": stiff, "motor side": float(rng.integers(2))}
    unit = place.unit("rad")
    return Concealed("backlash", "joint", place.site, 0.01, unit, details)


def _compliance(rng: np.random.Generator, place: Place) -> Concealed:
    details = {"motor side": float(rng.integers(2))}
    value = 1.0 / _stiffness(rng, place)
    unit = place.unit("rad/(N m)")
    return Concealed("joint_compliance", "joint", place.site, value, unit, details)


def _stiffness(rng: np.random.Generator, place: Place) -> float:
    """Draw a stiffness that makes rotor and gear a spring of 60 to 120 rad/s."""
    return _rotor(place.machine, place.site) * log_uniform(rng, 60.0, 120.0) ** 2


def _compose_rotor(draft: Draft, c: Concealed) -> None:
    dof = draft.machine.dof(c.site)
    gap = c.value if c.effect == "backlash" else 0.0
    stiffness = c.details["stiffness"] if c.effect == "backlash" else 1.0 / c.value
    inertia = _rotor(draft.machine, c.site)
    damping = 0.2 * (inertia * stiffness) ** 0.5
    draft.transmission = Transmission(dof, inertia, gap, stiffness, damping)
    draft.change_encoder(dof, motor_side=bool(c.details["motor side"]))
    add_armature(draft.model, dof, -inertia)


realised(
    Realised(
        "dry_friction", joints, _dry,
        lambda draft, c: bristle(draft, c, lambda t, q, v, load: c.value), most_force,
    )
)  # fmt: skip
realised(
    Realised(
        "stribeck_friction", joints, _stribeck, _compose_stribeck, most_force, along=("coulomb",)
    )
)
realised(
    Realised(
        "load_dependent_friction", driven, _loaded, _compose_loaded,
        most=lambda place: 0.8,
    )
)  # fmt: skip
_plain(
    "viscous_damping", "N m s/rad", _per_speed, lambda j, c: lambda t, q, v, load: -c.value * v[j]
)
_plain(
    "quadratic_damping",
    "N m s²/rad²",
    lambda place: _per_speed(place) / float(place.scales.speed[place.dof]),
    lambda j, c: lambda t, q, v, load: -c.value * v[j] * abs(v[j]),
)
_plain("constant_force", "N m", _force, lambda j, c: lambda t, q, v, load: c.value, signed=True)
_plain(
    "joint_spring",
    "N m/rad",
    lambda place: _force(place) / float(place.scales.travel[place.dof]),
    _spring,
    details=_rest,
)
_plain("cogging", "N m", _force, _cogging, details=_periods)
realised(
    Realised(
        "armature", joints, _armature,
        lambda draft, c: add_armature(draft.model, draft.machine.dof(c.site), c.value),
        lambda place: _MOST * float(place.scales.inertia[place.dof]),
    )
)  # fmt: skip
realised(
    Realised(
        "backlash", geared, _backlash, _compose_rotor,
        lambda place: 0.2 * float(place.scales.travel[place.dof]), tiers=(3,),
    )
)  # fmt: skip
realised(
    Realised(
        "joint_compliance", geared, _compliance, _compose_rotor,
        lambda place: 1.0 / (_rotor(place.machine, place.site) * _SOFTEST**2), tiers=(3,),
    )
)  # fmt: skip

"""What no name fits: a force law learned from the data, never given a physical name."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal, TypeAlias

import mujoco
import numpy as np

from bo_sysid.effects.contract import (
    Component,
    Extent,
    Force,
    Magnitudes,
    Motion,
    Part,
    Signal,
    Site,
)
from bo_sysid.effects.machine import ActuatorScale, JointScale, Machine
from bo_sysid.effects.registry import effect

Dependence = Literal["position", "speed", "control", "load", "time", "other_joint"]

Term: TypeAlias = Callable[[Motion], Signal]
Shape: TypeAlias = Callable[[Signal], Signal]

ELAPSED = "aux.elapsed"
"""Signal that features of time read: the time since a recording began, in [s]."""

_POSITIONS, _SPEEDS, _TIMES, _OTHERS = 24, 10, 8, 6  # bumps over the range of each
_FASTEST = 2.5  # of a joint's root-mean-square speed: the outermost bumps
_REVERSAL = 0.02  # of that speed: where a smooth sign turns


@dataclass(frozen=True)
class Feature:
    """One term of a learned force law.

    Attributes:
        depends_on: what it depends on.
        name: for tables.
        value: of the term, about 1 at most, for many simulations at one instant.
    """

    depends_on: Dependence
    name: str
    value: Term


def features(joint: str, machine: Machine) -> tuple[Feature, ...]:
    """Return the terms of a flexible force law on one joint.

    Bumps over position and speed, friction that changes with position; the controls and the
    torque of the joint's actuators; bumps over time, for forces and friction; bumps over the
    positions of the other joints. Features of time read the signal `ELAPSED`.
    """
    scale = machine.joints[joint]
    return (
        *_own(scale),
        *_of_drive(scale, machine),
        *_of_time(scale, machine),
        *_of_others(scale, machine),
    )


def learned_force(terms: Sequence[Feature], weights: Magnitudes, scale: float) -> Term:
    """Return the law scale·Σ wᵢ φᵢ(motion), in the unit of `scale`."""
    if len(terms) != len(weights):
        raise ValueError(f"{len(terms)} terms have {len(weights)} weights")
    used = [(t.value, float(w)) for t, w in zip(terms, weights, strict=True) if w]

    def law(motion: Motion) -> Signal:
        force = np.zeros_like(next(iter(motion.qvel.values())))
        for value, weight in used:
            force = force + scale * weight * value(motion)
        return force

    return law


def _bumps(count: int, low: float, high: float) -> list[Shape]:
    """Return Gaussians at even distances that overlap at 0.9 of their height."""
    width = max((high - low) / (count - 1), 1e-9)

    def bump(centre: float) -> Shape:
        return lambda x: np.exp(-0.5 * ((x - centre) / width) ** 2)

    return [bump(float(c)) for c in np.linspace(low, high, count)]


def _over_positions(joint: JointScale, count: int) -> list[Shape]:
    return _bumps(count, joint.middle - 0.5 * joint.span, joint.middle + 0.5 * joint.span)


def _direction(joint: JointScale) -> Shape:
    """Return a smooth sign of velocity."""
    return lambda v: np.tanh(v / (_REVERSAL * joint.speed))


def _of_qpos(joint: str, shape: Shape) -> Term:
    return lambda m: shape(m.qpos[joint])


def _of_qvel(joint: str, shape: Shape) -> Term:
    return lambda m: shape(m.qvel[joint])


def _of_elapsed(shape: Shape) -> Term:
    return lambda m: shape(m.signals[ELAPSED])


def _product(one: Term, other: Term) -> Term:
    return lambda m: one(m) * other(m)


def _own(joint: JointScale) -> list[Feature]:
    """Bumps over position, over speed, and over position times the direction of motion."""
    name, most = joint.name, _FASTEST * joint.speed
    over = [_of_qpos(name, f) for f in _over_positions(joint, _POSITIONS)]
    sign = _of_qvel(name, _direction(joint))
    speeds = [_of_qvel(name, f) for f in _bumps(_SPEEDS, -most, most)]
    return [
        *(Feature("position", f"position {k}", f) for k, f in enumerate(over)),
        *(Feature("speed", f"speed {k}", f) for k, f in enumerate(speeds)),
        *(
            Feature("position", f"friction at position {k}", _product(f, sign))
            for k, f in enumerate(over)
        ),
    ]


def _of_drive(joint: JointScale, machine: Machine) -> list[Feature]:
    """Powers of the control of each actuator; its torque against the motion."""
    sign = _of_qvel(joint.name, _direction(joint))
    found = []
    for a in (machine.actuators[n] for n in joint.actuators):
        if a.ctrl_max > 0:
            found += [Feature("control", f"{a.name}^{p}", _control(a, p)) for p in (1, 2, 3)]
        if a.ctrl_max > 0 and a.plain:
            load = _product(sign, _load(a, joint.name))
            found.append(Feature("load", f"torque of {a.name} against motion", load))
    return found


def _control(a: ActuatorScale, power: int) -> Term:
    return lambda m: (m.ctrl[a.name] / a.ctrl_max) ** power


def _load(a: ActuatorScale, joint: str) -> Term:
    return lambda m: np.abs(a.force(m.ctrl[a.name], m.qpos[joint], m.qvel[joint])) / a.force_max


def _of_time(joint: JointScale, machine: Machine) -> list[Feature]:
    """Bumps over time: of a force, of friction and of damping."""
    most = _FASTEST * joint.speed
    kinds: dict[str, Shape] = {
        "force": np.ones_like,
        "friction": _direction(joint),
        "damping": lambda v: v / most,
    }
    return [
        Feature(
            "time",
            f"{kind} at time {k}",
            _product(_of_elapsed(bump), _of_qvel(joint.name, shape)),
        )
        for kind, shape in kinds.items()
        for k, bump in enumerate(_bumps(_TIMES, 0.0, max(machine.duration, 1e-6)))
    ]


def _of_others(joint: JointScale, machine: Machine) -> list[Feature]:
    """Bumps over the positions of the other joints."""
    return [
        Feature("other_joint", f"{other.name} {k}", _of_qpos(other.name, f))
        for other in machine.joints.values()
        if other.name != joint.name
        for k, f in enumerate(_over_positions(other, _OTHERS))
    ]


def _unknown_force(site: Site, x: Magnitudes, machine: Machine) -> Term:
    joint = machine.joints[site.name]
    return learned_force(_own(joint), x, joint.force)


_TERMS = 2 * _POSITIONS + _SPEEDS
_EXTENT = Extent((0.05,) * _TERMS, (-20.0,) * _TERMS, (20.0,) * _TERMS)


@effect(
    "unknown",
    kind="joint",
    components=tuple(Component(f"weight {k}", "–") for k in range(_TERMS)),
    vector=_TERMS,
    extent=lambda site, machine: _EXTENT,
    noun="an unknown force",
    sentence="On {site} acts a force of no known kind (size {value}) that the model lacks.",
    form="learned force law",
    evidence="a force that position and speed predict and that no named effect explains",
    separation="what it depends on tells what to vary next",
    family="learned",
    force=_unknown_force,
)
def unknown(spec: mujoco.MjSpec, site: Site, x: Magnitudes, machine: Machine) -> Part:
    """A force of position and speed of the joint, in units of its typical force.

    Laws that depend on more are made of `features` by `learned_force`.
    """
    return Force(site.name, _unknown_force(site, x, machine))

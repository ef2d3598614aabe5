"""What no name fits: a force law learned from the data, never given a physical name."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal, TypeAlias

import mujoco
import numpy as np

from bo_sysid.effects.actuators import acting
from bo_sysid.effects.contract import Component, Extent, Magnitudes, Site
from bo_sysid.effects.machine import ActuatorScale, JointScale, Machine
from bo_sysid.effects.parts import Force, Motion, Part, Signal
from bo_sysid.effects.registry import effect

Dependence = Literal["position", "speed", "control", "load", "time", "other_joint"]

Term: TypeAlias = Callable[[Motion], Signal]
Shape: TypeAlias = Callable[[Signal], Signal]

ELAPSED = "aux.elapsed"
"""Signal that features of time read: the time since a recording began, in [s]."""

_POSITIONS, _SPEEDS, _TIMES, _OTHERS = 48, 10, 8, 12  # bumps over the range of each
_TURN = 2 * np.pi  # [rad]
_WINDS = 2.5  # turns above which what a hinge feels can only depend on its angle within one
_FASTEST = 2.5  # of a joint's root-mean-square speed: the outermost bumps
_NODES, _BEYOND = 4096, 0.5  # of the table that stands for many bumps; share of the range beyond
_REVERSAL = 0.02  # of that speed: where a smooth sign turns


@dataclass(frozen=True)
class Variable:
    """What a term is a function of, and over which range."""

    name: str
    read: Term
    low: float
    high: float


@dataclass(frozen=True)
class Feature:
    """One term of a learned force law: shape(variable) · times(motion), about 1 at most.

    Attributes:
        depends_on: what it depends on.
        name: for tables.
        of: the variable.
        shape: function of the variable.
        times: name and factor that goes with it, such as the direction of motion.
    """

    depends_on: Dependence
    name: str
    of: Variable
    shape: Shape
    times: tuple[str, Term] | None = None

    def value(self, motion: Motion) -> Signal:
        """Return the term for many simulations at one instant."""
        value = self.shape(self.of.read(motion))
        return value if self.times is None else value * self.times[1](motion)


def features(joint: str, machine: Machine) -> tuple[Feature, ...]:
    """Return the terms of a flexible force law on one joint.

    Bumps over position and speed, friction, also as it changes with position; the controls and the
    torque of the joint's actuators; bumps over time, for forces and friction; bumps over the
    positions of the other joints. Features of time read the signal `ELAPSED`.
    """
    scale = machine.joints[joint]
    return (
        *_own(scale, _over_positions(scale, _POSITIONS)),
        *_of_drive(scale, machine),
        *_of_time(scale, machine),
        *_of_others(scale, machine),
    )


def learned_force(terms: Sequence[Feature], weights: Magnitudes, scale: float) -> Term:
    """Return the law scale·Σ wᵢ φᵢ(motion), in the unit of `scale`.

    Terms of one variable with one factor are summed once, in a table that is interpolated
    linearly: a law is evaluated at every step of every simulation.
    """
    if len(terms) != len(weights):
        raise ValueError(f"{len(terms)} terms have {len(weights)} weights")
    together: dict[tuple[str, str], list[tuple[Feature, float]]] = {}
    for t, w in zip(terms, weights, strict=True):
        if w:
            key = (t.of.name, "" if t.times is None else t.times[0])
            together.setdefault(key, []).append((t, scale * float(w)))
    summed = [_summed(group) for group in together.values()]

    def law(motion: Motion) -> Signal:
        force = np.zeros_like(next(iter(motion.qvel.values())))
        for value in summed:
            force = force + value(motion)
        return force

    return law


def _summed(group: Sequence[tuple[Feature, float]]) -> Term:
    """Return the sum of weighted terms of one variable with one factor."""
    of, times = group[0][0].of, group[0][0].times
    beyond = _BEYOND * (of.high - of.low)
    nodes = np.linspace(of.low - beyond, of.high + beyond, _NODES)
    table = np.sum([w * t.shape(nodes) for t, w in group], axis=0)

    def value(motion: Motion) -> Signal:
        found = np.interp(of.read(motion), nodes, table)
        return np.asarray(found if times is None else found * times[1](motion))

    return value


def _bumps(count: int, low: float, high: float) -> list[Shape]:
    """Return Gaussians at even distances that overlap at 0.9 of their height.

    Beyond the range, of which nothing is known, each stays as it is at its end.
    """
    width = max((high - low) / (count - 1), 1e-9)

    def bump(centre: float) -> Shape:
        return lambda x: np.exp(-0.5 * ((np.clip(x, low, high) - centre) / width) ** 2)

    return [bump(float(c)) for c in np.linspace(low, high, count)]


def _winds(joint: JointScale) -> bool:
    """Whether a hinge turns on and on, as a wheel does."""
    return joint.hinge and joint.span > _WINDS * _TURN


def _over_positions(joint: JointScale, count: int) -> list[Shape]:
    """Return `count` bumps over the range of a joint, as many a turn where a hinge moves further.

    Of an arm that had spun once, those over its range were so far apart that a magnet was lost
    between them. A hinge that winds has them around the circle.
    """
    if _winds(joint):
        return _round_bumps(count)
    if joint.hinge:
        count = max(count, int(np.ceil(count * joint.span / _TURN)))
    return _bumps(count, joint.middle - 0.5 * joint.span, joint.middle + 0.5 * joint.span)


def _round_bumps(count: int) -> list[Shape]:
    """Return Gaussians at even distances around a circle, which overlap as `_bumps` do."""
    width = _TURN / count

    def bump(centre: float) -> Shape:
        return lambda x: np.exp(-0.5 * (((x - centre + np.pi) % _TURN - np.pi) / width) ** 2)

    return [bump(k * width) for k in range(count)]


def _direction(joint: JointScale) -> Shape:
    """Return a smooth sign of velocity."""
    return lambda v: np.tanh(v / (_REVERSAL * joint.speed))


def _position(joint: JointScale) -> Variable:
    half, name = 0.5 * (_TURN if _winds(joint) else joint.span), joint.name
    low, high = joint.middle - half, joint.middle + half
    if _winds(joint):
        return Variable(f"qpos.{name}", lambda m: low + (m.qpos[name] - low) % _TURN, low, high)
    return Variable(f"qpos.{name}", lambda m: m.qpos[name], low, high)


def _velocity(joint: JointScale) -> Variable:
    most, name = _FASTEST * joint.speed, joint.name
    return Variable(f"qvel.{name}", lambda m: m.qvel[name], -most, most)


def _turning(joint: JointScale) -> tuple[str, Term]:
    sign = _direction(joint)
    return "direction", lambda m: sign(m.qvel[joint.name])


def _own(joint: JointScale, over: Sequence[Shape]) -> list[Feature]:
    """Bumps over position, over speed with a step at rest, and friction over position.

    Without that step friction of one size was told as friction that changes with time.
    """
    at, speed, sign = _position(joint), _velocity(joint), _turning(joint)
    speeds = _bumps(_SPEEDS, speed.low, speed.high)
    return [
        *(Feature("position", f"position {k} of {len(over)}", at, f) for k, f in enumerate(over)),
        *(Feature("speed", f"speed {k}", speed, f) for k, f in enumerate(speeds)),
        Feature("speed", "direction of motion", at, np.ones_like, sign),
        *(
            Feature("position", f"friction at position {k} of {len(over)}", at, f, sign)
            for k, f in enumerate(over)
        ),
    ]


def _of_drive(joint: JointScale, machine: Machine) -> list[Feature]:
    """Powers of the control of each actuator; its torque against the motion."""
    found = []
    for a in (machine.actuators[n] for n in joint.actuators):
        if a.ctrl_max > 0:
            ctrl = _control(a)
            found += [Feature("control", f"{a.name}^{p}", ctrl, _power(a, p)) for p in (1, 2, 3)]
        if a.ctrl_max > 0 and a.plain and a.follows:
            name = f"torque of {a.name} against motion"
            found.append(Feature("load", name, _load(a, joint), np.asarray, _turning(joint)))
    return found


def _control(a: ActuatorScale) -> Variable:
    return Variable(f"ctrl.{a.name}", lambda m: acting(a, m), -a.ctrl_max, a.ctrl_max)


def _power(a: ActuatorScale, power: int) -> Shape:
    return lambda u: (u / a.ctrl_max) ** power


def _load(a: ActuatorScale, joint: JointScale) -> Variable:
    def read(m: Motion) -> Signal:
        force = a.force(acting(a, m), m.qpos[joint.name], m.qvel[joint.name])
        return np.asarray(np.abs(force) / a.force_max)

    return Variable(f"load.{a.name}", read, 0.0, 2.0)


def _of_time(joint: JointScale, machine: Machine) -> list[Feature]:
    """Bumps over time: of a force, of friction and of damping."""
    most, end = _FASTEST * joint.speed, max(machine.duration, 1e-6)
    elapsed = Variable(ELAPSED, lambda m: m.signals[ELAPSED], 0.0, end)
    kinds: dict[str, tuple[str, Term] | None] = {
        "force": None,
        "friction": _turning(joint),
        "damping": ("speed", lambda m: m.qvel[joint.name] / most),
    }
    return [
        Feature("time", f"{kind} at time {k}", elapsed, bump, times)
        for kind, times in kinds.items()
        for k, bump in enumerate(_bumps(_TIMES, 0.0, end))
    ]


def _of_others(joint: JointScale, machine: Machine) -> list[Feature]:
    """Bumps over the positions of the other joints."""
    others = [o for o in machine.joints.values() if o.name != joint.name]
    return [
        Feature("other_joint", f"{other.name} {k} of {len(over)}", _position(other), f)
        for other in others
        for over in [_over_positions(other, _OTHERS)]
        for k, f in enumerate(over)
    ]


def _unknown_force(site: Site, x: Magnitudes, machine: Machine) -> Term:
    """Return the law of one joint's position and speed; of as many weights however far it moved."""
    joint = machine.joints[site.name]
    at = _position(joint)
    around = _winds(joint)
    over = _round_bumps(_POSITIONS) if around else _bumps(_POSITIONS, at.low, at.high)
    return learned_force(_own(joint, over), x, joint.force)


_TERMS = 2 * _POSITIONS + _SPEEDS + 1
_EXTENT = Extent((0.05,) * _TERMS, (-20.0,) * _TERMS, (20.0,) * _TERMS)


@effect(
    "unknown",
    kind="joint",
    components=tuple(Component(f"weight {k}", "–") for k in range(_TERMS)),
    vector=_TERMS,
    extent=lambda site, machine: _EXTENT,
    noun="an unknown force",
    sentence="A force of no known kind (size {value}) that the model lacks acts on {site}.",
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

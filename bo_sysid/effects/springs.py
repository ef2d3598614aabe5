"""Forces that depend on where a joint is: springs, constant forces and cogging."""

from collections.abc import Mapping

import mujoco
import numpy as np

from bo_sysid.effects.actuators import passive_motor
from bo_sysid.effects.contract import Component, Extent, Magnitudes, Site
from bo_sysid.effects.machine import Machine
from bo_sysid.effects.parts import Force, Part
from bo_sysid.effects.registry import effect
from bo_sysid.effects.units import unit_at

_PERIODS = (*range(2, 33), 36, 40, 48)  # of cogging in a turn of a hinge
_STROKES = (1, 1.5, *range(2, 49))  # the same in the range of a slide; linear motors have up to 50
_FINER = (0.94, 0.97, 0.985, 1.015, 1.03, 1.06)
_ONE_PERIOD = 3.0  # [rad] of phase that the joint must sweep
_NO_SPRING = 1e-3  # of the springs that make it up: a sum that rests nowhere
_WEAK = 1e-6  # [1/rad] slope, relative to the force, of a spring that acts as a constant force


def add_spring(spec: mujoco.MjSpec, joint: str, stiffness: float, force: float) -> Force | None:
    """Add a spring to a joint: the force ``force - stiffness·q``.

    Together with a spring that the joint has, this is again one spring: stiffnesses add, and the
    rest position is where the sum of the forces vanishes. A constant force alone becomes a spring
    so weak, and so far away, that its force does not change. Beside a spring that is no straight
    line, whose higher terms would move with the rest position, it is a force law.
    """
    j = spec.joint(joint)
    if np.any(np.asarray(j.stiffness[1:])):
        return Force(joint, lambda m: force - stiffness * m.qpos[joint])
    angle = np.pi / 180 if j.compiler.degree and j.type == mujoco.mjtJoint.mjJNT_HINGE else 1.0
    at_zero = j.stiffness[0] * j.springref * angle + force
    total = j.stiffness[0] + stiffness
    if abs(total) * 1e6 < abs(at_zero):
        total = total + _WEAK * abs(at_zero)
    j.stiffness[0] = total
    j.springref = at_zero / total / angle if total else 0.0
    return None


def _stiffness(site: Site, machine: Machine) -> float:
    return float(machine.model.joint(site.name).stiffness[0])


def _spring_extent(site: Site, machine: Machine) -> Extent:
    joint = machine.joints[site.name]
    stiffness = joint.force / joint.spread
    return Extent(
        (0.05 * stiffness, 0.05 * joint.force),
        (-_stiffness(site, machine) - 1e-12, -9 * joint.force),
        (20 * stiffness, 9 * joint.force),
    )


def _rest_angle(x: Magnitudes, machine: Machine, site: Site) -> Mapping[str, tuple[float, str]]:
    """Return where the joint's whole spring rests, the model's with it: k q = k₀ q₀ + x[1].

    Nothing where the model's is no straight line.
    """
    own = _stiffness(site, machine)
    joint = machine.model.joint(site.name)
    stiffness = own + float(x[0])
    bent = bool(np.any(machine.model.jnt_stiffnesspoly[joint.id]))
    if bent or abs(stiffness) <= _NO_SPRING * (abs(own) + abs(float(x[0]))):
        return {}
    begun = own * float(machine.model.qpos_spring[joint.qposadr[0]])
    return {"rest angle": ((begun + float(x[1])) / stiffness, unit_at("rad", site, machine))}


@effect(
    "joint_spring",
    kind="joint",
    components=(Component("stiffness", "N m/rad"), Component("force at zero", "N m")),
    extent=_spring_extent,
    nominal=_stiffness,
    noun="a spring",
    sentence="{site} has a spring of {value} that the model lacks.",
    form="stiffness, springref",
    evidence="a force that grows with the distance from a rest position",
    separation="slow motion up and down over more than a radian",
    nested="constant_force",
    force=lambda site, x, machine: lambda m: x[1] - x[0] * m.qpos[site.name],
    details=_rest_angle,
)
def joint_spring(spec: mujoco.MjSpec, site: Site, x: Magnitudes, machine: Machine) -> Part | None:
    """Spring of stiffness x[0] with the force x[1] at position 0: rest position x[1]/x[0]."""
    return add_spring(spec, site.name, float(x[0]), float(x[1]))


def _constant_extent(site: Site, machine: Machine) -> Extent:
    force = machine.joints[site.name].force
    return Extent((0.05 * force,), (-9 * force,), (9 * force,))


@effect(
    "constant_force",
    kind="joint",
    components=(Component("force", "N m"),),
    extent=_constant_extent,
    noun="a constant force",
    sentence="A constant force of {value} that the model lacks acts on {site}.",
    form="stiffness, springref: a spring from far away",
    evidence="the same force at every position and speed",
    separation="several postures",
    force=lambda site, x, machine: lambda m: np.full_like(m.qvel[site.name], x[0]),
    grouped=True,
)
def constant_force(spec: mujoco.MjSpec, site: Site, x: Magnitudes, machine: Machine) -> Part | None:
    """A constant force along the joint."""
    return add_spring(spec, site.name, 0.0, float(x[0]))


def _cogging_extent(site: Site, machine: Machine) -> Extent | None:
    joint = machine.joints[site.name]
    if joint.hinge:
        periods = [float(k) for k in _PERIODS if k * joint.span > _ONE_PERIOD]
    else:
        periods = [2 * np.pi * k / joint.span for k in _STROKES]
    if not periods:
        return None
    probe, most = 0.05 * joint.force, 9 * joint.force
    return Extent(
        (probe, probe, periods[0]),
        (-most, -most, 0.5 * periods[0]),
        (most, most, 1.5 * periods[-1]),
        tuple((probe, probe, k) for k in periods),
        refine=_FINER,
    )


def _cogging_phase(x: Magnitudes, machine: Machine, site: Site) -> Mapping[str, tuple[float, str]]:
    """Return the phase, an angle at a slide, too."""
    return {"phase": (float(np.arctan2(x[1], x[0])), "rad")}


@effect(
    "cogging",
    kind="joint",
    components=(
        Component("sine", "N m"),
        Component("cosine", "N m"),
        Component("periods", "1/rad"),
    ),
    shapes=1,
    vector=2,
    extent=_cogging_extent,
    noun="cogging",
    sentence="{site} has cogging of {value} that the model lacks.",
    form="passive dcmotor",
    evidence="a force that repeats with position",
    separation="slow motion over several periods",
    force=lambda site, x, machine: (
        lambda m: x[0] * np.sin(x[2] * m.qpos[site.name]) + x[1] * np.cos(x[2] * m.qpos[site.name])
    ),
    details=_cogging_phase,
)
def cogging(spec: mujoco.MjSpec, site: Site, x: Magnitudes, machine: Machine) -> None:
    """Force x[0]·sin(k·q) + x[1]·cos(k·q) with k = x[2] periods a turn (a hinge: 2π rad).

    A passive `dcmotor`: it has no control and no state, and turns no current into force.
    """
    motor = passive_motor(spec, site.name, "cogging", machine)
    motor.biasprm[:3] = (float(np.hypot(x[0], x[1])), x[2], float(np.arctan2(x[1], x[0])))

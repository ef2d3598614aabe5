"""Friction at joints: what hardly depends on speed."""

from collections.abc import Callable, Sequence

import mujoco
import numpy as np

from bo_sysid.effects.actuators import acting, as_edited
from bo_sysid.effects.bristles import (
    PRESLIDING_FACTORS,
    add_bristles,
    add_rise,
    bristled,
    max_presliding,
    presliding_grid,
)
from bo_sysid.effects.contract import Component, Extent, Magnitudes, Site
from bo_sysid.effects.machine import ActuatorScale, JointScale, Machine
from bo_sysid.effects.parts import Force, Motion, Part, Signal
from bo_sysid.effects.registry import effect
from bo_sysid.mjcf.touching import can_touch

# With MuJoCo's default solver settings dry friction creeps under load; with these the speed is
# (1 - d)/d of the free one after a time constant: a load held at 33 rad/s² creeps 6.5e-6 rad/s.
_SOLREF = (0.002, 1.0)
_SOLIMP = (0.9999, 0.9999, 0.001, 0.5, 2.0)
_HOLDS, _CREEPS = 1.0, 0.0
_HELD = 1.2  # of the most that a joint's actuators did: friction that holds it all the time
_LOADED = 3.0  # times that, which impacts load a joint with
_FINER = (0.55, 0.75, 1.35, 1.8)
_REST = 1e-3  # of a joint's speed: below, it rests
_STRIBECK_SPEEDS = (0.056, 0.168, 0.49)  # of the joint's root-mean-square speed


PRESLIDING = 2
"""Place of the presliding displacement among the magnitudes of dry friction."""


def _frictionloss(site: Site, machine: Machine) -> float:
    return float(machine.model.joint(site.name).frictionloss[0])


def _dry_extent(site: Site, machine: Machine) -> Extent:
    joint = machine.joints[site.name]
    low = -_frictionloss(site, machine) - 1e-12
    held = _HELD * joint.driven
    loaded = _LOADED if can_touch(machine.model) else 1.0
    most = max(3 * joint.force, loaded * held)
    return Extent(
        (0.05 * joint.force, _HOLDS, 0.0),
        (low, _CREEPS, 0.0),
        (most, _HOLDS, max_presliding(joint)),
        secants=tuple((level, _HOLDS, 0.0) for level in (joint.force, held) if level > 0),
        variants=((_CREEPS, 0.0), *((_HOLDS, presliding) for presliding in presliding_grid(joint))),
        refine=PRESLIDING_FACTORS,
    )


@effect(
    "dry_friction",
    kind="joint",
    components=(
        Component("level", "N m"),
        Component("holds (1) or creeps (0)", "–"),
        Component("bend", "rad"),
    ),
    shapes=2,
    extent=_dry_extent,
    nominal=_frictionloss,
    noun="dry friction",
    sentence="{site} has dry friction of {value} that the model lacks.",
    form="frictionloss",
    evidence="a step of force where the velocity changes sign",
    separation="reversals at different speeds",
    force=lambda site, x, machine: lambda m: -x[0] * np.sign(m.qvel[site.name]),
    grouped=True,
)
def dry_friction(spec: mujoco.MjSpec, site: Site, x: Magnitudes, machine: Machine) -> None:
    """Coulomb friction: a force of constant size against the velocity.

    At x[1] = 1 (also where it is left out) it holds a load at rest, as that of machines does; at 0
    it creeps under one as the solver settings in the model's file say. Where x[2] is given it gives
    way by so much before it slips, as bristles do: LuGre friction of one level.
    """
    # shapes that are left out: it holds, without presliding
    level, hold, presliding = (*(float(v) for v in x), *(_HOLDS, 0.0)[len(x) - 1 :])
    total = spec.joint(site.name).frictionloss + level
    if presliding and level and total > 0:
        speed = machine.joints[site.name].speed
        add_bristles(spec, site.name, (total, total, speed), presliding, machine)
    else:
        add_dry_friction(spec, site.name, level, holds=hold > _CREEPS)


def add_dry_friction(spec: mujoco.MjSpec, joint: str, level: float, *, holds: bool = True) -> None:
    """Add dry friction to a joint; where it holds a load, with solver settings that let it."""
    j = spec.joint(joint)
    j.frictionloss = max(j.frictionloss + level, 0.0)
    if not holds:
        return
    j.solref_friction = list(_SOLREF)
    j.solimp_friction = list(_SOLIMP)


def _stribeck_extent(site: Site, machine: Machine) -> Extent:
    joint = machine.joints[site.name]
    probe = 0.05 * joint.force
    speeds = [k * joint.speed for k in _STRIBECK_SPEEDS]
    return Extent(
        (probe, probe, speeds[1], 0.0),
        (0.0, 0.0, 0.2 * speeds[0], 0.0),
        (3 * joint.force, 3 * joint.force, 3 * speeds[-1], max_presliding(joint)),
        tuple((probe, probe, s, 0.0) for s in speeds),
        refine=_FINER,
        variants=tuple((np.nan, presliding) for presliding in presliding_grid(joint)),
    )


def _write_stribeck(spec: mujoco.MjSpec, site: Site, x: Magnitudes, machine: Machine) -> None:
    """Write the friction of `stribeck_friction` as LuGre friction with the same steady state.

    Without presliding only what it loses in motion, beside dry friction.
    """
    excess, coulomb, speed, presliding = _stribeck_magnitudes(x)
    low = spec.joint(site.name).frictionloss + coulomb
    if presliding:
        add_bristles(spec, site.name, (low, low + excess, speed), presliding, machine)
    else:
        remains = add_rise(spec, site.name, excess, speed, machine) if excess else 0.0
        add_dry_friction(spec, site.name, coulomb - remains)


def _stribeck_magnitudes(x: Magnitudes) -> tuple[float, float, float, float]:
    """Return excess, Coulomb level, speed and presliding; where that is left out it is 0."""
    excess, coulomb, speed, *presliding = (float(v) for v in x)
    return excess, coulomb, speed, presliding[0] if presliding else 0.0


@effect(
    "stribeck_friction",
    kind="joint",
    components=(
        Component("excess", "N m"), Component("coulomb", "N m"), Component("speed", "rad/s"),
        Component("bend", "rad"),
    ),
    shapes=2,
    extent=_stribeck_extent,
    noun="Stribeck friction",
    sentence="{site} has friction that rises by {value} towards standstill.",
    form="passive dcmotor with lugre",
    evidence="more friction at low speed than at high speed",
    separation="very slow reversals",
    nested="dry_friction",
    force=lambda site, x, machine: (
        lambda m: (
            -np.sign(m.qvel[site.name]) * (x[1] + x[0] * np.exp(-((m.qvel[site.name] / x[2]) ** 2)))
        )
    ),
    written=_write_stribeck,
)  # fmt: skip
def stribeck_friction(
    spec: mujoco.MjSpec, site: Site, x: Magnitudes, machine: Machine
) -> Part | None:
    """Friction F(v) = Fc + (Fs - Fc)·exp(-(v/vs)²), x = (Fs - Fc, Fc, vs, bend).

    The constraint holds with Fs at rest; a force law gives back what the joint does not feel
    once it moves, and vanishes at v = 0. Where x[3] is given the friction gives way by so much
    before it slips: LuGre friction.
    """
    excess, coulomb, speed, presliding = _stribeck_magnitudes(x)
    if presliding and (excess or coulomb):
        _write_stribeck(spec, site, x, machine)
        return None
    add_dry_friction(spec, site.name, excess + coulomb)

    def relief(motion: Motion) -> Signal:
        v = motion.qvel[site.name]
        return np.asarray(excess * np.sign(v) * -np.expm1(-((v / speed) ** 2)))

    return Force(site.name, relief) if excess else None


def _moving(v: Signal, joint: JointScale) -> Signal:
    """Return 1 where a joint moves and 0 where it rests, with a ramp between."""
    return np.asarray(np.minimum(np.abs(v) / (_REST * joint.speed), 1.0))


def _asymmetric_friction_extent(site: Site, machine: Machine) -> Extent:
    force = machine.joints[site.name].force
    return Extent((0.05 * force,), (-6 * force,), (6 * force,))


def _friction_difference(site: Site, x: Magnitudes, machine: Machine) -> Callable[[Motion], Signal]:
    joint = machine.joints[site.name]
    return lambda m: -0.5 * x[0] * _moving(m.qvel[site.name], joint)


@effect(
    "asymmetric_friction",
    weight=2,
    kind="joint",
    components=(Component("difference", "N m"),),
    extent=_asymmetric_friction_extent,
    noun="a difference of friction between the directions",
    sentence="The dry friction of {site} is {value} larger forwards than backwards.",
    form="force law",
    evidence="a constant force that is there only while the joint moves",
    separation="standstill between slow moves in both directions",
    force=_friction_difference,
)
def asymmetric_friction(spec: mujoco.MjSpec, site: Site, x: Magnitudes, machine: Machine) -> Part:
    """Friction larger by x[0]/2 forwards and smaller by x[0]/2 backwards: -x[0]/2 in motion."""
    return Force(site.name, _friction_difference(site, x, machine))


def _load_extent(site: Site, machine: Machine) -> Extent | None:
    joint = machine.joints[site.name]
    if not any(a.ctrl_max > 0 for a in _drives(site, machine)):
        return None
    return Extent(
        (0.02, 0.0),
        (0.0, 0.0),
        (0.9, max_presliding(joint)),
        variants=tuple((presliding,) for presliding in presliding_grid(joint)),
        refine=PRESLIDING_FACTORS,
    )


def _drives(site: Site, machine: Machine) -> list[ActuatorScale]:
    """Return the actuators of a joint whose force is told by their controls."""
    held = (machine.actuators[n] for n in machine.joints[site.name].actuators)
    return [a for a in held if a.plain and a.follows]


def _load_friction(
    drives: Sequence[ActuatorScale], site: Site, x: Magnitudes, machine: Machine
) -> Callable[[Motion], Signal]:
    """Friction of a share of the drives' torque, never more than stops the joint in a step.

    Where x[1] is given it bends, as bristles do.
    """
    joint, presliding = machine.joints[site.name], float(x[1]) if len(x) > 1 else 0.0

    def law(m: Motion) -> Signal:
        q, v = m.qpos[site.name], m.qvel[site.name]
        load = np.asarray(sum(a.force(acting(a, m), q, v) for a in drives))
        if presliding > 0:
            return bristled(load, x[0], presliding, joint, m)
        stopping = 0.5 * joint.inertia * np.abs(v) / m.timestep
        return np.asarray(-np.sign(v) * np.minimum(x[0] * np.abs(load), stopping))

    return law


@effect(
    "load_dependent_friction",
    kind="joint",
    components=(Component("share", "fraction of the load torque"), Component("bend", "rad")),
    shapes=1,
    extent=_load_extent,
    noun="friction that grows with load",
    sentence="{site} loses {value} of its drive's torque to friction.",
    form="force law",
    evidence="dry friction that grows with the torque that the gear carries",
    separation="the same speed under another load",
    force=lambda site, x, machine: _load_friction(_drives(site, machine), site, x[:1], machine),
    of_drives=True,
)
def load_dependent_friction(
    spec: mujoco.MjSpec, site: Site, x: Magnitudes, machine: Machine
) -> Part:
    """Friction -x[0]·|τ|·sign(v), τ what the joint's actuators do, as they are in the spec.

    Where x[1] is given it gives way by so much before it slips, as bristles do.
    """
    drives = [as_edited(spec, a) for a in _drives(site, machine)]
    return Force(site.name, _load_friction(drives, site, x, machine))

"""Friction and damping at joints."""

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
from bo_sysid.effects.machine import Machine
from bo_sysid.effects.registry import effect

# With MuJoCo's default solver settings dry friction creeps under load; with these the speed is
# (1 - d)/d of the free one after a time constant: a load held at 33 rad/s² creeps 6.5e-6 rad/s.
_SOLREF = (0.002, 1.0)
_SOLIMP = (0.9999, 0.9999, 0.001, 0.5, 2.0)
_FINER = (0.55, 0.75, 1.35, 1.8)
_STRIBECK_SPEEDS = (0.056, 0.168, 0.49)  # of the joint's root-mean-square speed


def _frictionloss(site: Site, machine: Machine) -> float:
    return float(machine.model.joint(site.name).frictionloss[0])


def _damping(site: Site, machine: Machine) -> float:
    return float(machine.model.joint(site.name).damping[0])


def _dry_extent(site: Site, machine: Machine) -> Extent:
    force = machine.joints[site.name].force
    return Extent((0.05 * force,), (-_frictionloss(site, machine) - 1e-12,), (3 * force,))


@effect(
    "dry_friction",
    kind="joint",
    components=(Component("level", "N m"),),
    extent=_dry_extent,
    nominal=_frictionloss,
    noun="dry friction",
    sentence="{site} has dry friction of {value} that the model lacks.",
    evidence="a step of force where the velocity changes sign",
    separation="reversals at different speeds",
    force=lambda site, x, machine: lambda m: -x[0] * np.sign(m.qvel[site.name]),
    grouped=True,
)
def dry_friction(spec: mujoco.MjSpec, site: Site, x: Magnitudes, machine: Machine) -> None:
    """Coulomb friction: a force of constant size against the velocity."""
    add_dry_friction(spec, site.name, float(x[0]))


def add_dry_friction(spec: mujoco.MjSpec, joint: str, level: float) -> None:
    """Add dry friction to a joint, with solver settings under which it holds a load."""
    j = spec.joint(joint)
    j.frictionloss = max(j.frictionloss + level, 0.0)
    j.solref_friction = list(_SOLREF)
    j.solimp_friction = list(_SOLIMP)


def _viscous_extent(site: Site, machine: Machine) -> Extent:
    joint = machine.joints[site.name]
    scale = joint.force / joint.speed
    return Extent((0.05 * scale,), (-_damping(site, machine) - 1e-12,), (20 * scale,))


@effect(
    "viscous_damping",
    kind="joint",
    components=(Component("coefficient", "N m s/rad"),),
    extent=_viscous_extent,
    nominal=_damping,
    noun="viscous damping",
    sentence="{site} has viscous damping of {value} that the model lacks.",
    evidence="a force in proportion to velocity",
    separation="a range of speeds of four to one",
    force=lambda site, x, machine: lambda m: -x[0] * m.qvel[site.name],
    grouped=True,
)
def viscous_damping(spec: mujoco.MjSpec, site: Site, x: Magnitudes, machine: Machine) -> None:
    """Linear damping."""
    j = spec.joint(site.name)
    j.damping[0] = max(j.damping[0] + x[0], 0.0)


def _quadratic_extent(site: Site, machine: Machine) -> Extent:
    joint = machine.joints[site.name]
    scale = joint.force / joint.speed**2
    return Extent((0.02 * scale,), (0.0,), (20 * scale,))


@effect(
    "quadratic_damping",
    kind="joint",
    components=(Component("coefficient", "N m s²/rad²"),),
    extent=_quadratic_extent,
    noun="quadratic damping",
    sentence="{site} has quadratic damping of {value} that the model lacks.",
    evidence="a drag that grows with the square of velocity",
    separation="a range of speeds of four to one",
    force=lambda site, x, machine: lambda m: -x[0] * m.qvel[site.name] * np.abs(m.qvel[site.name]),
)
def quadratic_damping(spec: mujoco.MjSpec, site: Site, x: Magnitudes, machine: Machine) -> None:
    """Drag -x·v·|v|."""
    j = spec.joint(site.name)
    j.damping[1] = j.damping[1] + x[0]


def _stribeck_extent(site: Site, machine: Machine) -> Extent:
    joint = machine.joints[site.name]
    probe = 0.05 * joint.force
    speeds = [k * joint.speed for k in _STRIBECK_SPEEDS]
    return Extent(
        (probe, probe, speeds[1]),
        (0.0, 0.0, 0.2 * speeds[0]),
        (3 * joint.force, 3 * joint.force, 3 * speeds[-1]),
        tuple((probe, probe, s) for s in speeds),
        refine=_FINER,
    )


@effect(
    "stribeck_friction",
    kind="joint",
    components=(
        Component("excess", "N m"), Component("coulomb", "N m"), Component("speed", "rad/s"),
    ),
    shapes=1,
    extent=_stribeck_extent,
    noun="Stribeck friction",
    sentence="{site} has friction that rises by {value} towards standstill.",
    evidence="more friction at low speed than at high speed",
    separation="very slow reversals",
    nested="dry_friction",
    force=lambda site, x, machine: (
        lambda m: (
            -np.sign(m.qvel[site.name]) * (x[1] + x[0] * np.exp(-((m.qvel[site.name] / x[2]) ** 2)))
        )
    ),
)  # fmt: skip
def stribeck_friction(
    spec: mujoco.MjSpec, site: Site, x: Magnitudes, machine: Machine
) -> Part | None:
    """Friction F(v) = Fc + (Fs - Fc)·exp(-(v/vs)²), x = (Fs - Fc, Fc, vs).

    The constraint holds with Fs at rest; a force law gives back what the joint does not feel
    once it moves, and vanishes at v = 0.
    """
    excess, coulomb, speed = (float(v) for v in x)
    add_dry_friction(spec, site.name, excess + coulomb)

    def relief(motion: Motion) -> Signal:
        v = motion.qvel[site.name]
        return np.asarray(excess * np.sign(v) * -np.expm1(-((v / speed) ** 2)))

    return Force(site.name, relief) if excess else None

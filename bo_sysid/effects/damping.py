"""Damping at joints: what grows with speed."""

from collections.abc import Callable

import mujoco
import numpy as np

from bo_sysid.effects.contract import Component, Extent, Magnitudes, Site
from bo_sysid.effects.machine import Machine
from bo_sysid.effects.parts import Force, Motion, Part, Signal
from bo_sysid.effects.registry import effect


def _damping(site: Site, machine: Machine) -> float:
    return float(machine.model.joint(site.name).damping[0])


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
    form="damping",
    evidence="a force in proportion to velocity",
    separation="a range of speeds of four to one",
    force=lambda site, x, machine: lambda m: -x[0] * m.qvel[site.name],
    grouped=True,
)
def viscous_damping(spec: mujoco.MjSpec, site: Site, x: Magnitudes, machine: Machine) -> None:
    """Linear damping."""
    j = spec.joint(site.name)
    j.damping[0] = max(j.damping[0] + x[0], 0.0)


def _quadratic(site: Site, machine: Machine) -> float:
    return float(machine.model.dof_dampingpoly[machine.joints[site.name].dof, 0])


def _quadratic_extent(site: Site, machine: Machine) -> Extent:
    joint = machine.joints[site.name]
    scale = joint.force / joint.speed**2
    return Extent((0.02 * scale,), (-_quadratic(site, machine) - 1e-12,), (20 * scale,))


@effect(
    "quadratic_damping",
    kind="joint",
    components=(Component("coefficient", "N m s²/rad²"),),
    extent=_quadratic_extent,
    nominal=_quadratic,
    noun="quadratic damping",
    sentence="{site} has quadratic damping of {value} that the model lacks.",
    form="damping, second term",
    evidence="a drag that grows with the square of velocity",
    separation="a range of speeds of four to one",
    force=lambda site, x, machine: lambda m: -x[0] * m.qvel[site.name] * np.abs(m.qvel[site.name]),
)
def quadratic_damping(spec: mujoco.MjSpec, site: Site, x: Magnitudes, machine: Machine) -> None:
    """Drag -x·v·|v|."""
    j = spec.joint(site.name)
    j.damping[1] = max(j.damping[1] + x[0], 0.0)


def _asymmetric_damping_extent(site: Site, machine: Machine) -> Extent:
    joint = machine.joints[site.name]
    scale = joint.force / joint.speed
    return Extent((0.05 * scale,), (-20 * scale,), (20 * scale,))


def _damping_difference(site: Site, x: Magnitudes, machine: Machine) -> Callable[[Motion], Signal]:
    return lambda m: -0.5 * x[0] * np.abs(m.qvel[site.name])


@effect(
    "asymmetric_damping",
    weight=2,
    kind="joint",
    components=(Component("difference", "N m s/rad"),),
    extent=_asymmetric_damping_extent,
    noun="a difference of damping between the directions",
    sentence="The damping of {site} is {value} larger forwards than backwards.",
    form="force law",
    evidence="a force in proportion to the size of velocity that never changes its sign",
    separation="the same speeds in both directions",
    force=_damping_difference,
)
def asymmetric_damping(spec: mujoco.MjSpec, site: Site, x: Magnitudes, machine: Machine) -> Part:
    """Damping larger by x[0]/2 forwards and smaller by x[0]/2 backwards: -x[0]/2·|v|."""
    return Force(site.name, _damping_difference(site, x, machine))

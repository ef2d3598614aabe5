"""Masses and inertias that differ from the model's."""

import mujoco

from bo_sysid.effects.contract import Component, Extent, Magnitudes, Site
from bo_sysid.effects.machine import Machine
from bo_sysid.effects.registry import effect
from bo_sysid.mjcf import scale_mass

_POINT = 1e-9  # [m²] inertia of a point load, per kg


def _armature(site: Site, machine: Machine) -> float:
    return float(machine.model.joint(site.name).armature[0])


def _armature_extent(site: Site, machine: Machine) -> Extent:
    inertia = machine.joints[site.name].inertia
    return Extent((0.02 * inertia,), (-_armature(site, machine) - 1e-12,), (5 * inertia,))


@effect(
    "armature",
    kind="joint",
    components=(Component("inertia", "kg m²"),),
    extent=_armature_extent,
    nominal=_armature,
    noun="rotor inertia",
    sentence="{site} has rotor inertia of {value} that the model lacks.",
    evidence="a force in proportion to acceleration that no posture changes",
    separation="motion of one joint at several postures of the others",
    grouped=True,
)
def armature(spec: mujoco.MjSpec, site: Site, x: Magnitudes, machine: Machine) -> None:
    """Inertia of the rotor, reflected through the gear."""
    j = spec.joint(site.name)
    j.armature = max(j.armature + x[0], 0.0)


def _payload_extent(site: Site, machine: Machine) -> Extent:
    mass = machine.bodies[site.name].mass
    return Extent((0.03 * mass,), (0.0,), (5 * mass,))


@effect(
    "payload",
    kind="body",
    components=(Component("mass", "kg"),),
    extent=_payload_extent,
    noun="a payload",
    sentence="{site} carries {value} at its end that the model lacks.",
    evidence="inertia that changes with posture and loads gravity",
    separation="several postures",
)
def payload(spec: mujoco.MjSpec, site: Site, x: Magnitudes, machine: Machine) -> None:
    """A point mass at the end of a body."""
    name = f"{site.name}_payload"
    load = spec.body(name)
    if load is None:
        load = spec.body(site.name).add_body(
            name=name, pos=list(machine.bodies[site.name].tip), explicitinertial=True, mass=0.0
        )
    load.mass = load.mass + float(x[0])
    load.inertia = [max(_POINT * load.mass, 1e-12)] * 3


def _link_mass(site: Site, machine: Machine) -> float:
    return machine.bodies[site.name].mass


def _link_mass_extent(site: Site, machine: Machine) -> Extent:
    mass = machine.bodies[site.name].mass
    return Extent((0.03 * mass,), (-0.9 * mass,), (5 * mass,))


@effect(
    "link_mass",
    kind="body",
    components=(Component("mass", "kg"),),
    extent=_link_mass_extent,
    nominal=_link_mass,
    noun="mass",
    sentence="The mass of {site} differs from the model's by {value}.",
    evidence="inertia and weight that change together",
    separation="several postures",
)
def link_mass(spec: mujoco.MjSpec, site: Site, x: Magnitudes, machine: Machine) -> None:
    """A change of a body's mass; its inertia scales along, its centre stays."""
    scale_mass(spec, site.name, 1.0 + float(x[0]) / machine.bodies[site.name].mass)

"""Masses and inertias that differ from the model's."""

from collections.abc import Mapping, Sequence

import mujoco
import numpy as np

from bo_sysid.effects.contract import Component, Extent, Magnitudes, Site
from bo_sysid.effects.machine import Machine
from bo_sysid.effects.registry import effect
from bo_sysid.mjcf import make_explicit, scale_mass

_SMALL = 0.02  # [m] size of a body that its frame sits in
_POINT = 1e-9  # [m²] inertia of a point load, per kg
_MOST = 5.0  # times the model's inertia or mass, that may be missing beside it
_HELD_OUT = 0.5  # times the longest body, by which a load may lie beyond the end of its own
_INSIDE = 0.6  # of the way to that end, from where the place of a load is fitted
_AROUND = 0.1  # of its reach, that is looked around there


def _armature(site: Site, machine: Machine) -> float:
    return float(machine.model.joint(site.name).armature[0])


def _armature_extent(site: Site, machine: Machine) -> Extent:
    """Bound a rotor by what the actuators could move as the joint moved.

    Behind a high gear it is a hundred times the inertia of a wrist's last link.
    """
    joint = machine.joints[site.name]
    driven = sum(machine.actuators[a].force_max for a in joint.actuators) / joint.acceleration
    most = max(_MOST * joint.inertia, driven)
    return Extent((0.02 * joint.inertia,), (-_armature(site, machine) - 1e-12,), (most,))


@effect(
    "armature",
    kind="joint",
    components=(Component("inertia", "kg m²"),),
    extent=_armature_extent,
    nominal=_armature,
    noun="rotor inertia",
    sentence="{site} has rotor inertia of {value} that the model lacks.",
    form="armature",
    evidence="a force in proportion to acceleration that no posture changes",
    separation="motion of one joint at several postures of the others",
    grouped=True,
)
def armature(spec: mujoco.MjSpec, site: Site, x: Magnitudes, machine: Machine) -> None:
    """Inertia of the rotor, reflected through the gear."""
    j = spec.joint(site.name)
    j.armature = max(j.armature + x[0], 0.0)


def _carried(site: Site, machine: Machine) -> float:
    """Return the mass of the payload that the model has there already, 0 where there is none."""
    load = _body_of_payload(site, machine)
    return float(machine.model.body_mass[load]) if load >= 0 else 0.0


def payload_name(body: str) -> str:
    """Return how the body of a load on a body is called."""
    return f"{body}_payload"


def _body_of_payload(site: Site, machine: Machine) -> int:
    """Return the number of the body that bears a payload's name, -1 where there is none."""
    name = payload_name(site.name)
    return int(mujoco.mj_name2id(machine.model, mujoco.mjtObj.mjOBJ_BODY, name))


def _taken(site: Site, machine: Machine) -> bool:
    """Whether the body that bears a payload's name is another one: no point mass, or it moves."""
    model, load = machine.model, _body_of_payload(site, machine)
    if load < 0:
        return False
    parent = model.body(int(model.body_parentid[load])).name
    own = model.body_geomnum[load] or model.body_jntnum[load] or model.body_ipos[load].any()
    return bool(own) or parent != site.name


def _payload_extent(site: Site, machine: Machine) -> Extent | None:
    """Bound a load by the mass of all that moves: a wrist carries many times its last link.

    And its place by how far bodies reach: a tool may extend beyond its flange.
    """
    if _taken(site, machine):
        return None
    body = machine.bodies[site.name]
    most = max(_MOST * body.mass, sum(b.mass for b in machine.bodies.values()))
    carried = _carried(site, machine)
    reach = _reach(body.tip) + _HELD_OUT * max(_reach(b.tip) for b in machine.bodies.values())
    return Extent(
        (0.03 * body.mass, *body.tip),
        (-carried - 1e-12, *(min(-reach, d - 1e-9) for d in body.tip)),
        (most, *(max(reach, d + 1e-9) for d in body.tip)),
        place=() if carried else tuple(_INSIDE * d for d in body.tip),
        step=_AROUND * reach,
    )


def _reach(point: Sequence[float]) -> float:
    return max(float(np.linalg.norm(point)), _SMALL)


@effect(
    "payload",
    kind="body",
    components=(
        Component("mass", "kg"),
        Component("x", "m"),
        Component("y", "m"),
        Component("z", "m"),
    ),
    shapes=3,
    placed=3,
    extent=_payload_extent,
    nominal=_carried,
    noun="a payload",
    sentence="{site} carries a load of {value} that the model lacks.",
    form="child body with an inertial, at the first site, else the end or where it fits",
    evidence="inertia that changes with posture and loads gravity",
    separation="several postures",
)
def payload(spec: mujoco.MjSpec, site: Site, x: Magnitudes, machine: Machine) -> None:
    """A point mass at x[1:4] in the body's frame; left out, at its first site, else at its end.

    One that the model has there already stays where it is.
    """
    name = payload_name(site.name)
    load = spec.body(name)
    if load is None:
        place = [float(d) for d in x[1:]] or list(machine.bodies[site.name].tip)
        # fused, it would be frozen with its body where what follows makes an inertial of that
        spec.compiler.fusestatic = False
        load = spec.body(site.name).add_body(name=name, pos=place, explicitinertial=True, mass=0.0)
    load.ipos, load.iquat = [0.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0]  # undefined, it would be at pos
    load.mass = max(load.mass + float(x[0]), 0.0)
    load.inertia = [max(_POINT * load.mass, 1e-12)] * 3


def _link_mass(site: Site, machine: Machine) -> float:
    return machine.bodies[site.name].mass


def _link_mass_extent(site: Site, machine: Machine) -> Extent:
    mass = machine.bodies[site.name].mass
    return Extent((0.03 * mass,), (-0.9 * mass,), (_MOST * mass,))


@effect(
    "link_mass",
    kind="body",
    components=(Component("mass", "kg"),),
    extent=_link_mass_extent,
    nominal=_link_mass,
    noun="mass",
    sentence="The mass of {site} differs from the model's by {value}.",
    form="mass and inertia of geoms or inertial",
    evidence="inertia and weight that change together",
    separation="several postures",
)
def link_mass(spec: mujoco.MjSpec, site: Site, x: Magnitudes, machine: Machine) -> None:
    """A change of a body's mass; its inertia scales along, its centre stays."""
    scale_mass(spec, site.name, 1.0 + float(x[0]) / machine.bodies[site.name].mass)


def _shift_extent(site: Site, machine: Machine) -> Extent | None:
    if not machine.bodies[site.name].turns:
        return None
    size = max(float(np.linalg.norm(machine.bodies[site.name].tip)), _SMALL)
    return Extent((0.02 * size,) * 3, (-size,) * 3, (size,) * 3)


def _shifts(x: Magnitudes, machine: Machine, site: Site) -> Mapping[str, tuple[float, str]]:
    return {axis: (float(d), "m") for axis, d in zip("xyz", x, strict=True)}


@effect(
    "com_shift",
    kind="body",
    components=(Component("x", "m"), Component("y", "m"), Component("z", "m")),
    vector=3,
    extent=_shift_extent,
    noun="a shift of the centre of mass",
    sentence="The centre of mass of {site} lies {value} away from the model's.",
    form="inertial",
    evidence="gravity and inertia of a link that change together with posture",
    separation="several postures; a known weight",
    details=_shifts,
)
def com_shift(spec: mujoco.MjSpec, site: Site, x: Magnitudes, machine: Machine) -> None:
    """Shift the centre of mass by x in the body's frame; inertia about the centre stays."""
    body = make_explicit(spec, site.name)
    body.ipos = np.asarray(body.ipos) + x


def _inertia_extent(site: Site, machine: Machine) -> Extent | None:
    return Extent((0.05,), (-0.95,), (5.0,)) if machine.bodies[site.name].turns else None


@effect(
    "link_inertia",
    kind="body",
    components=(Component("change", "relative"),),
    extent=_inertia_extent,
    noun="rotational inertia",
    sentence="The rotational inertia of {site} differs from the model's by {value}.",
    form="inertial",
    evidence="a torque in proportion to angular acceleration that no weight goes with",
    separation="turning the link and moving it to and fro",
)
def link_inertia(spec: mujoco.MjSpec, site: Site, x: Magnitudes, machine: Machine) -> None:
    """Scale the inertia about the centre of mass by 1 + x[0]; the mass stays."""
    body = make_explicit(spec, site.name)
    body.inertia = np.asarray(body.inertia) * (1.0 + float(x[0]))

"""Gravity and the medium around the machine."""

from collections.abc import Mapping
from math import nan

import mujoco
import numpy as np

from bo_sysid.effects.contract import Component, Extent, Magnitudes, Site
from bo_sysid.effects.machine import Machine
from bo_sysid.effects.registry import effect


def _tilt_extent(site: Site, machine: Machine) -> Extent | None:
    if not np.any(machine.model.opt.gravity):
        return None
    # a planar machine feels one of the tilts only in second order: start off that saddle
    return Extent((0.01, 0.01), (-0.6, -0.6), (0.6, 0.6), starts=((0.12, nan), (nan, 0.12)))


def _tilts(x: Magnitudes, machine: Machine, site: Site) -> Mapping[str, tuple[float, str]]:
    return {"about x": (float(x[0]), "rad"), "about y": (float(x[1]), "rad")}


@effect(
    "gravity_tilt",
    kind="world",
    components=(Component("about x", "rad"), Component("about y", "rad")),
    vector=2,
    extent=_tilt_extent,
    noun="a tilt",
    sentence="The machine stands tilted by {value} against the model's vertical.",
    form="option gravity",
    evidence="a weight that pulls to the side",
    separation="several postures",
    details=_tilts,
)
def gravity_tilt(spec: mujoco.MjSpec, site: Site, x: Magnitudes, machine: Machine) -> None:
    """Turn gravity by x[0] about the world's x axis, then by x[1] about its y axis."""
    (cx, cy), (sx, sy) = np.cos(x), np.sin(x)
    about_x = np.array([[1, 0, 0], [0, cx, -sx], [0, sx, cx]])
    about_y = np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]])
    spec.option.gravity = about_y @ about_x @ np.asarray(spec.option.gravity)


def _density(site: Site, machine: Machine) -> float:
    return float(machine.model.opt.density)


def _drag_extent(site: Site, machine: Machine) -> Extent:
    option = machine.model.opt
    return Extent(
        (100.0, 0.1), (-option.density - 1e-12, -option.viscosity - 1e-12), (5000.0, 20.0)
    )


def _viscosity(x: Magnitudes, machine: Machine, site: Site) -> Mapping[str, tuple[float, str]]:
    return {"viscosity": (float(x[1]), "Pa s")}


@effect(
    "fluid_drag",
    kind="world",
    components=(Component("density", "kg/m³"), Component("viscosity", "Pa s")),
    extent=_drag_extent,
    nominal=_density,
    noun="drag of the medium",
    sentence="The machine moves in a medium denser than the model's by {value}, and more viscous "
    "by {viscosity}.",
    form="option density, viscosity",
    evidence="drag on all links that grows with their speed through space",
    separation="the same joint speed with the links stretched and folded",
    details=_viscosity,
    prior=0.5,
)
def fluid_drag(spec: mujoco.MjSpec, site: Site, x: Magnitudes, machine: Machine) -> None:
    """Add x[0] to the density and x[1] to the viscosity of the medium around all bodies."""
    spec.option.density = max(spec.option.density + float(x[0]), 0.0)
    spec.option.viscosity = max(spec.option.viscosity + float(x[1]), 0.0)


def _wind_extent(site: Site, machine: Machine) -> Extent | None:
    option = machine.model.opt
    if not (option.density or option.viscosity):
        return None  # a model without a medium feels no wind
    return Extent((0.5,) * 3, (-40.0,) * 3, (40.0,) * 3)


def _directions(x: Magnitudes, machine: Machine, site: Site) -> Mapping[str, tuple[float, str]]:
    return {axis: (float(v), "m/s") for axis, v in zip("xyz", x, strict=True)}


@effect(
    "wind",
    kind="world",
    components=(Component("x", "m/s"), Component("y", "m/s"), Component("z", "m/s")),
    vector=3,
    extent=_wind_extent,
    noun="wind",
    sentence="The medium moves at {value} against the model's.",
    form="option wind",
    evidence="a force that depends on the velocity of the links against the medium",
    separation="motion with the wind and against it",
    details=_directions,
)
def wind(spec: mujoco.MjSpec, site: Site, x: Magnitudes, machine: Machine) -> None:
    """Add x to the velocity of the medium, which the model must have."""
    spec.option.wind = np.asarray(spec.option.wind) + x


def _compensation(site: Site, machine: Machine) -> float:
    return float(machine.model.body_gravcomp[machine.model.body(site.name).id])


def _compensation_extent(site: Site, machine: Machine) -> Extent | None:
    if not np.any(machine.model.opt.gravity):
        return None
    nominal = _compensation(site, machine)
    return Extent((0.05,), (-nominal - 1e-12,), (2.0,))


@effect(
    "gravity_compensation",
    kind="body",
    components=(Component("fraction", "fraction"),),
    extent=_compensation_extent,
    nominal=_compensation,
    noun="gravity compensation",
    sentence="Of the weight of {site} and all it carries, {value} is compensated.",
    form="gravcomp",
    evidence="less weight with the same inertia",
    separation="rest at several postures, and fast motion",
)
def gravity_compensation(spec: mujoco.MjSpec, site: Site, x: Magnitudes, machine: Machine) -> None:
    """Carry x[0] of the weight of a body and of all bodies that it carries.

    One body alone is the difference of two such findings.
    """
    waiting = [spec.body(site.name)]
    while waiting:
        body = waiting.pop()
        body.gravcomp = body.gravcomp + float(x[0])
        waiting += list(body.bodies)

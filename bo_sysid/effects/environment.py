"""Gravity and the medium around the machine."""

from collections.abc import Mapping

import mujoco
import numpy as np

from bo_sysid.effects.contract import Component, Extent, Magnitudes, Site
from bo_sysid.effects.machine import Machine
from bo_sysid.effects.registry import effect


def _tilt_extent(site: Site, machine: Machine) -> Extent | None:
    if not np.any(machine.model.opt.gravity):
        return None
    # a planar machine feels one of the tilts only in second order: start off that saddle
    return Extent((0.01, 0.01), (-0.6, -0.6), (0.6, 0.6), starts=((0.12, 0.01), (0.01, 0.12)))


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

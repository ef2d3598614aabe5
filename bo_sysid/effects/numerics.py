"""How finely the model's motion is computed."""

from collections.abc import Mapping

import mujoco

from bo_sysid.effects.contract import Component, Extent, Magnitudes, Site
from bo_sysid.effects.machine import Machine
from bo_sysid.effects.registry import effect


def _timestep(site: Site, machine: Machine) -> float:
    return float(machine.model.opt.timestep)


def _extent(site: Site, machine: Machine) -> Extent:
    dt = _timestep(site, machine)
    return Extent((-0.5 * dt,), (-0.95 * dt,), (4.0 * dt,))


def _change(x: Magnitudes, machine: Machine, site: Site) -> Mapping[str, tuple[float, str]]:
    return {"change": (float(x[0]), "s")}


@effect(
    "timestep",
    kind="world",
    components=(Component("change", "s"),),
    extent=_extent,
    nominal=_timestep,
    noun="another time step",
    sentence="The recordings were made with a time step of {value}, not the model's.",
    form="option timestep",
    evidence="an error that grows with acceleration and shrinks with the time step",
    separation="the same simulation at a finer step, which every fit of a diagnosis takes along",
    family="numerics",
    absolute=lambda x, machine, site: _timestep(site, machine) + float(x[0]),
    details=_change,
)
def timestep(spec: mujoco.MjSpec, site: Site, x: Magnitudes, machine: Machine) -> None:
    """Change the simulation's time step by x[0]."""
    spec.option.timestep = spec.option.timestep + float(x[0])

"""Units of effects, as they read at a hinge and at a slide."""

from bo_sysid.effects.contract import Site
from bo_sysid.effects.machine import Machine

CHANNEL_UNIT = "channel's unit"
_SLIDE = {
    "N m": "N",
    "N m s/rad": "N s/m",
    "N m s²/rad²": "N s²/m²",
    "N m/rad": "N/m",
    "kg m²": "kg",
    "rad": "m",
    "rad/s": "m/s",
    "rad/(N m)": "m/N",
    "1/rad": "rad/m",
}


def at_slide(unit: str) -> str:
    """Return a hinge's unit as it reads at a slide: N m becomes N, rad becomes m."""
    return _SLIDE.get(unit, unit)


def unit_at(unit: str, site: Site, machine: Machine) -> str:
    """Return a unit as it reads at a site: N m becomes N where no joint is turned but pushed."""
    if unit == CHANNEL_UNIT:
        return machine.scales[site.name].unit
    if site.kind == "actuator" and site.name in machine.actuators:
        pushed = machine.actuators[site.name].pushes
    else:
        joint = machine.joint_of(site.kind, site.name)
        pushed = joint is not None and not joint.hinge
    return at_slide(unit) if pushed else unit

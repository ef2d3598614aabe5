"""The catalogue of physics that a model can lack or have wrong, a module per family."""

from bo_sysid.effects import (  # noqa: F401 - importing registers the effects
    actuation,
    commands,
    contact,
    damping,
    environment,
    friction,
    gears,
    inertia,
    learned,
    numerics,
    sensing,
    springs,
)
from bo_sysid.effects.contract import Component, Effect, Extent, Site
from bo_sysid.effects.machine import Machine
from bo_sysid.effects.parts import Filter, Force, Hidden, Motion, Part, Reading
from bo_sysid.effects.registry import (
    CATALOGUE,
    applicable,
    catalogue,
    chosen,
    effect,
    extent_at,
    listing,
    load_effects,
)
from bo_sysid.effects.surveying import survey
from bo_sysid.effects.units import at_slide, unit_at

__all__ = [
    "CATALOGUE",
    "Component",
    "Effect",
    "Extent",
    "Filter",
    "Force",
    "Hidden",
    "Machine",
    "Motion",
    "Part",
    "Reading",
    "Site",
    "applicable",
    "at_slide",
    "catalogue",
    "chosen",
    "effect",
    "extent_at",
    "listing",
    "load_effects",
    "survey",
    "unit_at",
]

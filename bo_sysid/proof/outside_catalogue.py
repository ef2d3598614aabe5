"""Tier 4: physics that the catalogue does not have, so that an open mind can be tested.

Each of these has a place (a joint) and a dependence; no name in the catalogue is right for it.
"""

from math import exp, log1p

import numpy as np

from bo_sysid.proof.draft import Draft, Place, Realised, realised
from bo_sysid.proof.joints import (
    bristle,
    bristle_details,
    joints,
    log_uniform,
    most_force,
    sign,
)
from bo_sysid.proof.machine import ProofMachine
from bo_sysid.proof.physics import Concealed, Law


def _magnet(rng: np.random.Generator, place: Place) -> Concealed:
    travel, centre = float(place.scales.travel[place.dof]), float(place.scales.centre[place.dof])
    details = {
        "at": centre + travel * rng.uniform(-1, 1),
        "width": travel * log_uniform(rng, 0.1, 0.3),
    }
    value = 0.2 * float(place.scales.force[place.dof]) * sign(rng)
    return Concealed(
        "magnet", "joint", place.site, value, place.unit("N m"), details, ("position",)
    )


def _compose_magnet(draft: Draft, c: Concealed) -> None:
    """Pull towards an angle: -A·s·exp(½ - s²/2), s = (q - at)/width, at most A."""
    dof, at, width = draft.machine.dof(c.site), c.details["at"], c.details["width"]

    def force(t: float, q: object, v: object, load: object) -> float:
        s = (q[dof] - at) / width  # type: ignore[index]
        return float(-c.value * s * exp(0.5 - 0.5 * s * s))

    draft.laws.append(Law(dof, force))


def _worn(rng: np.random.Generator, place: Place) -> Concealed:
    travel, centre = float(place.scales.travel[place.dof]), float(place.scales.centre[place.dof])
    details = bristle_details(rng, place) | {
        "at": centre + travel * rng.uniform(-1, 1),
        "width": travel * log_uniform(rng, 0.15, 0.4),
    }
    value = 0.2 * float(place.scales.force[place.dof])
    depends = ("position", "speed")
    return Concealed("worn_spot", "joint", place.site, value, place.unit("N m"), details, depends)


def _compose_worn(draft: Draft, c: Concealed) -> None:
    """Dry friction A·exp(-s²/2) near one angle."""
    dof, at, width = draft.machine.dof(c.site), c.details["at"], c.details["width"]
    bristle(draft, c, lambda t, q, v, load: c.value * exp(-0.5 * ((q[dof] - at) / width) ** 2))


def _warming(rng: np.random.Generator, place: Place) -> Concealed:
    details = bristle_details(rng, place) | {
        "time constant": rng.uniform(3.0, 10.0),
        "left": rng.uniform(0.0, 0.3),
    }
    value = 0.1 * float(place.scales.force[place.dof])
    depends = ("time", "speed")
    return Concealed(
        "warming_friction", "joint", place.site, value, place.unit("N m"), details, depends
    )


def _compose_warming(draft: Draft, c: Concealed) -> None:
    """Dry friction that fades from A to a share of it, as the joint warms up after the start."""
    constant, left = c.details["time constant"], c.details["left"]
    bristle(draft, c, lambda t, q, v, load: c.value * (left + (1.0 - left) * exp(-t / constant)))


def _cable(rng: np.random.Generator, place: Place) -> Concealed:
    machine, scales = place.machine, place.scales
    others = [machine.dof(j) for j in joints(machine) if j != place.site]
    other = int(rng.choice(others))
    details = {
        "other": float(other),
        "slack until": float(scales.centre[other] + scales.travel[other] * rng.uniform(-0.8, 0.8)),
        "sense": sign(rng),
        "softness": 0.1 * float(scales.travel[other]),
    }
    value = 0.2 * float(scales.force[place.dof] / scales.travel[other]) * sign(rng)
    unit = place.unit("N m/rad")
    return Concealed("cable", "joint", place.site, value, unit, details, ("other_joint",))


def _compose_cable(draft: Draft, c: Concealed) -> None:
    """A cable that pulls this joint once another one has moved far enough to take up its slack.

    Force A·w·log(1 + exp(s(q' - slack)/w)), with w the softness: 0, then rising in proportion.
    """
    dof, other = draft.machine.dof(c.site), int(c.details["other"])
    slack, sense, soft = c.details["slack until"], c.details["sense"], c.details["softness"]

    def force(t: float, q: object, v: object, load: object) -> float:
        x = sense * (q[other] - slack) / soft  # type: ignore[index]
        return float(c.value * soft * (x + log1p(exp(-x)) if x > 0 else log1p(exp(x))))

    draft.laws.append(Law(dof, force))


def _several(machine: ProofMachine) -> tuple[str, ...]:
    found = joints(machine)
    return found if len(found) > 1 else ()


realised(Realised("magnet", joints, _magnet, _compose_magnet, most_force, tiers=(4,), known=False))
realised(Realised("worn_spot", joints, _worn, _compose_worn, most_force, tiers=(4,), known=False))
realised(
    Realised(
        "warming_friction", joints, _warming, _compose_warming, most_force, tiers=(4,), known=False
    )
)
realised(Realised("cable", _several, _cable, _compose_cable, tiers=(4,), known=False))

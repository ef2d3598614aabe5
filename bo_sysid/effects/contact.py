"""Contact between geoms: how it grips and how it gives way."""

import mujoco
import numpy as np
from jaxtyping import Float

from bo_sysid.effects.contract import Component, Extent, Magnitudes, Site
from bo_sysid.effects.machine import Machine
from bo_sysid.effects.registry import effect
from bo_sysid.mjcf.touching import can_touch, mixed, partners, take_priority

_MOST_FRICTION = 5.0
_SLIPS = (0.5, 0.8)  # shares of the friction without which a grip may slip
_SOFTEST = 0.5  # [s]


def _friction(site: Site, machine: Machine) -> float:
    return float(machine.model.geom(site.name).friction[0])


def _rival(site: Site, machine: Machine) -> int | None:
    """Return the number of the geom of most friction among equals that this one can touch.

    -1 where there are none of equal priority; None where this geom does not decide on the friction
    of each of its contacts: MuJoCo takes the coefficient of the higher priority, among equals the
    larger one, and that of a pair which the model lists. None, too, where it cannot come to decide
    without changing more than friction, since its contacts differ in the rest.
    """
    model = machine.model
    geom = model.geom(site.name).id
    others = np.flatnonzero(partners(model)[geom])
    if not others.size or (model.geom_priority[others] > model.geom_priority[geom]).any():
        return None
    if geom in model.pair_geom1 or geom in model.pair_geom2:
        return None
    equal = others[model.geom_priority[others] == model.geom_priority[geom]]
    if not equal.size:
        return -1
    ruled = [geom] if equal.size < others.size else []  # contacts that are as this geom alone says
    rest = mixed(model, geom, np.append(equal, ruled).astype(int))
    if not np.allclose(rest, rest[0], rtol=1e-9, atol=0.0):
        return None
    rival = int(equal[np.argmax(model.geom_friction[equal, 0])])
    return rival if model.geom_friction[rival, 0] <= model.geom_friction[geom, 0] else None


def _friction_extent(site: Site, machine: Machine) -> Extent | None:
    if _rival(site, machine) is None:
        return None
    nominal = _friction(site, machine)
    # a contact that grips tells nothing of less friction until it is so little that it slips
    slips = tuple((-share * nominal,) for share in _SLIPS) if nominal else ()
    return Extent(
        (-0.1 * nominal if nominal else 0.1,),
        (-nominal - 1e-12,),
        (_MOST_FRICTION,),
        secants=slips,
        starts=slips,
    )


@effect(
    "contact_friction",
    kind="geom",
    components=(Component("change", "coefficient"),),
    extent=_friction_extent,
    nominal=_friction,
    noun="friction of contact",
    sentence="The coefficient of friction of {site} differs from the model's by {value}.",
    form="friction",
    evidence="slip at another ratio of tangential to normal force",
    separation="sliding under several normal forces",
)
def contact_friction(spec: mujoco.MjSpec, site: Site, x: Magnitudes, machine: Machine) -> None:
    """Change the sliding friction of every contact of a geom.

    Where its partners would now have the larger coefficient, the geom takes priority over them.
    """
    geom, rival = spec.geom(site.name), _rival(site, machine)
    geom.friction[0] = max(geom.friction[0] + float(x[0]), 0.0)
    if rival is None or rival < 0:
        return
    if geom.friction[0] < machine.model.geom_friction[rival, 0]:
        take_priority(spec, machine.model, site.name, rival)


def _timed(model: mujoco.MjModel) -> Float[np.ndarray, "k 2"]:
    """Return time constant and damping ratio of what touches: geoms, and pairs of the model's list.

    Without those whose stiffness and damping are given directly.
    """
    refs = model.geom_solref[partners(model).any(axis=0)]
    if can_touch(model):
        refs = np.concatenate([refs, model.pair_solref])
    return np.asarray(refs[refs[:, 0] > 0])


def _softness(site: Site, machine: Machine) -> float:
    """Return the smallest time constant of what touches, 0 where there is none."""
    return float(min(_timed(machine.model)[:, 0], default=0.0))


def _softness_extent(site: Site, machine: Machine) -> Extent | None:
    nominal = _softness(site, machine)
    if nominal <= 0:  # no contact, or stiffness and damping given directly
        return None
    safe = 2.0 * machine.model.opt.timestep  # MuJoCo makes no contact harder than that
    return Extent((0.25 * nominal,), (min(safe - nominal, 0.0) - 1e-12,), (_SOFTEST,))


@effect(
    "contact_softness",
    kind="world",
    components=(Component("change", "s"),),
    extent=_softness_extent,
    nominal=_softness,
    noun="softness of contact",
    sentence="Contacts give way with a time constant that differs from the model's by {value}.",
    form="solref",
    evidence="deeper and longer contacts",
    separation="falls from several heights",
)
def contact_softness(spec: mujoco.MjSpec, site: Site, x: Magnitudes, machine: Machine) -> None:
    """Change the time constant of all contacts."""
    for element in (*spec.geoms, *spec.pairs):
        if element.solref[0] > 0:
            element.solref[0] = max(element.solref[0] + float(x[0]), 1e-4)


_DAMPED = (0.02, 4.0)  # damping ratios of contacts that rebound almost fully, and hardly


def _damping_ratio(site: Site, machine: Machine) -> float:
    """Return the smallest damping ratio of what touches, 0 where there is none."""
    return float(min(_timed(machine.model)[:, 1], default=0.0))


def _rebound_extent(site: Site, machine: Machine) -> Extent | None:
    nominal = _damping_ratio(site, machine)
    if nominal <= 0:  # no contact, or stiffness and damping given directly
        return None
    least, most = (min(_DAMPED[0], nominal), max(_DAMPED[1], nominal))
    return Extent((-0.1 * nominal,), (least - nominal - 1e-12,), (most - nominal + 1e-12,))


def rebound(damping: float) -> float:
    """Return the coefficient of restitution of a damped elastic contact that does not pull.

    e = exp(-ζ/w · atan2(2ζw, 2ζ² - 1)) with w = √(1 - ζ²), its limit e⁻² at ζ = 1 and its
    continuation beyond [1]; MuJoCo's contacts follow it to 2 % where a step resolves them.

    [1] T. Schwager, T. Pöschel. Coefficient of restitution and linear-dashpot model revisited.
        Granular Matter 9, 2007, equation (19).
    """
    if abs(damping - 1.0) < 1e-6:
        return float(np.exp(-2.0))
    w = np.sqrt(abs(1.0 - damping**2))
    if damping < 1.0:
        return float(np.exp(-damping / w * np.arctan2(2 * damping * w, 2 * damping**2 - 1)))
    return float(((damping + w) / (damping - w)) ** (-damping / w))


def _restitution(x: Magnitudes, machine: Machine, site: Site) -> dict[str, tuple[float, str]]:
    nominal = _damping_ratio(site, machine)
    return {
        "restitution": (rebound(nominal + float(x[0])), "–"),
        "restitution in the model": (rebound(nominal), "–"),
    }


@effect(
    "contact_restitution",
    kind="world",
    components=(Component("change", "damping ratio"),),
    extent=_rebound_extent,
    nominal=_damping_ratio,
    noun="rebound of contact",
    sentence="Contacts are damped with a ratio that differs from the model's by {value}.",
    form="solref",
    evidence="another speed after an impact than the model's share of the speed before",
    separation="falls from several heights without spin",
    details=_restitution,
)
def contact_restitution(spec: mujoco.MjSpec, site: Site, x: Magnitudes, machine: Machine) -> None:
    """Change the damping ratio of all contacts, and with it how far they rebound."""
    for element in (*spec.geoms, *spec.pairs):
        if element.solref[0] > 0:
            element.solref[1] = max(element.solref[1] + float(x[0]), 1e-3)

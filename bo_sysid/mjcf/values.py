"""Read a number from a compiled model, and write one into a spec."""

from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
from jaxtyping import Float

from bo_sysid.errors import ModelError
from bo_sysid.mjcf.attributes import Attribute
from bo_sysid.mjcf.compiling import compile_spec
from bo_sysid.mjcf.inertia import inertial, make_explicit, mass_key, scale_mass
from bo_sysid.mjcf.strip import stripped


@dataclass(frozen=True)
class Target:
    """One number of one model.

    Attributes:
        address: its concrete address.
        kind: kind of element.
        element: name of the element; empty for "option".
        name: MJCF name of the attribute.
        attribute: where spec and model keep it.
        index: component, 0 for a single number.
        nominal: the model's own value.
        made_of: what in the unedited spec the value follows from, where other edits change it;
            one for each form of the spec, with and without `settotalmass`.
    """

    address: str
    kind: str
    element: str
    name: str
    attribute: Attribute
    index: int
    nominal: float
    made_of: tuple[tuple[object, ...], ...]

    @property
    def moves_mass(self) -> bool:
        """Whether masses or inertias depend on it."""
        return (self.kind, self.name) in _MASS

    @property
    def stage(self) -> int:
        """Shapes and densities come first, then a body's mass, then its inertia."""
        if self.kind != "body":
            return 0
        return {"mass": 1, "inertia": 2, "ipos": 2}.get(self.name, 0)


_MASS = {
    *(("geom", name) for name in ("mass", "density", "size", "pos")),
    *(("body", name) for name in ("mass", "inertia", "ipos")),
}


def compiled_vector(
    model: mujoco.MjModel, kind: str, element: str, attribute: Attribute
) -> Float[np.ndarray, " k"]:
    """Return all components of an attribute as compiled; every address kind but geom masses."""
    if kind == "option":
        return np.atleast_1d(np.array(getattr(model.opt, attribute.compiled[0]), dtype=float))
    owner = "eq" if kind == "equality" else kind
    row = getattr(model, owner)(element).id
    parts = [
        np.atleast_1d(getattr(model, name)[_row(model, name, row)]) for name in attribute.compiled
    ]
    return np.concatenate(parts).astype(float)


def compiled_value(model: mujoco.MjModel, target: Target) -> float:
    """Return a number as compiled; for a geom's mass or density the mass of its body."""
    if target.kind == "geom" and target.name in ("mass", "density"):
        return float(model.body_mass[model.geom(target.element).bodyid[0]])
    if target.name in ("kp", "kv"):
        actuator = model.actuator(target.element)
        return float(actuator.gainprm[0] if target.name == "kp" else -actuator.biasprm[2])
    return float(
        compiled_vector(model, target.kind, target.element, target.attribute)[target.index]
    )


def _row(model: mujoco.MjModel, compiled: str, element: int) -> int:
    """Return the row of an element in a compiled field."""
    if compiled.startswith("dof_"):
        return int(model.jnt_dofadr[element])
    if compiled.startswith("qpos"):
        return int(model.jnt_qposadr[element])
    if compiled == "actuator_gear":
        return int(model.actuator_outadr[element])
    if compiled == "actuator_ctrlrange":
        return int(model.actuator_ctrladr[element])
    return element


def geom_mass(spec: mujoco.MjSpec, name: str) -> float:
    """Return the mass, kg, that a geom gives to its body (compiles a copy with it alone)."""
    alone = stripped(spec)
    geom = alone.geom(name)
    if geom.mass == 0 or (geom.density == 0 and np.isnan(geom.mass)):
        return 0.0
    body = geom.parent
    for other in alone.bodies[1:]:  # which may weigh nothing but for the bounds
        other.explicitinertial, other.mass, other.inertia = True, 1.0, np.ones(3)
        other.fullinertia[0] = np.nan
    body.explicitinertial = False
    for other in body.geoms:
        if other.name != name:
            other.mass = 0.0
    alone.compiler.boundmass = 0.0
    alone.compiler.boundinertia = 0.0
    return float(compile_spec(alone, f"geom {name!r}").body(body.name).mass[0])


def made_of(spec: mujoco.MjSpec, kind: str, element: str, name: str) -> tuple[object, ...]:
    """Return what in the spec a mass or an inertia follows from; nothing for other numbers."""
    if kind == "body" and name in ("mass", "inertia", "ipos"):
        return mass_key(spec, element)
    if (kind, name) == ("geom", "mass"):
        return mass_key(spec, spec.geom(element).parent.name)
    return ()


def write_value(spec: mujoco.MjSpec, nominal: mujoco.MjModel, target: Target, value: float) -> None:
    """Write one number into a spec, in place.

    A number that has the value already is left alone, so that an edit without a change leaves
    the compiled model the same to the last bit.

    Args:
        spec: the spec to change.
        nominal: the unedited spec as compiled: what MuJoCo derives itself (the length of a
            `fromto`, a spring's rest length) is taken from it before one component is changed.
        target: the number.
        value: in the compiled model's units.

    Raises:
        ModelError: it is the mass of a body that has none, so that nothing says how it is spread.
    """
    kind, name, attribute = target.kind, target.name, target.attribute
    untouched = made_of(spec, kind, target.element, name) in target.made_of
    if untouched and value == target.nominal:
        return
    if (kind, name) == ("body", "mass"):
        source = nominal.body(target.element) if untouched else inertial(spec, target.element)
        mass = float(np.squeeze(source.mass))
        if not mass:
            raise ModelError(f"'{target.address}': it has no mass; give it one in the model")
        scale_mass(spec, target.element, value / mass)
        return
    if kind == "option":
        element = spec.option
    elif kind == "body" and name in ("inertia", "ipos"):
        element = make_explicit(spec, target.element)
    else:
        element = getattr(spec, kind)(target.element)
        _settle(element, nominal, target)
    if name in ("kp", "kv"):
        _write_servo(element, name, value)
    elif attribute.size == 0:
        setattr(element, attribute.spec, _authored(element, attribute, value))
    else:
        getattr(element, attribute.spec)[target.index] = _authored(element, attribute, value)


def _authored(target: Any, attribute: Attribute, value: float) -> float:
    """Return the value in the unit in which the spec keeps it."""
    if attribute.angle and target.compiler.degree and target.type == mujoco.mjtJoint.mjJNT_HINGE:
        return float(np.degrees(value))
    return value


def _write_servo(actuator: mujoco.MjsActuator, name: str, value: float) -> None:
    """Change gain and bias together: a position servo keeps its resting point."""
    position = actuator.biasprm[1] == -actuator.gainprm[0]
    if name == "kp":
        actuator.gainprm[0], actuator.biasprm[1] = value, -value
        return
    if not position:
        actuator.gainprm[0] = value
    actuator.biasprm[2] = -value


def _settle(element: Any, nominal: mujoco.MjModel, target: Target) -> None:
    """Replace what MuJoCo would derive, and so overrule the new value, by what it derived."""
    kind, name, attribute = target.kind, target.name, target.attribute
    if kind in ("geom", "site") and name in ("pos", "size"):
        if not np.isnan(element.fromto[0]) and (name == "pos" or target.index > 0):
            compiled = getattr(nominal, kind)(target.element)
            first = element.size[0]
            element.size, element.pos, element.quat = compiled.size, compiled.pos, compiled.quat
            element.size[0] = first
            element.fromto[0] = np.nan
    elif kind == "actuator" and name in ("ctrlrange", "actrange") and element.inheritrange > 0:
        setattr(element, name, compiled_vector(nominal, kind, target.element, attribute))
        element.inheritrange = 0
    elif attribute.size > 0 and attribute.compiled:
        field = getattr(element, attribute.spec)
        if np.any(np.isnan(field)):
            vector = compiled_vector(nominal, kind, target.element, attribute)
            setattr(element, attribute.spec, vector)

"""Read a number from a compiled model, and write one into a spec."""

from typing import Any

import mujoco
import numpy as np
from jaxtyping import Float

from bo_sysid.mjcf.attributes import Attribute
from bo_sysid.mjcf.compiling import compile_spec
from bo_sysid.mjcf.inertia import inertial, make_explicit, mass_key, scale_mass
from bo_sysid.mjcf.strip import stripped


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
    body.explicitinertial = False
    for other in body.geoms:
        if other.name != name:
            other.mass = 0.0
    alone.compiler.boundmass = 0.0
    alone.compiler.boundinertia = 0.0
    return float(compile_spec(alone, f"geom {name!r}").body(body.name).mass[0])


def write_value(
    spec: mujoco.MjSpec,
    nominal: mujoco.MjModel,
    kind: str,
    element: str,
    name: str,
    attribute: Attribute,
    index: int,
    value: float,
) -> None:
    """Write one number into a spec, in place.

    Args:
        spec: the spec to change.
        nominal: the unedited model as compiled: what MuJoCo derives itself (the length of a
            `fromto`, a spring's rest length) is taken from it before one component is changed.
        kind: kind of element, or "option".
        element: its name.
        name: MJCF name of the attribute.
        attribute: where it is kept.
        index: component; 0 for a single number.
        value: in the compiled model's units.
    """
    if kind == "option":
        target = spec.option
    elif kind == "body" and name in ("inertia", "ipos"):
        target = make_explicit(spec, element)
    else:
        target = getattr(spec, kind)(element)
        _settle(target, nominal, kind, element, name, attribute, index)
    if name in ("kp", "kv"):
        _write_servo(target, name, value)
    elif attribute.size == 0:
        setattr(target, attribute.spec, _authored(target, attribute, value))
    else:
        getattr(target, attribute.spec)[index] = _authored(target, attribute, value)


def write_body_mass(
    spec: mujoco.MjSpec, body: str, value: float, nominal: float, key: tuple[object, ...]
) -> None:
    """Give a body a mass, inertia in proportion.

    Args:
        spec: the spec to change.
        body: name of the body.
        value: the mass wanted, kg.
        nominal: its mass in the unedited spec, kg.
        key: `mass_key` of the unedited spec: whether an earlier edit changed the mass.
    """
    present = nominal if mass_key(spec, body) == key else inertial(spec, body).mass
    scale_mass(spec, body, value / present)


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


def _settle(
    target: Any,
    nominal: mujoco.MjModel,
    kind: str,
    element: str,
    name: str,
    attribute: Attribute,
    index: int,
) -> None:
    """Replace what MuJoCo would derive, and so overrule the new value, by what it derived."""
    if kind in ("geom", "site") and not np.isnan(target.fromto[0]):
        if name == "pos" or (name == "size" and index > 0):
            compiled = getattr(nominal, kind)(element)
            first = target.size[0]
            target.size, target.pos, target.quat = compiled.size, compiled.pos, compiled.quat
            target.size[0] = first
            target.fromto[0] = np.nan
    elif kind == "joint" and name in ("damping", "stiffness") and np.any(target.springdamper > 0):
        joint = nominal.joint(element)
        target.damping[0], target.stiffness[0] = joint.damping[0], joint.stiffness[0]
        target.springdamper = np.zeros(2)
    elif kind == "actuator" and name in ("ctrlrange", "actrange") and target.inheritrange > 0:
        setattr(target, name, compiled_vector(nominal, kind, element, attribute))
        target.inheritrange = 0
    elif attribute.size > 0 and attribute.compiled:
        field = getattr(target, attribute.spec)
        unset = np.isnan(field) | ((field == -1) if name == "springlength" else False)
        if np.any(unset):
            setattr(target, attribute.spec, compiled_vector(nominal, kind, element, attribute))

"""The numbers of an MJCF model that an address can name: where a spec and a model keep them.

Names are MJCF's (`solreflimit`), not the spec's (`solref_limit`). Values are in the compiled
model's units: angles in radians whatever the file's `compiler angle` says.
"""

from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np

from bo_sysid.mjcf.inertia import has_inertial


@dataclass(frozen=True)
class Attribute:
    """One numeric attribute of a kind of element.

    Attributes:
        spec: name of the field in the spec.
        compiled: names of the fields of the compiled model, their columns side by side; empty
            where the compiled model does not keep the value and the spec is read instead.
        size: number of components; 0 for a single number, which takes no index.
        angle: whether a spec in degrees keeps it in degrees (of hinges).
        polynomial: whether it is a polynomial whose linear term an address without index means.
    """

    spec: str
    compiled: tuple[str, ...] = ()
    size: int = 0
    angle: bool = False
    polynomial: bool = False


def _solver(prefix: str, mjcf: str, spec: str, compiled: str) -> dict[str, Attribute]:
    """Return the solref and solimp attributes of one constraint."""
    return {
        f"solref{mjcf}": Attribute(f"solref{spec}", (f"{prefix}_solref{compiled}",), 2),
        f"solimp{mjcf}": Attribute(f"solimp{spec}", (f"{prefix}_solimp{compiled}",), 5),
    }


def _polynomial(prefix: str, name: str) -> dict[str, Attribute]:
    fields = (f"{prefix}_{name}", f"{prefix}_{name}poly")
    return {name: Attribute(name, fields, 3, polynomial=True)}


def _plain(prefix: str, **sizes: int) -> dict[str, Attribute]:
    """Return attributes whose name is the same in MJCF, spec and compiled model."""
    return {name: Attribute(name, (f"{prefix}_{name}",), size) for name, size in sizes.items()}


_RANGES = ("range", "ctrlrange", "forcerange", "actrange", "actuatorfrcrange")

ATTRIBUTES: dict[str, dict[str, Attribute]] = {
    "joint": {
        **_polynomial("dof", "damping"),
        **_polynomial("jnt", "stiffness"),
        **_plain("dof", armature=0, frictionloss=0),
        **_plain("jnt", pos=3, margin=0),
        "actuatorfrcrange": Attribute("actfrcrange", ("jnt_actfrcrange",), 2),
        "range": Attribute("range", ("jnt_range",), 2, angle=True),
        "ref": Attribute("ref", ("qpos0",), angle=True),
        "springref": Attribute("springref", ("qpos_spring",), angle=True),
        **_solver("jnt", "limit", "_limit", ""),
        **_solver("dof", "friction", "_friction", ""),
    },
    "geom": {
        "mass": Attribute("mass"),
        "density": Attribute("density"),
        **_plain("geom", size=3, friction=3, pos=3, margin=0, gap=0, solmix=0),
        **_solver("geom", "", "", ""),
    },
    "body": _plain("body", mass=0, inertia=3, ipos=3, pos=3, gravcomp=0),
    "site": _plain("site", pos=3, size=3),
    "actuator": {
        "kp": Attribute("gainprm"),
        "kv": Attribute("gainprm"),
        **_plain("actuator", gear=6, gainprm=10, biasprm=10, dynprm=10),
        **_plain("actuator", ctrlrange=2, forcerange=2, actrange=2),
        **_plain("actuator", armature=0, delay=0),
        **_polynomial("actuator", "damping"),
    },
    "tendon": {
        **_polynomial("tendon", "damping"),
        **_polynomial("tendon", "stiffness"),
        **_plain("tendon", frictionloss=0, armature=0, margin=0, range=2),
        "actuatorfrcrange": Attribute("actfrcrange", ("tendon_actfrcrange",), 2),
        "springlength": Attribute("springlength", ("tendon_lengthspring",), 2),
        **_solver("tendon", "limit", "_limit", "_lim"),
        **_solver("tendon", "friction", "_friction", "_fri"),
    },
    "equality": {
        "polycoef": Attribute("data", ("eq_data",), 5),
        **_solver("eq", "", "", ""),
    },
    "pair": {
        **_plain("pair", friction=5, margin=0, gap=0, solreffriction=2),
        **_solver("pair", "", "", ""),
    },
    "option": {
        name: Attribute(name, (name,), size)
        for name, size in {
            "timestep": 0,
            "gravity": 3,
            "wind": 3,
            "magnetic": 3,
            "density": 0,
            "viscosity": 0,
            "impratio": 0,
            "o_margin": 0,
            "o_solref": 2,
            "o_solimp": 5,
            "o_friction": 5,
        }.items()
    },
}

NOT_NEGATIVE = {
    ("joint", "frictionloss"): "a friction loss",
    ("joint", "armature"): "an armature",
    ("tendon", "frictionloss"): "a friction loss",
    ("tendon", "armature"): "an armature",
    ("actuator", "armature"): "an armature",
    ("actuator", "delay"): "a delay",
    ("geom", "friction"): "a coefficient of friction",
    ("pair", "friction"): "a coefficient of friction",
    ("option", "o_friction"): "a coefficient of friction",
    ("option", "density"): "the density of a medium",
    ("option", "viscosity"): "a viscosity",
    ("option", "impratio"): "a ratio of impedances",
}
"""What MuJoCo compiles below 0 though it means nothing there, in words.

Damping and stiffness may be negative: a drive that feeds a joint, a spring past its dead centre.
"""

_GEOM_SIZES = {
    mujoco.mjtGeom.mjGEOM_SPHERE: 1,
    mujoco.mjtGeom.mjGEOM_CAPSULE: 2,
    mujoco.mjtGeom.mjGEOM_CYLINDER: 2,
    mujoco.mjtGeom.mjGEOM_ELLIPSOID: 3,
    mujoco.mjtGeom.mjGEOM_BOX: 3,
}


def size_of(kind: str, name: str, element: Any) -> int:
    """Return how many components the attribute has on this element; 0 for a single number."""
    if name == "size":
        return _GEOM_SIZES.get(element.type, 0)
    return ATTRIBUTES[kind][name].size


def refusal(kind: str, name: str, element: Any) -> str:
    """Return why the attribute means nothing on this element, or the empty string."""
    checks = {"joint": _joint, "geom": _geom, "body": _body, "actuator": _actuator}
    reason = checks[kind](name, element) if kind in checks else ""
    if not reason and name in _RANGES:
        low, high = getattr(element, ATTRIBUTES[kind][name].spec)
        inherited = name == "ctrlrange" and element.inheritrange > 0
        if low == high and not inherited:  # one end alone would switch it on, with the other at 0
            reason = f"the model has no {name}; write both ends into it first"
    if not reason and name == "pos" and element.frame is not None:
        reason = "it sits in a <frame>, which would move it again"
    if not reason and kind == "equality" and name == "polycoef":
        polynomials = (mujoco.mjtEq.mjEQ_JOINT, mujoco.mjtEq.mjEQ_TENDON)
        reason = "" if element.type in polynomials else "only joint and tendon equalities have it"
    return reason


def _joint(name: str, joint: Any) -> str:
    scalar = joint.type in (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE)
    if name in ("ref", "springref", "range", "actuatorfrcrange") and not scalar:
        return "only hinge and slide joints have it"
    if name == "pos" and joint.type == mujoco.mjtJoint.mjJNT_FREE:
        return "a free joint sits at its body's origin"
    return ""


def _geom(name: str, geom: Any) -> str:
    if name == "size" and geom.type not in _GEOM_SIZES:
        return "a plane, mesh or height field has no size that matters to the physics"
    if name == "pos" and geom.type == mujoco.mjtGeom.mjGEOM_MESH:
        return "MuJoCo moves a mesh to its centre of mass; address its body's pos"
    if name not in ("mass", "density"):
        return ""
    body, (low, high) = geom.parent, geom.compiler.inertiagrouprange
    if body.name == "world":
        return "it is fixed to the world, so its mass plays no role"
    if has_inertial(body):
        return (
            f"body {body.name!r} has an <inertial>, so its geoms' masses play no role; "
            f"address body[{body.name}].mass"
        )
    if not low <= geom.group <= high:
        return f"its group {geom.group} is outside the compiler's inertiagrouprange {low} {high}"
    if name == "density" and not np.isnan(geom.mass):
        return "it has an explicit mass, which wins; address its mass"
    return ""


def _body(name: str, body: Any) -> str:
    if body.name == "world":
        return "the world does not move"
    if name in ("mass", "inertia", "ipos") and not has_inertial(body) and not body.geoms:
        return "it has neither geoms nor an <inertial>, so there is no mass to change"
    return ""


def _actuator(name: str, actuator: Any) -> str:
    affine = actuator.biastype == mujoco.mjtBias.mjBIAS_AFFINE
    position = affine and actuator.biasprm[1] == -actuator.gainprm[0] != 0
    velocity = affine and actuator.biasprm[2] == -actuator.gainprm[0] != 0
    if name == "kp" and not position:
        return "it is not a position servo; address gainprm[0] and biasprm[1]"
    if name == "kv" and not (position or velocity):
        return "it is not a position or velocity servo; address gainprm[0] and biasprm[2]"
    return ""

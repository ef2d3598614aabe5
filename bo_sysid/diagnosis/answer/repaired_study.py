"""The study on which `identify` and `learn` go on with a repaired model."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from bo_sysid.diagnosis.answer.findings import Finding
from bo_sysid.diagnosis.answer.repaired import BESIDE, MODEL, Written
from bo_sysid.effects.commands import written_lag
from bo_sysid.effects.friction import PRESLIDING
from bo_sysid.errors import ModelError
from bo_sysid.intervals import Quantity
from bo_sysid.mjcf import Address, Model
from bo_sysid.mjcf.address import resolve
from bo_sysid.recording.value import stated_for
from bo_sysid.study import Study
from bo_sysid.study.inputs import load_model
from bo_sysid.yaml_text import dumped

_ADDRESSES = {
    "dry_friction": {"": "joint[{site}].frictionloss"},
    "viscous_damping": {"": "joint[{site}].damping"},
    "quadratic_damping": {"": "joint[{site}].damping[1]"},
    "joint_spring": {"": "joint[{site}].stiffness", "rest angle": "joint[{site}].springref"},
    "armature": {"": "joint[{site}].armature"},
    "link_mass": {"": "body[{site}].mass"},
    "payload": {"": "body[{site}_payload].mass"},
    "contact_friction": {"": "geom[{site}].friction[0]"},
    "actuator_lag": {"": "actuator[{site}].dynprm[0]"},
    "servo_kp": {"": "actuator[{site}].kp"},
    "servo_kd": {"": "actuator[{site}].kv"},
    "fluid_drag": {"": "option.density", "viscosity": "option.viscosity"},
    "wind": {axis: f"option.wind[{k}]" for k, axis in enumerate("xyz")},
    "gravity_compensation": {"": "body[{site}].gravcomp"},
}
"""Where the repaired model has an effect at `{site}`, and the details of it by name."""
_SIGNED = ("rest angle", *"xyz")  # details that may be negative
_BESIDE_MORE = ("fluid_drag", "wind")  # whose details are added to what the model has
_ZERO = 1e-9  # what is left of friction that the machine lacks
_SAME = 1e-3  # relative difference of what was found from what the repaired model has
_NO_ADDRESS = {
    "timestep": "recordings are cut for the time step of the repaired model",
    "actuator_saturation": "two numbers of the repaired model are it, the limits either way",
    "actuator_delay": "the repaired model keeps no more of the past than this delay needs",
    "contact_softness": "all contacts of the repaired model share it",
}
"""Why effects are no parameter of the repaired study that numbers of the model may be."""
_LAW = "the law that was found holds the whole friction of the joint"
_NO_NUMBER = "no one number of the repaired model has its value"
_BRISTLES = tuple(f"actuator[{{site}}_friction].biasprm[{k}]" for k in (3, 4))  # at speed, at rest


def study_text(
    study: Study,
    found: Sequence[Finding],
    folder: Path,
    written: Written,
    noise: Mapping[str, float] = MappingProxyType({}),
) -> str:
    """Return the study that goes on with the repaired model: findings become parameters.

    What was written beside the model is named, after what stood beside the model before, and the
    joints that were added, which nothing measures. Where the study has a parameter at a finding's
    address, its bounds are widened to hold the repaired value; where it ties several numbers, the
    finding's leaves it. One that was the friction of a joint goes, where bristles have a part in
    that, and one that the repaired model has no more; comments say why. Where the study states no
    noise of a position it is the one of the diagnosis, so that positions weigh by it: beside them
    speeds that a log differentiated would weigh as much by their spread.

    Args:
        study: what was diagnosed.
        found: the findings.
        folder: of the repaired model, which the study will lie beside.
        written: what was written of the repaired model.
        noise: σ by channel that the diagnosis saw, in the channels' units.
    """
    data: dict[str, Any] = {"version": 1} | study.resolved(relative_to=folder, defaults=False)
    data["name"] = f"{study.name}, repaired"
    stated = study.recordings.noise
    seen = {n: float(f"{s:.3g}") for n, s in noise.items() if stated_for(n, stated, None) is None}
    if seen:
        data["recordings"]["noise"] = {**stated, **seen}
    beside = list(data["model"].get("beside", ()))
    if written.beside:
        beside.append(BESIDE)
    data["model"] = {"file": MODEL, **({"beside": beside} if beside else {})}
    if written.unrecorded or study.model.unrecorded:
        data["model"]["unrecorded"] = {**study.model.unrecorded, **written.unrecorded}
    model = Model.from_file(folder / MODEL)
    absent = _readdressed(model, load_model(study), data)
    bristles = [f"joint[{f.site}].frictionloss" for f in found if _bristles(f)]
    absent += _release(model, data, bristles)
    for f in found:
        for made in (parameters := _parameters(model, f)):
            if not _taken(model, data.get("parameters", ()), made):
                data.setdefault("parameters", []).append(made)
        absent += [] if parameters else [_absent(f)]
    return "".join(absent) + dumped(data)


def _bristles(finding: Finding) -> bool:
    """Whether a finding is friction of which `frictionloss` is not all, or none, in the file."""
    presliding = finding.effect == "dry_friction" and any(finding.x[PRESLIDING:])
    return presliding or finding.effect == "stribeck_friction"


def _readdressed(model: Model, nominal: Model, data: dict[str, Any]) -> list[str]:
    """Let a study's parameters name what the repaired model has; return comments on what it lacks.

    A body whose inertia was repaired has an `<inertial>`, and masses of its geoms play no role.
    """
    absent = []
    for p in data.get("parameters", ()):
        named = []
        for address in _list(p["address"]):
            try:
                named.append(_standing(model, nominal, address))
            except ModelError as error:
                absent.append(f"# no parameter: {' '.join(str(error).split())}\n")
        p["address"] = named[0] if len(named) == 1 else named
    _keep(data, [p for p in data.get("parameters", ()) if p["address"]])
    return absent


def _standing(model: Model, nominal: Model, address: str) -> str:
    """Return an address of the nominal model as the repaired one has it.

    Raises:
        ModelError: it has not.
    """
    try:
        resolve(model, address)
    except ModelError:
        instead = _of_body(nominal, address)
        if instead is None:
            raise
        resolve(model, instead)
        return instead
    return address


def _of_body(nominal: Model, address: str) -> str | None:
    """Return the mass of the body in the place of its only geom's, None where it is not that."""
    target, *others = resolve(nominal, address)
    parsed = Address.parse(target.address)
    if others or (parsed.kind, parsed.attribute) != ("geom", "mass"):
        return None
    compiled = nominal.compile()
    body = compiled.body(int(compiled.geom(target.element).bodyid[0]))
    alone = np.isclose(target.nominal, body.mass[0], rtol=1e-9)
    return f"body[{body.name}].mass" if alone else None


def _release(model: Model, data: dict[str, Any], addresses: Sequence[str]) -> list[str]:
    """Take addresses out of a study's parameters, and parameters that are of no others.

    Comments on the numbers that are parameters no more are returned.
    """
    kept, absent, out = [], [], set(_named(model, addresses))
    for p in data.get("parameters", ()):
        named = _named(model, _list(p["address"]))
        others = [a for a in named if a not in out]
        gone = [" ".join(a.split()) for a in named if a in out]
        absent += [f"# no parameter: {a}, since {_LAW}\n" for a in gone]
        if others and len(others) < len(named):
            p["address"] = others[0] if len(others) == 1 else others
        kept += [p] if others else []
    _keep(data, kept)
    return absent


def _keep(data: dict[str, Any], parameters: list[Any]) -> None:
    """Leave a study these parameters; the key goes where there are none."""
    data["parameters"] = parameters
    if not parameters:
        del data["parameters"]


def _absent(finding: Finding) -> str:
    """Return the comment on a finding that is no parameter; a name in it is one line."""
    site, why = " ".join(finding.site.split()), _NO_ADDRESS.get(finding.effect, _NO_NUMBER)
    return f"# no parameter: {finding.effect} at {site}, since {why}\n"


def _parameters(model: Model, finding: Finding) -> list[dict[str, Any]]:
    """Return what a finding is in the repaired model; nothing where it is no number of it."""
    if finding.effect == "dry_friction" and _bristles(finding):
        own = _named(model, [a.format(site=finding.site) for a in _BRISTLES])
        return [_parameter(model, finding, "", own)]
    places = _ADDRESSES.get(finding.effect, {})
    written = {d: a for d, a in places.items() if not d or d in finding.details}
    named = {detail: a.format(site=finding.site) for detail, a in written.items()}
    placed = {d: [a, *_carried(model, finding)] for d, a in named.items()}
    held = {
        d: own
        for d, own in placed.items()
        if all(_holds(model, a, _found(model, finding, d)[0]) for a in own)
    }
    return [_parameter(model, finding, d, _named(model, own)) for d, own in held.items()]


def _carried(model: Model, finding: Finding) -> list[str]:
    """Return the further numbers that are one with a finding's: those of what a body carries."""
    if finding.effect != "gravity_compensation":
        return []
    compiled = model.compile()
    parent, carrier = compiled.body_parentid, compiled.body(finding.site).id
    found = [carrier]
    for b in range(carrier + 1, compiled.nbody):  # a body comes after its parent
        if parent[b] in found:
            found.append(b)
    return [f"body[{compiled.body(b).name}].gravcomp" for b in found[1:]]


def _found(model: Model, finding: Finding, detail: str) -> tuple[float, Quantity]:
    """Return the value in the repaired model of a finding, or of a detail of it."""
    if detail:
        found = finding.details[detail]
        if finding.effect in _BESIDE_MORE:
            address = _ADDRESSES[finding.effect][detail].format(site=finding.site)
            return Address.parse(address).read(model), found
        return found.value, found
    if finding.effect == "actuator_lag":
        return written_lag(finding.after, model.compile().opt.timestep), finding.quantity
    return finding.after, finding.quantity


def _holds(model: Model, address: str, value: float) -> bool:
    """Whether a model has a value there, and not, such as a second lag, beside it."""
    try:
        return bool(np.isclose(Address.parse(address).read(model), value, rtol=_SAME, atol=_ZERO))
    except ModelError:
        return False


def _named(model: Model, addresses: Sequence[str]) -> list[str]:
    """Return the addresses of every number that addresses name, wildcards resolved."""
    return [t.address for a in addresses for t in resolve(model, a)]


def _parameter(model: Model, finding: Finding, detail: str, own: Sequence[str]) -> dict[str, Any]:
    """Return a parameter about a finding's magnitude, or about a detail of it."""
    value, q = _found(model, finding, detail)
    low, high = q.interval
    width = 3 * max(high - low, 0.02 * abs(value), 1e-9)
    name = f"{finding.effect.replace('_', ' ')} of {finding.site}"
    return {
        "name": f"{name}, {detail}" if detail else name,
        "address": own[0] if len(own) == 1 else list(own),
        "low": float(value - width if detail in _SIGNED else max(value - width, 0.0)),
        "high": float(value + width),
        "unit": q.unit,
    }


def _taken(model: Model, parameters: Sequence[dict[str, Any]], made: dict[str, Any]) -> bool:
    """Whether parameters of the study vary a finding's numbers; they are made to hold its value."""
    taken, own = False, set(_list(made["address"]))
    for p in parameters:
        named = _named(model, _list(p["address"]))
        if not set(named) & own:
            continue
        others = [a for a in named if a not in own]
        if p.get("apply", "set") != "set":  # it changes the repaired model's own value
            taken = True
        elif others and not p.get("each"):
            p["address"] = others[0] if len(others) == 1 else others
        else:
            p["low"], p["high"] = min(p["low"], made["low"]), max(p["high"], made["high"])
            taken = True
    return taken


def _list(value: Any) -> list[Any]:
    return list(value) if isinstance(value, list | tuple) else [value]

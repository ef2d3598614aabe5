"""The study on which `identify` and `learn` go on with a repaired model."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import yaml

from bo_sysid.diagnosis.findings import Finding
from bo_sysid.diagnosis.repaired import BESIDE, MODEL, Written
from bo_sysid.effects.friction import BEND
from bo_sysid.mjcf import Model
from bo_sysid.mjcf.address import resolve
from bo_sysid.study import Study

_ADDRESS = {
    "dry_friction": "joint[{site}].frictionloss",
    "viscous_damping": "joint[{site}].damping",
    "quadratic_damping": "joint[{site}].damping[1]",
    "armature": "joint[{site}].armature",
    "link_mass": "body[{site}].mass",
    "payload": "body[{site}_payload].mass",
    "contact_friction": "geom[{site}].friction[0]",
}
_BRISTLES = tuple(f"actuator[{{site}}_friction].biasprm[{k}]" for k in (3, 4))  # at speed, at rest


def study_text(
    study: Study,
    found: Sequence[Finding],
    folder: Path,
    written: Written,
) -> str:
    """Return the study that goes on with the repaired model: findings become parameters.

    What was written beside the model is named, after what stood beside the model before, and the
    joints that were added, which nothing measures. Where the study has a parameter at a finding's
    address, its bounds are widened to hold the repaired value; where it ties several numbers, the
    finding's leaves it.
    """
    data: dict[str, Any] = study.resolved(relative_to=folder)
    data["name"] = f"{study.name}, repaired"
    beside = list(data["model"].get("beside", ()))
    if written.beside:
        beside.append(BESIDE)
    data["model"] = {"file": MODEL, **({"beside": beside} if beside else {})}
    if written.unrecorded or study.model.unrecorded:
        data["model"]["unrecorded"] = {**study.model.unrecorded, **written.unrecorded}
    model = Model.from_file(folder / MODEL)
    for f in found:
        own = _named(model, [a.format(site=f.site) for a in _addresses(f)])
        if own and not _taken(model, data.get("parameters", ()), f, own):
            data.setdefault("parameters", []).append(_parameter(f, own))
    return yaml.safe_dump(data, sort_keys=False, allow_unicode=True)


def _addresses(finding: Finding) -> tuple[str, ...]:
    """Return where the repaired model has a finding, by `{site}`; () where at no address."""
    if finding.effect == "dry_friction" and any(finding.x[BEND:]):
        return _BRISTLES
    return (_ADDRESS[finding.effect],) if finding.effect in _ADDRESS else ()


def _named(model: Model, addresses: Sequence[str]) -> list[str]:
    """Return the addresses of every number that addresses name, wildcards resolved."""
    return [t.address for a in addresses for t in resolve(model, a)]


def _bounds(finding: Finding) -> tuple[float, float]:
    low, high = finding.quantity.interval
    width = max(high - low, 0.02 * abs(finding.after), 1e-9)
    return float(max(finding.after - 3 * width, 0.0)), float(finding.after + 3 * width)


def _parameter(finding: Finding, own: Sequence[str]) -> dict[str, Any]:
    low, high = _bounds(finding)
    return {
        "name": f"{finding.effect.replace('_', ' ')} of {finding.site}",
        "address": own[0] if len(own) == 1 else list(own),
        "low": low,
        "high": high,
        "unit": finding.quantity.unit,
    }


def _taken(
    model: Model, parameters: Sequence[dict[str, Any]], finding: Finding, own: Sequence[str]
) -> bool:
    """Whether parameters of the study vary a finding's numbers; they are made to hold its value."""
    low, high = _bounds(finding)
    taken = False
    for p in parameters:
        named = _named(model, _list(p["address"]))
        if not set(named) & set(own):
            continue
        others = [a for a in named if a not in own]
        if p.get("apply", "set") != "set":  # it changes the repaired model's own value
            taken = True
        elif others and not p.get("each"):
            p["address"] = others[0] if len(others) == 1 else others
        else:
            p["low"], p["high"] = min(p["low"], low), max(p["high"], high)
            taken = True
    return taken


def _list(value: Any) -> list[Any]:
    return list(value) if isinstance(value, list | tuple) else [value]

"""The repaired model, and the study on which `identify` and `learn` go on with it."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import mujoco
import yaml

from bo_sysid.diagnosis.findings import Finding
from bo_sysid.diagnosis.hypothesis import Hypothesis, edits_and_parts
from bo_sysid.diagnosis.problem import finer_step
from bo_sysid.effects import Filter, Force, Machine, Part, Reading
from bo_sysid.mjcf import Model
from bo_sysid.study import Study

MODEL, STUDY = "model_repaired.xml", "study_repaired.yaml"

_ADDRESS = {
    "dry_friction": "joint[{site}].frictionloss",
    "viscous_damping": "joint[{site}].damping",
    "quadratic_damping": "joint[{site}].damping[1]",
    "armature": "joint[{site}].armature",
    "link_mass": "body[{site}].mass",
    "payload": "body[{site}_payload].mass",
    "contact_friction": "geom[{site}].friction[0]",
}


def write_model(
    model: Model, machine: Machine, hypothesis: Hypothesis, path: Path
) -> tuple[Part, ...]:
    """Write the model with the findings in it; return what MJCF cannot express.

    Where the recordings show the finer step of a continuous machine, the time step is divided.
    """
    edits, parts = edits_and_parts(hypothesis, machine, written=True)
    division = finer_step(hypothesis.numerics)
    if division > 1:
        edits.append(lambda spec: _finer(spec, division))
    model.export(path, edits)
    mujoco.MjModel.from_xml_path(str(path))
    return tuple(parts)


def _finer(spec: mujoco.MjSpec, division: int) -> None:
    spec.option.timestep = spec.option.timestep / division


def study_text(study: Study, found: Sequence[Finding], folder: Path) -> str:
    """Return the study that goes on with the repaired model: findings become parameters."""
    data: dict[str, Any] = study.resolved(relative_to=folder)
    data["name"] = f"{study.name}, repaired"
    data["model"] = {"file": MODEL}
    known = {a for p in data.get("parameters", ()) for a in _list(p["address"])}
    for f in found:
        address = _ADDRESS.get(f.effect, "").format(site=f.site)
        if not address or address in known:
            continue
        low, high = f.quantity.interval
        width = max(high - low, 0.02 * abs(f.after), 1e-9)
        least = max(f.after - 3 * width, 0.0)
        data.setdefault("parameters", []).append(
            {
                "name": f"{f.effect.replace('_', ' ')} of {f.site}",
                "address": address,
                "low": float(least),
                "high": float(f.after + 3 * width),
                "unit": f.quantity.unit,
            }
        )
    return yaml.safe_dump(data, sort_keys=False, allow_unicode=True)


def _list(value: Any) -> list[Any]:
    return list(value) if isinstance(value, list | tuple) else [value]


def beside(parts: Sequence[Part]) -> tuple[str, ...]:
    """Return in words what the repaired model lacks because MJCF cannot say it."""
    words = []
    for p in parts:
        if isinstance(p, Force):
            words.append(f"a force on joint {p.joint}")
        elif isinstance(p, Filter):
            words.append(f"a change of the control of {p.actuator}")
        elif isinstance(p, Reading):
            words.append(f"a change of what {p.channel} reads")
    return tuple(dict.fromkeys(words))

"""The repaired model, and the study on which `identify` and `learn` go on with it."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import yaml

from bo_sysid.diagnosis.findings import Finding
from bo_sysid.diagnosis.hypothesis import Candidate, Hypothesis, edits_and_parts
from bo_sysid.diagnosis.timestep import finer_step
from bo_sysid.effects import Filter, Force, Hidden, Machine, Part, Reading
from bo_sysid.effects.beside import Beside, LearnedLaw, Placed
from bo_sysid.effects.friction import BEND
from bo_sysid.mjcf import Model
from bo_sysid.runs import atomic
from bo_sysid.study import Study

MODEL, STUDY = "model_repaired.xml", "study_repaired.yaml"
BESIDE, MODULE = "model_repaired.json", "model_repaired.py"

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


@dataclass(frozen=True)
class Written:
    """What a model file that was written does not say by itself.

    Attributes:
        beside: in words, what stands beside it.
        unrecorded: joints that were added, each with the joint whose encoder shows it as well.
    """

    beside: tuple[str, ...]
    unrecorded: Mapping[str, str | None]


def write_model(
    model: Model, machine: Machine, hypothesis: Hypothesis, folder: Path, *, timestep: float
) -> Written:
    """Write the model with the findings in it, and beside it what MJCF cannot express.

    Args:
        model: the nominal model.
        machine: the scales of its sites.
        hypothesis: what it lacks.
        folder: to write to.
        timestep: at which the hypothesis was fitted, in [s]; divided where the recordings show the
            finer step of a continuous machine.
    """
    edits, parts = edits_and_parts(hypothesis, machine, written=True)
    share = timestep / finer_step(hypothesis.numerics) / machine.model.opt.timestep
    if share != 1:
        edits.append(lambda spec: _scale_step(spec, share))
    model.export(folder / MODEL, edits)
    mujoco.MjModel.from_xml_path(str(folder / MODEL))
    beside = _beside(model, machine, hypothesis)
    own = {c.effect.id: c.effect for c in hypothesis.members}
    words = _words(beside.parts(model, own))
    if words:
        beside.write(folder / BESIDE)
        text = _MODULE.format(words="\n".join(f"- {w}" for w in words), model=MODEL, beside=BESIDE)
        with atomic(folder / MODULE) as unfinished:
            unfinished.write_text(text, encoding="utf-8")
    else:  # those of an earlier diagnosis in the same folder say what is no longer so
        for name in (BESIDE, MODULE):
            (folder / name).unlink(missing_ok=True)
    added = {p.joint: p.of if p.shown else None for p in parts if isinstance(p, Hidden)}
    return Written(words, added)


_MODULE = '''"""What {model} lacks because MJCF cannot say it:

{words}

    from model_repaired import load

    simulation = load()
    simulation.data.ctrl[:] = ...
    simulation.step()          # in the place of mujoco.mj_step(model, data)
"""

from pathlib import Path

from bo_sysid.simulation.stepper import Stepper


def load() -> Stepper:
    folder = Path(__file__).parent
    return Stepper(folder / "{model}", folder / "{beside}")
'''


def _beside(model: Model, machine: Machine, hypothesis: Hypothesis) -> Beside:
    """Return the members of a hypothesis of which something remains beside a model file."""
    effects, laws = [], []
    for c, x in zip(hypothesis.members, hypothesis.x, strict=True):
        if c.effect.id == "unknown":
            laws += _learned(model, machine, c, x)
            continue
        remaining = c.effect.write(model.spec(), c.site, c.full(x), machine)
        if any(isinstance(p, Force | Filter | Reading) for p in remaining):
            effects.append(Placed(c.effect.id, c.site, tuple(map(float, c.full(x)))))
    return Beside(machine, tuple(effects), tuple(laws))


def _learned(model: Model, machine: Machine, c: Candidate, x: np.ndarray) -> list[LearnedLaw]:
    names = (k.name for k in c.effect.components)
    weights = {n: float(w) for n, w in zip(names, x, strict=True) if w}
    forces = c.effect.parts(model.spec(), c.site, c.full(x), machine)
    return [LearnedLaw(f.joint, weights, f.hold) for f in forces if isinstance(f, Force)]


def _scale_step(spec: mujoco.MjSpec, share: float) -> None:
    spec.option.timestep = spec.option.timestep * share


def study_text(
    study: Study,
    found: Sequence[Finding],
    folder: Path,
    written: Written,
) -> str:
    """Return the study that goes on with the repaired model: findings become parameters.

    What was written beside the model is named, after what stood beside the model before, and the
    joints that were added, which nothing measures.
    """
    data: dict[str, Any] = study.resolved(relative_to=folder)
    data["name"] = f"{study.name}, repaired"
    beside = list(data["model"].get("beside", ()))
    if written.beside:
        beside.append(BESIDE)
    data["model"] = {"file": MODEL, **({"beside": beside} if beside else {})}
    if written.unrecorded or study.model.unrecorded:
        data["model"]["unrecorded"] = {**study.model.unrecorded, **written.unrecorded}
    known = {a for p in data.get("parameters", ()) for a in _list(p["address"])}
    for f in found:
        address = [a.format(site=f.site) for a in _addresses(f)]
        if not address or not known.isdisjoint(address):
            continue
        low, high = f.quantity.interval
        width = max(high - low, 0.02 * abs(f.after), 1e-9)
        least = max(f.after - 3 * width, 0.0)
        data.setdefault("parameters", []).append(
            {
                "name": f"{f.effect.replace('_', ' ')} of {f.site}",
                "address": address[0] if len(address) == 1 else address,
                "low": float(least),
                "high": float(f.after + 3 * width),
                "unit": f.quantity.unit,
            }
        )
    return yaml.safe_dump(data, sort_keys=False, allow_unicode=True)


def _addresses(finding: Finding) -> tuple[str, ...]:
    """Return where the repaired model has a finding, by `{site}`; () where at no address."""
    if finding.effect == "dry_friction" and any(finding.x[BEND:]):
        return _BRISTLES
    return (_ADDRESS[finding.effect],) if finding.effect in _ADDRESS else ()


def _list(value: Any) -> list[Any]:
    return list(value) if isinstance(value, list | tuple) else [value]


def _words(parts: Sequence[Part]) -> tuple[str, ...]:
    """Return in words what stands beside the repaired model."""
    words = []
    for p in parts:
        if isinstance(p, Force):
            words.append(f"a force on joint {p.joint}")
        elif isinstance(p, Filter):
            words.append(f"a change of the control of {p.actuator}")
        elif isinstance(p, Reading):
            words.append(f"a change of what {p.channel} reads")
    return tuple(dict.fromkeys(words))

"""The oracle: the forecast error of the nominal model with exactly what was concealed put into it.

It uses the catalogue's own edits and the same forecast as the diagnosis, so that it says what is
left when every name, site and magnitude is right: sensor noise carried through, what no name
describes (other integrators, the damping of bristles), and starts estimated from the past. Its time
step is the plant's, or fine enough for a plant that is integrated from its equations of motion.
"""

from collections.abc import Mapping
from math import cos, sin
from pathlib import Path
from typing import Any

import numpy as np

from bo_sysid.diagnosis.gather import gather
from bo_sysid.diagnosis.windows.candidate import Candidate
from bo_sysid.diagnosis.windows.evidence import Evidence
from bo_sysid.diagnosis.windows.forecast import AHEAD, PAST, forecast, forecast_problem
from bo_sysid.diagnosis.windows.hypothesis import Hypothesis
from bo_sysid.effects import CATALOGUE, Machine, Site
from bo_sysid.mjcf import nominal
from bo_sysid.study import Study
from bo_sysid.study.inputs import load_holdout, load_train

_CONTINUOUS = 32  # steps in one of the model's


def oracle_error(case: Path, truth: Mapping[str, Any]) -> float | None:
    """Return the held-out forecast error of the truth in sensor sigma.

    Args:
        case: folder of the case.
        truth: its answer.

    Returns:
        None where the catalogue does not have what was concealed.
    """
    study = Study.load(case / "study.yaml")
    evidence = gather(study, load_train(study))
    hypothesis = true_hypothesis(study, evidence, truth)
    if hypothesis is None:
        return None
    problem, past = forecast_problem(
        evidence.model,
        evidence.machine,
        load_holdout(study),
        evidence.sigma,
        past=PAST,
        ahead=AHEAD,
        timestep=evidence.machine.model.opt.timestep / truth["plant"].get("divide", _CONTINUOUS),
        engine=evidence.engine,
    )
    return float(forecast(problem, past, hypothesis).ahead)


def true_hypothesis(
    study: Study, evidence: Evidence, truth: Mapping[str, Any]
) -> Hypothesis | None:
    """Return the truth as the diagnosis would write it.

    None where the catalogue does not have what was concealed.
    """
    members, values = [], []
    for e in truth["effects"]:
        candidate = _candidate(e, evidence.machine)
        if candidate is None:
            return None
        members.append(candidate)
        values.append(candidate.point[: candidate.size])
    off = tuple(
        np.array([truth["parameters"][p.name] - nominal(evidence.model, p)])
        for p in study.parameter_set(evidence.model)
    )
    return Hypothesis(tuple(members), tuple(values), evidence.nuisances, off)


def _candidate(e: Mapping[str, Any], machine: Machine) -> Candidate | None:
    """Return an effect of the truth as a candidate of the catalogue at its true magnitudes."""
    effect = CATALOGUE.get(e["effect"])
    if effect is None or effect.hidden:
        return None
    site = Site(effect.kind, e["site"])
    extent = effect.extent(site, machine)
    if extent is None:
        return None
    return Candidate(effect, site, extent, np.array(true_magnitudes(e, machine), float))


def true_magnitudes(e: Mapping[str, Any], machine: Machine) -> tuple[float, ...]:
    """Return the magnitudes of an effect of the truth as the catalogue's function takes them."""
    value, details = float(e["value"]), e["details"]
    match e["effect"]:
        case "dry_friction":
            return value, 1.0, details["presliding"]  # it holds a load at rest
        case "stribeck_friction":
            return value, details["coulomb"], details["speed"], details["presliding"]
        case "load_dependent_friction":
            return value, details["presliding"]
        case "encoder_scale":
            return value, 0.0, 0.0  # a servo's rate is not the encoder's
        case "joint_spring":
            return value, value * details["rest angle"]
        case "cogging":
            phase = details["phase"]
            return value * cos(phase), value * sin(phase), details["periods"]
        case "gravity_tilt":
            return details["about x"], details["about y"]
        case "payload":
            return value, *machine.bodies[e["site"]].tip
        case "actuator_saturation":
            return (machine.actuators[e["site"]].force_max - value,)
    return (value,)

"""What was done to study and recordings, and what was not looked for, in words."""

import numpy as np

from bo_sysid.checks.channels import clipped
from bo_sysid.checks.sensitivity import bounds_flags, listed
from bo_sysid.diagnosis.answer.holdout import Holdout
from bo_sysid.diagnosis.search.locate import Located
from bo_sysid.diagnosis.windows.evidence import Evidence
from bo_sysid.effects import chosen
from bo_sysid.effects.balance import balance_notes
from bo_sysid.mjcf import nominal
from bo_sysid.study import Study
from bo_sysid.study.inputs import held_notes, study_effects

_MUCH = 0.05  # of the time


def of_study(study: Study, evidence: Evidence) -> tuple[str, ...]:
    """Return what is not as a study asks."""
    return (
        *effects_without_site(study, evidence),
        *parameters_out_of_bounds(study, evidence),
        *clipped_commands(evidence),
        *not_compared(evidence),
    )


def clipped_commands(evidence: Evidence) -> tuple[str, ...]:
    """Return which commands the model clips for much of the time, as of wrong units."""
    flags = clipped(evidence.machine.model, evidence.recordings)
    return tuple(f.sentence for f in flags if f.evidence["share"] > _MUCH)


def not_compared(evidence: Evidence) -> tuple[str, ...]:
    """Return at which joints less is looked for, and which sensors are not compared."""
    notes = []
    model, recordings = evidence.machine.model, evidence.recordings
    notes += [
        f"{n}." for n in dict.fromkeys(n for r in recordings for n in balance_notes(model, r))
    ]
    channels = dict.fromkeys(n for r in recordings for n in r.channels)
    sensors = [n for n in channels if n.startswith("sensor.")]
    if sensors:
        notes.append(f"Positions of joints are compared, not {listed(sensors)}.")
    return tuple(notes)


def unsought_sentence(evidence: Evidence) -> str:
    """Return at which joints nothing is looked for, in words; empty where there are none."""
    silent = [j for j in evidence.model.unrecorded if j not in evidence.machine.joints]
    if not silent:
        return ""
    return (
        f"Nothing is looked for at {listed(silent)}, whose position was not recorded: what acts "
        "there may be named elsewhere, unless the study's parameters have it."
    )


def effects_without_site(study: Study, evidence: Evidence) -> tuple[str, ...]:
    """Return which effects a study asks for by name that none of the candidates is."""
    asked = study.diagnosis.effects
    if asked == "all":
        return ()
    found = {c.effect.id for c in evidence.candidates}
    wanted = chosen(study_effects(study), asked, study.diagnosis.exclude)
    missing = [e.id for e in wanted if e.id not in found and e.family in ("physics", "sensing")]
    sites = "nowhere in this model as it was recorded"
    if study.diagnosis.known:
        sites += ", or would change what is known"
    notes = [f"Not looked for: {', '.join(missing)} can act {sites}."] if missing else []
    if any(e.family == "numerics" for e in wanted):
        notes.append(
            "The time step is no finding: every fit takes a finer one along, and a note "
            "says where it shows."
        )
    return tuple(notes)


def parameters_out_of_bounds(study: Study, evidence: Evidence) -> tuple[str, ...]:
    """Return the parameters whose bounds leave out the model's own value, and what is done then."""
    parameters = study.parameter_set(evidence.given)
    own = np.array([nominal(evidence.given, p) for p in parameters])
    sentences = (flag.sentence for flag in bounds_flags(parameters, own))
    return tuple(f"{sentence} Values between are fitted as well." for sentence in sentences)


def of_unseen(study: Study, holdout: Holdout) -> tuple[str, ...]:
    """Return which recordings were set aside, and what they are too short for."""
    short = (f"The hold-out {name} is too short for a forecast." for name in holdout.short)
    return (*held_notes(study), *short)


def of_training(located: Located) -> tuple[str, ...]:
    """Return what was left out of the training recordings, and what was done to read them."""
    notes = (note for recording in located.evidence.recordings for note in recording.notes)
    return (*located.prepared.problem.windows.left_out, *notes)

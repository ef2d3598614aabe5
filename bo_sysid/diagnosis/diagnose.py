"""The diagnosis: where a simulation differs from recordings, which physics it lacks, the repair."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd

from bo_sysid.checks.motion import range_flags
from bo_sysid.diagnosis.answer.answer import Answer
from bo_sysid.diagnosis.answer.experiment import EXPERIMENT
from bo_sysid.diagnosis.answer.holdout import Holdout
from bo_sysid.diagnosis.answer.judge import judge
from bo_sysid.diagnosis.answer.notes import of_study, of_training, of_unseen
from bo_sysid.diagnosis.answer.repaired import MODEL, STUDY, write_model
from bo_sysid.diagnosis.answer.repaired_study import study_text
from bo_sysid.diagnosis.answer.tables import bent_pose, sets
from bo_sysid.diagnosis.frozen import Frozen, from_training
from bo_sysid.diagnosis.gather import gather
from bo_sysid.diagnosis.stages import Stages
from bo_sysid.diagnosis.told import told
from bo_sysid.diagnosis.unexplained.missing_force import missing_force
from bo_sysid.diagnosis.windows.kept_fits import NO_CACHE, FitCache
from bo_sysid.execution import OnProgress, limit_threads, silent
from bo_sysid.runs import Run
from bo_sysid.study import Study
from bo_sysid.study.inputs import load_holdout, load_train, made_from, require_holdout

_PROVED = (
    "diagnosis.json", "holdout.parquet", "sessions.parquet", "traces.parquet", "forces.parquet",
    "sets.parquet", "pose.json", "summary.json",
)  # fmt: skip
"""What is written of a diagnosis once it was proved on the hold-out."""

_CHECK = "`bo-sysid check` says more; a wrong sign or unit is no missing physics."


@dataclass(frozen=True)
class Diagnosis:
    """What a diagnosis found.

    Attributes:
        name: of the study.
        frozen: what the training recordings say, fixed before the hold-out was read.
        holdout: errors on the recordings that were set aside.
        sentences: the answer in words.
        notes: what was done to the data, and what the repaired model cannot say.
    """

    name: str
    frozen: Frozen
    holdout: Holdout
    sentences: tuple[str, ...]
    notes: tuple[str, ...]

    @property
    def answer(self) -> Answer:
        """Findings and verdict, from the training recordings alone."""
        return self.frozen.answer

    @property
    def verdict(self) -> str:
        """The verdict in one word."""
        return self.answer.verdict

    @property
    def findings(self) -> pd.DataFrame:
        """The findings, one row each."""
        return self.answer.table

    @property
    def sessions(self) -> pd.DataFrame:
        """The magnitudes recording by recording, where there are several."""
        return self.frozen.outcome.sessions.table

    @property
    def errors(self) -> pd.DataFrame:
        """Held-out errors, one row for each measure, horizon and model."""
        return self.holdout.table

    @property
    def parameters(self) -> pd.DataFrame:
        """The study's parameters beside the findings: see `Frozen.parameters`."""
        return self.frozen.parameters

    def as_json(self) -> dict[str, Any]:
        """Return the content of `diagnosis.json`."""
        ordered: dict[str, Any] = {}
        for key, value in self.answer.as_json().items():
            ordered[key] = value
            if key == "located":
                ordered["holdout"] = self.holdout.as_json()
        return {**ordered, "sha256": self.frozen.sha256}


@limit_threads(1)  # BLAS threads that spin while they wait slow the simulation down
def diagnose(
    study: Study, run: Run | None = None, *, progress: OnProgress = silent, strict: bool = False
) -> Diagnosis:
    """Find out which physics the model of a study lacks, and prove it on recordings set aside.

    Args:
        study: names the model and the recordings.
        run: folder for `diagnosis.json`, the repaired model and the repaired study.
        progress: told after every stage.
        strict: refuse messy recordings.

    Raises:
        UserError: the study, its model or its recordings are wrong.
    """
    require_holdout(study)
    kept = _kept(study, run, strict)
    evidence = gather(study, load_train(study, strict=strict), kept)
    stages = Stages(progress, contact=bool(evidence.machine.impacts))
    outside = [f.sentence for f in range_flags(evidence.machine.model, evidence.recordings)]
    if outside:
        stages.warn(" ".join([*outside, _CHECK]))
    frozen = from_training(study, evidence, stages)
    unsaid = _repair(study, run, frozen)
    stages.doing("forecasts of the unseen recordings")
    evidence = frozen.evidence
    unseen = evidence.without_skipped_start(load_holdout(study, strict=strict))
    holdout = judge(evidence, frozen.outcome, unseen)
    notes = [
        *of_study(study, evidence), *unsaid, *of_unseen(study, holdout),
        *evidence.notes, *outside, *of_training(frozen.located),
    ]  # fmt: skip
    late = {n: c.shift for n, c in study.recordings.clocks.items() if n.startswith("ctrl")}
    result = Diagnosis(
        study.name, frozen, holdout, told(frozen, holdout, late), tuple(dict.fromkeys(notes))
    )
    if run is not None:
        _write(run, result)
        kept.clear()
    stages.finished(result.verdict)
    return result


def _kept(study: Study, run: Run | None, strict: bool) -> FitCache:
    """Return the long fits that a killed diagnosis of the same files left in a run."""
    return NO_CACHE if run is None else FitCache.of(run, made_from(study, strict=strict))


def _repair(study: Study, run: Run | None, frozen: Frozen) -> tuple[str, ...]:
    """Write the repaired model and the answer; return notes on what the model cannot say."""
    if run is None:
        return ()
    for name in _PROVED:  # that of an earlier diagnosis in the same folder is of another model
        run.path(name).unlink(missing_ok=True)
    evidence, outcome, answer = frozen.evidence, frozen.outcome, frozen.answer
    folder = Path(run.path(MODEL)).parent
    written = write_model(
        evidence.given, evidence.machine, outcome.repaired, folder,
        timestep=outcome.timestep, laws=evidence.laws,
    )  # fmt: skip
    text = study_text(study, answer.findings, run.folder, written, evidence.sigma)
    run.write_text(STUDY, text)
    controls = answer.next_experiment.controls if answer.next_experiment else None
    if controls is not None:
        run.write_text(EXPERIMENT, controls.to_csv(index=False))
    else:  # that of an earlier diagnosis in the same folder is none of this one's
        run.path(EXPERIMENT).unlink(missing_ok=True)
    run.write_json("answer.json", {**answer.as_json(), "sha256": frozen.sha256})
    return written.notes


def _write(run: Run, result: Diagnosis) -> None:
    """Write the answer, the tables, what the pictures show, and the words."""
    run.write_json("diagnosis.json", result.as_json())
    run.write_frame("holdout.parquet", result.errors)
    run.write_frame("sessions.parquet", result.sessions)
    run.write_frame("traces.parquet", result.holdout.traces)
    evidence, outcome = result.frozen.evidence, result.frozen.outcome
    forces = missing_force(evidence, outcome.repaired, outcome.timestep)
    run.write_frame("forces.parquet", forces)
    found = sets(result.frozen.located.decision, result.answer, result.frozen.searched)
    run.write_frame("sets.parquet", found)
    run.write_json("pose.json", bent_pose(evidence.recordings))
    summary = {
        "name": result.name,
        "sentences": result.sentences,
        "notes": result.notes,
        "parameters": result.parameters["name"].tolist(),
    }
    run.write_json("summary.json", summary)

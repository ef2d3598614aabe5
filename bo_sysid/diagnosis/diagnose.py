"""The diagnosis: where a simulation differs from recordings, which physics it lacks, the repair."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import pandas as pd

from bo_sysid.checks.motion import range_flags
from bo_sysid.diagnosis.answer.answer import Answer, make_answer
from bo_sysid.diagnosis.answer.argmin import ArgminSets, argmin_sets
from bo_sysid.diagnosis.answer.experiment import EXPERIMENT, next_experiment
from bo_sysid.diagnosis.answer.explain import Outcome, explain
from bo_sysid.diagnosis.answer.hints import doubtful, hints, leaves_much, left_sentence
from bo_sysid.diagnosis.answer.holdout import Holdout
from bo_sysid.diagnosis.answer.judge import judge
from bo_sysid.diagnosis.answer.notes import (
    of_study,
    of_training,
    of_unseen,
    unsought_sentence,
)
from bo_sysid.diagnosis.answer.repaired import MODEL, STUDY, write_model
from bo_sysid.diagnosis.answer.repaired_study import study_text
from bo_sysid.diagnosis.answer.seen_once import seen_once
from bo_sysid.diagnosis.answer.sentences import (
    disputed_sentence,
    doubts,
    found_sentences,
    noise_sentence,
    parameters_sentence,
    rivals,
    shift_sentence,
    stood_in_sentence,
)
from bo_sysid.diagnosis.answer.tables import bent_pose, sets
from bo_sysid.diagnosis.answer.uncrossed import uncrossed_plays, uncrossed_sentence
from bo_sysid.diagnosis.search.locate import Located, locate
from bo_sysid.diagnosis.unexplained.missing_force import missing_force
from bo_sysid.diagnosis.windows.evidence import Evidence, make_evidence
from bo_sysid.diagnosis.windows.hypothesis import Hypothesis, edits_and_parts
from bo_sysid.diagnosis.windows.kept_fits import NO_CACHE, FitCache
from bo_sysid.diagnosis.windows.windowing import in_contact
from bo_sysid.effects import Machine, chosen, survey
from bo_sysid.execution import OnProgress, Progress, limit_threads, silent, threads
from bo_sysid.recording import Recording
from bo_sysid.runs import Run
from bo_sysid.simulation.of_study import study_laws
from bo_sysid.study import Study
from bo_sysid.study.inputs import (
    load_holdout,
    load_model,
    load_train,
    made_from,
    require_holdout,
    study_effects,
)
from bo_sysid.study.requirements import (
    require_known,
    require_limits,
    require_recorded,
    require_scales,
)

_STAGES = 4  # short windows, long ones, the final fits, what is said; or more
# of the work that is done by the ends of the first ones
_SHARES, _SHARES_IN_CONTACT = (0.03, 0.4, 0.5), (0.02, 0.1, 0.15)
_CHECK = "`bo-sysid check` says more; a wrong sign or unit is no missing physics."
_UNMOVED = 1e-6  # of a parameter's range: what its bounds leave beside the model's own value


@dataclass(frozen=True)
class Diagnosis:
    """What a diagnosis found.

    Attributes:
        name: of the study.
        answer: findings and verdict, from the training recordings alone.
        holdout: errors on the recordings that were set aside.
        sha256: hash of the answer, taken before the hold-out was read.
        located: the decision behind the answer.
        outcome: the repaired hypothesis, with a learned law where names do not suffice.
        evidence: what it was made from.
        searched: the same choice between sets as a search of the arg-min.
        notes: what was done to the data, and what the repaired model cannot say.
        contact: whether the machine touches something in the recordings, or meets its stops.
        shifts: seconds by which the study takes commands later than stamped, by channel or kind.
    """

    name: str
    answer: Answer
    holdout: Holdout
    sha256: str
    located: Located
    outcome: Outcome
    evidence: Evidence
    searched: ArgminSets
    notes: tuple[str, ...]
    contact: bool = False
    shifts: Mapping[str, float] = field(default_factory=dict)

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
        return self.outcome.sessions.table

    @property
    def errors(self) -> pd.DataFrame:
        """Held-out errors, one row for each measure, horizon and model."""
        return self.holdout.table

    @property
    def parameters(self) -> pd.DataFrame:
        """The study's parameters beside the findings: name, unit, model, fitted, at_bound."""
        h, machine = self.outcome.fit.hypothesis, self.evidence.machine
        columns = ["name", "unit", "model", "fitted", "at_bound"]
        rows = []
        for c, x, bound in zip(h.nuisances, h.nuisance_x, h.bound, strict=True):
            model = c.effect.nominal(c.site, machine)
            moved = 0.0 if abs(x[0]) < _UNMOVED * (c.high - c.low)[0] else float(x[0])
            rows.append((c.site.name, c.effect.unit, model, model + moved, bound))
        return pd.DataFrame(rows, columns=columns)

    @property
    def sentences(self) -> tuple[str, ...]:
        """The answer in words."""
        fitted = parameters_sentence(self.parameters)
        sentences = found_sentences(self.answer.findings) + list(self.answer.unexplained.sentences)
        disputed = disputed_sentence(self.outcome.disputed)
        if disputed:
            sentences.append(disputed)
        if not sentences:
            once = ", once its parameters are fitted" if fitted else ""
            sentences = [
                f"Nothing that these recordings could show is missing from the model{once}."
            ]
        whole = self.outcome.fit.key == self.located.decision.best.key  # no name was withdrawn
        if whole:
            sentences += rivals(self.located.decision, self.evidence.machine)
        instead = stood_in_sentence(self.evidence.nuisances, self.outcome.fit)
        assumed = (shift_sentence(self.shifts), unsought_sentence(self.evidence))
        sentences += [words for words in (fitted, instead, *assumed) if words]
        if whole:
            sentences += doubts(self.located.decision, self.searched)
        if self.contact and self.answer.findings:
            sentences.append(
                "The machine is in contact, or meets its stops, where names are hints and not yet "
                "findings."
            )
        best = self.outcome.fit
        if self.answer.findings and not self.contact and leaves_much(best):
            nearest = self.located.search.nearest
            sentences.append(left_sentence(best, self.evidence.most, nearest))
        fits, evidence = self.located.decision.fits, self.evidence
        sentences += hints(best, evidence.machine, fits, evidence.still)
        if uncrossed := uncrossed_plays(self.located.prepared.problem, best):
            sentences.append(uncrossed_sentence(uncrossed))
        after = self.answer.next_experiment
        if not self.contact and not self.answer.unexplained.flagged:
            prepared = self.located.prepared
            sentences += (
                [once] if (once := seen_once(prepared.problem, prepared.linear.Q, best)) else []
            )
        noise = noise_sentence(self.evidence.input_noise)
        shown = [*self.holdout.sentences, *((noise,) if noise else ())]
        return (*sentences, *shown, *((after.sentence,) if after else ()))

    def as_json(self) -> dict[str, Any]:
        """Return the content of `diagnosis.json`."""
        content = self.answer.as_json()
        ordered: dict[str, Any] = {}
        for key, value in content.items():
            ordered[key] = value
            if key == "located":
                ordered["holdout"] = self.holdout.as_json()
        return {**ordered, "sha256": self.sha256}


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
    impacts = evidence.machine.impacts
    stages = _Stages(progress, _SHARES_IN_CONTACT if impacts else _SHARES)
    outside = [f.sentence for f in range_flags(evidence.machine.model, evidence.recordings)]
    if outside:
        progress(Progress(0, _STAGES, " ".join([*outside, _CHECK])))
    frozen = _from_training(study, evidence, stages)
    notes = _repair(study, run, frozen)
    stages.doing("forecasts of the unseen recordings")
    unseen, holdout = _on_holdout(study, frozen, strict)
    evidence = frozen.evidence
    all_notes = [
        *of_study(study, evidence), *notes, *of_unseen(study, evidence, unseen, holdout),
        *evidence.notes, *outside, *of_training(frozen.located),
    ]  # fmt: skip
    result = Diagnosis(
        study.name,
        frozen.answer,
        holdout,
        frozen.sha256,
        frozen.located,
        frozen.outcome,
        evidence,
        frozen.searched,
        tuple(dict.fromkeys(all_notes)),
        frozen.contact,
        {n: c.shift for n, c in study.recordings.clocks.items() if n.startswith("ctrl")},
    )
    if run is not None:
        _write(run, result)
        kept.clear()
    stages.finished(result.verdict)
    return result


@dataclass(frozen=True)
class _Frozen:
    """What the training recordings say, fixed before the hold-out is read.

    Attributes:
        evidence: what it was made from.
        located: the decision between sets.
        outcome: the repaired hypothesis.
        searched: as in `Diagnosis`.
        answer: findings and verdict.
        sha256: hash of the answer.
        contact: as in `Diagnosis`.
    """

    evidence: Evidence
    located: Located
    outcome: Outcome
    searched: ArgminSets
    answer: Answer
    sha256: str
    contact: bool


def _from_training(study: Study, evidence: Evidence, stages: "_Stages") -> _Frozen:
    """Decide, repair and answer from the training recordings alone; return the frozen answer."""
    located = locate(evidence, stages, stages.doing)
    evidence = replace(located.evidence, candidates=evidence.candidates)  # a search may leave some
    stages.doing("what stays unexplained, and forecasts of the training recordings where any does")
    outcome = explain(located)
    searched = argmin_sets(located.prepared.problem, located.search.frame.Q, located.decision)
    stages.doing("what to record next")
    experiment = next_experiment(located, outcome, study.limits)
    contact = in_contact(located.prepared.problem)
    fits = located.decision.fits
    uncrossed = uncrossed_plays(located.prepared.problem, outcome.fit)
    doubt = doubtful(outcome.fit, evidence.machine, fits, evidence.still)
    unsure = contact or doubt or bool(uncrossed)
    answer = make_answer(
        located.decision, outcome, evidence.machine, experiment,
        doubtful=unsure, fitted=_fitted(evidence, outcome.fit.hypothesis),
    )  # fmt: skip
    return _Frozen(evidence, located, outcome, searched, answer, answer.sha256, contact)


def _on_holdout(
    study: Study, frozen: _Frozen, strict: bool
) -> tuple[tuple[Recording, ...], Holdout]:
    """Read the recordings that were set aside, and judge a frozen answer by them."""
    unseen = frozen.evidence.without_skipped_start(load_holdout(study, strict=strict))
    return unseen, judge(frozen.evidence, frozen.outcome, unseen)


def _kept(study: Study, run: Run | None, strict: bool) -> FitCache:
    """Return the long fits that a killed diagnosis of the same files left in a run."""
    return NO_CACHE if run is None else FitCache.of(run, made_from(study, strict=strict))


def _fitted(evidence: Evidence, hypothesis: Hypothesis) -> Machine:
    """Return the machine with the model in which only the study's parameters were fitted."""
    machine = evidence.machine
    if not hypothesis.nuisances:
        return machine
    own = replace(hypothesis, members=(), x=())
    edits, _ = edits_and_parts(own, machine)
    made = survey(evidence.model.compile(edits), evidence.recordings)
    return replace(machine, model=made.model, actuators=made.actuators, bodies=made.bodies)


def _write(run: Run, result: Diagnosis) -> None:
    """Write the answer, the tables, what the pictures show, and the words."""
    run.write_json("diagnosis.json", result.as_json())
    run.write_frame("holdout.parquet", result.errors)
    run.write_frame("sessions.parquet", result.sessions)
    run.write_frame("traces.parquet", result.holdout.traces)
    outcome = result.outcome
    forces = missing_force(result.evidence, outcome.repaired, outcome.timestep)
    run.write_frame("forces.parquet", forces)
    found = sets(result.located.decision, result.answer, result.searched)
    run.write_frame("sets.parquet", found)
    run.write_json("pose.json", bent_pose(result.evidence.recordings))
    summary = {
        "name": result.name,
        "sentences": result.sentences,
        "notes": result.notes,
        "parameters": result.parameters["name"].tolist(),
    }
    run.write_json("summary.json", summary)


def gather(study: Study, recordings: tuple[Recording, ...], kept: FitCache = NO_CACHE) -> Evidence:
    """Return what a diagnosis is made from: scales, noise, candidates."""
    model = load_model(study)
    require_scales(study, model)
    require_limits(study, model)
    for recording in recordings:
        require_known(model, recording)
    require_recorded(study, model, recordings)
    return make_evidence(
        model,
        recordings,
        effects=chosen(study_effects(study), study.diagnosis.effects, study.diagnosis.exclude),
        parameters=study.parameter_set(model),
        noise=study.recordings.noise,
        most=study.diagnosis.most,
        threads=threads(),
        laws=study_laws(study, model),
        known=study.diagnosis.known,
        kept=kept,
    )


class _Stages:
    """Counts the stages of a diagnosis for its progress.

    Args:
        report: is called at each.
        shares: of the work that is done by the ends of the first stages; the last of them for more.
    """

    def __init__(self, report: OnProgress, shares: Sequence[float]) -> None:
        self._report, self._shares, self._done = report, shares, 0

    def __call__(self, text: str) -> None:
        self._done += 1
        share = self._shares[min(self._done, len(self._shares)) - 1]
        self._report(Progress(self._done, max(_STAGES, self._done + 1), text, share=share))

    def doing(self, text: str) -> None:
        """Say how far a stage is."""
        self._report(Progress(self._done, max(_STAGES, self._done + 1), text, passing=True))

    def finished(self, text: str) -> None:
        """Say what was found."""
        done = max(_STAGES, self._done + 1)
        self._report(Progress(done, done, text))


def _repair(study: Study, run: Run | None, frozen: _Frozen) -> tuple[str, ...]:
    """Write the repaired model and the answer; return notes on what the model cannot say."""
    if run is None:
        return ()
    evidence, outcome, answer = frozen.evidence, frozen.outcome, frozen.answer
    folder = Path(run.path(MODEL)).parent
    written = write_model(
        evidence.given, evidence.machine, outcome.repaired, folder,
        timestep=outcome.timestep, laws=evidence.laws,
    )  # fmt: skip
    text = study_text(study, answer.findings, run.folder, written)
    run.write_text(STUDY, text)
    controls = answer.next_experiment.controls if answer.next_experiment else None
    if controls is not None:
        run.write_text(EXPERIMENT, controls.to_csv(index=False))
    else:  # that of an earlier diagnosis in the same folder is none of this one's
        run.path(EXPERIMENT).unlink(missing_ok=True)
    run.write_json("answer.json", {**answer.as_json(), "sha256": frozen.sha256})
    return written.notes


__all__ = ["Diagnosis", "diagnose", "gather"]

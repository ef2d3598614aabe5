"""What the training recordings say, frozen and hashed before the hold-out is read."""

from dataclasses import dataclass, replace

import pandas as pd

from bo_sysid.diagnosis.answer.answer import Answer, make_answer
from bo_sysid.diagnosis.answer.argmin import ArgminSets, argmin_sets
from bo_sysid.diagnosis.answer.experiment import next_experiment
from bo_sysid.diagnosis.answer.explain import Outcome, explain
from bo_sysid.diagnosis.answer.hints import doubtful
from bo_sysid.diagnosis.answer.quantities import parameters_of
from bo_sysid.diagnosis.answer.trifle import with_trifle
from bo_sysid.diagnosis.answer.uncrossed import uncrossed_plays
from bo_sysid.diagnosis.search.locate import Located, locate
from bo_sysid.diagnosis.stages import Stages
from bo_sysid.diagnosis.windows.evidence import Evidence
from bo_sysid.diagnosis.windows.hypothesis import Hypothesis, edits_and_parts
from bo_sysid.diagnosis.windows.windowing import in_contact
from bo_sysid.effects import Machine, survey
from bo_sysid.study import Study


@dataclass(frozen=True)
class Frozen:
    """What the training recordings say, fixed before the hold-out is read.

    Attributes:
        evidence: what it was made from.
        located: the decision between sets.
        outcome: the repaired hypothesis, with a learned law where names do not suffice.
        searched: the same choice between sets as a search of the arg-min.
        answer: findings and verdict.
        sha256: hash of the answer.
        contact: whether the machine touches something in the recordings, or meets its stops.
        uncrossed: joints with a play that the recordings do not cross.
        small: whether a member is smaller than what is named, see `with_trifle`.
    """

    evidence: Evidence
    located: Located
    outcome: Outcome
    searched: ArgminSets
    answer: Answer
    sha256: str
    contact: bool
    uncrossed: tuple[str, ...]
    small: bool = False

    @property
    def parameters(self) -> pd.DataFrame:
        """The study's parameters beside the findings.

        Columns name, unit, model, fitted, low95, high95 and at_bound.
        """
        h, machine = self.outcome.fit.hypothesis, self.evidence.machine
        columns = ["name", "unit", "model", "fitted", "low95", "high95", "at_bound"]
        rows = [
            (c.site.name, q.unit, c.effect.nominal(c.site, machine), q.value, *q.interval, bound)
            for c, q, bound in zip(
                h.nuisances, parameters_of(self.outcome.fit, machine), h.bound, strict=True
            )
        ]
        return pd.DataFrame(rows, columns=columns)


def from_training(study: Study, evidence: Evidence, stages: Stages) -> Frozen:
    """Decide, repair and answer from the training recordings alone.

    Args:
        study: its limits bound the next experiment.
        evidence: of the training recordings.
        stages: told how far it is.
    """
    decided = locate(evidence, stages, stages.doing)
    located = with_trifle(decided)
    evidence = replace(located.evidence, candidates=evidence.candidates)  # a search may leave some
    stages.doing("what stays unexplained, and forecasts of the training recordings where any does")
    outcome = explain(located)
    problem = located.prepared.problem
    searched = argmin_sets(problem, located.search.frame.Q, located.decision)
    stages.doing("what to record next")
    experiment = next_experiment(located, outcome, study.limits)
    contact, uncrossed = in_contact(problem), uncrossed_plays(problem, outcome.fit)
    doubt = doubtful(outcome.fit, evidence.machine, located.decision.fits, evidence.still)
    answer = make_answer(
        located.decision, outcome, evidence.machine, experiment,
        doubtful=contact or doubt or bool(uncrossed) or located is not decided,
        fitted=_fitted(evidence, outcome.fit.hypothesis),
    )  # fmt: skip
    return Frozen(
        evidence, located, outcome, searched, answer, answer.sha256, contact, uncrossed,
        small=located is not decided,
    )  # fmt: skip


def _fitted(evidence: Evidence, hypothesis: Hypothesis) -> Machine:
    """Return the machine with the model in which only the study's parameters were fitted."""
    machine = evidence.machine
    if not hypothesis.nuisances:
        return machine
    own = replace(hypothesis, members=(), x=())
    edits, _ = edits_and_parts(own, machine)
    made = survey(evidence.model.compile(edits), evidence.recordings)
    return replace(machine, model=made.model, actuators=made.actuators, bodies=made.bodies)

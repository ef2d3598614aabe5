"""What the decision amounts to: names that hold, and a learned law for what they leave."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from operator import itemgetter

import numpy as np
from scipy.stats import chi2

from bo_sysid.diagnosis.answer.longer_windows import shows_more, too_short
from bo_sysid.diagnosis.answer.prediction_error import PredictionError
from bo_sysid.diagnosis.answer.sessions import Sessions, by_recording, by_stretch
from bo_sysid.diagnosis.answer.unexplained import Unexplained, unexplained_of
from bo_sysid.diagnosis.search.locate import Located
from bo_sysid.diagnosis.sets.fit import Fit
from bo_sysid.diagnosis.sets.groups import subset
from bo_sysid.diagnosis.sets.refit import FINAL
from bo_sysid.diagnosis.sets.rules import LOOSE
from bo_sysid.diagnosis.sets.shapes import with_shapes_unsure
from bo_sysid.diagnosis.unexplained.law import learn, terms_of
from bo_sysid.diagnosis.unexplained.unknown import (
    Clue,
    Unknown,
    examine,
    needed_with_law,
    slopes_reach,
)
from bo_sysid.diagnosis.windows.candidate import Candidate, slices_of
from bo_sysid.diagnosis.windows.hypothesis import Hypothesis
from bo_sysid.diagnosis.windows.problem import ROUGH
from bo_sysid.diagnosis.windows.timestep import coarsened
from bo_sysid.diagnosis.windows.windowing import meets_impacts
from bo_sysid.errors import RecordingError

_BETTER = 0.95  # of a forecast error: what is less is better
# of the forecast error of names that are far off: a law alone that leaves less is nearer to what
# acts, also where no law predicts what the names leave (.69 beside right names of a real slide)
_OUTDONE = 0.25
_MOST_LEFT = 0.25  # of the squares that names leave, above which a law far off explains nothing
_ENOUGH = 0.05  # of what names leave unexplained: a law that leaves less is not compared


@dataclass(frozen=True)
class Outcome:
    """The decision after the unknown was looked for.

    Attributes:
        fit: the set whose names hold.
        refitted: the nominal model with the study's parameters fitted.
        repaired: the hypothesis that the repaired model is made from.
        unexplained: what it says of the unknown.
        timestep: of the simulation in [s].
        sessions: the magnitudes recording by recording.
        law_alone: the nominal model with nothing but a learned law, to compare with; None where
            no law says anything.
        disputed: names that the recordings disagree on, which are no findings for that.

    From here on every hypothesis is stepped with the coarsest time step whose own error is little
    beside what the hypothesis leaves (`coarsened`); `Hypothesis.numerics` says which.
    """

    fit: Fit
    refitted: Hypothesis
    repaired: Hypothesis
    unexplained: Unexplained
    timestep: float
    sessions: Sessions
    law_alone: Hypothesis | None
    disputed: tuple[Candidate, ...]


def explain(located: Located) -> Outcome:
    """Keep the names that hold beside a flexible law, and learn that law where one is needed."""
    decision, problem = located.decision, located.prepared.problem
    fit, sessions, unknown, unexplained, disputed = _held(located)
    touching = meets_impacts(problem)
    judged = unknown.flagged or touching or _far(fit)
    error = _forecast_error(located) if judged else None
    nominal = decision.nominal
    refitted = _stepped(located, nominal.hypothesis, nominal.rms, error)
    alone, found = _law_alone(located, error, rivals=unknown.flagged)
    if unknown.law is None and not touching and _outdone(error, fit, alone):
        fit, sessions = nominal, by_recording(problem, nominal)
        unexplained = unexplained_of(found)
        repaired, unexplained = _better(error, refitted, alone, unexplained)
    elif unknown.law is None:  # where nothing is missing, the repaired model is the refitted one
        fit, repaired = _fitted(located, fit, error) if fit.members else (fit, refitted)
    else:
        law = alone
        if fit.members:
            law, clue = _learned(located, fit, unknown.clues, error)
            unexplained = unexplained_of(replace(unknown, clues=(clue,)))
        if error is not None and _refuted(error, fit, nominal, law, alone):
            fit, law, sessions = nominal, alone, by_recording(problem, nominal)
            unexplained = replace(unexplained, share=_share(fit, nominal))
        if not fit.members and alone is not None:
            unexplained = unexplained_of(found)
        bare = _stepped(located, fit.hypothesis, fit.rms, error) if fit.members else refitted
        repaired, unexplained = _better(error, bare, law, unexplained)
    unexplained = replace(unexplained, sought=bool(problem.machine.joints))
    if not fit.members and not unexplained.flagged and too_short(problem):
        longer = shows_more(located.evidence, repaired, problem.windows.timestep)
        if longer:
            unexplained = Unexplained(1.0, "world", "world", longer=longer)
    step = problem.windows.timestep
    return Outcome(fit, refitted, repaired, unexplained, step, sessions, alone, disputed)


def _held(
    located: Located,
) -> tuple[Fit, Sessions, Unknown, Unexplained, tuple[Candidate, ...]]:
    """Return the names that hold, their magnitudes by recording, and what they leave.

    The last are the names that recordings disagree on.
    """
    decision, problem = located.decision, located.prepared.problem
    fit, unknown = decision.best, examine(problem, decision)
    unexplained = unexplained_of(unknown)
    if unknown.flagged and unknown.law is None:
        unexplained = _placed(located, unexplained)
    if unknown.law is not None and slopes_reach(problem, fit, decision.nominal):
        fit = _without(located, fit, needed_with_law(problem, fit, unknown.law))
    named = fit.members
    fit, sessions = _agreed(located, fit)
    disputed = tuple(c for c in named if c.key not in {d.key for d in fit.members})
    if disputed and not unknown.flagged:  # what they disagree on is left unexplained
        unknown = examine(problem, replace(decision, best=fit))
        unexplained = unexplained_of(unknown)
    if fit.key != decision.best.key:
        unexplained = replace(unexplained, share=_share(fit, decision.nominal))
    return fit, sessions, unknown, unexplained, disputed


def _share(fit: Fit, nominal: Fit) -> float:
    """Return what a fit leaves of what the nominal model leaves unexplained, 1 at most."""
    return min(fit.excess / max(nominal.excess, 1e-9), 1.0)


def _refuted(
    error: PredictionError, fit: Fit, nominal: Fit, law: Hypothesis | None, alone: Hypothesis | None
) -> bool:
    """Whether nothing, or a law alone, forecasts the training recordings better than names do.

    Within windows a wrong name takes over what a law would say, and the law what is wrong with it.
    Names that are far from the recordings without a law must forecast better with it than it does
    alone, and where they are very far, without it as well: a constant force that bettered the law
    of a cable a little was wrong wherever the cable did not pull.

    Args:
        error: of a forecast.
        fit: the names.
        nominal: no names.
        law: the names with a law.
        alone: a law without names.
    """
    if not fit.members:
        return False
    own = error(fit.hypothesis)
    if own > error(nominal.hypothesis):
        return True
    if fit.rms > ROUGH and alone is not None and own > error(alone):
        return True
    margin = _BETTER if fit.rms <= LOOSE else 1 / _BETTER
    return law is not None and alone is not None and error(alone) < margin * error(law)


def _far(fit: Fit) -> bool:
    """Whether there are names, and they are far from the recordings."""
    return bool(fit.members) and fit.rms > ROUGH


def _outdone(error: PredictionError | None, fit: Fit, alone: Hypothesis | None) -> bool:
    """Whether a law alone forecasts the training recordings far better than names far from them.

    Once such names have bent the motion no law predicts what they leave, and nothing is flagged.
    """
    if error is None or alone is None or not _far(fit):
        return False
    return error(alone) < _OUTDONE * error(fit.hypothesis)


def _better(
    error: PredictionError | None,
    bare: Hypothesis,
    law: Hypothesis | None,
    unexplained: Unexplained,
) -> tuple[Hypothesis, Unexplained]:
    """Return what is put in, and what is said of it: no law that forecasts worse than none."""
    if law is None or (error is not None and error(bare) < error(law)):
        return bare, replace(unexplained, learned=False)
    return law, unexplained


def _fitted(located: Located, fit: Fit, error: PredictionError | None) -> tuple[Fit, Hypothesis]:
    """Return a fit, in contact with the magnitudes that forecast best, and its hypothesis."""
    if error is None or not meets_impacts(located.prepared.problem):
        return fit, _stepped(located, fit.hypothesis, fit.rms, error)
    fit = replace(fit, hypothesis=error.fitted(fit.hypothesis))
    return fit, fit.hypothesis


def _forecast_error(located: Located) -> PredictionError | None:
    """Return what judges by forecasts, where recordings are long enough for one."""
    try:
        return PredictionError(located.evidence, located.prepared.problem.windows.timestep)
    except RecordingError:
        return None


def _law_alone(
    located: Located, error: PredictionError | None, *, rivals: bool
) -> tuple[Hypothesis | None, Unknown]:
    """Return the nominal model with a learned law at the joint where one explains most, and where.

    Without `rivals` only the law that predicts most is learned: beside names that explain all it is
    there to be compared with.
    The correction of the time step has the share that the answer shows, or all of it: without what
    is missing, its fit follows something else.
    """
    problem, decision = located.prepared.problem, located.decision
    whole = 0.0 if problem.correction is None else 1.0
    numerics = decision.best.hypothesis.numerics if decision.best.members else whole
    nominal = decision.nominal
    stepped = replace(nominal.hypothesis, numerics=numerics)
    left = problem.residual(stepped, nominal.start)
    nominal = replace(nominal, hypothesis=stepped, residual=left)
    found = replace(examine(problem, replace(decision, best=nominal)), flagged=True)
    if found.law is None:
        return None, found
    clues = found.clues if rivals else found.clues[:1]
    law, clue = _learned(located, nominal, clues, error)
    return law, replace(found, clues=(clue,))


def _learned(
    located: Located, fit: Fit, clues: Sequence[Clue], error: PredictionError | None
) -> tuple[Hypothesis, Clue]:
    """Return a fit's hypothesis with the law beside it that leaves least, at its time step.

    A law that leaves much, and not only a little of what there was, tells nothing: where many
    things are missing, what follows from all of them looks like a force of something at some joint.
    """
    problem = located.prepared.problem
    tried = []
    for clue in clues:
        terms = terms_of(problem.machine, clue.joint, clue.depends_on)
        law, _, rms = learn(problem, fit, clue.joint, terms)
        tried.append((rms, law, clue))
        if rms**2 - 1.0 < _ENOUGH * fit.excess:
            break
    rms, law, clue = min(tried, key=itemgetter(0))
    much = rms > ROUGH and rms**2 - 1.0 > _MOST_LEFT * fit.excess
    if much and len(problem.machine.joints) > 1 and not meets_impacts(problem):
        clue = replace(clue, tells=False)
    return _stepped(located, law, rms, error), clue


def _stepped(
    located: Located, hypothesis: Hypothesis, rms: float, error: PredictionError | None
) -> Hypothesis:
    """Return a hypothesis at the coarsest time step whose error is little beside its rms.

    In contact forecasts tell the step.
    """
    problem = located.prepared.problem
    if error is not None and meets_impacts(problem):
        return error.stepped(hypothesis)
    own = problem.windows.timestep == problem.machine.model.opt.timestep  # else it is fine already
    return coarsened(hypothesis, located.prepared.step_rms / max(rms, 1.0), finest=own)


def _agreed(located: Located, fit: Fit) -> tuple[Fit, Sessions]:
    """Return the fit without what the recordings disagree on, and the magnitudes by recording.

    Its intervals hold the differences between recordings. An effect whose magnitude differs so
    much between them that nothing remains of it on the whole is none of the machine's.
    """
    sessions = by_recording(located.prepared.problem, fit)
    while fit.members:
        kept = tuple(_significant(fit, sessions))
        if all(kept):
            break
        fit = _without(located, fit, kept)
        sessions = by_recording(located.prepared.problem, fit)
    covariance = sessions.stated
    if meets_impacts(located.prepared.problem):  # stretches also differ by what recordings do
        covariance = np.maximum(covariance, by_stretch(located.prepared.problem, fit))
    fit = replace(fit, covariance=covariance)
    return with_shapes_unsure(located.prepared.problem, located.search.frame.Q, fit), sessions


def _significant(fit: Fit, sessions: Sessions) -> list[bool]:
    """Return for each member whether the recordings agree that it is there."""
    found = []
    for c, x, own in zip(fit.members, fit.x, slices_of(fit.members), strict=True):
        widened = np.diag(sessions.covariance)[own] > np.diag(fit.covariance)[own]
        distance = x @ np.linalg.pinv(sessions.covariance[own, own], hermitian=True) @ x
        found.append(bool(not widened.any() or distance > chi2.ppf(0.95, c.size)))
    return found


def _placed(located: Located, unexplained: Unexplained) -> Unexplained:
    """Return where something sits that no law predicts beside the answer.

    That is where a law predicts most of what the nominal model leaves, if nothing was found
    elsewhere.
    """
    decision, machine = located.decision, located.prepared.problem.machine
    found = examine(located.prepared.problem, replace(decision, best=decision.nominal))
    at = [machine.joint_of(c.site.kind, c.site.name) for c in decision.best.members]
    joints = {None if joint is None else joint.name for joint in at}
    if found.law is None or joints != {found.law.joint}:
        return unexplained
    return replace(unexplained, kind="joint", site=found.law.joint)


def _without(located: Located, fit: Fit, kept: tuple[bool, ...]) -> Fit:
    if all(kept):
        return fit
    members, x = subset(fit, np.flatnonzero(kept).tolist())
    return located.search.refit(members, x, start=fit.start, guess=fit.hypothesis, effort=FINAL)

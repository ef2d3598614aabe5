"""Identification: the inner loop, from a study to the parameters that fit and their belief."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import count

import numpy as np
import pandas as pd

from bo_sysid.arrays import Point
from bo_sysid.belief.bootstrap import cell_interval
from bo_sysid.belief.stopping import StopReason, StopRule
from bo_sysid.execution import OnProgress, Progress, limit_threads, silent, threads
from bo_sysid.identify.discretisation import step_notes
from bo_sysid.identify.errors import compared, instants_needed, remarks, traces
from bo_sysid.identify.journal import Journal
from bo_sysid.identify.problem import Problem, instants_of, make_problem
from bo_sysid.identify.refine import Level, Refined, best_of, is_fine_enough, joined, zoomed
from bo_sysid.identify.result import Identification
from bo_sysid.identify.search import Evaluate, History, Rules, search
from bo_sysid.mjcf import parameter_edits
from bo_sysid.parameters import CandidateSet
from bo_sysid.recording import Recording, kind_of, sensor_noise, stated_for
from bo_sysid.runs import Run
from bo_sysid.study import Study
from bo_sysid.study.inputs import TRAINED_SHARE, held_notes, load_holdout
from bo_sysid.study.overview import described


@limit_threads(1)  # linear algebra of small matrices, see `use_threads`
def identify(
    study: Study,
    run: Run | None = None,
    *,
    progress: OnProgress = silent,
    strict: bool = False,
) -> Identification:
    """Find the candidate that predicts the recordings best, and how sure one can be.

    Ask, simulate, tell: Gaussian processes on a power of Δ give the probability P of each
    candidate to be the arg-min, the acquisition picks the next one to simulate, until a stop rule
    holds. The hold-out is read once, after the answer is written.

    Args:
        study: what is asked.
        run: folder that keeps every evaluation and the results; an interrupted run of the same
            study is resumed.
        progress: called after every evaluation.
        strict: refuse messy recordings.

    Raises:
        UserError: the study, its model or its recordings are wrong.
    """
    problem = make_problem(study, threads=threads(), strict=strict)
    _require_long_enough(problem)
    journal = Journal(run, problem.fingerprint)
    found = _searched(problem, journal, progress)
    best, refined = found.best, found.refined
    parameters = _parameters(problem, best, refined)
    noise = _noise(problem.recordings, study.recordings.noise)
    low, high = (parameters[c].to_numpy(float) for c in ("low95", "high95"))
    fitted_starts = problem.with_fitted_starts(best, noise, low, high)
    if run is not None:
        _write_answer(run, problem, best, refined)
    holdout = load_holdout(study, strict=strict)  # read once, after the answer is written
    errors = compared(problem, best, {"train": problem.recordings, "holdout": holdout})
    shown = traces(problem, best, holdout)
    result = Identification(
        name=study.name,
        best=best,
        parameters=parameters,
        candidates=refined.candidates,
        probabilities=refined.probabilities,
        bootstrap=refined.bootstrap,
        evaluations=_evaluations(problem, journal),
        errors=errors,
        traces=shown,
        reason=found.reason.sentence,
        notes=(
            *remarks(errors),
            *held_notes(study),
            *step_notes(problem, best, parameters),
            *_notes(problem),
            *problem.unscaled(holdout),
        ),
        noise={n: sigma for n, sigma in noise.items() if kind_of(n) == "qpos"},
        fitted_starts=fitted_starts,
        nominal_deviation=float(problem.deviation(problem.nominal[None]).deviation[0]),
        spread=problem.deviation.whitening.spread,
    )
    if run is not None:
        run.write_frame("traces.parquet", shown)
        run.write_json("identification.json", result.summary())
    return result


def _noise(recordings: Sequence[Recording], stated: Mapping[str, float]) -> dict[str, float]:
    """Return the standard deviation of each recorded channel's noise, as stated or estimated."""
    found: dict[str, list[float]] = {}
    for recording in recordings:
        for name, sigma in sensor_noise(recording).items():
            found.setdefault(name, []).append(sigma)
    return {n: stated_for(n, stated, float(np.median(each))) for n, each in found.items()}


def _require_long_enough(problem: Problem) -> None:
    """Refuse windows that the last quarter, set aside where no hold-out is named, cannot hold.

    The quarter is not read: its length follows from that of the rest.

    Raises:
        StudyError: it is too short.
    """
    study, needed = problem.study, instants_needed(problem)
    if study.recordings.holdout is not None or study.recordings.dataset is not None:
        return
    trained = min(instants_of(problem.model, r) for r in problem.recordings)
    held = int(trained * (1 - TRAINED_SHARE) / TRAINED_SHARE)
    if needed > held:
        raise study.error(
            ("deviation", "horizon"),
            f"windows of {needed} instants do not fit into the last quarter of the recordings, "
            f"which is set aside and has about {held}: use a shorter horizon, or name other "
            "recordings under recordings.holdout",
        )


def _write_answer(run: Run, problem: Problem, best: Point, refined: Refined) -> None:
    edits = parameter_edits(problem.model, problem.parameters, best)
    problem.model.export(run.path("model_identified.xml"), edits)
    frame = refined.candidates.frame()
    frame = frame.assign(P=refined.probabilities, P_boot=refined.bootstrap)
    run.write_frame("belief.parquet", frame)


@dataclass(frozen=True)
class _Searched:
    """The best candidate, all of them with what is known of each, and why the search ended."""

    best: Point
    refined: Refined
    reason: StopReason


def _searched(problem: Problem, journal: Journal, progress: OnProgress) -> _Searched:
    """Search B and, where the study says so, finer sets around the mass of P."""
    settings, blocks = problem.study.search, problem.deviation.blocks
    most = settings.budget if settings.refine else min(settings.budget, len(problem.candidates))
    candidates, known, spent = problem.candidates, History.empty(len(blocks.weight)), 0
    levels: list[Level] = []
    for number in count():
        rules = _rules(problem.study, number, spent)
        on_step = _ProgressReporter(journal, progress, number, candidates, spent, most)
        stored = journal.history(number, len(blocks.weight))
        history = stored if len(stored) else known
        outcome = search(candidates, evaluation(problem, candidates), rules, history, on_step)
        levels.append(Level(candidates, outcome))
        refined = joined(levels, blocks, settings.seed)
        over = not settings.refine or spent + len(outcome.history) >= settings.budget
        if over or is_fine_enough(candidates, refined):
            break
        mass = outcome.belief.probabilities
        finer = zoomed(candidates, outcome.history, mass, settings.seed + number)
        if finer is None:
            break
        spent += len(outcome.history) - len(finer[1])
        candidates, known = finer
    return _Searched(best_of(levels), refined, outcome.reason)


def _rules(study: Study, level: int, spent: int) -> Rules:
    settings = study.search
    return Rules(
        settings.acquisition,
        StopRule(settings.budget - spent, settings.stop.entropy, settings.stop.last),
        settings.seed + level,
    )


def evaluation(problem: Problem, candidates: CandidateSet) -> Evaluate:
    """Return the function that evaluates Δ of a row of B."""
    return lambda row: problem.deviation(candidates.points[[row]])


@dataclass(frozen=True)
class _ProgressReporter:
    """Writes the history of one level of the search to the journal, and reports progress."""

    journal: Journal
    progress: OnProgress
    level: int
    candidates: CandidateSet
    spent: int
    most: int

    def __call__(self, history: History) -> None:
        self.journal.write(self.level, self.candidates, history)
        lowest = history.evaluation.deviation.min()
        done = self.spent + len(history)
        self.progress(Progress(done, self.most, f"lowest deviation {lowest:.4g}"))


_CORRELATED_ERRORS = (
    "the model is off in the same way over long parts of the recordings, so that these are few "
    "independent ones: the intervals are narrower than they should be. Longer recordings help, as "
    "do four or more, between which what differs is then counted"
)
_AT_BOUND = 1e-9  # of the range between the bounds


def _parameters(problem: Problem, best: Point, refined: Refined) -> pd.DataFrame:
    """Return one row a parameter: its value, its interval and whether it lies on a bound.

    A candidate stands for its cell: the interval reaches half a cell further. Values
    without an order have nothing between or beyond them.
    """
    bounds = problem.candidates.bounds
    low95, high95 = cell_interval(
        refined.candidates.points, refined.cells, refined.bootstrap, bounds
    )
    at_bound = (abs(best - bounds) < _AT_BOUND * (bounds[1] - bounds[0])).any(axis=0)
    at_bound[list(problem.candidates.categories)] = False
    frame = described(problem.model, problem.parameters)
    return frame[["name", "unit", "addresses", "apply", "nominal"]].assign(
        value=best,
        low95=low95,
        high95=high95,
        at_bound=at_bound,
    )


def _evaluations(problem: Problem, journal: Journal) -> pd.DataFrame:
    """Return one row an evaluation; what a finer set took along was evaluated before."""
    names = [p.name for p in problem.parameters]
    frame = journal.frame.drop(columns="contributions")
    return frame.drop_duplicates(names, ignore_index=True)


def _notes(problem: Problem) -> tuple[str, ...]:
    notes = (
        list(problem.notes)
        + [n for r in problem.recordings for n in r.notes]
        + [*problem.deviation.windows.left_out, *problem.deviation.windows.notes]
    )
    if problem.deviation.blocks.short:
        notes.append(_CORRELATED_ERRORS)
    notes += [_compared(problem, k) for k in range(len(problem.deviation.whitening.channels))]
    return tuple(dict.fromkeys(notes))


def _compared(problem: Problem, k: int) -> str:
    """Return in words on which scale channel number `k` is compared, or why it is not."""
    whitening, observed = problem.deviation.whitening, problem.deviation.windows.observed
    name, scale = whitening.channels[k], whitening.scale[k]
    if np.isfinite(scale):
        return f"{name} is compared in units of {scale:.4g} ({whitening.source[k]})"
    if np.isfinite(observed[..., k]).any():
        return f"{name} is not compared: it never moves in the recordings"
    why = f"no window of {problem.horizon} instants has a sample of it; use a longer horizon"
    return f"{name} is not compared: {why}"

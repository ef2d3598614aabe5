"""The proof on recordings that were never used."""

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np
import pandas as pd
from jaxtyping import Float

from bo_sysid.diagnosis.answer.explain import Outcome
from bo_sysid.diagnosis.answer.tables import traces
from bo_sysid.diagnosis.answer.wording import spoken
from bo_sysid.diagnosis.windows.evidence import Evidence
from bo_sysid.diagnosis.windows.forecast import (
    AHEAD,
    LONGER,
    PAST,
    Errors,
    fitted,
    forecast,
    forecast_problem,
    noise_floor,
)
from bo_sysid.diagnosis.windows.hypothesis import Hypothesis
from bo_sysid.diagnosis.windows.problem import Problem, cut_problem
from bo_sysid.effects import Site
from bo_sysid.errors import RecordingError
from bo_sysid.recording import Recording
from bo_sysid.recording.alignment import instants_in

_BEYOND = 0.05  # of the unseen instants, outside what was trained on, that is worth telling
_ALIKE = 0.02  # by which two errors differ in words
_WORSE = 0.2  # of an error, by which a repair makes longer windows worse
_AT_FLOOR = 1.5  # of the floor, below which a forecast is as good as the sensors
_SPARE = 1.1  # times the length of a window, that a recording has at least
_FREE = (1.0, 5.0)  # [s] length of a free run
_FREE_SHARE = 0.1  # of the hold-out's length


@dataclass(frozen=True)
class Holdout:
    """Errors on the hold-out.

    Attributes:
        table: columns measure, horizon_s, model, error, unit; one row each.
        free_runs: free-run error by channel for each model.
        traces: what was recorded and what the models forecast, over the longest horizon.
        note: why some of it is not there, where that is so.
        parameters: whether the study has parameters, which `refitted` differs by.
        beyond: by joint, the share of the instants in which it is where no training recording was.
        short: names of recordings that are shorter than a forecast and what it begins from.
    """

    table: pd.DataFrame
    free_runs: Mapping[str, Mapping[str, float]]
    traces: pd.DataFrame
    note: str = ""
    parameters: bool = True
    beyond: Mapping[str, float] = field(default_factory=dict)
    short: tuple[str, ...] = ()

    def error(self, measure: str, horizon: float, model: str) -> float | None:
        """Return one error, None where it was not computed."""
        t = self.table
        rows = t[(t.measure == measure) & (t.horizon_s == horizon) & (t.model == model)]
        return None if rows.empty else float(rows.error.iloc[0])

    @property
    def sentences(self) -> tuple[str, ...]:
        """The proof in words."""
        before = self.error("forecast", AHEAD, "refitted")
        after = self.error("forecast", AHEAD, "repaired")
        floor = self.error("forecast", AHEAD, "noise_floor")
        if before is None or after is None or floor is None:
            return (self.note,) if self.note else ()
        nominal = self.error("forecast", AHEAD, "nominal") or before
        refitted = self.parameters and nominal > (1 + _ALIKE) * before  # they do some of it
        told = nominal if refitted else before
        verb, first = "falls" if after < (1 - _ALIKE) * told else "goes", _figure(told)
        if refitted and after != before:
            first += f" ({_figure(before)} with the study's parameters fitted)"
        text = (
            f"Forecast error on the unseen recording {verb} from {first} to "
            f"{_figure(after)} sensor sigmas; the noise floor is {_figure(floor)}."
        )
        if after > max((1 + _ALIKE) * before, _AT_FLOOR * floor):
            said = "The unseen recording does not confirm the repair."
        elif after > _AT_FLOOR * floor:
            said = "The floor is not reached: these recordings do not show all that is missing."
        elif longer := self._longer:
            said = longer
        else:
            return (text,)
        return (text, said, *self._elsewhere)

    @property
    def _longer(self) -> str:
        """Where the repair makes longer windows worse, in words; empty where it does not."""
        for measure, does in (("fit", "follows"), ("forecast", "forecasts")):
            models = ("refitted", "repaired", "noise_floor")
            errors = [self.error(measure, LONGER, m) for m in models]
            if None in errors:
                continue
            before, after, floor = (float(e or 0.0) for e in errors)
            if after > max((1 + _WORSE) * before, _AT_FLOOR * floor):
                return (
                    f"Over {LONGER:g} s the repaired model {does} the unseen recording worse than "
                    f"without what was found ({_figure(after)} for {_figure(before)} sensor "
                    "sigmas), which does not confirm the repair."
                )
        return ""

    @property
    def _elsewhere(self) -> tuple[str, ...]:
        """Where the hold-out goes and the training recordings do not, in words."""
        if not self.beyond:
            return ()
        shares = " and ".join(
            f"{spoken(Site('joint', joint))} in {share:.0%} of it"
            for joint, share in self.beyond.items()
        )
        return (f"The unseen recording goes where no training recording was: {shares}.",)

    def as_json(self) -> dict[str, Any]:
        """Return the part of `diagnosis.json` about the hold-out."""
        if self.table.empty:
            return {"forecast": {}, "fit": {}, "free_run": {}}
        out: dict[str, Any] = {}
        for measure in ("forecast", "fit"):
            rows = self.table[self.table.measure == measure]
            if rows.empty:
                out[measure] = {}
                continue
            horizon = float(rows.horizon_s.min())
            errors = rows[rows.horizon_s == horizon].set_index("model").error
            names = ("nominal", "refitted", "repaired", "learned_residual", "noise_floor")
            values = {n: _number(errors.get(n)) for n in names}
            out[measure] = {"unit": "sensor sigma", "horizon_s": horizon, **values}
        free = self.table[self.table.measure == "free_run"]
        if len(free):
            errors = free.set_index("model").error
            out["free_run"] = {
                "horizon_s": float(free.horizon_s.iloc[0]),
                "unit": str(free.unit.iloc[0]),
                **{n: _number(errors.get(n)) for n in ("nominal", "refitted", "repaired")},
                "channels": {m: dict(c) for m, c in self.free_runs.items()},
            }
        else:
            out["free_run"] = {}
        return out


def judge(evidence: Evidence, outcome: Outcome, recordings: Sequence[Recording]) -> Holdout:
    """Return the errors of nominal, refitted and repaired model on the hold-out.

    Where something touches in it, the models have contact, as those have that anyone is given.
    """
    evidence = evidence.with_contact_of(recordings)
    nominal, refitted = Hypothesis(), outcome.refitted
    as_it_is = not refitted.free and not refitted.numerics
    models = {
        "nominal": nominal,
        "refitted": nominal if as_it_is else refitted,
        "repaired": outcome.repaired,
    }
    if outcome.law_alone is not None:
        models["learned_residual"] = outcome.law_alone
    rows: list[dict[str, Any]] = []
    free_runs: Mapping[str, Mapping[str, float]] = {}
    traced = pd.DataFrame()
    length = max((r.duration for r in recordings), default=0.0)
    free = float(np.clip(_FREE_SHARE * length, *_FREE))
    all_but_law = {name: h for name, h in models.items() if name != "learned_residual"}
    measured = (
        partial(_forecasts, evidence, outcome, recordings, models, AHEAD),
        partial(_fits, evidence, outcome, recordings, models),
        # a baseline of what is told first; its law is slow
        partial(_forecasts, evidence, outcome, recordings, all_but_law, LONGER),
    )
    note = ""
    for measure in measured:
        try:
            made, shown = measure()
        except RecordingError as error:
            note = note or f"The hold-out cannot be judged: {error}"
        else:
            rows, traced = rows + made, traced if shown.empty else shown
    if rows and length > PAST + free:
        made, free_runs, longer = _free_runs(evidence, outcome, recordings, all_but_law, free)
        rows, traced = rows + made, traced if longer.empty else longer
    return Holdout(
        _table(rows), free_runs, traced, note, parameters=bool(evidence.nuisances),
        beyond=beyond(evidence.recordings, recordings, evidence.machine.joints) if rows else {},
        short=tuple(r.name for r in recordings if not _lasts(r, PAST + AHEAD)),
    )  # fmt: skip


def _lasting(recordings: Sequence[Recording], seconds: float) -> Sequence[Recording]:
    """Return the recordings that have windows of some length; all of them where none has."""
    return [r for r in recordings if _lasts(r, seconds)] or recordings


def _lasts(recording: Recording, seconds: float) -> bool:
    return recording.duration > _SPARE * seconds


def beyond(
    known: Sequence[Recording], unseen: Sequence[Recording], joints: Collection[str]
) -> dict[str, float]:
    """Return the joints that leave the range of their known positions, and how much of the time."""
    found = {}
    for joint in joints:
        seen, new = _positions(known, joint), _positions(unseen, joint)
        if seen.size and new.size:
            found[joint] = float(np.mean((new < np.nanmin(seen)) | (new > np.nanmax(seen))))
    return {joint: share for joint, share in found.items() if share > _BEYOND}


def _positions(recordings: Sequence[Recording], joint: str) -> Float[np.ndarray, " n"]:
    channels = (r.channels.get(f"qpos.{joint}") for r in recordings)
    return np.concatenate([*(c.values for c in channels if c is not None), np.zeros(0)])


def _table(rows: list[dict[str, Any]]) -> pd.DataFrame:
    return pd.DataFrame(rows, columns=["measure", "horizon_s", "model", "error", "unit"])


def _forecasts(
    evidence: Evidence,
    outcome: Outcome,
    recordings: Sequence[Recording],
    models: Mapping[str, Hypothesis],
    ahead: float,
) -> tuple[list[dict[str, Any]], pd.DataFrame]:
    lasting = _lasting(recordings, PAST + ahead)
    problem, past = _cut(evidence, outcome, lasting, PAST, ahead)
    made = _each(models, partial(forecast, problem, past))
    rows = [_row("forecast", ahead, name, errors.ahead) for name, errors in made.items()]
    floor = noise_floor(problem, past, models["repaired"], made["repaired"])
    rows.append(_row("forecast", ahead, "noise_floor", floor))
    residuals = {name: errors.residual for name, errors in made.items()}
    return rows, traces(problem, past, residuals)


def _fits(
    evidence: Evidence,
    outcome: Outcome,
    recordings: Sequence[Recording],
    models: Mapping[str, Hypothesis],
) -> tuple[list[dict[str, Any]], pd.DataFrame]:
    compared = {*evidence.model.qpos_channels, *evidence.sigma}
    lasting = _lasting(recordings, LONGER)
    horizon = max(instants_in(LONGER, lasting, compared), 4)
    problem = cut_problem(
        evidence.model, evidence.machine, lasting, evidence.sigma, (), horizon=horizon,
        timestep=outcome.timestep, engine=evidence.engine, laws=evidence.laws,
    )  # fmt: skip
    made = _each(models, partial(fitted, problem))
    rows = [_row("fit", LONGER, n, errors.ahead) for n, errors in made.items()]
    return [*rows, _row("fit", LONGER, "noise_floor", 1.0)], pd.DataFrame()


def _free_runs(
    evidence: Evidence,
    outcome: Outcome,
    recordings: Sequence[Recording],
    models: Mapping[str, Hypothesis],
    free: float,
) -> tuple[list[dict[str, Any]], dict[str, Mapping[str, float]], pd.DataFrame]:
    """Return the errors of runs of seconds as rows, by model and channel, and their traces."""
    try:
        problem, past = _cut(evidence, outcome, _lasting(recordings, PAST + free), PAST, free)
    except RecordingError:
        return [], {}, pd.DataFrame()
    made, rows = _each(models, partial(forecast, problem, past)), []
    joints = {f"qpos.{n}": "rad" if j.hinge else "m" for n, j in evidence.machine.joints.items()}
    for name, errors in made.items():
        units = {joints.get(channel, "SI") for channel in errors.channel}
        unit = units.pop() if len(units) == 1 else "SI"
        error = float(np.sqrt(np.mean(np.square(list(errors.channel.values())))))
        rows.append({**_row("free_run", free, name, error), "unit": unit})
    shown = traces(problem, past, {name: errors.residual for name, errors in made.items()})
    return rows, {name: errors.channel for name, errors in made.items()}, shown


def _each(
    models: Mapping[str, Hypothesis], judged: Callable[[Hypothesis], Errors]
) -> dict[str, Errors]:
    """Return the errors of each model, computed once where two names stand for one."""
    made: dict[int, Errors] = {}
    for hypothesis in models.values():
        if id(hypothesis) not in made:
            made[id(hypothesis)] = judged(hypothesis)
    return {name: made[id(hypothesis)] for name, hypothesis in models.items()}


def _cut(
    evidence: Evidence, outcome: Outcome, recordings: Sequence[Recording], past: float, ahead: float
) -> tuple[Problem, int]:
    return forecast_problem(
        evidence.model,
        evidence.machine,
        recordings,
        evidence.sigma,
        past=past,
        ahead=ahead,
        timestep=outcome.timestep,
        engine=evidence.engine,
        laws=evidence.laws,
    )


def _row(measure: str, horizon: float, model: str, error: float) -> dict[str, Any]:
    return {
        "measure": measure, "horizon_s": horizon, "model": model, "error": error,
        "unit": "sensor sigma",
    }  # fmt: skip


def _figure(value: float) -> str:
    """Return three figures without an exponent: 14,700."""
    return f"{float(f'{value:.3g}'):,.0f}" if value >= 1000 else f"{value:.3g}"


def _number(value: Any) -> float | None:
    return None if value is None or not np.isfinite(value) else float(value)

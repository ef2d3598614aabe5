"""The proof on recordings that were never used."""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
import pandas as pd
from jaxtyping import Float

from bo_sysid.diagnosis.answer.explain import Outcome
from bo_sysid.diagnosis.answer.holdout import Holdout
from bo_sysid.diagnosis.answer.tables import traces
from bo_sysid.diagnosis.windows.cutting import cut_problem
from bo_sysid.diagnosis.windows.evidence import Evidence
from bo_sysid.diagnosis.windows.forecast import (
    AHEAD,
    LONGER,
    PAST,
    Errors,
    fitted,
    fitted_floor,
    forecast,
    forecast_problem,
    noise_floor,
)
from bo_sysid.diagnosis.windows.hypothesis import Hypothesis
from bo_sysid.diagnosis.windows.problem import Problem
from bo_sysid.effects.machine import JointScale
from bo_sysid.errors import RecordingError
from bo_sysid.recording import Recording
from bo_sysid.recording.alignment import OTHER_RATE, Sampling, instants_in, interval_of

_TURN = 2 * np.pi  # [rad]
_BEYOND = 0.05  # of the unseen instants, outside what was trained on, that is worth telling
_SPARE = 1.1  # times the length of a window, that a recording has at least
_FREE = (1.0, 5.0)  # [s] length of a free run
_FREE_SHARE = 0.1  # of the hold-out's length
_JITTER = 0.2  # of an interval between samples, up to which they have a rate


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
        rates=_other_rate(evidence, recordings), units=_units(evidence),
    )  # fmt: skip


def _units(evidence: Evidence) -> dict[str, str]:
    """Return the units of the channels that are compared."""
    joints = evidence.machine.joints
    own = {f"qpos.{name}": "rad" if joint.hinge else "m" for name, joint in joints.items()}
    return {channel: own.get(channel, "SI") for channel in evidence.sigma}


def _other_rate(evidence: Evidence, unseen: Sequence[Recording]) -> str:
    """Return how the hold-out is sampled otherwise than all training recordings, in words.

    Commands that are logged when they change have no rate.
    """
    apart = {}
    for name in (*evidence.model.qpos_channels, *evidence.model.ctrl_channels):
        known, new = (
            [interval_of(r, [name]) for r in recordings if _is_steady(r, name)]
            for recordings in (evidence.recordings, unseen)
        )
        if known and new:
            usual = float(np.median(new))
            if not min(known) / OTHER_RATE < usual < OTHER_RATE * max(known):
                apart[name] = (usual, float(np.median(known)))
    if not apart:
        return ""
    name = max(apart, key=lambda n: abs(np.log(apart[n][0] / apart[n][1])))
    here, there = apart[name]
    return (
        f"The unseen recording has {name} every {here:.3g} s, training every {there:.3g} s: "
        "forecasts last as long, and controls are held from one sample to the next."
    )


def _is_steady(recording: Recording, name: str) -> bool:
    """Whether a channel was sampled at a rate."""
    channel = recording.channels.get(name)
    if channel is None or len(channel.time) < 2:
        return False
    sampling = Sampling.of(channel.time)
    return sampling.jitter <= _JITTER * sampling.median_dt


def _lasting(recordings: Sequence[Recording], seconds: float) -> Sequence[Recording]:
    """Return the recordings that have windows of some length; all of them where none has."""
    return [r for r in recordings if _lasts(r, seconds)] or recordings


def _lasts(recording: Recording, seconds: float) -> bool:
    return recording.duration > _SPARE * seconds


def beyond(
    known: Sequence[Recording], unseen: Sequence[Recording], joints: Mapping[str, JointScale]
) -> dict[str, float]:
    """Return the joints that leave the range of their known positions, and how much of the time.

    A hinge that has gone round, as wheels do, comes to no place where it was not.
    """
    found = {}
    for joint, scale in joints.items():
        seen, new = _positions(known, joint), _positions(unseen, joint)
        each = (_positions([r], joint) for r in known)
        round_ = scale.hinge and any(q.size and np.ptp(q) > _TURN for q in each)
        if seen.size and new.size and not round_:
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
    problem, past = _cut(evidence, outcome, recordings, ahead)
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
    horizon = [max(instants_in(LONGER, [r], compared), 4) for r in lasting]
    problem = cut_problem(
        evidence.model, evidence.machine, lasting, evidence.sigma, (), horizon=horizon,
        timestep=outcome.timestep, engine=evidence.engine, laws=evidence.laws,
        input_noise=evidence.input_noise,
    )  # fmt: skip
    made = _each(models, partial(fitted, problem))
    rows = [_row("fit", LONGER, n, errors.ahead) for n, errors in made.items()]
    floor = fitted_floor(problem, models["repaired"], made["repaired"])
    return [*rows, _row("fit", LONGER, "noise_floor", floor)], pd.DataFrame()


def _free_runs(
    evidence: Evidence,
    outcome: Outcome,
    recordings: Sequence[Recording],
    models: Mapping[str, Hypothesis],
    free: float,
) -> tuple[list[dict[str, Any]], dict[str, Mapping[str, float]], pd.DataFrame]:
    """Return the errors of runs of seconds as rows, by model and channel, and their traces."""
    try:
        problem, past = _cut(evidence, outcome, recordings, free)
    except RecordingError:
        return [], {}, pd.DataFrame()
    made, rows = _each(models, partial(forecast, problem, past)), []
    known = _units(evidence)
    for name, errors in made.items():
        units = {known[channel] for channel in errors.channel}
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
    evidence: Evidence, outcome: Outcome, recordings: Sequence[Recording], ahead: float
) -> tuple[Problem, int]:
    return forecast_problem(
        evidence.model,
        evidence.machine,
        _lasting(recordings, PAST + ahead),
        evidence.sigma,
        past=PAST,
        ahead=ahead,
        timestep=outcome.timestep,
        engine=evidence.engine,
        laws=evidence.laws,
        input_noise=evidence.input_noise,
    )


def _row(measure: str, horizon: float, model: str, error: float) -> dict[str, Any]:
    return {
        "measure": measure, "horizon_s": horizon, "model": model, "error": error,
        "unit": "sensor sigma",
    }  # fmt: skip

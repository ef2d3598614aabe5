"""How well the nominal and the identified model predict, in numbers and as traces."""

from collections.abc import Mapping, Sequence
from math import ceil

import numpy as np
import pandas as pd
from jaxtyping import Float

from bo_sysid.arrays import Point
from bo_sysid.deviation.forecast import (
    Residual,
    fit_residual,
    forecast_residual,
    prediction_residual,
)
from bo_sysid.identify.problem import Problem
from bo_sysid.mjcf.commands import units
from bo_sysid.recording import Recording
from bo_sysid.simulation.simulator import Prediction

_CLEARLY = 1.1  # times an error, from which another is clearly larger
_PAST = 8  # a forecast's start uses as many samples of a joint as 1/8 of the horizon's instants
_TRACED = 4_000  # most instants of a trace


def compared(
    problem: Problem, best: Point, recordings: Mapping[str, Sequence[Recording]]
) -> pd.DataFrame:
    """Return the prediction errors of both models, one row a part, kind and channel.

    Args:
        problem: on whose scales and horizon the errors are measured.
        best: the identified parameters.
        recordings: by part (train, holdout).

    Returns:
        Columns recordings, kind, channel, unit; nominal and identified, root mean square in that
        unit over the windows in which neither model diverges; nominal_diverged and
        identified_diverged, the shares of windows in which each does. Kinds: "prediction" from
        measured starts; or, where starts are fitted, "fit" inside the windows and "forecast" from
        the past alone. Where one model diverges in every window the other's error is that of its
        own windows, and its own is NaN, as is that of a channel of which nothing was recorded.
    """
    tables = []
    for part, given in recordings.items():
        nominal, identified = (_by_kind(problem, given, p) for p in (problem.nominal, best))
        for kind, left in nominal.items():
            table = side_by_side(left, identified[kind])
            table.insert(0, "recordings", part)
            table.insert(1, "kind", kind)
            tables.append(table)
    errors = pd.concat(tables, ignore_index=True)
    known = units(problem.model.compile())
    known |= {n: c.unit for r in problem.recordings for n, c in r.channels.items() if c.unit}
    errors.insert(3, "unit", [known.get(str(name), "") for name in errors["channel"]])
    return errors


def side_by_side(nominal: Residual, identified: Residual) -> pd.DataFrame:
    """Return what two models leave in the same windows, one row a channel; see `compared`.

    Only windows in which neither diverges count: a model must not gain by diverging where it is
    worst.
    """
    models = {"nominal": nominal, "identified": identified}
    alone = any(left.diverged.all() for left in models.values())
    windows = None if alone else ~(nominal.diverged | identified.diverged)
    return pd.DataFrame(
        {
            "channel": nominal.channels,
            **{name: left.rms(windows) for name, left in models.items()},
            **{f"{name}_diverged": float(left.diverged.mean()) for name, left in models.items()},
        }
    )


def remarks(errors: pd.DataFrame) -> tuple[str, ...]:
    """Return in words where models diverge, and what has no error for it; see `compared`."""
    notes = []
    for (part, kind), table in errors.groupby(["recordings", "kind"], sort=False):
        lost = {m: float(table[f"{m}_diverged"].iloc[0]) for m in ("nominal", "identified")}
        found = [f"the {m} model diverges in {_in(share)}" for m, share in lost.items() if share]
        has_error = table[list(lost)].notna().any(axis=1)
        if has_error.any():
            unrecorded = table.loc[~has_error, "channel"]
            found += [f"{name} was recorded in no window that is compared" for name in unrecorded]
        elif max(lost.values()) < 1:
            found.append("there is no window in which neither diverges")
        if part == "holdout" and is_worse(table):
            found.append(
                "the identified model is better than the nominal one in no channel; more "
                "evaluations or candidates may find what fits, and diagnose what the model lacks"
            )
        notes += [f"{part}, {kind}: {words}" for words in found]
    return tuple(notes)


def is_worse(table: pd.DataFrame) -> bool:
    """Return whether the identified model predicts no channel better, and one clearly worse.

    Args:
        table: rows of `compared`.
    """
    known = table[["nominal", "identified"]].dropna()
    ratio = known["identified"] / known["nominal"]
    return bool((ratio >= 1).all() and (ratio > _CLEARLY).any())


def _in(share: float) -> str:
    if share < 1:
        return f"{share:.1%} of the windows, which count for neither"
    return "every window"


def instants_needed(problem: Problem) -> int:
    """Return how many instants after its first a recording must have to be compared."""
    past = past_of(problem) if problem.deviation.fitted_starts else 0
    return problem.horizon + past


def past_of(problem: Problem) -> int:
    """Return how many instants a forecast's start uses.

    Where joints are sampled at different rates, many instants have no sample of the slowest:
    position and speed need two of its samples at least.
    """
    windows = problem.deviation.windows
    places = [k for k, name in enumerate(windows.channels) if name.startswith("qpos.")]
    observed = np.isfinite(windows.observed[:, :, places])
    each = [
        observed[windows.recording == r].mean(axis=(0, 1)) for r in np.unique(windows.recording)
    ]
    share = max(float(np.min(each)), 1 / problem.horizon)
    return ceil(max(problem.horizon // _PAST, 2) / share)


def _by_kind(
    problem: Problem, recordings: Sequence[Recording], point: Point
) -> dict[str, Residual]:
    deviation = problem.on(recordings)
    if not deviation.fitted_starts:
        return {"prediction": prediction_residual(deviation, point)}
    past = past_of(problem)
    longer = problem.on(recordings, problem.horizon + past)
    return {
        "fit": fit_residual(deviation, point, len(problem.model.loops.joints)),
        "forecast": forecast_residual(longer, point, past=past),
    }


def traces(problem: Problem, best: Point, recordings: Sequence[Recording]) -> pd.DataFrame:
    """Return what was recorded and what both models predict, for the first recording.

    Returns:
        Columns time [s], begin (the recording's first stamp), window, channel, recorded, nominal,
        identified, in the channels' units; NaN where a model's simulation of the window diverged.
        Quaternions have the sign that is nearer to what was recorded.
    """
    deviation = problem.on(recordings[:1])
    windows = deviation.windows
    keep = slice(0, max(_TRACED // windows.observed.shape[1], 1))
    predicted = (_survived(deviation.prediction(point)) for point in (problem.nominal, best))
    nominal, identified = ((p * windows.signs(p))[keep] for p in predicted)
    observed = windows.observed[keep]
    instants = (windows.step + windows.fraction)[keep] * windows.timestep
    time = windows.time[keep][:, None] + instants
    shape = observed.shape
    return pd.DataFrame(
        {
            "time": np.broadcast_to(time[..., None], shape).ravel(),
            "begin": recordings[0].span[0],
            "window": np.broadcast_to(np.arange(shape[0])[:, None, None], shape).ravel(),
            "channel": np.broadcast_to(np.array(windows.channels), shape).ravel(),
            "recorded": observed.ravel(),
            "nominal": nominal.ravel(),
            "identified": identified.ravel(),
        }
    )


def _survived(prediction: Prediction) -> Float[np.ndarray, "W H c"]:
    """Return what was predicted; NaN in windows that diverged, where values mean nothing."""
    return np.where(prediction.diverged[:, None, None], np.nan, prediction.values)

"""How well the nominal and the identified model predict, in numbers and as traces."""

from collections.abc import Mapping, Sequence

import numpy as np
import pandas as pd

from bo_sysid.arrays import Point
from bo_sysid.deviation.forecast import fit_error, forecast_error, prediction_error
from bo_sysid.identify.problem import Problem
from bo_sysid.recording import Recording

_PAST = 8  # a forecast's start uses as many instants as 1/8 of its horizon
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
        Columns recordings, kind, channel, nominal, identified, root mean square in the channel's
        unit. Kinds: "prediction" from measured starts; or, where starts are fitted, "fit" inside
        the windows and "forecast" from the past alone.
    """
    points = {"nominal": problem.nominal, "identified": best}
    tables = []
    for part, given in recordings.items():
        columns = {name: _by_kind(problem, given, point) for name, point in points.items()}
        table = pd.DataFrame(columns).rename_axis(["kind", "channel"]).reset_index()
        table.insert(0, "recordings", part)
        tables.append(table)
    return pd.concat(tables, ignore_index=True)


def instants_needed(problem: Problem) -> int:
    """Return how many instants after its first a recording must have to be compared."""
    past = past_of(problem.horizon) if problem.deviation.fitted_starts else 0
    return problem.horizon + past


def past_of(horizon: int) -> int:
    """Return how many instants a forecast's start uses."""
    return max(horizon // _PAST, 2)


def _by_kind(problem: Problem, recordings: Sequence[Recording], point: Point) -> pd.Series:
    deviation = problem.on(recordings)
    if not deviation.fitted_starts:
        kinds = {"prediction": prediction_error(deviation, point)}
    else:
        horizon = problem.horizon
        past = past_of(horizon)
        longer = problem.on(recordings, horizon + past)
        kinds = {
            "fit": fit_error(deviation, point),
            "forecast": forecast_error(longer, point, past=past),
        }
    columns = {kind: table.set_index("channel")["rms"] for kind, table in kinds.items()}
    return pd.Series(pd.concat(columns))


def traces(problem: Problem, best: Point, recordings: Sequence[Recording]) -> pd.DataFrame:
    """Return what was recorded and what both models predict, for the first recording.

    Returns:
        Columns time [s], begin (the recording's first stamp), window, channel, recorded, nominal,
        identified, in the channels' units.
    """
    deviation = problem.on(recordings[:1])
    windows = deviation.windows
    keep = slice(0, max(_TRACED // windows.observed.shape[1], 1))
    nominal = deviation.prediction(problem.nominal).values[keep]
    identified = deviation.prediction(best).values[keep]
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

"""Prediction errors on recordings that were set aside, in the channels' own units."""

import numpy as np
import pandas as pd
from jaxtyping import Float

from bo_sysid.deviation.measure import Deviation
from bo_sysid.deviation.starts import fit_starts
from bo_sysid.simulation import Windows


def prediction_error(deviation: Deviation, point: Float[np.ndarray, " d"]) -> pd.DataFrame:
    """Return the residual of predictions from the measured starts, one row a channel."""
    residual, good = _residual(deviation, point, deviation.windows)
    return _table(deviation.windows, residual[good], good)


def fit_error(deviation: Deviation, point: Float[np.ndarray, " d"]) -> pd.DataFrame:
    """Return the residual with starts fitted inside the windows, one row a channel.

    The root mean square is divided by √((n - p)/n) for the p start values fitted to the n numbers
    of each window. It flatters every model: the start absorbs part of what is wrong. The honest
    figure is `forecast_error`.
    """
    windows = fit_starts(
        deviation.simulator, point, deviation.windows, 1.0 / deviation.whitening.scale
    )
    residual, good = _residual(deviation, point, windows)
    n = np.isfinite(windows.observed).sum() / len(windows)
    p = 2 * windows.start.qvel.shape[1]
    return _table(windows, residual[good] / np.sqrt(max(n - p, 1) / n), good)


def forecast_error(
    deviation: Deviation, point: Float[np.ndarray, " d"], *, past: int
) -> pd.DataFrame:
    """Return the residual of forecasts from the past alone, one row a channel.

    The start of each window is fitted to its first `past` instants; the errors are those of the
    instants after.

    Args:
        deviation: on the recordings set aside, cut into windows longer than `past`.
        point: the candidate.
        past: number of instants that the start may use.

    Raises:
        ValueError: the windows are not longer than `past`.
    """
    windows = deviation.windows
    if not 0 < past < windows.observed.shape[1]:
        raise ValueError(
            f"past {past} must be between 1 and the horizon {windows.observed.shape[1]} - 1"
        )
    known = windows.beginning(past)
    start = fit_starts(deviation.simulator, point, known, 1.0 / deviation.whitening.scale).start
    residual, good = _residual(deviation, point, windows.with_start(start))
    return _table(windows, residual[good, past:], good)


def _residual(
    deviation: Deviation, point: Float[np.ndarray, " d"], windows: Windows
) -> tuple[Float[np.ndarray, "W H c"], np.ndarray]:
    prediction = next(iter(deviation.simulator.predictions(point[None], windows)))
    return windows.residual(prediction.values), ~prediction.diverged


def _table(windows: Windows, residual: np.ndarray, good: np.ndarray) -> pd.DataFrame:
    rms = np.sqrt(np.nanmean(residual**2, axis=(0, 1))) if good.any() else np.nan
    return pd.DataFrame(
        {"channel": windows.channels, "rms": rms, "diverged": 1.0 - float(good.mean())}
    )

"""What predictions leave on recordings that were set aside, in the channels' own units."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from bo_sysid.deviation.measure import Deviation
from bo_sysid.deviation.starts import fit_starts
from bo_sysid.simulation import Windows


@dataclass(frozen=True)
class Residual:
    """What the predictions of one candidate leave.

    Attributes:
        channels: names of the `c` channels.
        values: `W x H x c` recorded minus predicted, in the channels' units; NaN where nothing was
            recorded.
        diverged: `W` flags of windows whose simulation diverged: their values mean nothing.
    """

    channels: tuple[str, ...]
    values: Float[np.ndarray, "W H c"]
    diverged: Bool[np.ndarray, " W"]

    def rms(self, windows: Bool[np.ndarray, " W"] | None = None) -> Float[np.ndarray, " c"]:
        """Return the root mean square of each channel over some windows.

        Args:
            windows: `W` flags; by default those that did not diverge.

        Returns:
            `c` numbers; NaN for a channel of which nothing was recorded in these windows.
        """
        chosen = self.values[~self.diverged if windows is None else windows]
        squares = np.nansum(chosen**2, axis=(0, 1))
        count = np.isfinite(chosen).sum(axis=(0, 1))
        return np.sqrt(np.where(count > 0, squares / np.maximum(count, 1), np.nan))


def prediction_residual(deviation: Deviation, point: Float[np.ndarray, " d"]) -> Residual:
    """Return the residual of predictions from the measured starts."""
    return _residual(deviation, point, deviation.windows)


def fit_residual(
    deviation: Deviation, point: Float[np.ndarray, " d"], dependent: int = 0
) -> Residual:
    """Return the residual with starts fitted inside the windows.

    It is divided by √((n - p)/n) for the p start values fitted in a window and n, the mean count of
    recorded numbers a window. It is optimistic for every model, as the start absorbs part of
    its error; `forecast_residual` is not.

    Args:
        deviation: on the recordings set aside.
        point: the candidate.
        dependent: coordinates that follow from others, as in closed chains; no start values of
            theirs are fitted.
    """
    windows = fit_starts(
        deviation.simulator, point, deviation.windows, 1.0 / deviation.whitening.scale
    )
    left = _residual(deviation, point, windows)
    n = np.isfinite(windows.observed).sum() / len(windows)
    p = 2 * (windows.start.qvel.shape[1] - dependent)
    return Residual(left.channels, left.values / np.sqrt(max(n - p, 1) / n), left.diverged)


def forecast_residual(
    deviation: Deviation, point: Float[np.ndarray, " d"], *, past: int
) -> Residual:
    """Return the residual of forecasts from the past alone.

    The start of each window is fitted to its first `past` instants; the residual is that of the
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
    left = _residual(deviation, point, windows.with_start(start))
    return Residual(left.channels, left.values[:, past:], left.diverged)


def _residual(deviation: Deviation, point: Float[np.ndarray, " d"], windows: Windows) -> Residual:
    prediction = next(iter(deviation.simulator.predictions(point[None], windows)))
    return Residual(windows.channels, windows.residual(prediction.values), prediction.diverged)

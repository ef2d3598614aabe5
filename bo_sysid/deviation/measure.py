r"""The deviation Δ(β): how far the model at β predicts from what was recorded.

    Δ(β) = 1/W Σ_w d_w(β),   d_w² = 1/H Σ_h Σ_c ((s'_whc - F_whc(β)) / scale_c)²

With a horizon of one instant this is the mean over all transitions of ‖W (s' - F(s, a, β))‖₂,
the error that [Zhu2018] minimises. It is the mean, not the sum: it keeps its scale as recordings
are added.

[Zhu2018] S. Zhu, A. Kimmel, K. E. Bekris, A. Boularias. Fast Model Identification via Physics
Engines for Data-Efficient Policy Search. IJCAI 2018.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import pandas as pd
from jaxtyping import Float, Int

from bo_sysid.arrays import Points
from bo_sysid.deviation.starts import fit_starts
from bo_sysid.recording import stated_for
from bo_sysid.simulation import Prediction, Simulator, Windows

PENALTY = 10.0  # a diverged window deviates by this many times the recorded range
_MOST_BLOCKS = 40
_LEAST_BLOCKS = 8  # a bootstrap of fewer says little
_BLOCK_PER_TAU = 5  # correlation times that a block lasts, where the recordings are long enough
_MIN_BLOCK_PER_TAU = 2  # times τ - 1, plus one window: shorter blocks are still correlated
_MIN_WINDOWS = 4  # of a recording, below which it says nothing of correlation
_TAU_CORRELATED = 3.0  # τ from which errors count as correlated; few windows give τ roughly
SESSIONS = 4  # from this many recordings on, a bootstrap draws recordings


@dataclass(frozen=True)
class Whitening:
    """The scale of each observed channel.

    Attributes:
        channels: names of the c channels.
        scale: `c` positive scales, in the channels' units.
        source: for each channel, "sensor noise" or "recorded spread".
    """

    channels: tuple[str, ...]
    scale: Float[np.ndarray, " c"]
    source: tuple[str, ...]

    @classmethod
    def of(cls, windows: Windows, noise: Mapping[str, float] | None = None) -> "Whitening":
        """Return the known sensor noise of each channel, else its recorded spread.

        A channel without a sample in any window has an infinite scale: it is not compared.

        Args:
            windows: gives channels and their spread.
            noise: standard deviation by channel name or by kind (``qpos``), in their units.
        """
        noise = noise or {}
        spread = _spread(windows)
        floor = np.finfo(float).tiny
        scale, source = [], []
        for k, name in enumerate(windows.channels):
            known = stated_for(name, noise, None)
            scale.append(float(known) if known else max(float(spread[k]), floor))
            source.append("sensor noise" if known else "recorded spread")
        still = np.array(scale) <= floor  # a channel that never moved has no scale of its own
        filled = np.where(still, np.inf, scale)
        return cls(windows.channels, filled, tuple(source))

    def restricted(self, channels: Sequence[str]) -> "Whitening":
        """Return the scales of some channels, in their order.

        Raises:
            KeyError: a channel has no scale here.
        """
        where = {name: k for k, name in enumerate(self.channels)}
        rows = [where[name] for name in channels]
        return Whitening(tuple(channels), self.scale[rows], tuple(self.source[row] for row in rows))

    @property
    def spread(self) -> dict[str, float]:
        """Scale of each channel that is its recorded spread, by name."""
        scales = zip(self.channels, self.scale.tolist(), self.source, strict=True)
        return {name: scale for name, scale, source in scales if source == "recorded spread"}

    def frame(self) -> pd.DataFrame:
        """Return one row a channel: its scale and where that comes from."""
        return pd.DataFrame({"channel": self.channels, "scale": self.scale, "source": self.source})


@dataclass(frozen=True)
class Blocks:
    """Stretches of the recordings that a bootstrap draws as wholes.

    Attributes:
        index: `W` block of each window.
        weight: `b` share of all windows in each block.
        session: `b` number of the recording that each block comes from; None where there are too
            few recordings to draw from.
        short: whether errors are correlated and blocks last less than twice their correlation
            time. The bootstrap is then narrower than the spread of other recordings.
    """

    index: Int[np.ndarray, " W"]
    weight: Float[np.ndarray, " b"]
    session: Int[np.ndarray, " b"] | None
    short: bool = False

    @classmethod
    def of(cls, series: Float[np.ndarray, " W"], recording: Int[np.ndarray, " W"]) -> "Blocks":
        """Return blocks five times longer than the correlation time of a series, 8 at least.

        There are fewer where there are no more windows.

        Args:
            series: `W` deviations of one candidate, in order of time within each recording.
            recording: `W` number of the recording.
        """
        tau = correlation_time([series[recording == k] for k in np.unique(recording)])
        total = np.clip(
            len(series) // max(int(np.ceil(_BLOCK_PER_TAU * tau)), 1), _LEAST_BLOCKS, _MOST_BLOCKS
        )
        index, session = blocks_of(recording, int(total))
        weight = np.bincount(index, minlength=len(session)) / len(series)
        several = len(np.unique(recording)) >= SESSIONS
        size = len(series) / len(weight)  # windows in a block
        short = tau > _TAU_CORRELATED and size < 1 + _MIN_BLOCK_PER_TAU * (tau - 1)
        return cls(index, weight, session if several else None, short and not several)


def blocks_of(
    recording: Int[np.ndarray, " W"], total: int
) -> tuple[Int[np.ndarray, " W"], Int[np.ndarray, " b"]]:
    """Return about `total` blocks of consecutive windows, none across recordings.

    Args:
        recording: `W` number of the recording of each window.
        total: how many; each recording has one at least, and as many as its share of the windows.

    Returns:
        The block of each window, and the recording of each of the `b` blocks.
    """
    index = np.empty(len(recording), int)
    session: list[int] = []
    for number in np.unique(recording):
        rows = np.flatnonzero(recording == number)
        count = int(np.clip(round(total * len(rows) / len(recording)), 1, len(rows)))
        index[rows] = len(session) + np.arange(len(rows)) * count // len(rows)
        session += [int(number)] * count
    return index, np.array(session, int)


def correlation_time(series: Sequence[Float[np.ndarray, " _"]]) -> float:
    """Return the integrated autocorrelation time of several series in samples, at least 1.

    τ = 1 + 2 Σ_k ρ_k, summed until the estimate of ρ falls below .05. Each series has its own
    mean: what differs between recordings is no correlation within them.
    """
    centred = [x - x.mean() for x in series if len(x) >= _MIN_WINDOWS]
    variance = sum(float(x @ x) for x in centred)
    if variance <= 0:
        return 1.0
    tau = 1.0
    for k in range(1, max(map(len, centred)) // 4 + 1):
        rho = sum(float(x[k:] @ x[:-k]) for x in centred) / variance
        if rho < 0.05:
            break
        tau += 2 * rho
    return tau


@dataclass(frozen=True)
class Evaluation:
    """The deviation of C candidates.

    Attributes:
        deviation: `C` values of Δ, positive and finite.
        contributions: `C x b` mean deviation over each block.
        diverged: `C` share of windows in which the simulation diverged, or whose prediction
            was off by the penalty of a diverged one.
    """

    deviation: Float[np.ndarray, " C"]
    contributions: Float[np.ndarray, "C b"]
    diverged: Float[np.ndarray, " C"]


class Deviation:
    """Δ over the candidates, on fixed recordings.

    Args:
        simulator: predicts.
        windows: what was recorded.
        whitening: scale of each channel.
        fitted_starts: whether the start of each window is fitted for each candidate (the start is
            a nuisance) or taken as measured.
    """

    def __init__(
        self,
        simulator: Simulator,
        windows: Windows,
        whitening: Whitening,
        *,
        fitted_starts: bool = False,
    ) -> None:
        self.simulator = simulator
        self.windows = windows
        self.whitening = whitening
        self.fitted_starts = fitted_starts
        self._weight = 1.0 / whitening.scale
        self._complete = bool(np.isfinite(windows.observed).all())
        self.penalty = float(PENALTY * np.linalg.norm(_extent(windows) * self._weight))

    @cached_property
    def blocks(self) -> Blocks:
        """Blocks of time, from how the errors of the candidate amid the bounds correlate."""
        middle = np.array([[(p.low + p.high) / 2 for p in self.simulator.parameters]])
        return Blocks.of(next(iter(self._norms(middle)))[0], self.windows.recording)

    def __call__(self, points: Points) -> Evaluation:
        """Return the deviation of each of the `C x d` points."""
        deviation, contributions, diverged = [], [], []
        count = np.bincount(self.blocks.index)
        for norms, flags in self._norms(points):
            deviation.append(norms.mean())
            contributions.append(np.bincount(self.blocks.index, weights=norms) / count)
            diverged.append(flags.mean())
        return Evaluation(np.array(deviation), np.array(contributions), np.array(diverged))

    def prediction(self, point: Float[np.ndarray, " d"]) -> Prediction:
        """Return what is predicted at a point, from the starts that are fitted there if asked."""
        return next(iter(self.simulator.predictions(point[None], self._started(point))))

    def _started(self, point: Float[np.ndarray, " d"]) -> Windows:
        if not self.fitted_starts:
            return self.windows
        return fit_starts(self.simulator, point, self.windows, self._weight)

    def _predictions(self, points: Points) -> Iterator[Prediction]:
        if not self.fitted_starts:
            return self.simulator.predictions(points, self.windows)
        return (self.prediction(point) for point in points)

    def _norms(self, points: Points) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """Yield for each point the `W` window norms and the `W` flags of divergence.

        A window whose prediction strays as far as a diverged one costs counts as one.
        """
        for prediction in self._predictions(points):
            residual = self.windows.residual(prediction.values)
            residual *= self._weight
            if not self._complete:
                np.nan_to_num(residual, copy=False, nan=0.0)
            norms = np.sqrt(np.einsum("whc,whc->w", residual, residual) / residual.shape[1])
            strayed = prediction.diverged | ~(norms < self.penalty)
            norms[strayed] = self.penalty
            yield norms, strayed


def _spread(windows: Windows) -> Float[np.ndarray, " c"]:
    """Return the standard deviation of each channel, 0 where nothing of it was recorded or moved.

    Of equal numbers it is 0 up to rounding alone.
    """
    observed = windows.observed.reshape(-1, len(windows.channels))
    there = np.isfinite(observed).any(axis=0)
    deviation = np.nanstd(np.where(there, observed, 0.0), axis=0)
    return np.asarray(np.where(_extent(windows) > 0, deviation, 0.0))


def _extent(windows: Windows) -> Float[np.ndarray, " c"]:
    """Return the range of each channel, 0 where nothing of it was recorded in the windows."""
    observed = windows.observed.reshape(-1, len(windows.channels))
    there = np.isfinite(observed)
    highest = np.where(there, observed, -np.inf).max(axis=0)
    lowest = np.where(there, observed, np.inf).min(axis=0)
    return np.where(there.any(axis=0), highest - lowest, 0.0)

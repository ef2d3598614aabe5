"""Smoothed traces of recorded channels, with two derivatives, at common instants.

All channels pass through one filter, a Gaussian in time, and derivatives are those of the filter:
what holds between the signals then holds between the traces, and sensor noise is suppressed alike.
"""

import copy
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import convolve1d

from bo_sysid.effects.filters import lagged
from bo_sysid.recording import Channel, Recording, noise_sigma
from bo_sysid.recording.alignment import control_steps

WIDTHS = (0.006, 0.01, 0.016, 0.024, 0.03, 0.04, 0.05, 0.07)
"""Standard deviations of the filter to choose from, in s."""
_NOISE_SHARE = 0.03  # of an acceleration, that the filter may leave
_EDGE = 4.0  # standard deviations at both ends that are not used
_APART = 1.5  # standard deviations between two instants
_FEW_INSTANTS = 20  # of a recording, that must be left away from gaps
_FEW = 4  # recordings whose noise is looked at
LATEST = 0.12
"""Largest delay that is looked for, in s."""
_HALVED = 2.0  # intervals of a filter in which every other sample is enough
_LEAST_DT = 1e-3  # [s] the grid is not finer
_MOST_GRID = 200_000


@dataclass(frozen=True)
class Trace:
    """A smoothed channel on the grid of one recording.

    Attributes:
        time: `G` even stamps in [s].
        value: `G` smoothed values.
        rate: `G` first derivatives.
        second_derivative: `G` second derivatives.
    """

    time: Float[np.ndarray, " G"]
    value: Float[np.ndarray, " G"]
    rate: Float[np.ndarray, " G"]
    second_derivative: Float[np.ndarray, " G"]

    @classmethod
    def of(
        cls, channel: Channel, grid: Float[np.ndarray, " G"], width: float, *, held: bool
    ) -> "Trace":
        """Return a channel smoothed by a Gaussian.

        Args:
            channel: the samples.
            grid: `G` even stamps.
            width: standard deviation of the filter in [s].
            held: whether a value applies until the next stamp, or was measured at its stamp.
        """
        dt = float(grid[1] - grid[0])
        if held:
            values = control_steps(channel, grid[:1] - 0.5 * dt, len(grid), dt)[0]
        else:
            values = np.interp(grid, channel.time, channel.values)
        value, rate, second_derivative = (
            convolve1d(values, kernel, mode="nearest") / dt**k
            for k, kernel in enumerate(_kernels(width / dt))
        )
        return cls(grid, value, rate, second_derivative)


class Traces:
    """The traces of all channels of some recordings, at `n` instants of all of them in a row.

    Args:
        recordings: what was recorded.
        measured: channels that say where there are samples at all; they also set the filter.
        most: most instants.
    """

    def __init__(
        self, recordings: Sequence[Recording], measured: Sequence[str], most: int = 1500
    ) -> None:
        self.recordings = tuple(recordings)
        self.measured = tuple(measured)
        self.width = _width(self.recordings, self.measured)
        share = max(most // len(self.recordings), 20)
        self.instants = tuple(
            _instants(r, self.measured, g, self.width, share)
            for r, g in zip(self.recordings, self._grids, strict=True)
        )
        self._traces: dict[tuple[str, bool, float], tuple[Trace, ...]] = {}

    @property
    def count(self) -> int:
        """Number n of instants."""
        return sum(map(len, self.instants))

    @property
    def seconds(self) -> float:
        """Length of the recordings together, in [s]."""
        return sum(float(grid[-1] - grid[0]) for grid in self._grids)

    def required_seconds(self, count: int) -> float:
        """Return how long the recordings must be together for `count` instants, in [s]."""
        ends = 2 * (_EDGE * self.width + LATEST)
        return _APART * self.width * count + ends * len(self.recordings)

    @property
    def noisiest(self) -> str:
        """The channel whose noise asks for so wide a filter; empty where the sampling does."""
        narrower = [w for w in _usable(self.recordings, self.measured) if w < self.width]
        if not narrower:
            return ""
        shares = [_noise_shares(r, self.measured, narrower[-1]) for r in self.recordings[:_FEW]]
        worst = {name: max(s.get(name, 0.0) for s in shares) for s in shares for name in s}
        return max(worst, key=worst.__getitem__, default="")

    def at(self, instants: Sequence[Float[np.ndarray, " n"]]) -> "Traces":
        """Return the same at other instants of each recording, in [s]."""
        made = copy.copy(self)
        made.instants = tuple(instants)
        return made

    @cached_property
    def _grids(self) -> tuple[Float[np.ndarray, " G"], ...]:
        return tuple(_grid(r, self.measured, self.width) for r in self.recordings)

    @cached_property
    def halves(self) -> tuple["Traces", ...]:
        """Two of every other measured sample, with noise of their own, at the same instants.

        Empty where the filter is too narrow for samples that far apart: there is little noise.
        """
        if self.width < _HALVED * max(_dt(r, self.measured) for r in self.recordings):
            return ()
        return self._half(0), self._half(1)

    def _half(self, first: int) -> "Traces":
        half = copy.copy(self)
        half.recordings = tuple(_every_other(r, self.measured, first) for r in self.recordings)
        half.__dict__["_grids"], half._traces = self._grids, {}
        return half

    def column(
        self, name: str, *, held: bool, order: int = 0, delay: float = 0.0, lag: float = 0.0
    ) -> Float[np.ndarray, " n"]:
        """Return a channel, or its first or second derivative, at the instants less a delay.

        With a time constant `lag` in [s] it is what a first-order lag makes of it.
        """
        key = (name, held, lag)
        if key not in self._traces:
            self._traces[key] = tuple(
                Trace.of(_lagged(r.channels[name], lag, g), g, self.width, held=held)
                for r, g in zip(self.recordings, self._grids, strict=True)
            )
        parts = []
        for trace, t in zip(self._traces[key], self.instants, strict=True):
            values = (trace.value, trace.rate, trace.second_derivative)[order]
            parts.append(np.interp(t - delay, trace.time, values))
        return np.concatenate(parts)


def _lagged(channel: Channel, lag: float, grid: Float[np.ndarray, " G"]) -> Channel:
    return lagged(channel, lag, float(grid[1] - grid[0])) if lag else channel


def _every_other(recording: Recording, names: Iterable[str], first: int) -> Recording:
    """Return a recording with every other sample of some channels."""
    channels = dict(recording.channels)
    for n in names:
        c = channels[n]
        channels[n] = replace(c, time=c.time[first::2], values=c.values[first::2])
    return replace(recording, channels=channels)


def _kernels(sigma: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return a Gaussian of `sigma` samples and its two derivatives, as convolution kernels.

    The moments are exact on the grid: a parabola keeps its derivatives at any `sigma`.
    """
    half = int(np.ceil(_EDGE * sigma))
    x = np.arange(-half, half + 1.0)
    g = np.exp(-0.5 * (x / sigma) ** 2)
    g /= g.sum()
    m2, m4 = float(g @ x**2), float(g @ x**4)
    return g, -x * g / m2, (x**2 - m2) * g * 2.0 / (m4 - m2**2)


def blocks(count: int, number: int = 8) -> list[Bool[np.ndarray, " n"]]:
    """Return masks of `number` stretches of equal length."""
    index = np.arange(count) * number // max(count, 1)
    return [index == k for k in range(number)]


def interval(recordings: Sequence[Recording], names: Iterable[str]) -> float:
    """Return the median interval between samples of some channels, in [s], of the slowest log."""
    held = list(names)
    return max(_dt(r, held) for r in recordings)


def _dt(recording: Recording, names: Iterable[str]) -> float:
    return float(np.median([np.median(np.diff(recording.channels[n].time)) for n in names]))


def _width(recordings: Sequence[Recording], measured: Sequence[str]) -> float:
    """Return the narrowest filter that leaves little noise in the accelerations.

    White noise σ at interval dt becomes an acceleration of σ √(3 dt / (8 √π w⁵)) after a Gaussian
    of standard deviation w.
    """
    usable = _usable(recordings, measured)
    for width in usable:
        shares = [_noise_shares(r, measured, width) for r in recordings[:_FEW]]
        if float(np.median([max(s.values(), default=0.0) for s in shares])) < _NOISE_SHARE:
            return width
    return usable[-1]


def _usable(recordings: Sequence[Recording], measured: Sequence[str]) -> Sequence[float]:
    """Return the widths that the samples resolve."""
    least = 1.5 * interval(recordings, measured)
    return [w for w in WIDTHS if w >= least] or [least]


@np.errstate(over="ignore", invalid="ignore")  # absurd values tell nothing of their noise
def _noise_shares(
    recording: Recording, measured: Sequence[str], width: float
) -> Mapping[str, float]:
    """Return by channel how much of its acceleration is noise after a filter."""
    grid = _grid(recording, measured, width)
    shares = {}
    for name in _moving_channels(recording, measured):
        c = recording.channels[name]
        second_derivative = Trace.of(c, grid, width, held=False).second_derivative
        dt = float(np.median(np.diff(c.time)))
        noise = noise_sigma(c.time, c.values) * np.sqrt(3 * dt / (8 * np.sqrt(np.pi) * width**5))
        shares[name] = noise / max(float(second_derivative.std()), np.finfo(float).tiny)
    return shares


def _moving_channels(recording: Recording, measured: Sequence[str]) -> list[str]:
    """Return the measured channels that move, and the controls that may be swapped with them."""
    names = [*measured, *(n for n in recording.channels if n.startswith("ctrl."))]
    return [n for n in names if np.ptp(recording.channels[n].values) > 0]


def _grid(recording: Recording, measured: Sequence[str], width: float) -> np.ndarray:
    first = max(recording.channels[n].time[0] for n in measured)
    last = min(recording.channels[n].time[-1] for n in measured)
    dt = min(max(_dt(recording, measured), _LEAST_DT), width / 1.5)
    count = int(np.clip((last - first) / dt, 2, _MOST_GRID))
    return np.asarray(np.linspace(first, last, count + 1))


def _instants(
    recording: Recording, measured: Sequence[str], grid: np.ndarray, width: float, most: int
) -> np.ndarray:
    """Return instants about a filter's width apart, away from the ends and from gaps.

    Next to gaps, where too few were left otherwise.
    """
    margin = _EDGE * width + LATEST
    first, last = grid[0] + margin, grid[-1] - margin
    if last - first < 2 * width:
        return grid[len(grid) // 2 :][:1]
    count = int(np.clip((last - first) / (_APART * width), 2, most))
    t = np.linspace(first, last, count)
    for clear in (_EDGE * width, 0.0):
        good = np.ones(count, bool)
        for name in measured:
            good &= _away_from_gaps(t, recording.channels[name].time, width, clear)
        if good.sum() >= _FEW_INSTANTS:
            break
    return np.asarray(t[good])


def _away_from_gaps(
    t: Float[np.ndarray, " n"], stamps: Float[np.ndarray, " m"], width: float, clear: float
) -> Bool[np.ndarray, " n"]:
    """Return which instants are neither in a gap between stamps nor within `clear` of one."""
    first, last = gap_ends(stamps, width)
    inside = np.searchsorted(first - clear, t) > np.searchsorted(last + clear, t)
    return np.asarray(~inside)


def gap_ends(
    stamps: Float[np.ndarray, " m"], width: float
) -> tuple[Float[np.ndarray, " g"], Float[np.ndarray, " g"]]:
    """Return the stamps before and after each gap that a filter of `width` in [s] feels."""
    apart = np.diff(stamps)
    gaps = np.flatnonzero(apart > 2 * width + 1.75 * float(np.median(apart)))
    return stamps[gaps], stamps[gaps + 1]

"""Clocks: what a simulation needs to know about when things were recorded.

Controls are held between their stamps, or interpolated where that was asked for, and averaged over
each simulation step, exactly; measured channels are never interpolated.
"""

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from jaxtyping import Float

from bo_sysid.arrays import Times
from bo_sysid.errors import RecordingError
from bo_sysid.recording.value import Channel, Recording

GAP = 1.75  # an interval longer than this many medians misses a sample
OTHER_RATE = 1.5  # times an interval between samples, which is another rate
_PAUSE = 20.0  # one longer than this many parts a recording: nothing is told of what lies between
_SNAP = 1e-6  # a step edge this close to a stamp, in steps, is meant to be on it


def stretches(time: Float[np.ndarray, " T"]) -> list[slice]:
    """Return the stretches of stamps between pauses, across which no motion is interpolated."""
    intervals = np.diff(time)
    parted = intervals > _PAUSE * np.median(intervals) if intervals.size else intervals > 0
    ends = [0, *(np.flatnonzero(parted) + 1).tolist(), len(time)]
    return [slice(begin, end) for begin, end in pairwise(ends)]


def control_steps(
    channel: Channel, start_times: Float[np.ndarray, " W"], n_steps: int, dt: float
) -> Float[np.ndarray, "W S"]:
    """Return the value of a channel averaged over each simulation step.

    With u(t) the zero-order hold of the samples, or their linear interpolant where the channel's
    hold is "linear", entry (w, s) is
    1/dt · ∫ u(t) dt from start_w + s·dt to start_w + (s+1)·dt. The first sample extends to before
    its stamp and the last one beyond it. A step within one hold returns the sample itself, bit for
    bit, also where rounding puts the step's edge a hair beside the stamp.

    Args:
        channel: control, goal or auxiliary input.
        start_times: `W` starts of the windows in [s].
        n_steps: number S of simulation steps.
        dt: simulation timestep in [s].

    Returns:
        `W x S` averages, in the channel's unit.

    Raises:
        RecordingError: `n_steps` or `dt` is not positive.
    """
    if n_steps < 1 or not dt > 0:
        raise RecordingError(f"n_steps {n_steps} and dt {dt:g} s must be positive")
    edges = np.asarray(start_times)[:, None] + np.arange(n_steps + 1) * dt
    if channel.hold == "linear":
        return _interpolated(channel, edges)
    edges = _snapped(edges, channel.time, _SNAP * dt + rounding(channel.time))
    left, right = edges[:, :-1], edges[:, 1:]
    stamps, values = channel.time, channel.values
    last_row = stamps.size - 1
    first = np.clip(np.searchsorted(stamps, left, side="right") - 1, 0, last_row)
    last = np.clip(np.searchsorted(stamps, right, side="left") - 1, 0, last_row)
    # integral of the hold from the first stamp to each stamp
    whole = np.concatenate([[0.0], np.cumsum(values[:-1] * np.diff(stamps))])
    after_first = np.minimum(first + 1, last_row)
    integral = (
        (stamps[after_first] - left) * values[first]
        + (whole[last] - whole[after_first])
        + (right - stamps[last]) * values[last]
    )
    return np.where(first == last, values[first], integral / (right - left))


def rounding(time: Times) -> float:
    """Return by how much in [s] a difference of time stamps may be off, in floating point.

    Of stamps that count from 1970 it is half a microsecond.
    """
    return 2.0 * float(np.spacing(np.abs(time).max()))


def _interpolated(channel: Channel, edges: Float[np.ndarray, "W _"]) -> Float[np.ndarray, "W S"]:
    """Return the mean of the linear interpolant between successive edges.

    The mean of a line between two times is its value in the middle; stamps between the edges are
    corners, so that each step is a sum of trapezoids.
    """
    stamps, values = channel.time, channel.values
    at = np.interp(edges, stamps, values)
    # integral of the interpolant from the first stamp to each stamp, and on to each edge
    whole = np.concatenate([[0.0], np.cumsum(0.5 * (values[1:] + values[:-1]) * np.diff(stamps))])
    segment = np.searchsorted(stamps, edges, side="right") - 1
    before = np.clip(segment, 0, None)
    partial = 0.5 * (at + values[before]) * (edges - stamps[before])
    same_segment = segment[:, 1:] == segment[:, :-1]
    across = np.diff(whole[before] + partial, axis=1) / np.diff(edges, axis=1)
    return np.asarray(np.where(same_segment, 0.5 * (at[:, 1:] + at[:, :-1]), across))


def _snapped(times: np.ndarray, stamps: Times, tolerance: float) -> np.ndarray:
    """Return `times`, those within `tolerance` of a stamp moved onto it."""
    after = np.clip(np.searchsorted(stamps, times), 1, stamps.size - 1)
    before = after - 1
    nearer = np.where(
        np.abs(times - stamps[before]) <= np.abs(times - stamps[after]), before, after
    )
    return np.where(np.abs(times - stamps[nearer]) <= tolerance, stamps[nearer], times)


@dataclass(frozen=True)
class Sampling:
    """How a clock ticks.

    Attributes:
        median_dt: median interval in [s].
        jitter: spread of the intervals about the median, 1.4826·MAD of those that are not gaps,
            in [s].
        gaps: number of intervals longer than `GAP` medians.
        missing: samples that would fill the gaps at the median interval.
        longest: longest interval in [s].
    """

    median_dt: float
    jitter: float
    gaps: int
    missing: int
    longest: float

    @classmethod
    def of(cls, time: Times) -> "Sampling":
        """Return the sampling of `T` increasing time stamps in [s], T at least 2."""
        intervals = np.diff(time)
        median = float(np.median(intervals))
        gap = intervals > GAP * median
        missing = np.rint(intervals[gap] / median) - 1
        return cls(
            median_dt=median,
            jitter=float(1.4826 * np.median(np.abs(intervals[~gap] - median))),
            gaps=int(gap.sum()),
            missing=int(missing.sum()),
            longest=float(intervals.max()),
        )


def interval_of(recording: Recording, channels: Collection[str]) -> float:
    """Return the median interval in [s] of the fastest of some channels, NaN without any."""
    times = [c.time for n, c in recording.channels.items() if n in channels and len(c.time) > 1]
    return min((float(np.median(np.diff(t))) for t in times), default=float("nan"))


def rates_note(recordings: Sequence[Recording], channels: Collection[str]) -> tuple[str, ...]:
    """Return what recordings of different rates mean for windows of one number of samples."""
    every = {r.name: interval_of(r, channels) for r in recordings}
    every = {name: dt for name, dt in every.items() if np.isfinite(dt)}
    slow, fast = (f(every, key=every.__getitem__, default="") for f in (max, min))
    if not every or every[slow] < OTHER_RATE * every[fast]:
        return ()
    return (
        f"{fast} is sampled every {every[fast]:.3g} s and {slow} every {every[slow]:.3g} s: "
        "windows have as many samples in each, and so are of different length.",
    )


def instants_each(
    horizon: int, interval: float, recordings: Sequence[Recording], channels: Collection[str]
) -> list[int]:
    """Return how many instants of each recording last as long as a window usually does.

    Args:
        horizon: instants of a usual window.
        interval: usual one in [s] from one instant to the next.
        recordings: of which those of another rate have another number.
        channels: by name, whose samples are instants.
    """
    each = []
    for r in recordings:
        ratio = interval_of(r, channels) / interval
        other = ratio > OTHER_RATE or ratio < 1 / OTHER_RATE
        each.append(instants_in(horizon * interval, [r], channels) if other else horizon)
    return each


def instants_in(length: float, recordings: Sequence[Recording], channels: Collection[str]) -> int:
    """Return how many instants `length` seconds have, counted as windows are.

    Those are the instants at which any of some channels has a sample: a hundred positions and a
    thousand forces in a second are a thousand instants at least. Gaps do not count.

    Args:
        length: of a window in [s].
        recordings: where the channels are looked for.
        channels: by name; those that a recording lacks are passed over.

    Returns:
        One or more.

    Raises:
        RecordingError: no recording has two samples of any of the channels.
    """
    steps = []
    for r in recordings:
        times = [c.time for n, c in r.channels.items() if n in channels]
        time = np.unique(np.concatenate(times)) if times else np.empty(0)
        if len(time) > 1:
            inside = np.searchsorted(time, time + length) - np.arange(len(time)) - 1
            m = int(np.clip(np.median(inside), 1, len(time) - 1))
            steps.append((time[m:] - time[:-m]) / m)
    if not steps:
        names = ", ".join(r.name for r in recordings)
        raise RecordingError(f"{names}: no samples of {', '.join(sorted(channels))}")
    return max(round(length / float(np.median(np.concatenate(steps)))), 1)

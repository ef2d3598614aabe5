"""Samples of a position that leave both neighbours and come back: codes for "none", dropouts.

A joint that moves so fast as to jump moves fast before or after as well. A sample, or a few, is
therefore told where it jumps out and back by `CLEAR` times the largest step that the rest of the
log takes; that step is noise, an impact or a slip where there are any. (A Hampel filter, which asks
how far the local median is in units of the local spread, takes impacts and slips for outliers.) A
joint at rest may be knocked and back within a sample, and must jump by `_ALONE` times as much.
Nothing is left out or altered. Rows count from 0.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from bo_sysid.arrays import Samples, Times
from bo_sysid.recording.alignment import GAP

PERIODS = (2 * np.pi, np.pi, 360.0, 1.0, 256.0, 1024.0, 4096.0, 65536.0)
"""Jumps that are a turn: in radians, degrees, turns, encoder ticks."""
CLEAR = 5.0
"""Times the largest other step, that a jump exceeds."""
_LONGEST, _SECONDS = 5, 0.1  # samples, and [s] that they last: for longer a joint may go and return
_ALONE = 100.0  # where nothing else moves as far: a joint at rest may be knocked
_FEW = 20  # samples, of which nothing is told
_SHARE = 0.02  # of the samples at most: many are no outliers
_BACK = 0.25  # of the jump, between the neighbours
_SHOWN = 3  # places and values that are named


@dataclass(frozen=True)
class Outlier:
    """Samples that stand apart.

    Attributes:
        first: row of the first one.
        last: row of the last one.
    """

    first: int
    last: int


@np.errstate(over="ignore", invalid="ignore")
def find_outliers(time: Times, values: Samples) -> tuple[Outlier, ...]:
    """Return where a position jumps and comes back; a wrapped angle does so without being wrong.

    Args:
        time: `T` increasing stamps in [s].
        values: `T` samples.
    """
    if len(values) < _FEW:
        return ()
    runs = _returning(time, values)[: max(2, int(_SHARE * len(values)))]
    steps = np.abs(np.diff(values))
    intervals = np.diff(time)
    steps[intervals > GAP * np.median(intervals)] = 0.0  # over a gap a joint may move by anything
    rank = np.full(steps.size, len(runs))  # of the largest jump that a step is part of
    for k in range(len(runs) - 1, -1, -1):
        rank[int(runs[k, 0]) - 1 : int(runs[k, 1]) + 1] = k
    largest = np.zeros(len(runs) + 1)
    np.maximum.at(largest, rank, steps)
    rest = np.maximum.accumulate(largest[::-1])[::-1][1:]  # what is left beside the first k + 1
    clear = np.flatnonzero((rest > 0) & (runs[:, 2] > CLEAR * rest))
    if not clear.size:
        return ()
    outlying, other = runs[: clear[-1] + 1], float(rest[clear[-1]])
    rows = [np.arange(first, last + 1) for first, last in outlying[:, :2].astype(int)]
    least, moved = float(outlying[-1, 2]), float(np.ptp(np.delete(values, np.concatenate(rows))))
    if _is_turn(values, outlying[:, 2], other) or moved < least < _ALONE * other:
        return ()
    return _joined(np.unique(np.concatenate(rows)))


def _returning(time: Times, values: Samples) -> Float[np.ndarray, "r 3"]:
    """Return short runs that leave both neighbours on one side: first and last row, size.

    The largest jumps stand first.
    """
    intervals = np.diff(time)
    usual = float(np.median(intervals))
    found = [np.empty((0, 3))]
    for length in range(1, min(_LONGEST, int(_SECONDS / usual + 0.01)) + 1):
        inside = np.lib.stride_tricks.sliding_window_view(values, length)[1:-1]
        before, after = values[: -length - 1], values[length + 1 :]
        out, back = inside[:, 0] - before, inside[:, -1] - after
        size = np.minimum(np.abs(out), np.abs(back))
        spans = np.lib.stride_tricks.sliding_window_view(intervals, length + 1).max(axis=1)
        apart = ((inside - before[:, None]) * np.sign(out)[:, None]).min(axis=1) >= 0.5 * size
        kept = (out * back > 0) & (np.abs(after - before) <= _BACK * size) & apart
        first = np.flatnonzero(kept & (spans <= GAP * usual)) + 1
        found.append(np.stack([first, first + length - 1, size[first - 1]], axis=1))
    runs = np.concatenate(found)
    return np.asarray(runs[np.argsort(-runs[:, 2], kind="stable")])


def _is_turn(values: Samples, sizes: Float[np.ndarray, " r"], step: float) -> bool:
    """Whether jumps lead from one end of a turn to the other, as noise does at its ends."""
    spread = float(np.ptp(values))
    return any(
        spread <= p + step and bool((np.abs(sizes - p) <= CLEAR * step).all())
        for p in (*PERIODS, 2.0**32)
    )


def _joined(rows: np.ndarray) -> tuple[Outlier, ...]:
    parts = np.split(rows, np.flatnonzero(np.diff(rows) > 1) + 1)
    return tuple(Outlier(int(p[0]), int(p[-1])) for p in parts)


def in_words(found: Sequence[Outlier], written: Samples, rows: Sequence[int] | np.ndarray) -> str:
    """Return where a position jumps to and back from, such as ``-9999 and back in rows 4-5``.

    Args:
        found: the outliers.
        written: `T` samples, as the file has them.
        rows: of the file, in which the samples stand.
    """
    to = list(dict.fromkeys(f"{written[o.first]:.4g}" for o in found))
    places = [
        f"{rows[o.first]}" if o.first == o.last else f"{rows[o.first]}-{rows[o.last]}"
        for o in found[:_SHOWN]
    ]
    several = "s" if sum(o.last - o.first + 1 for o in found) > 1 else ""
    values = ", ".join(to[:_SHOWN]) + (", …" if len(to) > _SHOWN else "")
    more = f" and {len(found) - _SHOWN} more" if len(found) > _SHOWN else ""
    return f"{values} and back in row{several} {', '.join(places)}{more}"

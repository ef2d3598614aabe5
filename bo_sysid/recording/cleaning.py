"""Messy but usable logs: what is dropped, what is kept, and what is refused.

Duplicate stamps: the first sample is kept; where a rule skips empty cells, the first that is not
empty, for a merged log may write its channels in rows of their own. Gaps, dropped samples and
jitter: kept as recorded, for predictions are compared at the recorded instants. A measurement is
never invented: nothing that is predicted is interpolated, resampled or filled, and what a slow
sensor showed before is no measurement of later rows (`repeats`). Time that runs
backwards, a value that is not finite and an empty cell that no rule explains are errors. Rows count
from 0.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool

from bo_sysid.errors import RecordingError
from bo_sysid.recording.alignment import GAP, Sampling
from bo_sysid.recording.value import COARSE, Channel, Hold

JITTER = 0.05  # intervals that spread by more than this share of their median are mentioned
_RUNS, _REGULAR = 20, 0.9  # runs of equal values at least; share of them that is as long as usual
_LOST = 0.05  # share of the samples that a coarse clock loses
_KEPT: Mapping[Hold, str] = {
    "zero": "the value before it is held",
    "linear": "what lies between is interpolated",
    "none": "no measurement was made up",
}


@dataclass(frozen=True)
class Clock:
    """The time stamps of a column.

    Attributes:
        column: name of the column.
        length: cells of the column.
        stamps: time of each cell in [s], up to the last one that is not empty.
        rows: rows that are used: the first of each run of equal stamps.
    """

    column: str
    length: int
    stamps: np.ndarray
    rows: np.ndarray

    @property
    def duplicates(self) -> np.ndarray:
        """Rows that repeat the stamp before them."""
        return np.setdiff1d(np.arange(self.stamps.size), self.rows)


def read_clock(column: str, stamps: np.ndarray, where: str) -> Clock:
    """Validate the time stamps of a column.

    Args:
        column: name of the column.
        stamps: time stamps in [s]; NaN is an empty cell, which may only stand at the end.
        where: file and column, for messages.

    Raises:
        RecordingError: an empty cell, a stamp that is not finite, time that runs backwards, or
            fewer than two different stamps.
    """
    filled = np.flatnonzero(~np.isnan(stamps))
    used = stamps[: filled[-1] + 1] if filled.size else stamps[:0]
    bad = np.flatnonzero(~np.isfinite(used))
    if bad.size:
        raise RecordingError(
            f"{where}: row {bad[0]} is {_shown(used[bad[0]])}; every sample needs a finite time "
            "stamp"
        )
    steps = np.diff(used)
    backwards = np.flatnonzero(steps < 0)
    if backwards.size:
        row = int(backwards[0]) + 1
        raise RecordingError(
            f"{where}: time runs backwards in row {row}, from {used[row - 1]:.9g} s to "
            f"{used[row]:.9g} s; time stamps must increase (two logs in one file? another clock?)"
        )
    rows = np.concatenate([[0], np.flatnonzero(steps > 0) + 1]) if used.size else np.empty(0, int)
    if rows.size < 2:
        raise RecordingError(
            f"{where}: {used.size} rows hold {rows.size} different time stamps; at least 2 are "
            "needed"
        )
    return Clock(column, len(stamps), used, rows)


def usable_rows(
    values: np.ndarray, clock: Clock, where: str, *, hold: Hold, skip_missing: bool
) -> tuple[np.ndarray, list[str]]:
    """Return the rows of a column that become samples, and what is to be said about them.

    Args:
        values: samples as numbers; NaN is an empty cell.
        clock: the clock of the column.
        where: file, channel and column, for messages.
        hold: what the value does between its samples.
        skip_missing: whether an empty cell means that the row holds no new sample.

    Raises:
        RecordingError: lengths do not match, or a value is empty or not finite.
    """
    notes = []
    size = clock.stamps.size
    if hold != "none" and len(values) == clock.length - 1:
        size = min(size, len(values))
        notes.append("one sample fewer than time stamps; the last stamp has no value")
    elif len(values) != clock.length:
        raise RecordingError(
            f"{where}: {len(values)} samples, but its clock, column {clock.column!r}, has "
            f"{clock.length} stamps; they must be of one length"
        )
    beyond = np.flatnonzero(~np.isnan(values[size:]))
    if beyond.size:
        raise RecordingError(
            f"{where}: row {size + beyond[0]} has a value but no time stamp in column "
            f"{clock.column!r}"
        )
    rows = clock.rows[clock.rows < size]
    if skip_missing:
        filled = _first_filled(values[:size], rows)
        missing, rows = rows.size - filled.size, filled
        if missing:
            notes.append(f"{_counted(missing, 'empty cell')} skipped; {_KEPT[hold]}")
    bad = rows[~np.isfinite(values[rows])]
    if bad.size:
        remedy = (
            ". Where an empty cell means that nothing new was recorded, say `missing: skip` for "
            "this channel under columns:"
        )
        raise RecordingError(
            f"{where}: row {bad[0]} is {_shown(values[bad[0]])}; every sample must be a finite "
            f"number ({bad.size} of {len(values)} are not)"
            + (remedy if np.isnan(values[bad[0]]) else "")
        )
    if rows.size < 2:
        raise RecordingError(f"{where}: {rows.size} samples; at least 2 are needed")
    return rows, notes


def repeats(values: np.ndarray) -> Bool[np.ndarray, " n"]:
    """Return which samples repeat the one before since their sensor is slower than its log.

    Values then stand for equally many rows each, as far as they change at all, and change by more
    than an encoder's step: one that turns steadily, a step at a time, is read anew in every row.

    Args:
        values: `n` samples of a measured channel, in the order of their stamps.
    """
    same = np.append(False, values[1:] == values[:-1])
    begins = np.flatnonzero(~same)
    runs = np.diff(begins)[1:]  # without the first and the last, which the log may cut
    if len(runs) < _RUNS or np.median(runs) < 2:
        return np.zeros(len(values), bool)
    usual = np.abs(runs - np.median(runs)) <= max(1.0, 0.25 * float(np.median(runs)))
    steps = np.abs(np.diff(values[begins]))
    stepwise = np.median(steps) < 1.5 * steps.min()
    if usual.mean() < _REGULAR or stepwise:
        return np.zeros(len(values), bool)
    return same


def coarse_clock(values: np.ndarray, clock: Clock, rows: np.ndarray, channel: str) -> list[str]:
    """Return a sentence where stamps are repeated though what they stamp goes on.

    Args:
        values: samples as numbers.
        clock: their clock.
        rows: those that are used.
        channel: for the sentence.
    """
    dropped = clock.duplicates[clock.duplicates < len(values)]
    kept = rows[np.maximum(np.searchsorted(rows, dropped) - 1, 0)]
    lost = int((values[dropped] != values[kept]).sum())
    if lost <= _LOST * len(values):
        return []
    return [
        f"{COARSE}{clock.column!r}: {lost} of {len(values)} samples of {channel} have the stamp of "
        "one before them and another value, and are lost. Where rows came at a steady rate, count "
        "them instead: columns: {time: {rate: …}}, in Hz."
    ]


def _first_filled(values: np.ndarray, first: np.ndarray) -> np.ndarray:
    """Return the first row with a value of each run of equal stamps, given their first rows."""
    filled = np.flatnonzero(~np.isnan(values))
    runs = np.searchsorted(first, filled, side="right")
    return filled[np.unique(runs, return_index=True)[1]]


def clock_flaws(clock: Clock, dropped: np.ndarray, measured: Iterable[np.ndarray]) -> list[str]:
    """Return a sentence for each thing that is messy about a clock.

    A clock of held channels only may repeat stamps and pause: a command was not sent again. In a
    merged log the rows of commands say nothing about how steadily positions were sampled.

    Args:
        clock: the clock.
        dropped: rows with a sample that was dropped, for it repeats a stamp.
        measured: rows of its measured channels, those once that several channels share.
    """
    sampled = [Sampling.of(clock.stamps[rows]) for rows in measured]
    if not sampled:
        return []
    sentences = []
    name = f"Clock {clock.column!r}"
    if dropped.size:
        sentences.append(
            f"{name}: {_counted(dropped.size, 'duplicate stamp')}; the first sample of each was "
            f"kept (dropped: rows {_listed(dropped)})."
        )
    for s in sampled:
        if s.gaps:
            sentences.append(
                f"{name}: {_counted(s.gaps, 'gap')} longer than {GAP:g} x {s.median_dt:.4g} s, "
                f"the longest {s.longest:.4g} s, about {_counted(s.missing, 'sample')} missing; "
                "nothing was filled in."
            )
        if s.jitter > JITTER * s.median_dt:
            sentences.append(
                f"{name}: intervals jitter by {s.jitter:.2g} s about {s.median_dt:.4g} s; samples "
                "are used at their own stamps."
            )
    return sentences


def motion_flaws(source: str, channels: Mapping[str, Channel]) -> list[str]:
    """Return a sentence about measured channels that never move.

    Raises:
        RecordingError: no position moves (no measured channel where positions were not recorded).
    """
    measured = {n: c for n, c in channels.items() if not c.continuous}
    frozen = [n for n, c in measured.items() if np.ptp(c.values) == 0]
    positions = [n for n in measured if n.startswith("qpos.")] or list(measured)
    if set(positions) <= set(frozen):
        first = measured[positions[0]]
        raise RecordingError(
            f"{source}: {', '.join(positions)} never moves (all {first.values.size} samples are "
            f"{first.values[0]:g}); nothing can be learned from it. Is it the right column?"
        )
    if not frozen:
        return []
    return [f"Never moves: {', '.join(frozen)}; nothing can be said about it."]


def refuse(source: str, flaws: Sequence[str]) -> None:
    """Raise `RecordingError` with all `flaws`, if there are any."""
    if flaws:
        raise RecordingError(f"{source}: refused because of --strict. {' '.join(flaws)}")


def _listed(rows: np.ndarray, most: int = 5) -> str:
    shown = ", ".join(str(r) for r in rows[:most])
    return shown + (", …" if rows.size > most else "")


def _counted(number: int, what: str) -> str:
    return f"{number} {what}" + ("" if number == 1 else "s")


def _shown(value: float) -> str:
    return "empty (NaN)" if np.isnan(value) else f"{value:g}"

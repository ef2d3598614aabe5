"""Where windows begin: at instants of which everything is known that a prediction starts from."""

from collections.abc import Mapping

import numpy as np
from jaxtyping import Bool, Float, Int

from bo_sysid.errors import RecordingError
from bo_sysid.recording import Channel

_GAP = 1.5  # a window longer than this many median windows spans a gap and is left out
_PAUSE = 0.15  # [s] beyond the usual interval, that is a gap in a window of any length
_LATE = 1.5  # samples of an input: by more than these it begins after a window, or ends before
_LEFT = 0.5  # of the windows, that must be left without those that begin before a drive forgot
_STEADY, _MANY = 0.9, 10  # share and number of short intervals of what is sent all the time


def window_starts(
    name: str,
    time: Float[np.ndarray, " T"],
    complete: Bool[np.ndarray, " T"],
    horizon: int,
    stride: int,
    inputs: Mapping[str, Channel],
    memory: Mapping[str, float],
) -> tuple[Int[np.ndarray, " W"], tuple[str, ...]]:
    """Return the instants where windows begin, and what was left out, in words.

    Args:
        name: of the recording.
        time: the instants at which something was measured, in [s].
        complete: whether every joint position was.
        horizon: number of instants after each start.
        stride: instants from one start to the next.
        inputs: recorded controls and signals, by channel.
        memory: for how long in [s] an input of before its first one acts, by channel.

    Raises:
        RecordingError: no window fits, or all begin before an input.
    """
    first, uncovered = _spread(name, complete, horizon, stride)
    first, gaps = _without_gaps(name, time, first, horizon)
    first, unheard = _with_inputs(name, time, first, horizon, inputs)
    first, remembered = _without_memory(name, time, first, inputs, memory)
    return first, gaps + uncovered + unheard + remembered


def _spread(
    name: str, complete: Bool[np.ndarray, " T"], horizon: int, stride: int
) -> tuple[Int[np.ndarray, " W"], tuple[str, ...]]:
    """Return the instants where windows start: complete ones, as soon as `stride` allows."""
    limit = len(complete) - horizon
    first = np.arange(0, max(limit, 0), stride)
    if not complete[first].all():
        there = np.flatnonzero(complete[: max(limit, 0)])
        following = np.searchsorted(there, there + stride)
        picked, k = [], 0
        while k < len(there):
            picked.append(k)
            k = int(following[k])
        first = there[picked]
    if limit <= 0:
        raise RecordingError(
            f"{name}: {len(complete)} instants are too few for a window of {horizon} "
            "(deviation.horizon, where `identify` or `learn` cuts it)"
        )
    if not first.size:
        raise RecordingError(
            f"{name}: no instant has every joint position, where a window of {horizon} could begin"
        )
    reach = max(stride, horizon)
    lost = int(np.maximum(np.diff(first, prepend=-reach, append=limit) - reach, 0).sum())
    note = (
        f"{name}: {lost} of {len(complete)} instants are predicted by no window, for one starts "
        "only where every joint position was recorded"
    )
    return first, (note,) if lost else ()


def _without_gaps(
    name: str, time: np.ndarray, first: Int[np.ndarray, " W"], horizon: int
) -> tuple[Int[np.ndarray, " kept"], tuple[str, ...]]:
    """Leave out windows in which nothing was recorded for a while, unless that is usual.

    A long window is hardly longer for a gap in which commands are held that nobody knows.
    """
    length = time[first + horizon] - time[first]
    whole = length <= _GAP * np.median(length)
    intervals = np.diff(time)
    pauses = np.append(0, np.cumsum(intervals > np.median(intervals) + _PAUSE))
    steady = whole & (pauses[first + horizon] == pauses[first])
    whole = steady if steady.any() else whole
    lost = int((~whole).sum())
    note = f"{name}: {lost} of {len(first)} windows span a gap in the recording and are left out"
    return first[whole], (note,) if lost else ()


def _with_inputs(
    name: str,
    time: np.ndarray,
    first: Int[np.ndarray, " W"],
    horizon: int,
    inputs: Mapping[str, Channel],
) -> tuple[Int[np.ndarray, " kept"], tuple[str, ...]]:
    """Leave out windows in which an input was not recorded yet, or no more.

    Nobody knows what acted there. An input that is sent only where it changes holds at its end.
    """
    notes = []
    for channel, values in inputs.items():
        intervals = np.diff(values.time)
        reach = _LATE * float(np.median(intervals))
        short = intervals <= reach
        steady = short.sum() >= max(_MANY, _STEADY * len(short))
        late_at_most = reach if steady else _LATE * float(np.median(np.diff(time)))
        begun = time[first] >= values.time[0] - late_at_most
        ended = time[first + horizon] > values.time[-1] + (reach if steady else np.inf)
        late, early = values.time[0] - time[0], time[-1] - values.time[-1]
        for out, fault in (
            (~begun, f"{name}: {channel} begins {late:.3g} s after the measurements"),
            (ended, f"{name}: {channel} ends {early:.3g} s before the measurements"),
        ):
            if out.all():
                raise RecordingError(
                    f"{fault}, which last {time[-1] - time[0]:.3g} s: no window is left. Do their "
                    "clocks count from the same moment?"
                )
            if lost := np.count_nonzero(out):
                notes.append(f"{fault}; {lost} of {len(first)} windows lack it and are left out")
        if (~begun | ended).all():
            raise RecordingError(f"{name}: no window lies where {channel} was recorded")
        first = first[begun & ~ended]
    return first, tuple(notes)


def _without_memory(
    name: str,
    time: np.ndarray,
    first: Int[np.ndarray, " W"],
    inputs: Mapping[str, Channel],
    memory: Mapping[str, float],
) -> tuple[Int[np.ndarray, " kept"], tuple[str, ...]]:
    """Leave out windows in which a drive acts on what was sent before a log began.

    A lag that follows its first command as if it had always been sent may be far off. Where too few
    windows would be left, half of that time has to do, or none.
    """
    for share in (1.0, 0.5):
        until = {n: inputs[n].time[0] + share * s for n, s in memory.items() if n in inputs}
        known = time[first] >= max(until.values(), default=-np.inf) - 1e-9
        if known.all():
            break
        if np.count_nonzero(known) >= _LEFT * len(first):
            last = max(until, key=until.__getitem__)
            note = (
                f"{name}: {np.count_nonzero(~known)} of {len(first)} windows begin less than "
                f"{until[last] - time[0]:.2g} s after the log and are left out: what {last} drives "
                f"still acts on what was sent before, unless {last.replace('ctrl.', 'act.', 1)} is "
                "recorded"
            )
            return first[known], (note,)
    return first, ()

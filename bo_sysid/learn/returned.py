"""Whether a recording that a person returned may be what was asked for."""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from bo_sysid.errors import RecordingError
from bo_sysid.recording import READERS, Recording

_BEYOND = 0.1  # of the commands' range, that noise of a measured torque may add
_RARE = 0.05  # share of the samples that may be beyond all the same
_SLOW = 1.5  # control steps between samples, from which commands are lost


def unread(place: Path) -> str:
    """Return a line about other files where one is waited for; empty where there are none.

    Args:
        place: of the file that is waited for, without its ending.
    """
    ours, endings = ("first-", "trajectory-"), tuple(READERS)
    files = [p for p in sorted(place.parent.glob("[!.]*")) if p.is_file()]
    known = [p for p in files if p.name.startswith(ours) and p.name.endswith(endings)]
    same_number = [p for p in known if _number(p) == _number(place)]  # trajectory-1.csv
    named = [p.name for p in files if p not in known or p in same_number]
    if not named:
        return ""
    are = "is" if len(named) == 1 else "are"
    return (
        f"- {', '.join(named)} in {place.parent} {are} not read: the recording must be called "
        f"{place.name}.parquet (or .csv, .npz, .mat)."
    )


def _number(path: Path) -> int | None:
    digits = path.name.split(".")[0].rpartition("-")[2]
    return int(digits) if digits.isdecimal() else None


def require_commands_within(recording: Recording, about: Mapping[str, Any], file: Path) -> None:
    """Refuse commands that the policy cannot have given.

    Args:
        recording: as the study's rules read it.
        about: content of the policy's JSON file: actuators, low, high.
        file: that it was read from.

    Raises:
        RecordingError: the message names file, channel and range.
    """
    for name, low, high in zip(about["actuators"], about["low"], about["high"], strict=True):
        channel = recording.channels.get(f"ctrl.{name}")
        if channel is None:
            continue
        margin = _BEYOND * (high - low)
        beyond = (channel.values < low - margin) | (channel.values > high + margin)
        if beyond.mean() > _RARE:
            raise RecordingError(
                f"{file}: ctrl.{name} goes from {channel.values.min():.4g} to "
                f"{channel.values.max():.4g}, and this policy's commands are clipped to "
                f"[{low:g}, {high:g}]: another unit (recordings: columns), another column, or "
                "another recording"
            )


def require_new(recording: Recording, others: Iterable[Recording], file: Path) -> None:
    """Refuse a recording that is there already.

    Raises:
        RecordingError: its positions are those of another one, sample by sample.
    """
    for other in others:
        shared = [n for n in recording.channels if n.startswith("qpos.") and n in other.channels]
        pairs = [(recording.channels[n].values, other.channels[n].values) for n in shared]
        if pairs and all(_same(a, b) for a, b in pairs):
            raise RecordingError(
                f"{file}: the positions are those of {other.name}, which was used already; put "
                "what the machine did under this policy there"
            )


def _same(one: np.ndarray, other: np.ndarray) -> bool:
    count = min(len(one), len(other))
    return bool(np.array_equal(one[:count], other[:count]))


def with_lost_commands(recording: Recording, step: float) -> Recording:
    """Return a recording, noting where commands are rarer than the policy gave them.

    Args:
        recording: of a policy.
        step: time in [s] between two of its commands.
    """
    notes = [
        f"{recording.name}: ctrl.{name} was recorded every {interval:.3g} s, and the policy acts "
        f"every {step:g} s: what it commanded in between is lost. Record at least as often."
        for name, channel in recording.of_kind("ctrl").items()
        if len(channel.time) > 1
        and (interval := float(np.median(np.diff(channel.time)))) > _SLOW * step
    ]
    return recording.with_notes(notes) if notes else recording

"""The value of a recording: channels by name, each with a clock of its own."""

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any, Literal, TypeVar

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike

from bo_sysid.arrays import Samples, Times
from bo_sysid.errors import RecordingError, nearest
from bo_sysid.recording.numbers import numbers, stamps

KINDS = ("qpos", "qvel", "act", "ctrl", "goal", "sensor", "aux")
HELD_KINDS = frozenset({"act", "ctrl", "goal", "aux"})
_NAMED = {
    **dict.fromkeys(("qpos", "qvel"), "joint"),
    **dict.fromkeys(("act", "ctrl", "goal"), "actuator"),
    "sensor": "sensor",
}  # what of a model a channel is named after
_Value = TypeVar("_Value")
_Otherwise = TypeVar("_Otherwise")
_INDEX = re.compile(r"\.\d+$")
_NAME = re.compile(rf"({'|'.join(KINDS)})\.[^\s]+")

UNUSED = "Columns not used: "
"""What the note of a recording begins with that lists them."""

COARSE = "Coarse clock "
"""What the note of a recording begins with whose clock stamps several samples alike."""

Hold = Literal["none", "zero", "linear"]
UNNAMED = "recording"
"""Name of a recording that was given none; written to a file, it takes that file's."""


@dataclass(frozen=True)
class Channel:
    """Samples of one quantity.

    Attributes:
        time: `T` strictly increasing time stamps in [s].
        values: `T` finite samples, in `unit`.
        unit: unit of `values` as the model has it (rad, m, rad/s, N m, …); may be empty.
        source: where the samples came from, for messages.
        hold: "zero" where the value applies from its stamp until the next one (controls, goals,
            auxiliary inputs); "linear" where such an input changes all the time and was sampled at
            the stamp (a measured duty, current or voltage); "none" where it was measured at the
            stamp and says nothing between.
        converted: unit that the samples were converted from; empty where they were in `unit`.
    """

    time: Times
    values: Samples
    unit: str = ""
    source: str = ""
    hold: Hold = "none"
    converted: str = ""

    def __post_init__(self) -> None:
        time = _frozen(self.time)
        values = _frozen(self.values)
        where = self.source or "channel"
        if time.ndim != 1 or time.shape != values.shape:
            raise RecordingError(
                f"{where}: time stamps {time.shape} and values {values.shape} must be two vectors "
                "of one length"
            )
        if time.size < 2:
            raise RecordingError(f"{where}: {time.size} samples; at least 2 are needed")
        _require_finite(time, where, "time stamp")
        _require_finite(values, where, "value")
        backwards = np.flatnonzero(np.diff(time) <= 0)
        if backwards.size:
            k = int(backwards[0]) + 1
            raise RecordingError(
                f"{where}: time stamps must increase; row {k} has {time[k]:g} s after "
                f"{time[k - 1]:g} s"
            )
        object.__setattr__(self, "time", time)
        object.__setattr__(self, "values", values)

    @property
    def continuous(self) -> bool:
        """Whether it has a value between its stamps, as inputs have: held or interpolated."""
        return self.hold != "none"

    def at(self, time: Times) -> Samples:
        """Return the value at each of `time`, held or interpolated; beyond the ends, that there."""
        if self.hold == "linear":
            return np.asarray(np.interp(time, self.time, self.values))
        row = np.searchsorted(self.time, time, side="right") - 1
        return np.asarray(self.values[np.clip(row, 0, None)])


@dataclass(frozen=True)
class Recording:
    """What was recorded of one trajectory of a machine; validated once, when made.

    Channel names follow the column convention: ``qpos.<joint>``, ``qvel.<joint>``,
    ``act.<actuator>``, ``ctrl.<actuator>``, ``goal.<actuator>``, ``sensor.<name>``, ``aux.<name>``;
    a joint with several coordinates adds an index, ``qpos.root.3``.

    Attributes:
        name: a short name, for messages and tables.
        channels: channel by name.
        notes: what was done to the data on the way in, one sentence each.
        begin: time at which the log began in [s], where this is a part of one.
    """

    name: str
    channels: Mapping[str, Channel]
    notes: tuple[str, ...] = ()
    begin: float | None = None

    def __post_init__(self) -> None:
        if not self.channels:
            raise RecordingError(f"{self.name}: a recording needs at least one channel")
        for name in self.channels:
            if wrong := wrong_name(name):
                raise RecordingError(
                    f"{self.name}: channel {name!r} must be named <kind>.<name>; {wrong}"
                )
        object.__setattr__(self, "channels", MappingProxyType(dict(self.channels)))

    def hint(self, missing: str) -> str:
        """Return what may stand for a channel that is not there: those nearest, unused columns."""
        unused = [n[0].lower() + n[1:-1] for n in self.notes if n.startswith(UNUSED)]
        near = nearest(missing, self.channels)
        return "; ".join([near.replace("valid:", "it has", 1) if unused else near, *unused])

    @classmethod
    def from_arrays(
        cls,
        time: ArrayLike,
        *,
        name: str = UNNAMED,
        units: Mapping[str, str] | None = None,
        **kinds: Mapping[str, ArrayLike],
    ) -> "Recording":
        """Make a recording from arrays that share one clock.

        Args:
            time: `T` time stamps: numbers in [s], dates or durations.
            name: a short name.
            units: unit by channel name, where known.
            **kinds: for each kind of channel (``qpos``, ``qvel``, ``act``, ``ctrl``, ``goal``,
                ``sensor``, ``aux``) the samples by name; `T x k` arrays become k channels with an
                index.

        Raises:
            RecordingError: a kind is unknown or the arrays do not fit together.

        Example:
            >>> t = np.linspace(0.0, 1.0, 101)
            >>> r = Recording.from_arrays(t, qpos={"elbow": np.sin(t)}, ctrl={"elbow": np.cos(t)})
            >>> sorted(r.channels)
            ['ctrl.elbow', 'qpos.elbow']
        """
        clock = stamps(time, f"{name}: time")
        units = units or {}
        channels: dict[str, Channel] = {}
        for kind, group in kinds.items():
            if kind not in KINDS:
                raise RecordingError(f"{name}: unknown kind {kind!r}; {nearest(kind, KINDS)}")
            if not isinstance(group, Mapping):
                raise RecordingError(
                    f"{name}: {kind} is {type(group).__name__}; it must be a mapping from names to "
                    f"samples, as in {kind}={{'elbow': q}}"
                )
            hold: Hold = "zero" if kind in HELD_KINDS else "none"
            for item, samples in group.items():
                whole = f"{kind}.{item}"
                for key, column in _columns(whole, numbers(samples, f"{name}: {whole}")):
                    unit = units.get(key, units.get(whole, ""))
                    channels[key] = Channel(clock, column, unit, f"{name}: {key}", hold)
        return cls(name, channels)

    @classmethod
    def from_frame(cls, frame: pd.DataFrame, *, name: str = UNNAMED) -> "Recording":
        """Make a recording from a DataFrame with channels as columns and a column ``time``.

        That holds numbers in [s], dates or durations. A channel has no sample where it is NaN, as
        `to_frame` writes those of several clocks.
        """
        if "time" not in frame.columns:
            raise RecordingError(
                f"{name}: no column 'time'; {nearest('time', map(str, frame.columns))}"
            )
        time = stamps(frame["time"], f"{name}: time")
        channels = {}
        for column in frame.columns:
            key = str(column)
            if key == "time":
                continue
            hold: Hold = "zero" if kind_of(key) in HELD_KINDS else "none"
            where = f"{name}: {key}"
            values = numbers(frame[column], where)
            seen = ~np.isnan(values)
            if not seen.any():
                raise RecordingError(f"{where}: no row has a number")
            channels[key] = Channel(time[seen], values[seen], "", where, hold)
        return cls(name, channels)

    def to_frame(self) -> pd.DataFrame:
        """Return the channels as columns beside ``time``.

        Inputs are given, held or interpolated, at the stamps of all channels from their first on;
        measured channels are NaN where they have no sample. Units, and which inputs are
        interpolated, are not in a frame.
        """
        time = np.unique(np.concatenate([c.time for c in self.channels.values()]))
        columns: dict[str, Any] = {"time": time}
        for name, channel in self.channels.items():
            if channel.continuous:
                columns[name] = np.where(time < channel.time[0], np.nan, channel.at(time))
            else:
                full = np.full(time.size, np.nan)
                full[np.searchsorted(time, channel.time)] = channel.values
                columns[name] = full
        return pd.DataFrame(columns)

    def of_kind(self, kind: str) -> dict[str, Channel]:
        """Return the channels of one kind, by what follows the dot."""
        start = f"{kind}."
        return {n[len(start) :]: c for n, c in self.channels.items() if n.startswith(start)}

    def between(self, start: float, stop: float) -> "Recording":
        """Return the part from `start` to before `stop`, in [s], and all inputs before it.

        What has a memory, as a lag or friction that warms up, goes on from where it was. Of an
        input that is interpolated the sample at or after `stop` is kept, too: it says what acted
        until then.
        """
        channels = {}
        for name, c in self.channels.items():
            first, last = np.searchsorted(c.time, [start, stop])
            if c.continuous:  # a command that did not change within the part brings a neighbour
                first, last = 0, max(int(last) + (c.hold == "linear"), 2)
            if last - first < 2:
                raise RecordingError(
                    f"{self.name}: channel {name!r} has fewer than 2 samples from {start:g} s to "
                    f"{stop:g} s"
                )
            channels[name] = replace(c, time=c.time[first:last], values=c.values[first:last])
        return replace(self, channels=channels, begin=self.origin)

    def with_notes(self, notes: Iterable[str]) -> "Recording":
        """Return a copy with `notes` added."""
        return replace(self, notes=(*self.notes, *notes))

    @property
    def span(self) -> tuple[float, float]:
        """First and last time stamp in [s] of what was measured, or of the inputs alone."""
        measured = [c for c in self.channels.values() if not c.continuous]
        return _span(measured or self.channels.values())

    @property
    def duration(self) -> float:
        """Length of the `span` in [s]."""
        first, last = self.span
        return last - first

    @property
    def origin(self) -> float:
        """Time in [s] at which the log began, of which this may be a part."""
        return _span(self.channels.values())[0] if self.begin is None else self.begin


def _span(channels: Iterable[Channel]) -> tuple[float, float]:
    times = [c.time for c in channels]
    return min(float(t[0]) for t in times), max(float(t[-1]) for t in times)


def kind_of(channel: str) -> str:
    """Return the kind of a channel, qpos of ``qpos.elbow``; a kind is its own."""
    return channel.split(".", 1)[0]


def stated_for(
    channel: str, stated: Mapping[str, _Value], otherwise: _Otherwise
) -> _Value | _Otherwise:
    """Return what is stated for a channel: by its name, else for its kind.

    Args:
        channel: its name, as ``qpos.elbow``.
        stated: what holds for channels and for kinds, by name of either.
        otherwise: returned where neither is there.

    Example:
        >>> noise = {"qpos": 1e-3, "qpos.elbow": 5e-4}
        >>> [stated_for(c, noise, None) for c in ("qpos.elbow", "qpos.wrist", "qvel.elbow")]
        [0.0005, 0.001, None]
    """
    return stated.get(channel, stated.get(kind_of(channel), otherwise))


def wrong_name(name: str) -> str:
    """Return what to change in the name of a channel; empty where it follows the convention."""
    if _NAME.fullmatch(name):
        return ""
    kind, _, element = name.partition(".")
    if kind not in KINDS:
        return f"kind: {nearest(kind, KINDS)}"
    if not element.strip():
        return f"the name is missing, as in '{kind}.elbow'"
    plain = repr("_".join(_INDEX.sub("", element).split()))
    remedy = f"write {plain}"
    if kind in _NAMED:
        remedy = f"rename the {_NAMED[kind]} in the model and its columns, for instance to {plain}"
    return f"names may hold no white space: {remedy}"


def _frozen(values: ArrayLike) -> np.ndarray:
    array = np.array(values, dtype=float)
    array.flags.writeable = False
    return array


def _require_finite(values: np.ndarray, where: str, what: str) -> None:
    bad = np.flatnonzero(~np.isfinite(values))
    if bad.size:
        raise RecordingError(
            f"{where}: {what} in row {bad[0]} is {values[bad[0]]}; all must be finite "
            f"({bad.size} of {values.size} are not)"
        )


def _columns(key: str, samples: np.ndarray) -> list[tuple[str, np.ndarray]]:
    if samples.ndim == 1:
        return [(key, samples)]
    if samples.ndim == 2:
        return [(f"{key}.{i}", samples[:, i]) for i in range(samples.shape[1])]
    raise RecordingError(f"{key}: samples must have one or two dimensions, not {samples.ndim}")

"""Messages of ROS topics as columns: every topic keeps its own clock.

A column is called ``<topic>.<field>.<joint>``, as ``/joint_states.position.elbow``; arrays without
names get an index. A topic's stamps are those of its headers where it has them, else the times at
which its messages were received; the column ``<topic>.time`` holds them, in seconds since the
bag's first message, and ``<topic>.received`` the times of receipt beside headers. Headers on
another clock, a simulator's for instance, count from the first stamp on that clock. Of a trajectory
that a later one replaces, the points are left out that were no longer gone to.
"""

import re
from bisect import bisect_left
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from bo_sysid.errors import RecordingError, nearest
from bo_sysid.recording.table import RawTable

READABLE = (
    "sensor_msgs/JointState",
    "trajectory_msgs/JointTrajectory",
    "std_msgs/Float64MultiArray",
    "std_msgs/Float32MultiArray",
    "std_msgs/Float64",
    "control_msgs states and commands",
)
"""What is read of a bag."""
_READ = re.compile(
    r"sensor_msgs/(msg/)?JointState|trajectory_msgs/(msg/)?JointTrajectory|"
    r"std_msgs/(msg/)?Float(32|64)(MultiArray)?|control_msgs/(msg/)?\w+"
)
_NAMES = ("name", "joint_names", "joint_name", "dof_names", "interface_names")
_SKIPPED = {"header", "layout", "time_from_start"}
_APART = 3600.0  # [s] headers and receipts farther apart belong to different clocks
_NS = 1e-9


@dataclass(frozen=True)
class Message:
    """One message of a bag.

    Attributes:
        topic: its topic.
        kind: its type, as "sensor_msgs/msg/JointState".
        received: time of receipt in [ns].
        content: the decoded message.
    """

    topic: str
    kind: str
    received: int
    content: Any


@dataclass
class _Rows:
    """Messages of one topic that fill the same columns."""

    values: dict[str, list[float]] = field(default_factory=dict)
    stamps: list[int] = field(default_factory=list)
    received: list[int] = field(default_factory=list)
    plan: int = 0  # row of the last trajectory's first point
    replaced: int = 0  # points that are left out

    @property
    def apart(self) -> float:
        """How far the headers are from the times of receipt in [s]; 0 where one has no stamp."""
        if not all(self.stamps):
            return 0.0
        return float(np.median(np.array(self.stamps) - np.array(self.received))) * _NS

    def add(self, stamp: int, received: int, values: Mapping[str, float]) -> None:
        """Add a row."""
        self.stamps.append(stamp)
        self.received.append(received)
        for name, value in values.items():
            self.values.setdefault(name, []).append(value)

    def replan(self, start: int, first: int) -> None:
        """Take out what a new trajectory replaces, from its start and first point in [ns].

        A trajectory keeps its first point, where the new one has none before it: goals that are
        streamed a little ahead are each replaced before they are due.
        """
        due = max(bisect_left(self.stamps, start), self.plan + 1)
        kept = min(due, bisect_left(self.stamps, first))
        self.replaced += len(self.stamps) - kept
        del self.stamps[kept:], self.received[kept:]
        for column in self.values.values():
            del column[kept:]
        self.plan = kept

    def followed_by(self, later: "_Rows") -> "_Rows":
        """Return these rows and later ones, with NaN in columns that either has not."""
        names = dict.fromkeys((*self.values, *later.values))
        values = {
            n: [v for r in (self, later) for v in r.values.get(n, [np.nan] * len(r.stamps))]
            for n in names
        }
        stamps, received = self.stamps + later.stamps, self.received + later.received
        return _Rows(values, stamps, received, replaced=self.replaced + later.replaced)

    def left_out(self, topic: str) -> list[str]:
        """Return a sentence about the points that were replaced, where there are any."""
        if not self.replaced:
            return []
        points = f"{self.replaced} point{'s' * (self.replaced > 1)}"
        return [f"{topic}: {points} of trajectories left out, which a later trajectory replaced."]


def readable(kind: str) -> bool:
    """Whether messages of a type are read."""
    return _READ.fullmatch(kind) is not None


def messages_to_table(
    messages: Iterator[Message], source: str, skipped: Mapping[str, str]
) -> RawTable:
    """Return the columns of a bag.

    Args:
        messages: of readable types.
        source: the bag, for messages.
        skipped: type of each topic that is not read.

    Raises:
        RecordingError: no topic can be read, or one has no time stamps.
    """
    topics: dict[str, dict[frozenset[str], _Rows]] = {}
    for message in messages:
        begun: set[frozenset[str]] = set()
        for stamp, values in _rows(message):
            groups = topics.setdefault(message.topic, {})
            key = frozenset(values)
            rows = groups.setdefault(key, _Rows())
            if _is_plan(message) and key not in begun:
                rows.replan(_start(message), stamp)
            begun.add(key)
            rows.add(stamp, message.received, values)
    if not topics:
        found = ", ".join(f"{t} ({k})" for t, k in skipped.items()) or "no messages at all"
        raise RecordingError(
            f"{source}: no topic that is read; it has {found}. Read are {', '.join(READABLE)}"
            + _nearest_kind(skipped)
        )
    return _table(topics, source, skipped)


def _nearest_kind(skipped: Mapping[str, str]) -> str:
    kinds = [k.replace("/msg/", "/") for k in skipped.values()]
    return f"; for {kinds[0]}: {nearest(kinds[0], READABLE[:-1])}" if kinds else ""


def _table(
    topics: Mapping[str, Mapping[frozenset[str], _Rows]], source: str, skipped: Mapping[str, str]
) -> RawTable:
    origin = min(r.received[0] for groups in topics.values() for r in groups.values())
    foreign = _foreign(topics)
    columns: dict[str, np.ndarray] = {}
    clocks: dict[str, str] = {}
    notes = [f"Topic {t} ({k}) is not read." for t, k in skipped.items()]
    for topic, groups in topics.items():
        for number, rows in enumerate(_joined(groups.values())):
            name = f"{topic}.time" if number == 0 else f"{topic}.time{number + 1}"
            stamps, note = _clock(topic, rows, origin, foreign, source)
            notes += note
            notes += rows.left_out(topic)
            order = np.argsort(stamps, kind="stable")
            columns[name] = stamps[order]
            if any(rows.stamps):
                received = (np.array(rows.received) - origin) * _NS
                columns[name.replace(".time", ".received")] = received[order]
            for column, values in rows.values.items():
                array = np.array(values)[order]
                if np.isnan(array).all():
                    continue  # a field that the publisher does not fill
                key = f"{topic}.{column}"
                if key in columns:
                    raise RecordingError(
                        f"{source}: two publishers on {topic} name {column.rsplit('.', 1)[-1]!r} "
                        "in messages of different joints: two robots on one topic? Record them "
                        "under namespaces of their own"
                    )
                columns[key] = array
                clocks[key] = name
    return RawTable(source, columns, clocks=clocks, notes=tuple(dict.fromkeys(notes)))


def _joined(groups: Iterable[_Rows]) -> list[_Rows]:
    """Return the rows of a topic, one publisher's together where what it sends has changed.

    A first message without velocities, or a joint that comes later, is followed by messages that
    fill other columns and take over for good.
    """
    found: list[_Rows] = []
    for rows in sorted(groups, key=lambda r: r.received[0]):
        last = found[-1] if found else rows
        shared = last is not rows and last.values.keys() & rows.values.keys()
        if shared and last.received[-1] <= rows.received[0]:
            found[-1] = last.followed_by(rows)
        else:
            found.append(rows)
    return found


def _foreign(
    topics: Mapping[str, Mapping[frozenset[str], _Rows]],
) -> list[tuple[str, float, int]]:
    """Return topic, distance in [s] and first stamp in [ns] of headers on another clock."""
    return [
        (topic, rows.apart, min(rows.stamps))
        for topic, groups in topics.items()
        for rows in groups.values()
        if abs(rows.apart) > _APART
    ]


def _clock(
    topic: str,
    rows: _Rows,
    origin: int,
    foreign: Sequence[tuple[str, float, int]],
    source: str,
) -> tuple[np.ndarray, list[str]]:
    """Return the stamps of a topic in [s], and what is to be said about them.

    Topics whose headers are as far from the times of receipt are on one clock: it begins with the
    first stamp of all of them.
    """
    received = (np.array(rows.received) - origin) * _NS
    if all(rows.stamps):
        stamps, apart = np.array(rows.stamps), rows.apart
        if abs(apart) > _APART:
            alike = [(t, first) for t, other, first in foreign if abs(other - apart) <= _APART]
            others = ", ".join(dict.fromkeys(t for t, _ in alike if t != topic))
            note = (
                f"{topic}: its headers are {abs(apart):.6g} s from the times of receipt, another "
                f"clock{', that of ' * bool(others)}{others}; to use those of receipt, name the "
                f"column {topic}.received under clocks:."
            )
            return (stamps - min(first for _, first in alike)) * _NS, [note]
        return (stamps - origin) * _NS, []
    if len(received) > 1 and np.ptp(received) == 0:
        raise RecordingError(
            f"{source}: topic {topic} has no time stamps: no header, and all of its "
            f"{len(received)} messages were received at one time; record it with receive times"
        )
    return received, [f"{topic}: no header stamps; its clock is the time of receipt."]


def _rows(message: Message) -> Iterator[tuple[int, dict[str, float]]]:
    """Yield stamp in [ns] (0 where there is none) and values of each row of a message."""
    if _is_plan(message):
        start = _start(message)
        for point in message.content.points:
            later = point.time_from_start
            moment = start + _nanoseconds(later)
            yield moment, dict(_numbers(point, "", _labels(message.content) or ()))
    else:
        values = dict(_numbers(message.content, "", ()))
        if values:
            yield _stamp(message.content), values


def _is_plan(message: Message) -> bool:
    return message.kind.endswith("JointTrajectory")


def _start(message: Message) -> int:
    """Return when a trajectory starts in [ns]: as its header says, else when it is received."""
    return _stamp(message.content) or message.received


def _stamp(content: Any) -> int:
    header = getattr(content, "header", None)
    return 0 if header is None else _nanoseconds(header.stamp)


def _nanoseconds(time: Any) -> int:
    nanosecond = getattr(time, "nanosec", None)
    return int(time.sec) * 10**9 + int(time.nanosec if nanosecond is not None else time.nsec)


def _fields(content: Any) -> list[str]:
    names = getattr(content, "__dataclass_fields__", None) or getattr(content, "__slots__", None)
    found = list(names) if names else list(vars(content))
    return [n for n in found if not n.startswith("_")]


def _labels(content: Any) -> Sequence[str] | None:
    for name in _NAMES:
        value = getattr(content, name, None)
        if isinstance(value, list | tuple) and value and isinstance(value[0], str):
            return list(value)
    return None


def _numbers(content: Any, prefix: str, inherited: Sequence[str]) -> Iterator[tuple[str, float]]:
    """Yield name and value of every number in a message, however deep."""
    labels = _labels(content) or inherited
    for name in _fields(content):
        if name in _SKIPPED:
            continue
        value = getattr(content, name)
        path = f"{prefix}{name}"
        if isinstance(value, bool | int | float | np.number):
            yield path, float(value)
        elif isinstance(value, np.ndarray | list | tuple):
            yield from _items(value, path, labels)
        elif not isinstance(value, str | bytes):
            yield from _numbers(value, f"{path}.", labels)


def _items(values: Any, path: str, labels: Sequence[str]) -> Iterator[tuple[str, float]]:
    named = labels if len(labels) == len(values) else [str(i) for i in range(len(values))]
    for label, value in zip(named, values, strict=True):
        if isinstance(value, bool | int | float | np.number):
            yield f"{path}.{label}", float(value)
        elif not isinstance(value, str | bytes):
            own = getattr(value, "name", None)
            yield from _numbers(value, f"{path}.{own if isinstance(own, str) else label}.", ())

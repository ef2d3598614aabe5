"""What the channels show of the sensors, drives and clocks behind them."""

from collections.abc import Sequence

import mujoco
import numpy as np

from bo_sysid.checks.flags import Flag
from bo_sysid.mjcf.commands import control_limits, controlled
from bo_sysid.recording import Channel, Recording, Sampling, kind_of
from bo_sysid.recording.alignment import GAP
from bo_sysid.recording.outliers import CLEAR, find_outliers
from bo_sysid.recording.value import COARSE, UNUSED

_SEVERAL = 5  # samples at an extreme: every command has one
_HELD_AT_LIMIT = 0.02  # share of the time at an extreme value that is a saturation
_OFTEN = 3.0  # times the share of its typical value, that an extreme one has at a saturation
_STUCK = 0.25  # [s] of one and the same value while the channel otherwise changes, and
_RUNS = 15.0  # so many times its typical run
_THAW = 3.0  # times the usual step, that a frozen channel jumps at least
_JITTER = 0.2  # of the interval
_SLOW = 0.11  # [s] between samples, from which on a motion is hardly seen


def channel_flags(model: mujoco.MjModel, recordings: Sequence[Recording]) -> list[Flag]:
    """Return saturated commands, frozen sensors and positions that jump and come back."""
    limits = _ranges(model)
    flags: list[Flag] = []
    for r in recordings:
        for name, channel in r.channels.items():
            kind = kind_of(name)
            if kind == "ctrl":
                flags += _saturated(r.name, name, channel, limits.get(name))
            elif channel.hold == "none":
                flags += _frozen(r.name, name, channel)
                flags += _outliers(r.name, name, channel) if kind == "qpos" else []
    return flags


def clipped(model: mujoco.MjModel, recordings: Sequence[Recording]) -> list[Flag]:
    """Return how long commands are beyond what the model takes of them."""
    found = (
        _beyond(r.name, name, r.channels[name], limits)
        for name, limits in _ranges(model).items()
        for r in recordings
        if name in r.channels
    )
    return [flag for flags in found for flag in flags]


def _ranges(model: mujoco.MjModel) -> dict[str, tuple[float, float]]:
    """Return the ends to which a model clips its controls, by channel."""
    ends = {
        f"ctrl.{model.actuator(a).name}": control_limits(model, k)
        for k, a in enumerate(controlled(model))
    }
    return {name: limits for name, limits in ends.items() if limits is not None}


def _saturated(
    recording: str, name: str, channel: Channel, limits: tuple[float, float] | None
) -> list[Flag]:
    values, spent = channel.values[:-1], np.diff(channel.time)
    flags = []
    levels, which = np.unique(values, return_inverse=True)
    if len(levels) > 20:  # a command of few levels is meant to stay at them
        usual = float(np.median(np.bincount(which, spent)) / spent.sum())  # and one of steps
        for side, extreme in (("largest", values.max()), ("smallest", values.min())):
            held = values == extreme
            share = float(spent[held].sum() / spent.sum())
            if share > max(_HELD_AT_LIMIT, _OFTEN * usual) and held.sum() >= _SEVERAL:
                limited = limits is not None and not limits[0] < extreme < limits[1]
                what = "the drive saturates there" + (", or a motion rests there" * (not limited))
                flags.append(
                    Flag(
                        "note",
                        "saturation",
                        (name,),
                        f"{recording}: {name} stays at its {side} value {extreme:.4g} for "
                        f"{100 * share:.0f} % of the time: {what}.",
                        {"value": float(extreme), "share": share},
                    )
                )
    return flags + (_beyond(recording, name, channel, limits) if limits else [])


def _beyond(recording: str, name: str, channel: Channel, limits: tuple[float, float]) -> list[Flag]:
    """Return for how much of the time a command is beyond its range, if it ever is."""
    values, spent = channel.values[:-1], np.diff(channel.time)
    if values.min() >= limits[0] - 1e-9 and values.max() <= limits[1] + 1e-9:
        return []
    beyond = float(spent[(values < limits[0]) | (values > limits[1])].sum() / spent.sum())
    return [
        Flag(
            "look",
            "saturation",
            (name,),
            f"{recording}: {name} leaves the model's control range [{limits[0]:g}, "
            f"{limits[1]:g}] for {100 * beyond:.0f} % of the time; the model will clip it.",
            {"share": beyond},
        )
    ]


def _frozen(recording: str, name: str, channel: Channel) -> list[Flag]:
    """Return a stretch in which a channel repeats one value while what it measures goes on.

    A joint that rests does so, too; what was frozen jumps when it thaws.
    """
    steps = np.diff(channel.values)
    changed = np.flatnonzero(steps != 0)
    if len(changed) < 10:
        return []
    first, last = changed[:-1] + 1, changed[1:]  # samples of each run of one value
    runs = channel.time[last] - channel.time[first]
    usual = float(np.quantile(np.abs(steps[changed]), 0.95))
    frozen = (runs > max(_STUCK, _RUNS * float(np.quantile(runs, 0.95)))) & (
        np.abs(steps[last]) > _THAW * usual
    )
    if not frozen.any():
        return []
    k = int(np.argmax(np.where(frozen, runs, 0.0)))
    return [
        Flag(
            "look",
            "frozen",
            (name,),
            f"{recording}: {name} repeats one value for {runs[k]:.3g} s from "
            f"{channel.time[first[k]]:.4g} s on and then jumps: a frozen sensor or a lost "
            "connection.",
            {"seconds": float(runs[k]), "start": float(channel.time[first[k]])},
        )
    ]


def _outliers(recording: str, name: str, channel: Channel) -> list[Flag]:
    """Return samples of a position that leave both neighbours as nothing else in it does."""
    found = find_outliers(channel.time, channel.values)
    if not found:
        return []
    at = [float(channel.time[o.first]) for o in found]
    times = ", ".join(f"{t:.4g}" for t in at[:3]) + (", …" if len(at) > 3 else "")
    sentence = (
        f"{recording}: {name} jumps to {channel.values[found[0].first]:.4g} and back at "
        f"{times} s, by more than {CLEAR:g} times any other step of it: a code for no "
        "sample, or a dropout. Speeds, wiring and units of comparison are wrong by it. To leave "
        f"such samples out, empty their cells and write {name}: {{missing: skip}} under "
        "recordings: columns."
    )
    return [Flag("look", "outlier", (name,), sentence, {"times": at})]


def coarse_flags(recordings: Sequence[Recording]) -> list[Flag]:
    """Return clocks that stamp several samples alike, of which one is kept."""
    return [
        Flag("look", "sampling", (r.name,), f"{r.name}: {note}")
        for r in recordings
        for note in r.notes
        if note.startswith(COARSE)
    ]


def shared_flags(recordings: Sequence[Recording]) -> list[Flag]:
    """Return controls that are read from one column where others of the log are not used."""
    found: dict[tuple[str, ...], Flag] = {}
    for r in recordings:
        unused = [n.removeprefix(UNUSED).removesuffix(".") for n in r.notes if n.startswith(UNUSED)]
        by_column: dict[str, list[str]] = {}
        for name, channel in r.channels.items():
            if kind_of(name) == "ctrl":
                by_column.setdefault(channel.source, []).append(name)
        for source, names in by_column.items():
            if source and len(names) > 1 and unused:
                sentence = (
                    f"{' and '.join(names)} are read from one column ({source}), and {unused[0]} "
                    "is not used: right for motors on one command, wrong if that is one's own."
                )
                flag = Flag("look", "swap", tuple(names), sentence)
                found.setdefault(tuple(names), flag)
    return list(found.values())


def slow_flags(recordings: Sequence[Recording]) -> list[Flag]:
    """Return positions and speeds so far apart that their time stamps may be in another unit."""
    apart = []  # two logs may have one name
    for r in recordings:
        moving = [*r.of_kind("qpos").values(), *r.of_kind("qvel").values()]
        apart.append(max((Sampling.of(c.time).median_dt for c in moving), default=0.0))
    slow = [r.name for r, dt in zip(recordings, apart, strict=True) if dt > _SLOW]
    if not slow:
        return []
    interval = max(apart)
    more = f" and {len(slow) - 3} more" if len(slow) > 3 else ""
    sentence = (
        f"Motions are sampled every {interval:.3g} s in {', '.join(slow[:3])}{more}, which is too "
        "rarely for most machines. Perhaps the time stamps are in a smaller unit than the study "
        "says, ms and not s, or us and not ms: recordings: columns: {time: {from: …, unit: us}}. "
        "Nothing else that is said here holds then."
    )
    return [Flag("look", "sampling", tuple(slow), sentence, {"interval": interval})]


def sampling_flags(recordings: Sequence[Recording]) -> list[Flag]:
    """Return clocks that jitter or lose samples; channels of one clock are told once."""
    flags = []
    for r in recordings:
        clocks: dict[bytes, list[str]] = {}
        for name, channel in r.channels.items():
            if channel.hold == "none":
                clocks.setdefault(channel.time.tobytes(), []).append(name)
        for names in clocks.values():
            s = Sampling.of(r.channels[names[0]].time)
            reasons = []
            if s.gaps:
                reasons.append(
                    f"{s.gaps} gap{'s' * (s.gaps > 1)} longer than {GAP:g} x "
                    f"{1e3 * s.median_dt:.3g} ms, about {s.missing} samples lost"
                )
            if s.jitter > _JITTER * s.median_dt:
                reasons.append(
                    f"intervals jitter by {1e3 * s.jitter:.2g} ms about {1e3 * s.median_dt:.3g} ms"
                )
            if reasons:
                listed = ", ".join(names[:3]) + (" …" if len(names) > 3 else "")
                flags.append(
                    Flag(
                        "note",
                        "sampling",
                        tuple(names),
                        f"{r.name}: {listed}: {'; '.join(reasons)}.",
                    )
                )
    return flags

"""A picture of each recording, as `check` reads it."""

from collections.abc import Collection, Mapping, Sequence

import numpy as np
from matplotlib.figure import Figure

from bo_sysid.recording import Channel, Recording, kind_of
from bo_sysid.report.look import GREY, IDENTIFIED, NOMINAL, RECORDED, in_lines

_WIDTH = 7.2  # inches
_MOST = 10  # panels
_SHOWN = 4_000  # samples of a curve
_KINDS = ("qpos", "qvel", "ctrl", "goal", "sensor", "aux")
_COLOURS = {"qpos": RECORDED, "qvel": IDENTIFIED, "ctrl": NOMINAL, "goal": NOMINAL}


def recording_figure(
    recording: Recording,
    flagged: Collection[str] = (),
    *,
    order: Sequence[str] = (),
    limits: Mapping[str, tuple[float, float]] | None = None,
) -> Figure:
    """Return the channels of a recording, one panel each; of many, those with remarks stay.

    Args:
        recording: what was recorded.
        flagged: channels or joints that something was said about.
        order: of the channels; by kind where left out.
        limits: least and largest value of channels.
    """
    place = {n: k for k, n in enumerate(order or sorted(recording.channels, key=_kind))}
    by_place = sorted(recording.channels, key=lambda n: place.get(n, len(place)))
    shaded = {n for n in by_place if n in flagged or _joint(n) in flagged}
    kept = sorted(by_place, key=lambda n: n not in shaded)[:_MOST]
    names = [n for n in by_place if n in kept]
    figure = Figure(figsize=(_WIDTH, 1.2 * len(names) + 0.6), layout="constrained")
    axes = figure.subplots(len(names), 1, squeeze=False, sharex=True)[:, 0]
    for axis, name in zip(axes, names, strict=True):
        channel = recording.channels[name]
        time, values = _thinned(channel, recording.span[0])
        colour = _COLOURS.get(kind_of(name), RECORDED)
        where = {"drawstyle": "steps-post"} if channel.hold == "zero" else {}
        axis.plot(time, values, color=colour, linewidth=0.8, **where)
        label = in_lines(name) + (f"\n[{channel.unit}]" if channel.unit else "")
        axis.set_ylabel(label, fontsize="x-small")
        axis.tick_params(labelsize="x-small")
        if name in shaded:
            axis.set_facecolor("#FFF6E5")
        for limit in (limits or {}).get(name, ()):
            if np.isfinite(limit):
                axis.axhline(limit, color=GREY, linewidth=1.0, linestyle="--")
    hidden = len(recording.channels) - len(names)
    notes = [f"{hidden} channels not shown"] if hidden else []
    notes += ["shaded: the check has a remark on it"] if shaded else []
    dashed = any(np.isfinite((limits or {}).get(n, ())).any() for n in names)
    notes += ["dashed: limits"] if dashed else []
    axes[0].set_title(
        "\n".join([recording.name, *filter(None, ["; ".join(notes)])]), fontsize="medium"
    )
    axes[-1].set_xlabel("time [s]")
    return figure


def _kind(name: str) -> int:
    kind = kind_of(name)
    return _KINDS.index(kind) if kind in _KINDS else len(_KINDS)


def _joint(name: str) -> str:
    """Return the joint whose position a channel is; the channel where it is none."""
    return name.removeprefix("qpos.")


def _thinned(channel: Channel, begin: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the time since the recording began, and the values.

    Of many samples these are the least and the largest of every so many: what stands out stays.
    """
    time, values = channel.time - begin, channel.values
    each = -(-2 * len(values) // _SHOWN)
    if each <= 2:
        return time, values
    begins = range(0, len(values), each)
    ends = [k + f(values[k : k + each]) for k in begins for f in (np.argmin, np.argmax)]
    chosen = np.unique([0, *ends, len(values) - 1])
    return time[chosen], values[chosen]

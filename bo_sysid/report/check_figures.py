"""A picture of each recording, as `check` reads it."""

import numpy as np
from matplotlib.figure import Figure

from bo_sysid.recording import Channel, Recording
from bo_sysid.report.look import IDENTIFIED, NOMINAL, RECORDED

_WIDTH = 7.2  # inches
_MOST = 10  # panels
_SHOWN = 4_000  # samples of a curve
_KINDS = ("qpos", "qvel", "ctrl", "goal", "sensor", "aux")
_COLOURS = {"qpos": RECORDED, "qvel": IDENTIFIED, "ctrl": NOMINAL, "goal": NOMINAL}


def recording_figure(recording: Recording, flagged: set[str]) -> Figure:
    """Return the channels of a recording, one panel each; those with remarks first.

    Args:
        recording: what was recorded.
        flagged: channels or joints that something was said about.
    """
    order = sorted(
        recording.channels,
        key=lambda n: (
            n not in flagged,
            _KINDS.index(k) if (k := n.split(".")[0]) in _KINDS else 9,
        ),
    )
    names = order[:_MOST]
    figure = Figure(figsize=(_WIDTH, 1.2 * len(names) + 0.6), layout="constrained")
    axes = figure.subplots(len(names), 1, squeeze=False, sharex=True)[:, 0]
    for axis, name in zip(axes, names, strict=True):
        channel = recording.channels[name]
        time, values = _thinned(channel, recording.span[0])
        colour = _COLOURS.get(name.split(".", 1)[0], RECORDED)
        where = {"drawstyle": "steps-post"} if channel.hold == "zero" else {}
        axis.plot(time, values, color=colour, linewidth=0.8, **where)
        label = f"{name}\n[{channel.unit}]" if channel.unit else name
        axis.set_ylabel(label, fontsize="x-small")
        axis.tick_params(labelsize="x-small")
        if name in flagged:
            axis.set_facecolor("#FFF6E5")
    hidden = len(order) - len(names)
    axes[0].set_title(recording.name + (f" ({hidden} channels not shown)" if hidden else ""))
    axes[-1].set_xlabel("time [s]")
    return figure


def _thinned(channel: Channel, begin: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the time since the recording began, and the values, of every so many-th sample."""
    step = max(len(channel.time) // _SHOWN, 1)
    return channel.time[::step] - begin, channel.values[::step]

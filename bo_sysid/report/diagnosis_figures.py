"""Figures of a diagnosis, as Matplotlib objects; they show what was stored and compute nothing."""

import textwrap
from collections.abc import Mapping
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, NullLocator

from bo_sysid.report.look import (
    COLOURS,
    GREY,
    MODELS,
    RECORDED,
    first_part,
    in_a_row,
    in_lines,
    left_words,
    rms,
    set_colour,
    since_start,
    sure,
    time_label,
    top_sets,
    with_gaps,
    worst_channels,
    worst_joints,
)

_LINES = {
    "nominal": {"linestyle": "-", "linewidth": 1.5},
    "refitted": {"linestyle": (0, (4, 5)), "linewidth": 1.2},
    "repaired": {"linestyle": "-", "linewidth": 1.1},
}
_WIDTH = 7.2  # inches
_CHANNELS = 3
_JOINTS = 3
_ROOM = 2.6  # axis of the evidence, in lengths of its longest bar: words stand beside it
_FEW = 20.0  # [sigma] below which two and five are marked as well
_MARKS = 4  # decades from which every other one is marked


def held_out(traces: pd.DataFrame, units: Mapping[str, str] | None = None) -> Figure:
    """Return recorded, nominal, refitted and repaired on recordings set aside, and the residuals.

    Args:
        traces: recording, time, begin, window, channel, recorded, nominal, refitted, repaired.
        units: of the channels.
    """
    shown = first_part(since_start(traces))
    recorded = {*shown.dropna(subset="recorded")["channel"]}
    names = [n for n in worst_channels(traces) if n in recorded][:_CHANNELS]
    figure = Figure(figsize=(_WIDTH, 0.6 + 2.9 * len(names)), layout="constrained")
    axes = figure.subplots(
        2 * len(names), 1, squeeze=False, sharex=True, height_ratios=[3, 2] * len(names)
    )[:, 0]
    for k, name in enumerate(names):
        part, unit = shown[shown["channel"] == name], (units or {}).get(name, "")
        _one_channel(axes[2 * k], axes[2 * k + 1], part, name, unit)
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, fontsize="small", ncols=4, loc="outside lower center")
    axes[0].set_title(
        "A recording that was never used. Each piece is forecast from the moment before it.",
        fontsize="medium",
        loc="left",
    )
    axes[-1].set_xlabel("time [s]")
    return figure


def _one_channel(top: Axes, below: Axes, part: pd.DataFrame, name: str, unit: str) -> None:
    part = with_gaps(part)
    time, recorded = part["time"], part["recorded"]
    top.plot(time, recorded, color=GREY, linewidth=4.0, label="recorded")
    for model in (m for m in MODELS if m in part):
        style: dict[str, Any] = {"color": COLOURS[model], **_LINES[model]}
        top.plot(time, part[model], label=MODELS[model], **style)
        error = recorded - part[model]
        off = rms(error)
        size = f"{float(f'{off:.2g}'):g} {unit}".rstrip()
        words = f"{size} rms" if np.isfinite(off) else "no prediction"
        below.plot(time, error, label=f"{model}: {words}", **style)
    low, high = float(recorded.min()), float(recorded.max())
    span = max(high - low, 1e-9)
    margin = 0.5 * span  # a forecast that leaves is cut off
    view = top.get_ylim()
    top.set_ylim(max(view[0], low - margin), min(view[1], high + margin))
    axis_unit = f"[{unit}]" if unit else ""
    top.set_ylabel(f"{in_lines(name)}\n{axis_unit}")
    below.set_ylabel(f"recorded -\nforecast {axis_unit}", fontsize="small")
    below.axhline(0, color=RECORDED, linewidth=0.5)
    below.legend(fontsize="x-small", ncols=3, loc="lower center", bbox_to_anchor=(0.5, 1.0),
                 frameon=False, borderaxespad=0.0)  # fmt: skip
    below.set_ylim(*np.clip(below.get_ylim(), -span, span))


def forces(pieces: pd.DataFrame) -> Figure:
    """Return the force that the models lack against time, position and speed of the joint.

    Args:
        pieces: recording, time, begin, joint, position, speed, unit, nominal, repaired, sigma.
    """
    names = worst_joints(pieces)[:_JOINTS]
    pieces, begins = in_a_row(pieces)
    figure = Figure(figsize=(_WIDTH, 0.7 + 2.2 * len(names)), layout="constrained")
    rows = figure.subplots(len(names), 3, squeeze=False, sharey="row")
    for name, axes in zip(names, rows, strict=True):
        part = sure(pieces[pieces["joint"] == name])
        unit = str(part["unit"].iloc[0])
        place, what = ("rad", "torque") if unit == "N m" else ("m", "force")
        for begin in begins[1:]:
            axes[0].axvline(begin, color=GREY, linewidth=0.8, linestyle=":")
        across = {"time": time_label(begins), "position": f"position [{place}]", "speed": ""}
        across["speed"] = f"speed [{place}/s]"
        for axis, (column, label) in zip(axes, across.items(), strict=True):
            for model in ("nominal", "repaired"):
                axis.plot(
                    part[column],
                    part[model],
                    "o" if model == "nominal" else "s",
                    color=COLOURS[model],
                    markersize=3 if model == "nominal" else 2,
                    alpha=0.75,
                    label=MODELS[model],
                )
            axis.axhline(0, color=RECORDED, linewidth=0.5)
            axis.set_xlabel(label, fontsize="small")
            axis.tick_params(labelsize="small")
        axes[0].set_ylabel(f"{in_lines(name)}:\nmissing {what} [{unit}]")
    figure.suptitle(
        "The force that would have to be added for the model to follow the recording",
        fontsize="medium",
    )
    handles, labels = rows[0][0].get_legend_handles_labels()
    figure.legend(handles, labels, fontsize="small", ncols=2, loc="outside lower center")
    return figure


def _round_to(largest: float) -> list[float]:
    """Return the round numbers from one up to where bars end."""
    steps = (1.0, 2.0, 5.0) if largest < _FEW else (1.0,)
    most = int(np.log10(largest))
    decades = 10.0 ** np.arange(0, most + 1, 1 + most // _MARKS)
    return [float(s * d) for d in decades for s in steps if s * d <= largest]


def evidence(sets: pd.DataFrame) -> Figure:
    """Return what each of the best explanations leaves unexplained, and its probability.

    Args:
        sets: set, effects, probability, rms [sensor sigma], best, equivalent.
    """
    shown = top_sets(sets)
    figure = Figure(figsize=(_WIDTH, 1.1 + 0.45 * len(shown)), layout="constrained")
    axis = figure.subplots()
    place = np.arange(len(shown))[::-1]
    colours = [set_colour(row) for row in shown.itertuples()]
    left = 0.7
    axis.barh(place, shown["rms"] - left, left=left, color=colours, height=0.6)
    axis.set_xscale("log")
    largest = max(float(shown["rms"].max()), 2.0)
    axis.set_xlim(left, left * (largest / left) ** _ROOM)
    axis.set_xticks(_round_to(largest))
    axis.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:,g}"))
    axis.xaxis.set_minor_locator(NullLocator())
    axis.axvline(1.0, color=RECORDED, linewidth=1.0, linestyle="--")
    axis.text(1.0, len(shown) - 0.45, " sensor noise", fontsize="small", va="bottom")
    axis.set_ylim(-0.6, len(shown) + 0.1)
    labels = ["\n".join(textwrap.wrap(str(s), 40)) for s in shown["set"]]
    axis.set_yticks(place, labels, fontsize="small")
    for y, row in zip(place, shown.to_dict("records"), strict=True):
        leaves = float(row["rms"])
        words = f" {left_words(leaves, row['probability'], row.get('p_boot', np.nan))}"
        beside = max(np.nan_to_num(leaves, nan=1.0), 1.0)  # right of the noise's line
        axis.text(beside, y, words, va="center", fontsize="small")
    axis.set_xlabel("training residual [sensor sigma, rms]")
    axis.spines[["top", "right"]].set_visible(False)
    return figure

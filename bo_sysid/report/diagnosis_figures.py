"""Figures of a diagnosis, as Matplotlib objects; they show what was stored and compute nothing."""

import textwrap
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import ScalarFormatter

from bo_sysid.report.figures import NOMINAL, RECORDED, SECOND

REPAIRED = "#0072B2"
COLOURS = {"nominal": NOMINAL, "refitted": SECOND, "repaired": REPAIRED}
MODELS = {
    "nominal": "nominal model",
    "refitted": "refitted, no new physics",
    "repaired": "repaired model",
}
UNITS = {"qpos": "rad or m", "qvel": "rad/s or m/s"}
_LINES = {
    "nominal": {"linestyle": "-", "linewidth": 1.5},
    "refitted": {"linestyle": (0, (4, 5)), "linewidth": 1.2},
    "repaired": {"linestyle": "-", "linewidth": 1.1},
}
_GREY = "#AAAAAA"
_WIDTH = 7.2  # inches
_CHANNELS = 3
_SECONDS = 12.0
_JOINTS = 3
_UNSURE = 0.5  # of the largest missing force: the deviation above which a piece says nothing
_SETS = 8


def held_out(traces: pd.DataFrame, unit: str = "rad") -> Figure:
    """Return recorded, nominal, refitted and repaired on recordings set aside, and the residuals.

    Args:
        traces: recording, time, window, channel, recorded, nominal, refitted, repaired.
        unit: of the channels.
    """
    names = worst_channels(traces)[:_CHANNELS]
    shown = first_part(traces)
    figure = Figure(figsize=(_WIDTH, 0.6 + 2.9 * len(names)), layout="constrained")
    axes = figure.subplots(
        2 * len(names), 1, squeeze=False, sharex=True, height_ratios=[3, 2] * len(names)
    )[:, 0]
    for k, name in enumerate(names):
        _one_channel(axes[2 * k], axes[2 * k + 1], shown[shown["channel"] == name], name, unit)
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
    top.plot(time, recorded, color=_GREY, linewidth=4.0, label="recorded")
    for model in (m for m in MODELS if m in part):
        style: dict[str, Any] = {"color": COLOURS[model], **_LINES[model]}
        top.plot(time, part[model], label=MODELS[model], **style)
        error = recorded - part[model]
        rms = float(np.sqrt(np.nanmean(np.square(error))))
        below.plot(time, error, label=f"{model}: {rms:.2g} {unit} rms", **style)
    low, high = float(recorded.min()), float(recorded.max())
    margin = 0.5 * max(high - low, 1e-9)  # a forecast that leaves is cut off
    view = top.get_ylim()
    top.set_ylim(max(view[0], low - margin), min(view[1], high + margin))
    top.set_ylabel(f"{name}\n[{unit}]")
    below.set_ylabel(f"recorded -\nforecast [{unit}]", fontsize="small")
    below.axhline(0, color=RECORDED, linewidth=0.5)
    below.legend(fontsize="x-small", ncols=3, loc="upper center", framealpha=0.9)
    low, high = below.get_ylim()
    below.set_ylim(low, high + 0.35 * (high - low))  # room for the legend


def forces(pieces: pd.DataFrame) -> Figure:
    """Return the force that the models lack against time, position and speed of the joint.

    Args:
        pieces: joint, time, position, speed, unit, nominal, repaired, sigma.
    """
    names = worst_joints(pieces)[:_JOINTS]
    figure = Figure(figsize=(_WIDTH, 0.7 + 2.2 * len(names)), layout="constrained")
    rows = figure.subplots(len(names), 3, squeeze=False, sharey="row")
    for name, axes in zip(names, rows, strict=True):
        part = sure(pieces[pieces["joint"] == name])
        unit = str(part["unit"].iloc[0])
        place, what = ("rad", "torque") if unit == "N m" else ("m", "force")
        across = {"time": "time [s]", "position": f"position [{place}]", "speed": ""}
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
        axes[0].set_ylabel(f"{name}:\nmissing {what} [{unit}]")
    figure.suptitle(
        "The force that would have to be added for the model to follow the recording",
        fontsize="medium",
    )
    handles, labels = rows[0][0].get_legend_handles_labels()
    figure.legend(handles, labels, fontsize="small", ncols=2, loc="outside lower center")
    return figure


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
    axis.set_xlim(left, left * (largest / left) ** 1.75)  # room for the words
    axis.xaxis.set_major_formatter(ScalarFormatter())
    axis.axvline(1.0, color=RECORDED, linewidth=1.0, linestyle="--")
    axis.text(1.0, len(shown) - 0.45, " sensor noise", fontsize="small", va="bottom")
    axis.set_ylim(-0.6, len(shown) + 0.1)
    labels = ["\n".join(textwrap.wrap(str(s), 40)) for s in shown["set"]]
    axis.set_yticks(place, labels, fontsize="small")
    ends = zip(place, shown["rms"].astype(float), shown["probability"].astype(float), strict=True)
    for y, rms, probability in ends:
        words = f" {rms:.3g}, probability {chance(probability)}"
        axis.text(rms, y, words, va="center", fontsize="small")
    axis.set_xlabel("what the training recordings leave unexplained [sensor sigma, rms]")
    axis.spines[["top", "right"]].set_visible(False)
    return figure


def worst_channels(traces: pd.DataFrame) -> list[str]:
    """Return the channels, those first that the nominal model predicts worst for their range."""

    def badness(part: pd.DataFrame) -> float:
        error = np.sqrt(np.nanmean(np.square(part["recorded"] - part["nominal"])))
        return float(error / max(float(np.ptp(part["recorded"].dropna())), 1e-12))

    names = list(dict.fromkeys(traces["channel"]))
    size = {n: badness(traces[traces["channel"] == n]) for n in names}
    return sorted(names, key=lambda n: -size[n])


def worst_joints(pieces: pd.DataFrame) -> list[str]:
    """Return the joints, those first whose missing force is largest beside what a model leaves."""
    size = {}
    for name in dict.fromkeys(pieces["joint"]):
        part = sure(pieces[pieces["joint"] == name])
        left = np.hypot(part["repaired"].std(), part["sigma"].median())
        size[name] = float(part["nominal"].std() / max(float(left), 1e-12)) if len(part) > 2 else 0
    order = sorted(size, key=lambda n: -size[n])
    return [n for n in order if size[n] > 0] or order[:1]


def sure(part: pd.DataFrame) -> pd.DataFrame:
    """Return the pieces of one joint in which its recording says something about the force."""
    largest = float(np.nanquantile(part["nominal"].abs(), 0.95)) if len(part) else 0.0
    kept = part[part["sigma"] < max(_UNSURE * largest, 2 * float(part["sigma"].min()))]
    return kept if len(kept) else part


def first_part(traces: pd.DataFrame) -> pd.DataFrame:
    """Return the first seconds of the first recording."""
    first: pd.DataFrame = traces[traces["recording"] == traces["recording"].iloc[0]]
    return first.loc[first["time"] <= float(first["time"].min()) + _SECONDS]


def with_gaps(part: pd.DataFrame) -> pd.DataFrame:
    """Return the rows of one channel with a gap after each window: lines do not join two starts."""
    values = [c for c in ("recorded", *MODELS) if c in part]
    ends = part.groupby("window", sort=False).tail(1).assign(**dict.fromkeys(values, np.nan))
    return pd.concat([part, ends]).sort_values(["window", "time"], kind="stable")


def top_sets(sets: pd.DataFrame) -> pd.DataFrame:
    """Return the sets that are shown: the most probable, and "nothing is missing"."""
    top = sets.iloc[:_SETS]
    nothing = sets[(sets["effects"] == 0) & ~sets.index.isin(top.index)]
    return pd.concat([top, nothing])


def set_colour(row: object) -> str:
    """Return the colour of a set: the answer, its equivalents, nothing, others."""
    if getattr(row, "best", False):
        return REPAIRED
    if getattr(row, "equivalent", False):
        return "#56B4E9"
    return NOMINAL if getattr(row, "effects", 1) == 0 else _GREY


def chance(p: float) -> str:
    """Return a probability as it is said."""
    if p < 0.001:
        return "below 0.001"
    return "above 0.999" if p > 0.999 else f"{p:.3f}"

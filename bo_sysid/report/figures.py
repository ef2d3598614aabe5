"""Figures of a run, as Matplotlib objects; they show what was stored and compute nothing."""

import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.artist import Artist
from matplotlib.figure import Figure
from matplotlib.text import Text
from matplotlib.ticker import FixedFormatter

from bo_sysid.report.bins import bin_edges
from bo_sysid.report.look import (
    GREY,
    IDENTIFIED,
    NOMINAL,
    RECORDED,
    SECOND,
    in_lines,
    since_start,
    with_gaps,
    worst_channels,
)

__all__ = [
    "IDENTIFIED",
    "NOMINAL",
    "RECORDED",
    "SECOND",
    "marginals",
    "predictions",
    "progress",
    "save",
]

_WIDTH = 7.2  # inches
_CHANNELS = 6
_SHOWN = 3_000
_LINES: dict[str, dict[str, Any]] = {
    "nominal": {"color": NOMINAL, "linewidth": 1.8},
    "identified": {"color": IDENTIFIED, "linewidth": 1.1, "linestyle": (0, (3, 3))},
}
"""Of two curves that are the same both are seen."""

_BESIDE = 0.1  # of the range that is drawn: so far beside it the nominal value is drawn as well


def marginals(belief: pd.DataFrame, parameters: pd.DataFrame) -> Figure:
    """Return the marginals of P and P_boot, one panel a parameter.

    Args:
        belief: one row a candidate: the parameters, P and P_boot.
        parameters: name, unit, nominal, value, low95 and high95 of each parameter.
    """
    count = len(parameters)
    figure = Figure(figsize=(_WIDTH, 2.3 * count), layout="constrained")
    axes = figure.subplots(count, 1, squeeze=False)[:, 0]
    for axis, row in zip(axes, parameters.itertuples(), strict=True):
        edges = bin_edges(belief[row.name].to_numpy(float))
        middle, width = (edges[:-1] + edges[1:]) / 2, np.diff(edges)
        for column, colour, label in (
            ("P_boot", SECOND, "P_boot: what the recordings say about the machine"),
            ("P", IDENTIFIED, "P: where the minimum lies on these recordings"),
        ):
            mass = np.histogram(belief[row.name], edges, weights=belief[column])[0]
            height = 0.9 * width if column == "P_boot" else 0.5 * width
            axis.bar(middle, mass, width=height, color=colour, alpha=0.85, label=label)
        axis.axvspan(row.low95, row.high95, color=SECOND, alpha=0.15, label="95 % interval")
        axis.axvline(row.value, color=IDENTIFIED, label="identified")
        beside = _BESIDE * (edges[-1] - edges[0])  # samples of a range miss its ends
        if edges[0] - beside <= row.nominal <= edges[-1] + beside:
            axis.axvline(row.nominal, color=NOMINAL, linestyle="--", label="nominal")
        axis.set_xlabel(_label(str(row.name), str(row.unit)))
        axis.set_ylabel("probability")
    drawn: dict[str, Artist] = {}
    for axis in axes:  # the nominal value may be drawn in some of them only
        handles, labels = axis.get_legend_handles_labels()
        drawn |= dict(zip(labels, handles, strict=True))
    figure.legend(
        drawn.values(), drawn.keys(), fontsize="x-small", loc="outside upper center", ncols=2
    )
    return figure


def progress(evaluations: pd.DataFrame) -> Figure:
    """Return deviation and entropy of P over the evaluations."""
    figure = Figure(figsize=(_WIDTH, 4.2), layout="constrained")
    top, bottom = figure.subplots(2, 1, sharex=True)
    number = np.arange(1, len(evaluations) + 1)
    deviation = evaluations["deviation"].to_numpy()
    top.semilogy(number, deviation, "o", color=SECOND, markersize=3, label="evaluated")
    lowest = np.minimum.accumulate(deviation)
    top.step(number, lowest, where="post", color=IDENTIFIED, label="lowest so far")
    top.set_ylabel("deviation [scaled]")
    top.legend(fontsize="small")
    bottom.plot(number, evaluations["entropy"], ".-", color=IDENTIFIED)
    bottom.set_ylabel("entropy of P [nats]")
    bottom.set_xlabel("evaluation")
    return figure


def predictions(
    traces: pd.DataFrame,
    title: str = "recordings set aside",
    units: Mapping[str, str] | None = None,
) -> Figure:
    """Return recorded, nominal and identified over time, and the residuals below.

    Of many channels those are drawn that the nominal model predicts worst.

    Args:
        traces: time, begin, window, channel, recorded, nominal, identified.
        title: of the figure.
        units: of the channels.
    """
    channels = list(dict.fromkeys(traces["channel"]))
    names = [n for n in channels if n in worst_channels(traces)[:_CHANNELS]]
    shown = since_start(traces)
    figure = Figure(figsize=(_WIDTH, 2.8 * len(names)), layout="constrained")
    axes = figure.subplots(2 * len(names), 1, squeeze=False, sharex=True)[:, 0]
    for k, name in enumerate(names):
        part = with_gaps(shown[shown["channel"] == name].sort_values("time").iloc[:_SHOWN])
        axis, below = axes[2 * k], axes[2 * k + 1]
        time = part["time"]
        axis.plot(time, part["recorded"], color=GREY, linewidth=4.0, label="recorded")
        for column, style in _LINES.items():
            axis.plot(time, part[column], label=column, **style)
            below.plot(time, part["recorded"] - part[column], **style)
        unit = (units or {}).get(name, "")
        axis.set_ylabel(in_lines(name) + (f"\n[{unit}]" if unit else ""))
        below.set_ylabel(_label("recorded -\npredicted", unit), fontsize="small")
        below.axhline(0, color=RECORDED, linewidth=0.5)
    hidden = len(channels) - len(names)
    axes[0].set_title(f"{title}\n{hidden} channels not shown" if hidden else title)
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, fontsize="small", ncols=3, loc="outside upper center")
    axes[-1].set_xlabel("time [s]")
    return figure


def save(figure: Figure, path: Path) -> None:
    """Write a figure; the ending says as what (png, pdf, svg).

    Names may hold any letter: a dollar begins no formula, and one that no font has is a box.
    """
    _as_written(figure)
    with warnings.catch_warnings():  # a panel too small for its labels is drawn all the same
        warnings.filterwarnings("ignore", "constrained_layout not applied")
        warnings.filterwarnings("ignore", "Glyph .* missing from font")
        figure.savefig(path, dpi=140)


def _as_written(figure: Figure) -> None:
    """Let texts of a figure be drawn as they are; numbers at ticks are formulas of matplotlib's."""
    named = [
        label
        for axes in figure.axes
        for axis in (axes.xaxis, axes.yaxis)
        if isinstance(axis.get_major_formatter(), FixedFormatter)
        for label in axis.get_ticklabels()
    ]
    for text in (*figure.findobj(Text), *named):
        if "$" in text.get_text():
            text.set_parse_math(False)


def _label(name: str, unit: str) -> str:
    return f"{name} [{unit}]" if unit else name

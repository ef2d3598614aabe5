"""The figure of the outer loop's benchmark: return on the plant against real trajectories."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from bo_sysid.report.figures import save
from bo_sysid.report.look import GREY, IDENTIFIED, NOMINAL, RECORDED, SECOND

LOOK = {
    "true": (RECORDED, "true parameters (reference)"),
    "worst": (NOMINAL, "worst candidate of B"),
    "nominal": ("#CC79A7", "nominal model"),
    "uniform": (SECOND, "all of B at random"),
    "method": (IDENTIFIED, "method"),
    "zhu": ("#009E73", "Zhu's variant"),
}
LOOPS = ("method", "zhu")
_BESIDE = {"method": 1.0, "zhu": 1.15}


def draw(figures: Mapping[str, Any], curves: Mapping[str, Any], path: Path) -> None:
    """Draw one panel a task and write them.

    Args:
        figures: by task, then arm: "return" and "seeds".
        curves: by task, then arm: each seed's real trajectories and returns.
        path: of the PNG.
    """
    figure = Figure(figsize=(4.2 * len(curves), 3.9), layout="constrained")
    panels = np.atleast_1d(figure.subplots(1, len(curves)))
    for axes, task in zip(panels, curves, strict=True):
        _panel(axes, figures[task], curves[task])
        axes.set_title(_title(task, figures[task]), fontsize="medium")
        axes.set_xlabel("real trajectories")
    panels[0].set_ylabel("return on the plant")
    told = {
        label: handle
        for axes in panels
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True)
    }
    figure.legend(told.values(), told.keys(), loc="outside lower center", ncols=4, fontsize="small")
    path.parent.mkdir(exist_ok=True)
    save(figure, path)


def _title(task: str, figures: Mapping[str, Any]) -> str:
    """Return the task with its number of seeds, and the arms that have fewer."""
    counts = {arm: figures[arm]["seeds"] for arm in LOOK if arm in figures}
    fewer = [f"{arm} {n}" for arm, n in counts.items() if n != counts["true"]]
    return f"{task}, {counts['true']} seeds" + (f" ({', '.join(fewer)})" if fewer else "")


def _panel(axes: Axes, figures: Mapping[str, Any], curves: Mapping[str, Any]) -> None:
    for arm in (a for a in ("true", "worst", "nominal", "uniform") if a in figures):
        colour, label = LOOK[arm]
        axes.axhline(figures[arm]["return"], color=colour, linestyle="--", label=label)
    for k, (x, y) in enumerate(curves.get("true", ())):
        label = "TRPO straight on the plant, exploring" if k == 0 else None
        axes.plot(x, y, color=GREY, linewidth=1, label=label)
    for arm in (a for a in LOOPS if a in figures):
        colour, label = LOOK[arm]
        for k, (x, y) in enumerate(curves[arm]):
            beside = np.array(x) * _BESIDE[arm]  # both have the same numbers of trajectories
            axes.plot(
                beside, y, color=colour, marker="o", markersize=4, linewidth=1, alpha=0.8,
                label=f"{label}, after each trajectory" if k == 0 else None,
            )  # fmt: skip
    axes.set_xscale("log")
    axes.set_ylim(bottom=0)

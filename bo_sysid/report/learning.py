"""What a run of `learn` found, as a figure and as text."""

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from bo_sysid.intervals import half_width
from bo_sysid.report.text import table
from bo_sysid.runs import Run, read_frame

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_TICKS = 12  # at most, each with its number


def learning_text(summary: Mapping[str, Any], folder: Path) -> str:
    """Return `learning.json` in words and tables."""
    rows = read_frame(folder, "iterations.parquet")
    episodes = rows.get("episodes", pd.Series(np.inf, rows.index))
    returns = {
        f"return on the {where} ± 95 %": [
            _with_interval({"mean": mean, "error": error, "samples": samples})
            if pd.notna(mean)
            else "–"
            for mean, error, samples in zip(
                rows[f"{where}_return"], rows[f"{where}_error"], episodes, strict=True
            )
        ]
        for where in ("model", "plant")
        if rows[f"{where}_return"].notna().any()
    }
    shown = ["iteration", "trajectories", "evaluated", "entropy", "deviation", "floor"]
    parts = [
        f"{summary['name']}: {_spent(summary)}.",
        "",
        table(rows[shown].assign(**returns)),
        "",
        f"The last policy was learned on {_chosen(summary)}.",
        summary["waiting"] or summary["stopped"],
        *(summary.get("to_run") or ()),
    ]
    if summary["notes"]:
        parts += ["", *[f"- {note}" for note in summary["notes"]]]
    return "\n".join(parts)


def _chosen(summary: Mapping[str, Any]) -> str:
    """Return the chosen parameters, with what P_boot leaves of each: "mass 1.2 (1.1 to 1.4)"."""
    rounds = summary.get("iterations") or [{}]
    intervals = rounds[-1].get("intervals") or {}
    each = []
    for name, value in summary["chosen"].items():
        low, high = intervals.get(name, (value, value))
        each.append(f"{name} {value:.4g}" + (f" ({low:.4g} to {high:.4g})" if high > low else ""))
    told = ", ".join(each)
    return f"{told} (in brackets P_boot's 95 %)" if "(" in told else told


def _spent(summary: Mapping[str, Any]) -> str:
    """Return how much was recorded, in words."""
    several = "y" if summary["trajectories"] == 1 else "ies"
    sentence = (
        f"{summary['trajectories']} real trajector{several} ({summary['seconds_recorded']:.4g} s)"
    )
    if summary.get("given"):
        several = "" if summary["given"] == 1 else "s"
        sentence += (
            f" beside the study's {summary['given']} recording{several} "
            f"({summary['given_seconds']:.4g} s)"
        )
    return sentence


def learning_summary(summary: Mapping[str, Any]) -> dict[str, Any]:
    """Return what `learning.json` amounts to: a verdict, the sentences below it, and notes."""
    spent = _spent(summary)
    why = summary["waiting"] or summary["stopped"]
    rounds = summary.get("iterations") or []
    with_plant = [r for r in rounds if r.get("plant_return")]
    notes = list(summary.get("notes") or ())
    if summary["waiting"]:
        return {"verdict": why, "sentences": [f"So far: {spent}.", *notes]}
    last = rounds[-1] if rounds else {}
    model = last.get("model_return")
    verdict = f"The policy was learned after {spent}."
    if with_plant:
        plant = _with_interval(with_plant[-1]["plant_return"])
        verdict = f"The policy returns {plant} on the plant, after {spent}."
    where = f"It was learned on {_chosen(summary)}"
    where += f", where it returns {_with_interval(model)}." if model else "."
    diagnosed = [r for r in rounds if r.get("diagnosis")]
    found = [f"{_after(r['trajectories'])} the diagnosis repaired the model." for r in diagnosed]
    sentences = [where, *found, f"Why it stopped: {why}", *(summary.get("to_run") or ()), *notes]
    return {"verdict": verdict, "sentences": sentences}


def _after(trajectories: int) -> str:
    if not trajectories:
        return "On the study's recordings"
    return f"After {trajectories} real trajector{'y' if trajectories == 1 else 'ies'}"


def _with_interval(value: Mapping[str, Any]) -> str:
    """Return a mean with its 95 % interval."""
    error = value.get("error")
    half = float(half_width(error, value.get("samples", np.inf))) if error else 0.0
    return f"{value['mean']:.4g} ± {float(f'{half:.2g}'):g}" if half else f"{value['mean']:.4g}"


def learning_curve(iterations: pd.DataFrame, training: pd.DataFrame) -> "Figure":
    """Return returns against real trajectories, and those of training against simulated steps.

    Args:
        iterations: trajectories, episodes, model_return, model_error, plant_return, plant_error,
            diagnosed.
        training: learned (the iteration), steps, batch_return.
    """
    from matplotlib.figure import Figure

    from bo_sysid.report.look import IDENTIFIED, NOMINAL, RECORDED, SECOND

    figure = Figure(figsize=(7.2, 5.6), layout="constrained")
    top, bottom = figure.subplots(2, 1)
    for kind, colour, size, label in (
        ("model", IDENTIFIED, 8, "on the identified model"),  # seen around what lies on it
        ("plant", RECORDED, 4, "on the plant"),
    ):
        mean = iterations[f"{kind}_return"].astype(float)
        if mean.notna().any():
            error = iterations[f"{kind}_error"].astype(float).fillna(0.0)
            half = half_width(error, iterations.get("episodes", np.inf))
            top.errorbar(
                iterations["trajectories"], mean, half, color=colour, marker="o",
                markersize=size, capsize=size - 1, label=label,
            )  # fmt: skip
    for number in iterations.loc[iterations["diagnosed"], "trajectories"]:
        top.axvline(number, color=NOMINAL, linestyle="--", label="diagnosis")
    counted = iterations["trajectories"]
    if len(counted) <= _TICKS:
        top.set_xticks(counted)
        top.set_xlim(counted.min() - 0.5, counted.max() + 0.5)
    else:
        top.xaxis.get_major_locator().set_params(integer=True)
    top.set_xlabel("real trajectories")
    top.set_ylabel("return (95 % interval)")
    top.legend(fontsize="small")
    last = training["learned"].max()
    for number in training["learned"].unique():
        part = training[training["learned"] == number]
        newest = number == last
        bottom.plot(
            part["steps"], part["batch_return"], color=IDENTIFIED if newest else SECOND,
            alpha=1.0 if newest else 0.5, label=f"iteration {number}" if newest else None,
        )  # fmt: skip
    bottom.set_xlabel("simulated control steps")
    bottom.set_ylabel("mean reward of a batch\n× steps of an episode")
    bottom.legend(fontsize="small")
    return figure


def write_learning_figures(run: Run) -> list[Path]:
    """Draw what `learn` left in a run folder; return the paths of the figures."""
    from bo_sysid.report.figures import save

    figure = learning_curve(
        run.read_frame("iterations.parquet"), run.read_frame("training.parquet")
    )
    with run.writing("figures/learning.png") as path:
        save(figure, path)
    return [run.path("figures/learning.png")]

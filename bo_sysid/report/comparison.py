"""What a run of `compare` found, as figures and as text."""

import itertools
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from bo_sysid.report.text import table
from bo_sysid.runs import Run, read_frame, read_json

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from bo_sysid.report.parts import Found, Section

_WIDTH = 7.2  # inches
_TELLING = 6  # pairs at least, of which a signed-rank test can say something at 95 %
_LEAST = 1e-4  # regrets below it are drawn there, on a logarithmic axis


def comparison_text(content: Mapping[str, Any], folder: Path) -> str:
    """Return `comparison.json` and its tables in words."""
    parts = [sentence(content), *conclusions(content, folder)]
    for caption, frame in tables_of(content, folder):
        parts += ["", f"{caption}:", table(frame)]
    parts += [f"- {name} was left out: {why}" for name, why in content["skipped"].items()]
    return "\n".join(parts)


def sentence(content: Mapping[str, Any]) -> str:
    """Return what was run, in one sentence."""
    runs, several = ("" if n == 1 else "s" for n in (content["runs"], len(content["arms"])))
    return f"{content['name']}: {content['runs']} run{runs} of {len(content['arms'])} arm{several}."


def conclusions(content: Mapping[str, Any], folder: Path) -> list[str]:
    """Return what the runs say of the first arm and each other one, a sentence each.

    Told is the lowest regret that both reach in all runs; costs of runs that do not are bounds.
    """
    if len(content["arms"]) == 1:
        return []
    unit, first = _unit(content), content["arms"][0]
    versus, spent = read_frame(folder, "paired.parquet"), read_frame(folder, "costs.parquet")
    versus = versus[versus["unit"] == unit]
    if "all" in set(versus["problem"]):
        versus = versus[versus["problem"] == "all"]
    sentences = []
    for arm in content["arms"][1:]:
        own = versus[(versus["arm"] == arm) & (versus["unreached"] == 0) & (versus["pairs"] > 0)]
        if own.empty:
            sentences.append(_reached(spent, first, arm))
        else:
            sentences.append(_ratio(own.loc[own["level"].idxmin()], first, arm, unit))
    return sentences


def _ratio(row: pd.Series, first: str, arm: str, unit: str) -> str:
    """Return in words what an arm costs beside the first one."""
    ratio, low, high, pairs = (row[n] for n in ("ratio", "low", "high", "pairs"))
    if low == high == 1:
        return (
            f"To a regret of {row['level']:g}, {arm} takes as many {unit} as {first} in all "
            f"{pairs} pairs."
        )
    if pairs < _TELLING:
        sure = "one pair, which says little" if pairs == 1 else f"{pairs} pairs, which say little"
    elif low <= 1 <= high:
        sure = f"95 % interval {low:.2f} to {high:.2f}: {pairs} pairs do not tell it from 1"
    else:
        sure = f"95 % interval {low:.2f} to {high:.2f}, {pairs} pairs"
    return (
        f"To a regret of {row['level']:g}, {arm} takes {ratio:.2f} times the {unit} of {first} "
        f"({sure})."
    )


def _reached(spent: pd.DataFrame, first: str, arm: str) -> str:
    """Return in words how often the lowest regret was reached, where not always."""
    level = spent["level"].min()
    there = spent[spent["level"] == level].groupby("arm")["reached"].agg(["sum", "count"])
    shares = [f"{there['sum'][a]} of {there['count'][a]} runs of {a}" for a in (first, arm)]
    return (
        f"A regret of {level:g} was reached in {' and in '.join(shares)}: what they cost is a "
        "bound."
    )


def tables_of(content: Mapping[str, Any], folder: Path) -> list[tuple[str, pd.DataFrame]]:
    """Return the tables of a comparison that a person reads, with their captions."""
    unit = _unit(content)
    means = read_frame(folder, "summary.parquet")
    cost = [
        f"{'' if reached == 1 else '≥ '}{mean:.3g}"
        + ("" if np.isnan(low) else f" [{low:.3g}, {high:.3g}]")
        for reached, mean, low, high in means[
            ["reached", unit, f"{unit}_low", f"{unit}_high"]
        ].to_numpy()
    ]
    shown = means.assign(reached=[f"{n:.0%}" for n in means["reached"]], **{unit: cost})
    found = [
        (
            f"Mean {unit} until the regret is at most a level, with 95 % intervals; a run that "
            "does not reach it counts as the longest one, and the mean is a lower bound (≥)",
            shown[["problem", "arm", "level", "runs", "reached", unit]],
        )
    ]
    if len(content["arms"]) > 1:
        versus = read_frame(folder, "paired.parquet")
        versus = versus[versus["unit"] == unit].drop(columns="unit")
        first = content["arms"][0]
        found.append(
            (
                f"{unit.capitalize()} over those of {first} on the same seeds: geometric mean, its "
                "95 % bootstrap interval, and p of Wilcoxon's signed-rank test, which few pairs "
                "cannot bring low; a pair in which one did not get there (unreached) counts it as "
                "the longest run",
                versus,
            )
        )
        if content["loop"] == "inner":
            columns = ["problem", "arm", "other", "pairs", "identical", "step", "overlap"]
            agreement = read_frame(folder, "agreement.parquet")
            agreement = agreement.loc[agreement["arm"] == first, columns]
            found.append(
                (
                    f"How alike {first} and the others pick: share of pairs with one and the same "
                    "path, median number of the first pick that differs, mean share of common "
                    "candidates",
                    agreement,
                )
            )
    return found


def _unit(content: Mapping[str, Any]) -> str:
    return "trajectories" if content["loop"] == "outer" else "evaluations"


def comparison(found: "Found") -> "Section | None":
    """The arms against each other."""
    from bo_sysid.report.parts import Section, Table

    if not found.has("comparison.json"):
        return None
    content = read_json(found.folder, "comparison.json")
    pictures = {
        "regret": f"Regret against {_unit(content)}: medians and quartiles over seeds.",
        "costs": f"{_unit(content).capitalize()} until a regret is reached: means and intervals.",
    }
    images = [
        (found.picture(f"figures/{name}.png"), words)
        for name, words in pictures.items()
        if found.has(f"figures/{name}.png")
    ]
    return Section(
        "comparison",
        "Arms against each other",
        images=images,
        tables=[(f"{c}.", Table.of(frame)) for c, frame in tables_of(content, found.folder)],
        items=[f"{name} was left out: {why}" for name, why in content["skipped"].items()],
    )


def regret_curves(paths: pd.DataFrame, unit: str) -> "Figure":
    """Return the median regret of each arm, with its quartiles, one panel a problem.

    Args:
        paths: as `bo_sysid.compare` writes them.
        unit: column on the horizontal axis.
    """
    from matplotlib.figure import Figure

    problems = list(paths["problem"].drop_duplicates())
    figure = Figure(figsize=(_WIDTH, 2.6 * len(problems)), layout="constrained")
    axes = figure.subplots(len(problems), 1, squeeze=False)[:, 0]
    colours = _colours(paths)
    for axis, problem in zip(axes, problems, strict=True):
        part = paths[paths["problem"] == problem]
        for (arm, runs), dash in zip(part.groupby("arm", sort=False), _dashes(), strict=False):
            middle, low, high = _quartiles(runs, unit)
            style: dict[str, Any] = {"color": colours[str(arm)]}
            axis.fill_between(middle.index, low, high, step="post", alpha=0.1, **style)
            style |= {"label": arm, "linestyle": dash, "linewidth": 1.4}
            axis.step(middle.index, middle, where="post", **style)
        axis.set_yscale("log")
        axis.set_ylabel(f"regret (0 at {_LEAST:g})", fontsize="small")
        axis.set_title(problem, fontsize="medium")
    axes[-1].set_xlabel(unit)
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, fontsize="x-small", ncols=4, loc="outside upper center")
    return figure


def _dashes() -> Iterator[str]:
    """Yield line styles, so that of curves on top of each other all are seen."""
    return itertools.cycle(("-", "--", ":", "-."))


def _quartiles(runs: pd.DataFrame, unit: str) -> tuple[pd.Series, pd.Series, pd.Series]:
    """Return median and quartiles over seeds; a run that has ended keeps its regret."""
    wide = runs.pivot_table(index=unit, columns="seed", values="regret").ffill()
    wide = wide.clip(lower=_LEAST)
    return tuple(wide.quantile(q, axis=1) for q in (0.5, 0.25, 0.75))  # type: ignore[return-value]


def cost_bars(means: pd.DataFrame, unit: str) -> "Figure":
    """Return the mean cost of each arm with its interval, one panel a problem, a colour a level.

    A mean with runs that did not get there is a lower bound, and hollow.

    Args:
        means: the summary of a comparison.
        unit: of the cost.
    """
    from matplotlib.figure import Figure

    problems = list(means["problem"].drop_duplicates())
    arms = list(means["arm"].drop_duplicates())
    height = 0.28 * len(arms) + 0.5
    figure = Figure(figsize=(_WIDTH, height * len(problems) + 0.8), layout="constrained")
    axes = figure.subplots(len(problems), 1, squeeze=False)[:, 0]
    for axis, problem in zip(axes, problems, strict=True):
        _bars(axis, means[means["problem"] == problem], arms, unit)
        axis.set_title(problem, fontsize="medium")
    bound = "" if (means["reached"] == 1).all() else "\nhollow: not in all runs, a lower bound"
    axes[-1].set_xlabel(f"{unit} until the regret is reached (mean, 95 % interval){bound}")
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, fontsize="x-small", ncols=4, loc="outside upper center")
    return figure


def _bars(axis: "Axes", part: pd.DataFrame, arms: list[str], unit: str) -> None:
    levels = list(part["level"].drop_duplicates())
    for k, level in enumerate(levels):
        at = part[part["level"] == level].set_index("arm").reindex(arms)
        place = np.arange(len(arms)) + 0.25 * (k - (len(levels) - 1) / 2)
        mean = at[unit]
        error = np.array([mean - at[f"{unit}_low"], at[f"{unit}_high"] - mean])
        axis.errorbar(mean, place, xerr=error, fmt="o", markersize=4, label=f"regret {level:g}")
        short = at["reached"].to_numpy(float) < 1
        axis.plot(mean[short], place[short], "o", markersize=2.5, color="w", zorder=3)
    axis.set_yticks(np.arange(len(arms)), arms, fontsize="x-small")
    axis.set_xlim(left=0)
    axis.set_ylim(len(arms) - 0.4, -0.6)  # the first arm on top


def _colours(paths: pd.DataFrame) -> dict[str, Any]:
    from matplotlib import colormaps

    arms = list(paths["arm"].drop_duplicates())
    palette = colormaps["tab20" if len(arms) > 10 else "tab10"]
    return {arm: palette(k) for k, arm in enumerate(arms)}


def write_comparison_figures(run: Run) -> None:
    """Write the figures of a comparison into its run folder."""
    from bo_sysid.report.figures import save

    outer = run.read_json("comparison.json")["loop"] == "outer"
    unit = "trajectories" if outer else "evaluations"
    drawn = {
        "regret": regret_curves(run.read_frame("paths.parquet"), unit),
        "costs": cost_bars(run.read_frame("summary.parquet"), unit),
    }
    for name, figure in drawn.items():
        with run.writing(f"figures/{name}.png") as path:
            save(figure, path)

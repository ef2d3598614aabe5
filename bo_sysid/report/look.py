"""What every figure shares: colours, words, and which part of a table is shown."""

import re
from collections.abc import Mapping, Sequence

import numpy as np
import pandas as pd

# Okabe and Ito's colours, which colour-blind people can tell apart
RECORDED, NOMINAL, IDENTIFIED, SECOND = "#000000", "#D55E00", "#0072B2", "#E69F00"
REPAIRED, EQUIVALENT, GREY = IDENTIFIED, "#56B4E9", "#AAAAAA"
COLOURS = {"nominal": NOMINAL, "refitted": SECOND, "repaired": REPAIRED, "identified": IDENTIFIED}
MODELS = {
    "nominal": "nominal model",
    "refitted": "refitted, no new physics",
    "repaired": "repaired model",
    "identified": "identified model",
}
_SECONDS = 12.0
_BETWEEN = 0.03  # of their length: gap between recordings in a row
_UNSURE = 0.5  # of the largest missing force: the deviation above which a piece says nothing
_SETS = 8
_LINE = 18  # letters of a name in a line beside a panel


def worst_channels(traces: pd.DataFrame) -> list[str]:
    """Return the channels, those first that the nominal model predicts worst for their range.

    Parts of a quaternion come last, which say nothing one by one, and jump where it turns about.
    """

    def badness(part: pd.DataFrame) -> float:
        recorded = part["recorded"].dropna()
        if recorded.empty:
            return 0.0
        error = rms(part["recorded"] - part["nominal"])
        # a model that diverged wherever there is something to predict is worse than any
        return error / max(float(np.ptp(recorded)), 1e-12) if np.isfinite(error) else np.inf

    names = list(dict.fromkeys(traces["channel"]))
    size = {n: badness(traces[traces["channel"] == n]) for n in names}
    return sorted(names, key=lambda n: (_turns(n, names), -size[n]))


def _turns(name: str, names: Sequence[str]) -> bool:
    """Whether a channel is a part of the quaternion of a floating base."""
    stem, _, index = name.rpartition(".")
    return index in {*"3456"} and all(f"{stem}.{k}" in names for k in range(7))


def in_lines(name: str) -> str:
    """Return a name in lines that fit beside a panel, broken behind its marks."""
    lines = [""]
    for part in re.findall(r"[^_./-]*[_./-]|[^_./-]+", name):
        if lines[-1] and len(lines[-1]) + len(part) > _LINE:
            lines.append("")
        lines[-1] += part
    return "\n".join(lines)


def rms(error: pd.Series) -> float:
    """Return the root mean square of what is there; NaN where nothing is."""
    return float(np.sqrt(np.square(error).mean()))


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


def channel_units(pieces: pd.DataFrame) -> dict[str, str]:
    """Return the unit of each position channel, from the joints' missing forces."""
    first = pieces.drop_duplicates("joint")
    hinges = zip(first["joint"], first["unit"], strict=True)
    return {f"qpos.{joint}": "rad" if unit == "N m" else "m" for joint, unit in hinges}


def error_units(errors: Sequence[Mapping[str, object]]) -> dict[str, str]:
    """Return the unit of each channel, from an identification's errors; earlier ones have none."""
    return {str(e["channel"]): str(e.get("unit", "")) for e in errors}


def since_start(table: pd.DataFrame) -> pd.DataFrame:
    """Return the rows with the time since their recording began; clocks may count from 1970.

    A table of an earlier version does not say when: there the first row counts as the start.
    """
    if "begin" in table:
        begin = table["begin"]
    elif "recording" in table:
        begin = table.groupby("recording")["time"].transform("min")
    else:
        begin = table["time"].min()
    return table.assign(time=table["time"] - begin)


def in_a_row(table: pd.DataFrame) -> tuple[pd.DataFrame, list[float]]:
    """Return the rows with recordings one after the other in time, and where each begins."""
    table = since_start(table)
    if "recording" not in table:
        return table, [0.0]
    lasts = table.groupby("recording", sort=False)["time"].max()
    gap = _BETWEEN * float(lasts.sum())
    begins = (lasts + gap).cumsum().shift(fill_value=0.0)
    moved = table["time"] + table["recording"].map(begins)
    return table.assign(time=moved), [float(b) for b in begins]


def time_label(begins: Sequence[float]) -> str:
    """Return what stands at the time axis of recordings that begin where they are said to."""
    return "time [s]" if len(begins) == 1 else "time [s], recordings in a row"


def first_part(traces: pd.DataFrame) -> pd.DataFrame:
    """Return the first seconds of the first recording."""
    first: pd.DataFrame = traces[traces["recording"] == traces["recording"].iloc[0]]
    return first.loc[first["time"] <= float(first["time"].min()) + _SECONDS]


def with_gaps(part: pd.DataFrame) -> pd.DataFrame:
    """Return the rows of one channel with a gap after each window: lines do not join two starts."""
    if part["window"].nunique() == len(part):  # predictions of one step each
        return part
    values = [c for c in ("recorded", *MODELS) if c in part]
    ends = part.groupby("window", sort=False).tail(1).assign(**dict.fromkeys(values, np.nan))
    return pd.concat([part, ends]).sort_values(["window", "time"], kind="stable")


def top_sets(sets: pd.DataFrame) -> pd.DataFrame:
    """Return the sets that are shown, the most probable first.

    Among them are in any case the answer, what is equivalent to it, "nothing is missing" and "none
    of these".
    """
    ordered = sets.sort_values("probability", ascending=False, kind="stable")
    shown = ordered["effects"].eq(0) | ordered["set"].eq("none of these")
    shown.iloc[:_SETS] = True
    for column in ("best", "equivalent"):
        if column in ordered:
            shown |= ordered[column].astype(bool)
    return ordered[shown]


def set_colour(row: object) -> str:
    """Return the colour of a set: the answer, its equivalents, nothing, others."""
    if getattr(row, "best", False):
        return REPAIRED
    if getattr(row, "equivalent", False):
        return EQUIVALENT
    return NOMINAL if getattr(row, "effects", 1) == 0 else GREY


def left_words(rms: float, probability: float, p_boot: float) -> str:
    """Return what a set leaves, where that is known, with its probability and P_boot."""
    chance = "below 0.001" if probability < 0.001 else f"{probability:.3g}"
    words = f"probability {'above 0.999' if probability > 0.999 else chance}"
    words += f", P_boot {p_boot:.2f}" if np.isfinite(p_boot) else ""
    left = f"{rms:,.0f}" if rms >= 1000 else f"{rms:.3g}"
    return f"{left}, {words}" if np.isfinite(rms) else words

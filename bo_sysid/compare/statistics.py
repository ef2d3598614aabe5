"""What paired runs of arms say: cost to reach a regret, and how it differs between arms.

References:
    Efron & Tibshirani (1993), An introduction to the bootstrap, chapter 13 (percentile interval).
    Wilcoxon (1945), Individual comparisons by ranking methods.
    Wilson (1927), Probable inference, the law of succession, and statistical inference.
"""

import itertools
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import pandas as pd
from jaxtyping import Float
from scipy.stats import binomtest, sem, wilcoxon

from bo_sysid.intervals import half_width

DRAWS = 10_000
_FEW = 10  # values, below which a percentile interval covers less than it says (5: 83 %)
LEVEL = 0.95
_SLACK = 1e-12  # of regret above a level that still counts as reached: rounding


def bootstrap(values: Float[np.ndarray, " n"], seed: int = 0) -> tuple[float, float, float]:
    """Return the mean and its 95 % interval; NaN of a single value.

    The interval is the percentile bootstrap's, of fewer than ten values Student's t: bootstraps of
    so few have too small a spread.

    Args:
        values: independent.
        seed: of the draws.
    """
    values = np.asarray(values, float)
    mean = float(values.mean())
    if len(values) < 2:
        return mean, float("nan"), float("nan")
    if len(values) < _FEW:
        half = float(half_width(sem(values), len(values)))
        return mean, mean - half, mean + half
    rows = np.random.default_rng(seed).integers(len(values), size=(DRAWS, len(values)))
    low, high = np.quantile(values[rows].mean(axis=1), [0.5 - LEVEL / 2, 0.5 + LEVEL / 2])
    return mean, float(low), float(high)


def share(right: int, of: int) -> tuple[float, float, float]:
    """Return a share and its 95 % Wilson interval; NaN where nothing was counted."""
    if not of:
        return (float("nan"),) * 3
    interval = binomtest(right, of).proportion_ci(LEVEL, method="wilson")
    return right / of, float(interval.low), float(interval.high)


def costs(paths: pd.DataFrame, levels: Sequence[float], units: Sequence[str]) -> pd.DataFrame:
    """Return what each run spent until its regret was at most each level.

    Args:
        paths: one row a step of a run, in order: problem, arm, seed, regret (of what the run had
            found until then) and the units, cumulated.
        levels: of regret.
        units: columns of `paths` that count cost; the first one is limited equally for all runs.

    Returns:
        One row a run and level: problem, arm, seed, level, reached, and each unit. A run that did
        not reach a level counts as if it had spent as much of the first unit as the longest run of
        the problem did, and of the others in proportion: stopping early is no saving by itself.
    """
    limits = paths.groupby("problem", sort=False)[units[0]].max()
    rows = []
    for key, run in paths.groupby(["problem", "arm", "seed"], sort=False):
        row: dict[str, Any] = dict(zip(("problem", "arm", "seed"), key, strict=True))
        regret = run["regret"].to_numpy(float)
        longer = float(limits.loc[row["problem"]] / run[units[0]].iloc[-1])
        for level in dict.fromkeys(levels):  # each counts once
            there = np.flatnonzero(regret <= level + _SLACK)
            at, factor = (int(there[0]), 1.0) if len(there) else (len(run) - 1, longer)
            spent = {unit: factor * float(run[unit].iloc[at]) for unit in units}
            rows.append({**row, "level": level, "reached": bool(len(there)), **spent})
    return pd.DataFrame(rows)


def summary(spent: pd.DataFrame, units: Sequence[str]) -> pd.DataFrame:
    """Return for each problem, arm and level the share that reached it and the mean costs.

    Args:
        spent: as `costs` returns it.
        units: columns that count cost.

    Returns:
        Columns problem, arm, level, runs, reached, reached_low, reached_high and, for each unit,
        its mean, `<unit>_low` and `<unit>_high` (95 %).
    """
    rows = []
    for key, part in spent.groupby(["problem", "arm", "level"], sort=False):
        row = dict(zip(("problem", "arm", "level"), key, strict=True)) | {"runs": len(part)}
        reached = share(int(part["reached"].sum()), len(part))
        row |= dict(zip(("reached", "reached_low", "reached_high"), reached, strict=True))
        for unit in units:
            names = (unit, f"{unit}_low", f"{unit}_high")
            row |= dict(zip(names, bootstrap(part[unit].to_numpy(float)), strict=True))
        rows.append(row)
    return pd.DataFrame(rows)


def paired(spent: pd.DataFrame, units: Sequence[str], reference: str) -> pd.DataFrame:
    """Return how the costs of each arm compare with the reference's on the same seeds.

    Args:
        spent: as `costs` returns it.
        units: columns that count cost.
        reference: the arm that the others are compared with.

    Returns:
        One row a problem (and "all" of them together), arm, level and unit: pairs, unreached (of
        them, in which one run or both did not get to the level), ratio (the geometric mean of arm
        over reference; below 1 the arm is cheaper), low, high (bootstrap, 95 %), p (Wilcoxon
        signed-rank, two-sided; 1 where all pairs are equal).
    """
    index = ["problem", "seed", "level"]
    theirs = spent[spent["arm"] == reference].set_index(index)
    rows = []
    for arm in spent["arm"].drop_duplicates():
        if arm == reference:
            continue
        own = spent[spent["arm"] == arm].set_index(index)
        both = own.index.intersection(theirs.index, sort=False)
        one, other = own.loc[both], theirs.loc[both]
        logs = np.log(one[list(units)] / other[list(units)])
        logs = logs.assign(unreached=~(one["reached"] & other["reached"])).reset_index()
        for where, part in _with_all(logs):
            for level, at_level in part.groupby("level", sort=False):
                for unit in units:
                    comparison = _compared(at_level[unit].to_numpy(float))
                    which = {"problem": where, "arm": arm, "level": level, "unit": unit}
                    unreached = int(at_level["unreached"].sum())
                    rows.append(
                        {**which, "pairs": len(at_level), "unreached": unreached, **comparison}
                    )
    columns = ["problem", "arm", "level", "unit", "pairs", "unreached", "ratio", "low", "high", "p"]
    return pd.DataFrame(rows, columns=columns)


def _with_all(frame: pd.DataFrame) -> Iterator[tuple[str, pd.DataFrame]]:
    parts = list(frame.groupby("problem", sort=False))
    yield from ((str(name), part) for name, part in parts)
    if len(parts) > 1:
        yield "all", frame


def _compared(logs: Float[np.ndarray, " n"]) -> dict[str, float]:
    mean, low, high = np.exp(bootstrap(logs)) if len(logs) else (np.nan,) * 3
    differ = bool((logs != 0).any())
    p = float(wilcoxon(logs, zero_method="zsplit").pvalue) if differ else 1.0
    return {"ratio": mean, "low": low, "high": high, "p": p}


def agreement(paths: pd.DataFrame) -> pd.DataFrame:
    """Return how much the picks of every pair of arms agree on the same seeds.

    Args:
        paths: one row an evaluation, in order: problem, arm, seed, row, and chosen (False for the
            initial design, which the arms share).

    Returns:
        One row a problem and pair of arms: pairs, identical (share of seeds with one and the same
        path, as far as both went) with its interval, step (median number of the first pick that
        differs; NaN where none does), overlap (mean share of common candidates among the picks).
    """
    picked = paths[paths["chosen"]]
    rows = []
    for problem, part in picked.groupby("problem", sort=False):
        runs = {
            (str(run["arm"].iloc[0]), int(run["seed"].iloc[0])): run["row"].to_numpy(int)
            for _, run in part.groupby(["arm", "seed"], sort=False)
        }
        arms = list(part["arm"].drop_duplicates())
        for one, other in itertools.combinations(arms, 2):
            seeds = sorted({s for a, s in runs if a == one} & {s for a, s in runs if a == other})
            if seeds:
                both = [(runs[one, s], runs[other, s]) for s in seeds]
                rows.append({"problem": problem, "arm": one, "other": other, **_alike(both)})
    columns = ["problem", "arm", "other", "pairs", "identical", "identical_low",
               "identical_high", "step", "overlap"]  # fmt: skip
    return pd.DataFrame(rows, columns=columns)


def _alike(both: Sequence[tuple[np.ndarray, np.ndarray]]) -> dict[str, float]:
    steps, overlaps = [], []
    for one, other in both:
        count = min(len(one), len(other))
        differ = np.flatnonzero(one[:count] != other[:count])
        if len(differ):
            steps.append(int(differ[0]) + 1)
        common = len(np.intersect1d(one[:count], other[:count]))
        overlaps.append(common / max(count, 1))
    same = len(both) - len(steps)
    identical, low, high = share(same, len(both))
    return {
        "pairs": len(both),
        "identical": identical,
        "identical_low": low,
        "identical_high": high,
        "step": float(np.median(steps)) if steps else float("nan"),
        "overlap": float(np.mean(overlaps)),
    }

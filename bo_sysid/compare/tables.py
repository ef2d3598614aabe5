"""From the records of single runs to the tables of a comparison."""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
import pandas as pd


class Key(NamedTuple):
    """One run of a comparison."""

    problem: str
    arm: str
    seed: int


Records = Mapping[Key, Mapping[str, Any]]

INNER_UNITS = ("evaluations", "steps", "seconds")
OUTER_UNITS = ("trajectories", "evaluations", "steps")


def inner_paths(records: Records) -> pd.DataFrame:
    """Return one row an evaluation of a search.

    The regret is the excess of the lowest Δ so far over that of B, in shares of the excess of the
    median candidate. Where Δ is not known on all of B, the lowest that any arm found on the same
    recordings stands for it, and the median of what all arms evaluated.

    Returns:
        Columns problem, arm, seed, evaluations (1, 2, …), row, chosen (by the arm; False in the
        initial design), deviation, regret, entropy, max_p, right (whether the row of the largest P
        is an arg-min of Δ on B; missing where not known), steps and seconds so far.
    """
    scales = _scales(records)
    parts = []
    for key, record in records.items():
        lowest, median = scales[key.problem, key.seed]
        deviation = np.array(record["deviation"])
        so_far = np.minimum.accumulate(deviation)
        count = len(deviation)
        design = _designed(record)
        part = pd.DataFrame(
            {
                "problem": key.problem,
                "arm": key.arm,
                "seed": key.seed,
                "evaluations": np.arange(1, count + 1),
                "row": record["row"],
                "chosen": np.arange(count) >= design,
                "deviation": deviation,
                "regret": (so_far - lowest) / max(median - lowest, np.finfo(float).tiny),
            }
        )
        for name in ("entropy", "max_p", "steps", "seconds"):
            part[name] = np.array(record[name], float)
        part["right"] = pd.Series(record["right"], dtype="boolean")
        parts.append(part)
    return pd.concat(parts, ignore_index=True)


def _designed(record: Mapping[str, Any]) -> int:
    """Return how many evaluations were the initial design: no belief is computed before its end."""
    return next(n for n, entropy in enumerate(record["entropy"], 1) if entropy is not None)


def _scales(records: Records) -> dict[tuple[str, int], tuple[float, float]]:
    """Return lowest and median Δ of each problem and seed."""
    found: dict[tuple[str, int], list[Mapping[str, Any]]] = {}
    for key, record in records.items():
        found.setdefault((key.problem, key.seed), []).append(record)
    scales = {}
    for where, those in found.items():
        known = those[0]
        if known["lowest"] is not None:
            scales[where] = known["lowest"], known["median"]
        else:
            every = np.concatenate([np.array(r["deviation"]) for r in those])
            scales[where] = float(every.min()), float(np.median(every))
    return scales


def ends(records: Records) -> pd.DataFrame:
    """Return one row a search: how it ended, and whether P_boot covers the plant's parameters.

    Returns:
        Columns problem, arm, seed, stopped, evaluations, settled, max_p, and covered and
        uncertain, the numbers of parameters whose interval holds the truth and whose truth is
        known.
    """
    rows = []
    for key, record in records.items():
        known = [
            (low <= truth <= high)
            for truth, low, high in zip(
                record["truth"], record["low95"], record["high95"], strict=True
            )
            if truth is not None
        ]
        rows.append(
            {
                **key._asdict(),
                "stopped": record["stopped"],
                "evaluations": len(record["row"]),
                "settled": record["settled"],
                "max_p": record["max_p"][-1],
                "covered": sum(known),
                "uncertain": len(known),
            }
        )
    return pd.DataFrame(rows).astype({"settled": "Int64"})


def outer_paths(records: Records) -> pd.DataFrame:
    """Return one row an iteration of an outer loop.

    The regret is the shortfall of the policy's return on the plant from the best that any arm
    reached with the same plant, in shares of it; that of the best policy so far counts.

    Returns:
        Columns problem, arm, seed, trajectories, evaluations, steps, plant_return, plant_error,
        model_return, regret.
    """
    best: dict[tuple[str, int], float] = {}
    for key, record in records.items():
        where = key.problem, key.seed
        best[where] = max(best.get(where, -np.inf), *record["plant_return"])
    parts = []
    for key, record in records.items():
        top = best[key.problem, key.seed]
        so_far = np.maximum.accumulate(record["plant_return"])
        parts.append(
            pd.DataFrame(
                {
                    **key._asdict(),
                    "trajectories": record["trajectories"],
                    "evaluations": record["evaluations"],
                    "steps": record["steps"],
                    "plant_return": record["plant_return"],
                    "plant_error": record["plant_error"],
                    "model_return": record["model_return"],
                    "regret": (top - so_far) / max(abs(top), np.finfo(float).tiny),
                }
            )
        )
    return pd.concat(parts, ignore_index=True)

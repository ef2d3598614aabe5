"""What a comparison says in words."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from bo_sysid.compare.statistics import agreement, costs, paired, summary
from bo_sysid.report.comparison import comparison_text, conclusions, cost_bars
from bo_sysid.runs import Run

UNITS = ["evaluations"]


def compared(folder: Path, finds: dict[str, list[int]], length: int = 30) -> tuple[dict, Path]:
    """Write the tables of runs of `length` evaluations that find the lowest at given ones."""
    parts = [
        pd.DataFrame(
            {
                "problem": "p",
                "arm": arm,
                "seed": seed,
                "evaluations": np.arange(1, length + 1),
                "row": np.arange(length),
                "chosen": np.arange(length) > 0,
                "regret": np.where(np.arange(1, length + 1) >= found, 0.0, 1.0),
            }
        )
        for arm, at in finds.items()
        for seed, found in enumerate(at)
    ]
    paths = pd.concat(parts, ignore_index=True)
    spent = costs(paths, [0.0], UNITS)
    arms = list(finds)
    told = {"name": "test", "loop": "inner", "arms": arms, "runs": len(parts), "skipped": {}}
    with Run.open(folder, {"name": "test"}, "compare") as run:
        run.write_frame("costs.parquet", spent)
        run.write_frame("summary.parquet", summary(spent, UNITS))
        run.write_frame("paired.parquet", paired(spent, UNITS, arms[0]))
        run.write_frame("agreement.parquet", agreement(paths))
    return told, folder


@pytest.mark.parametrize(
    ("other", "says"),
    [
        ([20, 22, 18, 24, 20, 16], "b takes 2.00 times the evaluations of a (95 % interval"),
        ([11, 10, 10, 11, 10, 8], "6 pairs do not tell it from 1"),
        ([20, 22, 18], "b takes 2.00 times the evaluations of a (3 pairs, which say little)."),
        ([20], "(one pair, which says little)."),
        ([10, 11, 9, 12, 10, 8], "b takes as many evaluations as a in all 6 pairs."),
        ([20, 99, 18, 99, 20, 16], "reached in 6 of 6 runs of a and in 4 of 6 runs of b: what"),
    ],
)
def test_what_the_arms_cost_is_said_in_a_sentence(
    tmp_path: Path, other: list[int], says: str
) -> None:
    (said,) = conclusions(*compared(tmp_path / "run", {"a": [10, 11, 9, 12, 10, 8], "b": other}))
    assert says in said


def test_costs_of_runs_that_did_not_get_there_are_bounds(tmp_path: Path) -> None:
    """A run that stopped short counts as the longest: a mean with it is no mean of costs."""
    text = comparison_text(*compared(tmp_path / "run", {"a": [10, 12, 14], "b": [30, 99, 99]}))
    assert "≥ 30 [30, 30]" in text
    assert " 12 [" in text
    assert "unreached" in text
    assert "≥ 12" not in text


def test_means_that_are_bounds_are_drawn_hollow(tmp_path: Path) -> None:
    _, folder = compared(tmp_path / "run", {"a": [10, 12, 14], "b": [30, 99, 99]})
    figure = cost_bars(pd.read_parquet(folder / "summary.parquet"), "evaluations")
    (axis,) = figure.axes
    (hollow,) = [line for line in axis.lines if line.get_color() == "w"]
    assert hollow.get_xydata().tolist() == [[30.0, 1.0]]
    assert "hollow: not in all runs, a lower bound" in axis.get_xlabel()

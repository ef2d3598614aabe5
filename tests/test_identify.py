"""The search and the identification, against functions and machines whose answer is known."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from bo_sysid.belief.stopping import StopReason, StopRule
from bo_sysid.deviation import Evaluation
from bo_sysid.errors import RunError
from bo_sysid.identify.journal import Journal
from bo_sysid.identify.refine import zoomed
from bo_sysid.identify.result import Identification
from bo_sysid.identify.search import History, Rules, initial_rows, search
from bo_sysid.parameters import CandidateSet, Parameter
from bo_sysid.runs import Run

X = Parameter("x", ("joint[a].damping",), 0.0, 1.0, 13)
Y = Parameter("y", ("joint[b].damping",), 0.0, 2.0, 13)
TRUTH = np.array([0.33, 1.41])


def bowl(candidates: CandidateSet, floor: float = 0.02):  # type: ignore[no-untyped-def]
    """A deviation with a floor, as of a norm of residuals, and a narrow valley."""

    def evaluate(row: int) -> Evaluation:
        u = (candidates.points[row] - TRUTH) / np.array([1.0, 2.0])
        value = np.sqrt(floor**2 + (u @ np.array([[6.0, 5.0], [5.0, 6.0]]) @ u))
        blocks = value * (1 + 0.01 * np.sin(np.arange(8) + row))
        return Evaluation(np.array([value]), blocks[None], np.zeros(1))

    return evaluate


@pytest.fixture(scope="module")
def grid() -> CandidateSet:
    return CandidateSet.from_grid([X, Y])


def test_the_search_finds_the_minimum_in_a_tenth_of_the_evaluations(grid: CandidateSet) -> None:
    everything = [bowl(grid)(row).deviation[0] for row in range(len(grid))]
    rules = Rules("argmin-entropy", StopRule(17))
    outcome = search(grid, bowl(grid), rules, History.empty(8))
    assert outcome.belief.best == int(np.argmin(everything))
    assert len(outcome.history) <= 17
    assert len(set(outcome.history.rows)) == len(outcome.history)  # none twice


def test_what_recordings_tell_of_a_sum_alone_is_said(grid: CandidateSet) -> None:
    # P_boot along x/1 + y/2 = 1, half of it: the sum is known, neither summand is
    u = grid.points / np.array([1.0, 2.0])
    valley = np.isclose(u.sum(axis=1), 1.0) & (u[:, 0] > 0.2) & (u[:, 0] < 0.8)
    boot = valley / valley.sum()
    sure = (np.arange(len(grid)) == np.flatnonzero(valley)[0]).astype(float)
    for p, told in ((boot, 1), (sure, 0)):
        spread = grid.points[p > 0]
        low, high = spread.min(axis=0), spread.max(axis=0)
        table = pd.DataFrame({"name": ["x", "y"], "low95": low, "high95": high})
        found = Identification(
            "valley", grid.points[0], table, grid, sure, p, pd.DataFrame({"deviation": [1.0]}),
            pd.DataFrame(), pd.DataFrame(), "", (),
        )  # fmt: skip
        tied = found.identifiability
        assert list(tied["correlation"]) == pytest.approx([-told, -told])
        assert tied["of_range"].to_numpy() == pytest.approx((high - low) / [1.0, 2.0])
        against = [s for s in found.unsure if "x and y move against each other" in s]
        assert len(against) == told


def test_every_candidate_evaluated_means_converged() -> None:
    small = CandidateSet.from_grid([Parameter("x", ("a",), 0.0, 1.0, 3), replace(X, steps=3)])
    rules = Rules("random", StopRule(1000, entropy=None))
    outcome = search(small, bowl(small), rules, History.empty(8))
    assert outcome.reason is StopReason.CONVERGED


def test_an_interrupted_search_goes_on_to_the_same_result(grid: CandidateSet) -> None:
    rules = Rules("argmin-entropy", StopRule(9, entropy=None), 5)
    steps: list[History] = []
    whole = search(grid, bowl(grid), rules, History.empty(8), steps.append)
    for cut in (2, len(steps) - 1):
        again = search(grid, bowl(grid), rules, steps[cut])
        np.testing.assert_array_equal(again.history.rows, whole.history.rows)
        np.testing.assert_array_equal(again.history.entropy, whole.history.entropy)
        np.testing.assert_array_equal(again.belief.probabilities, whole.belief.probabilities)


def test_the_initial_design_fills_the_box(grid: CandidateSet) -> None:
    rows = initial_rows(grid, Rules("random", StopRule(60)))
    assert len(set(rows.tolist())) == 6
    unit = grid.points[rows] / np.array([1.0, 2.0])
    assert (np.ptp(unit, axis=0) > 0.5).all()
    tiny = CandidateSet.from_grid([Parameter("x", ("a",), 0.0, 1.0, 2)])
    assert sorted(initial_rows(tiny, Rules("random", StopRule(60)))) == [0, 1]


def test_zooming_keeps_the_minimum_and_what_is_known(grid: CandidateSet) -> None:
    table = np.array([bowl(grid)(row).deviation[0] for row in range(len(grid))])
    mass = np.exp(-(table - table.min()) / 0.02)
    history = History.empty(8)
    for row in (0, 5, int(table.argmin()), 100):
        history = history.told(row, bowl(grid)(row))
    finer = zoomed(grid, history, mass / mass.sum(), 0)
    assert finer is not None
    candidates, known = finer
    low, high = candidates.bounds
    assert ((low <= TRUTH) & (high >= TRUTH)).all()
    assert ((high - low) < 0.7 * (grid.bounds[1] - grid.bounds[0])).all()
    assert 1 <= len(known) < 4  # those in the box, the corner of the old one not among them
    for row, value in zip(known.rows, known.evaluation.deviation, strict=True):
        assert bowl(candidates)(int(row)).deviation[0] == value
    fine = np.array([bowl(candidates)(row).deviation[0] for row in range(len(candidates))])
    assert fine.min() < table.min()
    np.testing.assert_allclose(
        candidates.points[fine.argmin()], TRUTH, atol=float(np.max(candidates.spacing))
    )


def test_zooming_stops_where_the_box_does_not_shrink(grid: CandidateSet) -> None:
    flat = np.full(len(grid), 1 / len(grid))
    assert zoomed(grid, History.empty(8).told(0, bowl(grid)(0)), flat, 0) is None


def test_the_journal_gives_back_what_was_written(grid: CandidateSet, tmp_path: Path) -> None:
    history = History.empty(8)
    for row in (3, 77, 120):
        history = history.told(row, bowl(grid)(row)).with_entropy(1.0 / row)
    with Run.open(tmp_path / "run", {"name": "s"}, "identify") as run:
        Journal(run, "abc").write(0, grid, history)
        back = Journal(run, "abc").history(0, 8)
        np.testing.assert_array_equal(back.rows, history.rows)
        np.testing.assert_array_equal(back.entropy, history.entropy)
        np.testing.assert_array_equal(
            back.evaluation.contributions, history.evaluation.contributions
        )
        assert len(Journal(run, "abc").history(1, 8)) == 0
        frame = run.read_frame("evaluations.parquet")
        pd.testing.assert_series_equal(
            frame["x"], pd.Series(grid.points[[3, 77, 120], 0], name="x")
        )
        with pytest.raises(RunError, match="recordings or the model changed"):
            Journal(run, "other")

"""The search and the identification, against functions and machines whose answer is known."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from scipy.spatial import cKDTree

from bo_sysid.belief.stopping import StopReason, StopRule
from bo_sysid.deviation import Blocks, Evaluation
from bo_sysid.errors import RecordingError, RunError
from bo_sysid.identify.journal import Journal
from bo_sysid.identify.problem import make_problem
from bo_sysid.identify.refine import Level, joined, zoomed
from bo_sysid.identify.result import Identification
from bo_sysid.identify.search import (
    History,
    Rules,
    SearchOutcome,
    initial_rows,
    search,
    update_belief,
)
from bo_sysid.parameters import CandidateSet, Parameter
from bo_sysid.runs import Run
from bo_sysid.study import Study

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


@pytest.mark.parametrize("share", [1e-1, 1e-3, 1e-5])
def test_a_faint_minimum_is_found_as_fast_as_a_deep_one(grid: CandidateSet, share: float) -> None:
    """Where noise makes most of Δ it varies by a small share over B, and is no less smooth."""
    low, high = grid.bounds
    u = (grid.points - low) / (high - low)
    values = 1 + share * ((u - np.array([0.35, 0.7])) ** 2).sum(axis=1)

    def evaluate(row: int) -> Evaluation:
        return Evaluation(values[[row]], np.full((1, 8), values[row]), np.zeros(1))

    outcome = search(grid, evaluate, Rules("argmin-entropy", StopRule(20)), History.empty(8))
    assert outcome.belief.best == int(values.argmin())
    assert outcome.reason.value == "converged"


def test_a_sensor_of_speed_without_any_position_is_refused(tmp_path: Path) -> None:
    """Starts that nothing measures were sought from rest, and friction was told to be none."""
    turning = """<mujoco><worldbody><body><joint name="x" armature="1"/><geom size=".1"/></body>
      </worldbody><actuator><motor name="m" joint="x"/></actuator>
      <sensor><jointvel name="tacho" joint="x"/></sensor></mujoco>"""
    (tmp_path / "turning.xml").write_text(turning)
    time = np.arange(0.0, 4.0, 0.02)
    columns = {"time": time, "sensor.tacho": np.cos(time), "ctrl.m": np.sin(time)}
    pd.DataFrame(columns).to_csv(tmp_path / "log.csv", index=False)
    data = {
        "model": {"file": "turning.xml", "unrecorded": {"x": None}},
        "recordings": {"train": "log.csv", "holdout": "log.csv"},
        "parameters": [{"address": "joint[x].frictionloss", "low": 0.0, "high": 1.0}],
    }
    with pytest.raises(RecordingError, match="no position was recorded, and identify needs one"):
        make_problem(Study.from_dict(data, tmp_path))


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


@pytest.mark.parametrize(
    ("low", "high", "said"),
    [((0.1, 1.8), (0.3, 2.0), "y: the interval ends"), ((0.0, 0.2), (0.3, 0.4), "")],
)
def test_an_interval_that_the_search_cuts_off_is_said(
    grid: CandidateSet, low: tuple[float, ...], high: tuple[float, ...], said: str
) -> None:
    """A rotor of .00098 +- .00006 was told of a search up to .001; less than nothing is none."""
    sure = (np.arange(len(grid)) == 0).astype(float)
    table = pd.DataFrame({"name": ["x", "y"], "low95": low, "high95": high})
    found = Identification(
        "cut", grid.points[0], table, grid, sure, sure, pd.DataFrame({"deviation": [1.0]}),
        pd.DataFrame(), pd.DataFrame(), "", (),
    )  # fmt: skip
    assert [s[: len(said)] for s in found.unsure] == ([said] if said else [])


@pytest.mark.parametrize(
    ("y", "sure", "said"),
    [(1.4, 0.2, True), (1.6, 0.2, False), (2.0, 0.2, True), (1.4, 0.9, False)],
)
def test_a_value_outside_its_interval_is_said(
    grid: CandidateSet, y: float, sure: float, said: bool
) -> None:
    """A search of 25 picks at random ended with .58, whose interval was .59 to .69."""
    best = int(np.abs(grid.points - [0.2, y]).sum(axis=1).argmin())
    p = np.where(np.arange(len(grid)) == best, sure, (1 - sure) / (len(grid) - 1))
    table = pd.DataFrame({"name": ["x", "y"], "low95": [0.1, 1.6], "high95": [0.3, 1.9]})
    found = Identification(
        "outside", grid.points[best], table, grid, p, p, pd.DataFrame({"deviation": [1.0]}),
        pd.DataFrame(), pd.DataFrame(), "", (),
    )  # fmt: skip
    assert [s[:12] for s in found.unsure] == ["y: the value"] * said


@pytest.mark.parametrize(("left", "said"), [(0.17, "340 standard deviations"), (6e-4, "")])
def test_recordings_that_nothing_explains_are_said(
    grid: CandidateSet, left: float, said: str
) -> None:
    """Intervals of a model that lacks a spring looked as sure as those of a right one."""
    sure = (np.arange(len(grid)) == 0).astype(float)
    point = grid.points[0]
    table = pd.DataFrame({"name": ["x", "y"], "low95": point, "high95": point})
    errors = pd.DataFrame(
        {
            "recordings": ["train", "train", "train", "holdout"],
            "kind": ["fit", "fit", "forecast", "fit"],
            "channel": ["qpos.a", "qvel.a", "qpos.a", "qpos.a"],
            "unit": ["rad", "rad/s", "rad", "rad"],
            "nominal": [9.0, 9.0, 9.0, 9.0],
            "identified": [left, 9.0, 9.0, 9.0],
        }
    )
    found = Identification(
        "spring", point, table, grid, sure, sure, pd.DataFrame({"deviation": [1.0]}),
        errors, pd.DataFrame(), "", (), {"qpos.a": 5e-4},
    )  # fmt: skip
    assert any(said in s for s in found.unsure) if said else found.unsure == ()


@pytest.mark.parametrize(("nominal", "said"), [(0.018, True), (0.6, False)])
def test_candidates_that_are_all_worse_than_the_model_as_it_is_are_said(
    grid: CandidateSet, nominal: float, said: bool
) -> None:
    """Ten thousand points in six dimensions were all far from a rotor of a thousandth of theirs."""
    sure, point = (np.arange(len(grid)) == 0).astype(float), grid.points[0]
    table = pd.DataFrame({"name": ["x", "y"], "low95": point, "high95": point})
    errors = pd.DataFrame(
        {
            "recordings": ["train", "train", "holdout"], "kind": "fit", "unit": "rad",
            "channel": ["qpos.wheel", "qpos.rod", "qpos.rod"],
            "nominal": [nominal, 8e-4, 9.0], "identified": [0.58, 6e-3, 8.0],
        }
    )  # fmt: skip
    errors.loc[1, "identified"] = 6e-3 if said else 5e-4
    found = Identification(
        "far", point, table, grid, sure, sure, pd.DataFrame({"deviation": [1.0]}),
        errors, pd.DataFrame(), "", (),
    )  # fmt: skip
    words = "(qpos.wheel: 0.018 rad, and 0.58 with the best of them)"
    assert [words in s for s in found.unsure] == [True] * said
    assert ["refine: true" in s for s in found.unsure] == [True] * said
    zoomed = pd.DataFrame({"level": [0, 1], "deviation": [2.0, 1.0]})
    assert not any("refine: true" in s for s in replace(found, evaluations=zoomed).unsure)


@pytest.mark.parametrize(("wheel", "said"), [(250.0, True), (2.0, False)])
def test_a_channel_that_its_spread_hides_is_named(
    grid: CandidateSet, wheel: float, said: bool
) -> None:
    point = grid.points[0]
    table = pd.DataFrame({"name": ["x", "y"], "low95": [0.0, 0.0], "high95": [1.0, 0.1]})
    p = np.full(len(grid), 1 / len(grid))
    found = Identification(
        "hidden", point, table, grid, p, p, pd.DataFrame({"deviation": [1.0]}), pd.DataFrame(),
        pd.DataFrame(), "", (), {"qpos.wheel": 5e-4, "qpos.rod": 2.5e-4},
        {"qpos.wheel": wheel, "qpos.rod": 0.4},
    )  # fmt: skip
    whiten = "`deviation: {whiten: {qpos.wheel: 0.0005, qpos.rod: 0.00025}}`"
    assert any(whiten in s for s in found.unsure) == said


def test_what_is_certain_is_tied_to_nothing() -> None:
    """Its spread over P_boot is a rounding, and so is what that has to do with another's."""
    rng, values = np.random.default_rng(0), []
    for _ in range(60):
        ends = rng.uniform(0, 0.5, 3), rng.uniform(0.6, 2, 3)
        axes = [Parameter(n, (n,), a, b, 11) for n, a, b in zip("abc", *ends, strict=True)]
        whole = CandidateSet.from_grid(axes)
        own = [axis.grid[int(rng.integers(1, 10))] for axis in axes[:2]]
        boot = np.where((whole.points[:, :2] == own).all(axis=1), rng.random(len(whole)), 0.0)
        table = pd.DataFrame({"name": list("abc"), "low95": ends[0], "high95": ends[0] + 0.01})
        found = Identification(
            "certain", whole.points[0], table, whole, boot, boot / boot.sum(), pd.DataFrame(),
            pd.DataFrame(), pd.DataFrame(), "", (),
        )  # fmt: skip
        values += list(found.identifiability["correlation"])
    assert not np.any(values)


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
        history = history.with_evaluation(row, bowl(grid)(row))
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
    assert zoomed(grid, History.empty(8).with_evaluation(0, bowl(grid)(0)), flat, 0) is None


def test_a_box_reaches_to_the_neighbours_in_every_parameter() -> None:
    uneven = CandidateSet.from_grid([replace(X, steps=101), replace(X, name="y", steps=3)])
    here = np.flatnonzero(np.isclose(uneven.points, 0.5).all(axis=1))
    history = History.empty(8).with_evaluation(int(here[0]), bowl(uneven)(int(here[0])))
    finer = zoomed(uneven, history, np.eye(len(uneven))[here[0]], 0)
    assert finer is not None
    np.testing.assert_allclose(finer[0].bounds, [[0.49, 0.0], [0.51, 1.0]])


def test_no_candidate_is_there_twice_after_zooming(grid: CandidateSet) -> None:
    history = History.empty(8)
    for row in range(len(grid)):
        history = history.with_evaluation(row, bowl(grid)(row))
    middle = len(grid) // 2
    finer = zoomed(grid, history, np.eye(len(grid))[middle], 0)
    assert finer is not None
    candidates, known = finer
    apart = cKDTree(candidates.points / candidates.cell).query(
        candidates.points / candidates.cell, k=2
    )[0][:, 1]
    assert len(known) == 9  # the middle and its neighbours
    assert apart.min() > 0.5


def level(candidates: CandidateSet, history: History) -> Level:
    """A set in which nothing more is evaluated."""
    rules = Rules("argmin-entropy", StopRule(1))
    surrogate, belief = update_belief(candidates, history, rules)
    return Level(candidates, SearchOutcome(history, surrogate, belief, StopReason.BUDGET))


BLOCKS = Blocks(np.arange(8), np.full(8, 1 / 8), None)


def test_a_value_is_not_there_twice_a_rounding_apart_after_zooming() -> None:
    """Candidates that were not evaluated have values of finer grids as well."""
    whole = CandidateSet.from_grid([replace(X, low=0.3, high=0.9, steps=7), replace(X, name="y")])
    for row in range(0, len(whole), 5):
        history = History.empty(8).with_evaluation(row, bowl(whole)(row))
        finer = zoomed(whole, history, np.eye(len(whole))[row], 0)
        assert finer is not None
        points = joined([level(whole, history), level(*finer)], BLOCKS, 0).candidates.points
        for values, cell in zip(points.T, finer[0].cell, strict=True):
            assert np.diff(np.unique(values)).min() > 0.01 * cell


def test_all_sets_together_have_the_finer_one_in_its_box(grid: CandidateSet) -> None:
    middle = len(grid) // 2
    history = History.empty(8)
    for row in (0, middle, 3):
        history = history.with_evaluation(row, bowl(grid)(row))
    finer = zoomed(grid, history, np.eye(len(grid))[middle], 0)
    assert finer is not None
    candidates, known = finer
    known = known.with_evaluation(len(known), bowl(candidates)(len(known)))
    coarse, fine = level(grid, history), level(candidates, known)
    whole = joined([coarse, fine], BLOCKS, 0)
    points = whole.candidates.points
    assert len(np.unique(points, axis=0)) == len(points)
    low, high = candidates.bounds
    outside = ((grid.points < low - 1e-9) | (grid.points > high + 1e-9)).any(axis=1)
    expected = {*map(tuple, grid.points[outside]), *map(tuple, candidates.points)}
    assert {*map(tuple, points)} == expected
    within = ((points > low - 1e-9) & (points < high + 1e-9)).all(axis=1)
    np.testing.assert_allclose(whole.cells[within], np.tile(candidates.cell, (within.sum(), 1)))
    np.testing.assert_allclose(whole.cells[~within], np.tile(grid.cell, ((~within).sum(), 1)))
    # P of the box times P within it
    assert whole.probabilities.sum() == pytest.approx(1.0)
    of_box = 1 - coarse.outcome.belief.probabilities[outside].sum()
    assert whole.probabilities[within].sum() == pytest.approx(of_box)
    ratio = whole.probabilities[within].max() / whole.probabilities[within].sum()
    assert ratio == pytest.approx(fine.outcome.belief.probabilities.max())
    assert whole.bootstrap.sum() == pytest.approx(1.0)


def test_the_initial_design_keeps_to_the_budget(grid: CandidateSet) -> None:
    known = History.empty(8).with_evaluation(7, bowl(grid)(7))
    outcome = search(grid, bowl(grid), Rules("random", StopRule(2)), known)
    assert len(outcome.history) == 2
    assert outcome.reason is StopReason.BUDGET


def test_the_journal_gives_back_what_was_written(grid: CandidateSet, tmp_path: Path) -> None:
    history = History.empty(8)
    for row in (3, 77, 120):
        history = history.with_evaluation(row, bowl(grid)(row)).with_entropy(1.0 / row)
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
        with pytest.raises(RunError, match=r"the recordings, the model or a file .* changed"):
            Journal(run, "other")

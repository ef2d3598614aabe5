"""Choices, stop rules, values and the floor, against answers worked out by hand."""

from copy import copy
from dataclasses import replace
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
from learning import pendulum

from bo_sysid.belief.stopping import StopReason
from bo_sysid.errors import StudyError
from bo_sysid.identify.problem import make_problem
from bo_sysid.intervals import half_width
from bo_sysid.learn import CHOICES, STOPS
from bo_sysid.learn.choose import CHOOSE
from bo_sysid.learn.floor import ABOVE, Floor, floor_of, lacks_physics
from bo_sysid.learn.hand_over import beyond_limits
from bo_sysid.learn.identified import Identified, identified
from bo_sysid.learn.iteration import Iteration
from bo_sysid.learn.learn import doubts
from bo_sysid.learn.scene import Scene
from bo_sysid.learn.stops import (
    STOP_RULES,
    Verdict,
    distances,
    near_enough,
    neighbours,
    value_guided,
)
from bo_sysid.learn.values import Estimate, Values, values
from bo_sysid.parameters import CandidateSet, Parameter
from bo_sysid.plants.build import build_plant, foreign_task, record
from bo_sysid.plants.limits import LimitedTask
from bo_sysid.plants.simulations import Simulations
from bo_sysid.plants.tasks.base import VectorTask
from bo_sysid.plants.tasks.pendulum import PendulumSwingup
from bo_sysid.policy.store import LearnedPolicy
from bo_sysid.runs import Run, plain
from bo_sysid.study import Study
from bo_sysid.study.inputs import load_model

X = Parameter("x", ("joint[a].damping",), 0.0, 1.0, 11)
Y = Parameter("y", ("joint[b].damping",), 0.0, 4.0, 11)


@pytest.fixture(scope="module")
def grid() -> CandidateSet:
    return CandidateSet.from_grid([X, Y])


def row(grid: CandidateSet, x: float, y: float) -> int:
    return int(np.abs(grid.points - [x, y]).sum(axis=1).argmin())


def test_the_names_in_studies_are_those_of_the_registries() -> None:
    assert tuple(CHOOSE) == CHOICES
    assert tuple(STOP_RULES) == STOPS


def test_choices() -> None:
    p, mean = np.array([0.2, 0.5, 0.3, 0.0]), np.array([1.0, 0.3, 0.2, 0.9])
    rng = np.random.default_rng(0)
    assert CHOOSE["argmax"](p, mean, rng) == 1
    assert CHOOSE["minimum-mean"](p, mean, rng) == 2
    drawn = np.bincount([CHOOSE["sample"](p, mean, rng) for _ in range(4000)], minlength=4) / 4000
    np.testing.assert_allclose(drawn, p, atol=0.03)


def test_distances_are_in_shares_of_the_bounds(grid: CandidateSet) -> None:
    here = row(grid, 0.5, 2.0)
    assert distances(grid, here)[row(grid, 0.7, 2.4)] == pytest.approx(0.2)
    assert distances(grid, here)[row(grid, 0.5, 0.0)] == pytest.approx(0.5)
    near = neighbours(grid, here, 0.1)
    assert len(near) == 8  # one step either way in two parameters
    assert here not in near
    assert len(neighbours(grid, row(grid, 0.0, 0.0), 0.1)) == 3
    assert set(neighbours(grid, here, 0.05)) == set(near)  # the nearest, where none is
    farthest = neighbours(grid, here, 0.2, most=16)
    assert (distances(grid, here)[farthest] > 0.15).all()


def test_any_two_categories_are_as_far_apart_as_the_bounds() -> None:
    kind = Parameter("kind", ("geom[g].size",), 0.0, 20.0, 21, ordered=False)
    alone, mixed = CandidateSet.from_grid([kind]), CandidateSet.from_grid([X, kind])
    np.testing.assert_array_equal(distances(alone, 7), np.arange(21) != 7)
    assert len(neighbours(alone, 7, 0.05)) == 0
    here = row(mixed, 0.5, 7.0)
    near = mixed.points[neighbours(mixed, here, 0.1)]
    np.testing.assert_allclose(near, [[0.4, 7.0], [0.6, 7.0]])


def slope(grid: CandidateSet, gain: float):  # type: ignore[no-untyped-def]
    """Values that change by `gain` over the whole of x, with noise common to all models."""

    def valued(rows: np.ndarray, times: int) -> Values:
        common = np.random.default_rng(5).normal(0.0, 30.0, 8 * times)
        return Values(100.0 + gain * grid.points[rows, :1] + common)

    return valued


def test_the_seeds_rule_needs_both_conditions(grid: CandidateSet) -> None:
    here = row(grid, 0.5, 2.0)
    flat, steep = slope(grid, 10.0), slope(grid, 1000.0)
    good = near_enough(grid, here, here, 0.1, 0.05, flat)
    assert good.stop
    # one step of x changes the value by 1, exactly the same in every episode
    assert good.figures["largest_difference"]["mean"] == pytest.approx(1.0, abs=1e-9) or (
        good.figures["largest_difference"]["mean"] == pytest.approx(-1.0, abs=1e-9)
    )
    assert good.figures["largest_difference"]["error"] == pytest.approx(0.0, abs=1e-9)
    assert not near_enough(grid, here, here, 0.1, 0.05, steep).stop
    away = near_enough(grid, here, row(grid, 0.7, 2.0), 0.1, 0.05, flat)
    assert not away.stop
    assert away.figures["distance"] == pytest.approx(0.2)
    coarse = near_enough(grid, here, here, 0.05, 0.05, steep)
    assert not coarse.stop  # the nearest candidates are farther than epsilon
    assert "the nearest candidates, 0.1 of the bounds away (epsilon is 0.05)," in coarse.sentence
    assert near_enough(grid, here, here, 0.05, 0.05, flat).stop
    assert "0.2 of the bounds away" in away.sentence

    def worthless(rows: np.ndarray, times: int) -> Values:
        return Values(np.zeros((len(rows), 4)))

    assert not near_enough(grid, here, here, 0.1, 0.05, worthless).stop


def noisy(grid: CandidateSet, gain: float, spread: float, seed: int):  # type: ignore[no-untyped-def]
    """Values that change by `gain` over the whole of x, with noise of each model's own."""

    def valued(rows: np.ndarray, times: int) -> Values:
        noise = np.random.default_rng((seed, times)).normal(0.0, spread, (len(rows), 20 * times))
        return Values(100.0 + gain * grid.points[rows, :1] + noise)

    return valued


def test_noise_alone_does_not_keep_the_loop_going(grid: CandidateSet) -> None:
    # equal values, known to ± 3: the largest of 8 differences is often beyond the allowed 5
    here = row(grid, 0.5, 2.0)
    told = [near_enough(grid, here, here, 0.1, 0.05, noisy(grid, 0.0, 13.0, s)) for s in range(40)]
    assert np.mean([v.stop for v in told]) >= 0.9
    # a step of x that changes the value by 20, four times what is allowed, does
    told = [near_enough(grid, here, here, 0.1, 0.05, noisy(grid, 200, 13.0, s)) for s in range(40)]
    assert np.mean([v.stop for v in told]) <= 0.05
    # episodes that cannot tell are no reason to stop
    blind = near_enough(grid, here, here, 0.1, 0.05, noisy(grid, 0.0, 300.0, 0))
    assert not blind.stop
    assert "too uncertain" in blind.sentence


def test_neighbours_in_doubt_are_valued_again(grid: CandidateSet) -> None:
    here, asked = row(grid, 0.5, 2.0), []
    far = neighbours(grid, here, 0.2)[-1]  # worth 4 less for certain: within what is allowed

    def valued(rows: np.ndarray, times: int) -> Values:
        asked.append((rows.tolist(), times))
        noise = np.random.default_rng(times).normal(0.0, 13.0, (len(rows), 20 * times))
        noise[rows == far] = noise[0] - 4.0
        return Values(100.0 + noise)

    verdict = near_enough(grid, here, here, 0.2, 0.05, valued)
    (first, once), (second, often) = asked
    assert (len(first), once, often) == (25, 1, 4)
    assert set(first) - set(second) == {far}
    assert verdict.stop
    assert verdict.figures["largest_difference"]["mean"] == pytest.approx(4.0)
    assert verdict.figures["episodes"] == 20  # those behind the difference that is told


def test_the_value_guided_rule_is_the_expected_difference(grid: CandidateSet) -> None:
    p = np.zeros(len(grid))
    best, other, slight = row(grid, 0.5, 2.0), row(grid, 0.9, 2.0), row(grid, 0.0, 2.0)
    p[[best, other, slight]] = 0.6, 0.395, 0.005
    verdict = value_guided(p, 0.05, 0.01, slope(grid, 20.0))
    assert verdict.figures["expected_difference"] == pytest.approx(0.395 * 0.4 * 20.0)
    assert verdict.figures["mass"] == pytest.approx(0.995)
    assert verdict.stop
    assert not value_guided(p, 0.01, 0.01, slope(grid, 20.0)).stop
    broad = np.full(len(grid), 1 / len(grid))
    told = value_guided(broad, 0.5, 0.01, slope(grid, 0.0))
    assert not told.stop
    assert "hold 0 of P" in told.sentence
    worthless = value_guided(p, 0.05, 0.01, lambda rows, times: Values(np.zeros((len(rows), 8))))
    assert not worthless.stop


def test_values_of_a_single_episode_are_written(grid: CandidateSet) -> None:
    """The error of one episode is infinite, which JSON does not know."""
    one = value_guided(
        np.eye(len(grid))[0], 0.05, 0.01, lambda rows, times: Values(np.ones((len(rows), 1)))
    )
    settled = Identified(
        rows=np.zeros(1, int), deviation=np.ones(1), entropy=np.zeros(1), fresh=1,
        probabilities=np.ones(1), bootstrap=np.ones(1), mean=np.zeros(1),
        reason=StopReason.CONVERGED, floor=Floor(1.0, 1.0, 0.0), interval=np.zeros((2, 1)),
        guided=one.figures,
    )  # fmt: skip
    assert plain(settled.figures())["search_values"]["value"]["error"] is None


def test_what_an_earlier_version_wrote_of_an_identification_is_read(
    grid: CandidateSet, tmp_path: Path
) -> None:
    count = len(grid)
    boot = np.zeros(count)
    boot[[3, 4]] = 0.5
    own = Identified(
        rows=np.arange(2), deviation=np.ones(2), entropy=np.zeros(2), fresh=2,
        probabilities=boot, bootstrap=boot, mean=np.zeros(count), reason=StopReason.CONVERGED,
        floor=Floor(1.0, 1.0, 0.0), interval=np.array([grid.points.min(0), grid.points.max(0)]),
        moved="It did.",
    )  # fmt: skip
    with Run.open(tmp_path / "run", {}, "learn") as run:
        own.write(run, "iterations/01", grid)
        again = Identified.read(run, "iterations/01")
        assert again is not None
        np.testing.assert_array_equal(again.interval, own.interval)
        assert again.moved == "It did."
        figures = run.read_json("iterations/01/identified.json")
        del figures["interval"], figures["moved"]
        run.write_json("iterations/01/identified.json", figures)
        before = Identified.read(run, "iterations/01")
    assert before is not None
    likely = grid.points[[3, 4]]
    np.testing.assert_array_equal(before.interval, [likely.min(axis=0), likely.max(axis=0)])
    assert before.moved == ""


def test_estimates() -> None:
    told = Estimate.of(np.array([1.0, 2.0, 3.0, 6.0]))
    assert told.mean == 3.0
    assert told.error == pytest.approx(np.std([1, 2, 3, 6], ddof=1) / 2)
    assert Estimate.of(np.array([1.0])).error == np.inf


def test_values_are_paired_over_models() -> None:
    scene = Scene.of(Study.from_dict(pendulum(learn={"episodes": 3})))
    points = scene.candidates.points
    light, heavy = scene.compiled(points[0]), scene.compiled(points[-1])

    def act(observation: np.ndarray) -> np.ndarray:
        return np.sign(observation[:, 2:])  # pump energy in

    told = values(scene, [light, heavy, light], act)
    assert told.returns.shape == (3, 3)
    np.testing.assert_array_equal(told.returns[0], told.returns[2])
    assert told.difference(0, 2) == Estimate(0.0, 0.0, 3)
    alone = values(scene, [heavy], act)
    np.testing.assert_array_equal(alone.returns[0], told.returns[1])
    assert np.abs(told.returns[0] - told.returns[1]).max() > 0


@pytest.mark.parametrize(
    ("ratio", "reason", "expected"),
    [
        (3.0, StopReason.CONVERGED, True),
        (3.0, StopReason.ENTROPY, True),
        (3.0, StopReason.BUDGET, False),
        (3.0, StopReason.VALUES, False),
        (1.1, StopReason.CONVERGED, False),
    ],
)
def test_physics_is_missing_where_a_converged_floor_is_high(
    ratio: float, reason: StopReason, expected: bool
) -> None:
    floor = Floor(deviation=5.0 * ratio, noise=4.0, resolution=3.0)
    assert floor.ratio == pytest.approx(ratio)
    assert lacks_physics(floor, reason) is expected


@pytest.mark.parametrize("settled", [False, True])
def test_a_search_that_values_ended_tells_nothing_of_physics_that_is_missing(settled) -> None:
    """The plant is one of B; what is left is that of a search that has not come to it yet."""
    plain = pendulum(search={"budget": 40, "seed": 2})
    plain["recordings"]["noise"] = plain["plant"]["noise"] = {"qpos": 1e-5, "qvel": 1e-4}
    study = Study.from_dict(plain)
    recording = build_plant(study).record(np.sin(np.arange(600)[:, None] * 0.11))

    def valued(probabilities: np.ndarray) -> Verdict:
        return Verdict(not settled or bool(probabilities.max() > 0.999), "")

    found = identified(Scene.of(study), [recording], np.zeros(0, int), valued)
    missing = 1.0 - found.probabilities[found.rows].sum()
    assert not lacks_physics(found.floor, found.reason)
    if settled:
        assert missing < 1e-3
        assert not found.floor.is_above
    else:
        assert missing > 0.5
        assert found.floor.is_above
        assert found.reason is StopReason.VALUES


@pytest.mark.parametrize("rates", [True, False])
@pytest.mark.parametrize(
    ("effects", "high"),
    [
        ([], False),
        ([{"effect": "dry_friction", "kind": "joint", "site": "hinge", "value": 0.3}], True),
    ],
)
def test_the_expected_floor_is_that_of_a_plant_without_effects(
    effects: list[dict[str, object]], high: bool, rates: bool
) -> None:
    """Where rates are not recorded starts are fitted, and take over much of the noise."""
    plain = pendulum()
    plain["plant"] = {
        "parameters": {"mass": 1.23, "damping": 0.84},
        "noise": {"qpos": 0.001, "qvel": 0.01},
        "effects": effects,
    }
    study = Study.from_dict(plain)
    plant = build_plant(study, seed=3)
    controls = np.sin(np.arange(600)[:, None] * 0.11)
    recording = plant.record(controls)
    if not rates:
        kept = {n: c for n, c in recording.channels.items() if not n.startswith("qvel")}
        recording = replace(recording, channels=kept)
    problem = make_problem(study, [recording])
    assert problem.deviation.fitted_starts is not rates
    points = problem.candidates.points
    found = problem.deviation(points).deviation
    best = int(found.argmin())
    floor = floor_of(problem, points[best], float(found[best]))
    assert lacks_physics(floor, StopReason.CONVERGED) is high
    if not high:
        assert 0.8 < floor.ratio < 1.1


TWO = """<mujoco><option timestep="0.002" integrator="implicitfast"/><worldbody><body pos="0 0 1">
<joint name="a" axis="0 1 0" damping=".1"/>
<geom type="capsule" fromto="0 0 0 .3 0 0" size=".02" mass=".5"/>
<body pos=".3 0 0"><joint name="b" axis="0 1 0" damping=".05"/>
<geom type="capsule" fromto="0 0 0 .2 0 0" size=".02" mass=".3"/></body></body></worldbody>
<actuator><motor name="a" joint="a" ctrlrange="-1 1"/></actuator></mujoco>"""


def measured(
    folder: Path, text: str, parameters: list[dict[str, object]], **changed: object
) -> Study:
    """A study of a plant that its model has right, but for the noise of its sensors."""
    (folder / "model.xml").write_text(text)
    noise = {"qpos": 1e-3, "qvel": 1e-2}
    study = {
        "model": "model.xml",
        "recordings": {"train": ["none.csv"], "noise": noise},
        "parameters": parameters,
        "plant": {"noise": noise},
    }
    return Study.from_dict({**study, **changed}, folder)


def test_noise_counts_only_where_something_was_recorded(tmp_path: Path) -> None:
    """One joint at a tenth of the other's rate; at the truth Δ is that of the noise alone."""
    damping = {"address": "joint[a].damping", "low": 0.05, "high": 0.15}
    study = measured(tmp_path, TWO, [damping], deviation={"horizon": 10})
    (whole,) = record(build_plant(study), load_model(study), 1, duration=4.0)
    slow = {
        n: replace(c, time=c.time[::10], values=c.values[::10])
        for n, c in whole.channels.items()
        if n.endswith(".b")
    }
    problem = make_problem(study, [replace(whole, channels={**whole.channels, **slow})])
    truth = np.array([0.1])
    found = float(problem.deviation(truth[None]).deviation[0])
    assert floor_of(problem, truth, found).noise == pytest.approx(found, rel=0.1)


FLOATING = """<mujoco><option timestep="0.01" gravity="0 0 0" density="20"/><worldbody>
<body pos="0 0 1"><freejoint name="root"/>
<geom name="hull" type="box" size=".2 .1 .05" mass="1"/>
<body pos=".2 0 0"><joint name="h" axis="0 1 0" damping=".05"/>
<geom type="capsule" size=".02" fromto="0 0 0 .3 0 0" mass=".2"/></body></body></worldbody>
<actuator><motor name="m" joint="h" ctrlrange="-.3 .3"/></actuator></mujoco>"""


@pytest.mark.parametrize("joint", ["free", "ball"])
@pytest.mark.parametrize("horizon", [1, 10])
def test_noise_counts_on_joints_that_turn_freely(tmp_path: Path, joint: str, horizon: int) -> None:
    """At the truth Δ is that of the noise alone, which starts of free bodies have as well."""
    ball = FLOATING.replace('<freejoint name="root"/>', '<joint name="root" type="ball"/>')
    mass = {"address": "geom[hull].mass", "low": 0.5, "high": 1.5, "steps": 11}
    text = FLOATING if joint == "free" else ball
    study = measured(tmp_path, text, [mass], deviation={"horizon": horizon})
    recordings = record(build_plant(study), load_model(study), 2, duration=5.0)
    problem = make_problem(study, recordings)
    truth = np.array([1.0])
    found = float(problem.deviation(truth[None]).deviation[0])
    assert floor_of(problem, truth, found).noise == pytest.approx(found, rel=0.06)


def test_a_resolution_is_measured_within_the_bounds(tmp_path: Path, monkeypatch) -> None:
    """Few candidates of many parameters stand for boxes wider than half of the bounds."""
    wide = [f"joint[{j}].{what}" for j in "ab" for what in ("damping", "armature", "frictionloss")]
    parameters = [{"address": a, "low": 0.01, "high": 0.1} for a in wide]
    study = measured(tmp_path, TWO, parameters, search={"candidates": {"sobol": 16}})
    problem = make_problem(study, record(build_plant(study), load_model(study), 1, duration=1.0))
    low, high = problem.candidates.bounds
    assert (problem.candidates.cell > 0.5 * (high - low)).all()
    simulator, seen = problem.deviation.simulator, []
    predictions = type(simulator).predictions

    def watched(self, points, *args, **kwargs):
        seen.append(points)
        return predictions(self, points, *args, **kwargs)

    monkeypatch.setattr(type(simulator), "predictions", watched)
    for best in problem.candidates.points:
        assert floor_of(problem, best, 1.0).resolution > 0
    points = np.concatenate(seen)
    assert (points >= low - 1e-12).all()
    assert (points <= high + 1e-12).all()


def test_few_windows_lack_no_physics_by_chance(tmp_path: Path) -> None:
    """A recording that broke off at once: what two or three draws of noise leave varies much."""
    damping = {"address": "joint[a].damping", "low": 0.05, "high": 0.15, "steps": 3}
    study = measured(tmp_path, TWO, [damping])
    plant, truth, high, beyond = build_plant(study), np.array([0.1]), 0, 0
    for _ in range(40):
        (whole,) = record(plant, load_model(study), 1, duration=0.008)
        problem = make_problem(study, [whole])
        found = float(problem.deviation(truth[None]).deviation[0])
        floor = floor_of(problem, truth, found)
        beyond += floor.ratio > ABOVE
        high += lacks_physics(floor, StopReason.CONVERGED)
    assert beyond >= 4
    assert high <= 1


@pytest.mark.parametrize("rates", [True, False])
def test_categories_add_nothing_to_the_expected_floor(rates: bool) -> None:
    """As if the machine's own category had been written into the model."""
    plain = pendulum()
    mass, damping = plain["parameters"]
    kinds = [mass, {**damping, "ordered": False}]
    recording = build_plant(Study.from_dict(plain), seed=3).record(np.full((300, 1), 0.5))
    if not rates:
        kept = {n: c for n, c in recording.channels.items() if not n.startswith("qvel")}
        recording = replace(recording, channels=kept)
    floors = []
    for parameters, best in (([mass], [1.2]), (kinds, [1.2, 1.0])):
        study = Study.from_dict({**plain, "parameters": parameters, "plant": None})
        problem = make_problem(study, [recording])
        floors.append(floor_of(problem, np.array(best), 1.0))
    assert floors[1].resolution == pytest.approx(floors[0].resolution, rel=1e-9)
    assert floors[1].noise == pytest.approx(floors[0].noise, rel=1e-9)


def test_the_first_and_the_last_category_are_no_end_of_b() -> None:
    plain = pendulum()
    mass, damping = plain["parameters"]
    scene = Scene.of(
        Study.from_dict({**plain, "parameters": [mass, {**damping, "ordered": False}]})
    )
    assert doubts(ended(scene, {"mass": 1.5, "damping": 0.5})) == [
        "mass = 1.5 is an end of B; widen it if it may lie beyond"
    ]


def ended(
    scene: Scene,
    chosen: dict[str, float],
    worst: float = 5.0,
    *,
    floor: float = 1.0,
    reason: StopReason = StopReason.CONVERGED,
    moved: str = "",
) -> Iteration:
    """An iteration whose worst candidate left so many times the noise."""
    found = Mock(
        floor=Floor(floor, 1.0, 0.0), reason=reason, deviation=np.array([1.0, worst]), moved=moved
    )
    return Mock(Iteration, scene=scene, found=found, figures={"chosen": chosen})


@pytest.mark.parametrize(
    ("floor", "reason", "said"),
    [
        (1.34, StopReason.BUDGET, "1.3 times what noise and the spacing of B leave is left, and"),
        (1.34, StopReason.CONVERGED, "no candidate explains the recordings: 1.3 times"),
        (1.1, StopReason.BUDGET, ""),
    ],
)
def test_a_search_that_ended_early_says_that_it_looked_for_no_physics(
    floor: float, reason: StopReason, said: str
) -> None:
    """34 % above the floor were left after 12 of 30 evaluations, without a word."""
    scene = Scene.of(Study.from_dict(pendulum()))
    middle = {"mass": 1.1, "damping": 0.1}
    found = doubts(ended(scene, middle, floor=floor, reason=reason))
    assert [s[: len(said)] for s in found] == ([said] if said else [])
    assert doubts(ended(scene, middle, moved="Starts moved it.")) == ["Starts moved it."]


@pytest.mark.parametrize(("starts", "hint"), [("measured", "or starts: fitted, "), ("fitted", "")])
def test_that_noise_hides_the_parameters_is_said(starts: str, hint: str) -> None:
    """Friction was hidden by the noise of starts over one step, and a wrong mass was certain."""
    deviation = {"horizon": 3, "starts": starts}
    scene = Scene.of(Study.from_dict(pendulum(deviation=deviation)))
    middle = {"mass": 1.1, "damping": 0.1}
    assert doubts(ended(scene, middle, 2.1)) == []
    (said,) = doubts(ended(scene, middle, 1.44))
    assert said.startswith("the worst of the candidates that were tried leaves 1.4 times")
    assert (
        f"over 3 recorded instants (deviation.horizon) parameters change little; a longer horizon"
        f"{', ' if hint else ' '}{hint}tells them better apart" in said
    )


@pytest.mark.parametrize(
    ("asked", "environments", "batch"), [(20_000, 80, 20_000), (20_011, 80, 20_080), (401, 80, 480)]
)
def test_a_batch_that_few_simulations_divide_is_a_little_larger(
    asked: int, environments: int, batch: int
) -> None:
    """401 is a prime: one simulation alone would take eighty times as long."""
    scene = Scene.of(Study.from_dict(pendulum(policy={"batch": asked, "steps": 40_000})))
    assert (scene.environments, scene.settings.batch) == (environments, batch)


def test_the_smallest_training_has_two_steps_of_episodes_of_one() -> None:
    step = 0.02
    policy = {"batch": 2, "steps": 2, "hidden": [8], "episode": step}
    scene = Scene.of(Study.from_dict(pendulum(policy=policy)))
    assert scene.environments == 1
    training = scene.training(scene.candidates.points[0], None, threads=1)
    assert training.episode_steps == 1
    for seconds in (0.5 * step, 0.001):
        study = Study.from_dict(pendulum(policy={**policy, "episode": seconds}))
        with pytest.raises(StudyError, match=r"policy\.episode: .*at least 0\.02 s"):
            Scene.of(study)


def test_training_may_have_shorter_episodes_and_held_actions() -> None:
    suite = {"dm_control": {"domain": "pendulum", "task": "swingup"}, "repeat": 4}
    policy = {"batch": 400, "steps": 800, "episode": 2.0, "discount": 0.9, "decay": 0.8}
    scene = Scene.of(Study.from_dict(pendulum(task=suite, policy=policy)))
    point = scene.candidates.points[0]
    assert scene.training(point, None, 1).episode_steps == 25  # of 0.08 s
    assert scene.environment(scene.compiled(point), 1).episode_steps == 250
    assert (scene.settings.discount, scene.settings.decay) == (0.9, 0.8)
    assert build_plant(scene.study).control_timestep == pytest.approx(0.08)


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"policy": {"steps": 400, "draft": 800}}, "draft: 800 must not be more than steps, 400"),
        (
            {"task": {"file": "reach.py", "class": "Reach", "repeat": 2}},
            "repeat goes with dm_control",
        ),
    ],
)
def test_contradictions_in_a_study_are_said(changed: dict[str, object], message: str) -> None:
    with pytest.raises(StudyError, match=message):
        Study.from_dict(pendulum(**changed), trust_code=True)


class Ending(PendulumSwingup):
    """A task that ends every episode by itself."""

    def is_terminated(self, sims: Simulations) -> np.ndarray:
        return np.ones(len(sims), bool)


@pytest.mark.parametrize(("task", "velocity", "share"), [
    (Ending(), 1e3, 0.0), (PendulumSwingup(), 1e3, 0.0), (PendulumSwingup(), 1e-3, 1.0),
    (Ending(), 1e-6, 1.0),
])  # fmt: skip
def test_only_the_limits_count_as_left(task: VectorTask, velocity: float, share: float) -> None:
    study = Study.from_dict(pendulum(limits={"hinge": {"velocity": velocity}}))
    task = copy(task)
    task.time_limit = 1.0
    scene = Scene.of(study, LimitedTask(task, study, load_model(study)))
    push = Mock(spec=LearnedPolicy)
    push.act = lambda observations: np.ones((len(observations), 1))
    found = beyond_limits(scene, push, scene.candidates.points[0])
    assert found is not None
    assert (found["episodes"], found["share"]) == (60, share)
    assert found["at_most"] == pytest.approx(max(share, 1 - 0.05 ** (1 / 60)))
    assert beyond_limits(replace(scene, task=task), push, scene.candidates.points[0]) is None


def test_a_task_that_is_taken_to_a_model_with_other_joints_is_told() -> None:
    """A crane is not a cart-pole, although it has as many joints: it was learned on unasked."""
    own = Study.from_dict(pendulum())
    assert foreign_task(own, load_model(own)) == ""
    other = {"dm_control": {"domain": "acrobot", "task": "swingup"}}
    study = Study.from_dict(pendulum(model=other, parameters=[]))
    assert foreign_task(study, load_model(study)) == (
        "The task pendulum swingup is written for the joints hinge; it takes shoulder, elbow in "
        "their place, in this order."
    )


@pytest.mark.parametrize("count", [2, 4, 20])
def test_an_interval_of_returns_holds_the_mean_as_often_as_it_says(count: int) -> None:
    samples = np.random.default_rng(count).normal(3.0, 2.0, (4000, count))
    told = [Estimate.of(row) for row in samples]
    held = np.mean([abs(e.mean - 3.0) <= e.half_width for e in told])
    assert held == pytest.approx(0.95, abs=0.015)


def test_of_how_many_episodes_a_return_was_may_be_unknown() -> None:
    """As in runs of before their number was written: 1.96 standard errors, as they were told."""
    assert half_width(2.0, np.inf) == pytest.approx(2.0 * 1.96, rel=1e-4)

"""The learned force law and an effect of a user's own."""

from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest
from effect_bench import SLIDE, Bench, pendulum

from bo_sysid.effects import CATALOGUE, Force, Machine, Site, applicable, load_effects
from bo_sysid.effects.learned import ELAPSED, Feature, features, learned_force
from bo_sysid.simulation.lockstep import LawInputs

MINE = Path(__file__).parent.parent / "studies" / "effects" / "my_effect.py"
ARM = """<mujoco><worldbody><body><joint name="a" axis="0 1 0"/><geom size=".1" pos=".2 0 0"/>
<body pos=".3 0 0"><joint name="b" axis="0 1 0"/><geom size=".1" pos=".2 0 0"/></body></body>
</worldbody><actuator><motor name="a" joint="a"/><position name="b" joint="b" kp="3"/></actuator>
</mujoco>"""


def motion(count: int = 400, seed: int = 0) -> LawInputs:
    rng = np.random.default_rng(seed)
    q = {n: rng.uniform(-1, 1, count) for n in "ab"}
    v = {n: rng.uniform(-2, 2, count) for n in "ab"}
    u = {n: rng.uniform(-1, 1, count) for n in "ab"}
    return LawInputs(np.zeros(count), q, v, u, {ELAPSED: rng.uniform(0, 4, count)}, 0.002)


@pytest.fixture(scope="module")
def arm() -> Bench:
    return Bench(ARM)


def explained(terms: tuple[Feature, ...], force) -> float:
    """Return the share of a force that the terms fit, on motions that they were not fitted to."""
    table = [np.stack([t.value(motion(seed=s)) for t in terms], axis=1) for s in (0, 1)]
    truth = [force(motion(seed=s)) for s in (0, 1)]
    ridge = 1e-6 * np.eye(len(terms))
    w = np.linalg.solve(table[0].T @ table[0] + ridge, table[0].T @ truth[0])
    return 1.0 - float(np.var(truth[1] - table[1] @ w) / np.var(truth[1]))


FORCES = {
    "position": lambda m: np.exp(-(((m.qpos["a"] - 0.3) / 0.15) ** 2)),
    "speed": lambda m: m.qvel["a"] * np.abs(m.qvel["a"]),
    "control": lambda m: m.ctrl["a"] ** 3,
    "load": lambda m: np.abs(m.ctrl["a"]) * np.tanh(m.qvel["a"] / 0.03),
    "time": lambda m: np.exp(-m.signals[ELAPSED]) * np.tanh(m.qvel["a"] / 0.03),
    "other_joint": lambda m: np.cos(2 * m.qpos["b"]),
}


@pytest.mark.parametrize("depends_on", FORCES)
def test_features_fit_a_force_that_depends_on_what_they_say(arm, depends_on) -> None:
    terms = features("a", arm.machine)
    assert {t.depends_on for t in terms} == set(FORCES)
    own = tuple(t for t in terms if t.depends_on == depends_on)
    others = tuple(t for t in terms if t.depends_on not in (depends_on, "load", "control", "time"))
    assert explained(own, FORCES[depends_on]) > 0.97
    if depends_on not in ("load", "control"):
        assert explained(others, FORCES[depends_on]) < 0.75


def test_a_servos_load_follows_its_error(arm) -> None:
    m = motion()
    (load,) = (t for t in features("b", arm.machine) if t.depends_on == "load")
    error = 3 * (m.ctrl["b"] - m.qpos["b"])
    ratio = load.value(m) / (np.abs(error) * np.tanh(m.qvel["b"] / 0.03))
    assert np.ptp(ratio[np.abs(m.qvel["b"]) > 0.3]) < 1e-3


def test_a_law_is_the_weighted_sum_of_its_terms(arm) -> None:
    m, terms = motion(), features("a", arm.machine)
    w = np.random.default_rng(1).normal(size=len(terms))
    expected = 2.5 * sum(wi * t.value(m) for wi, t in zip(w, terms, strict=True))
    tabled = 1e-4 * np.abs(expected).max()
    np.testing.assert_allclose(learned_force(terms, w, 2.5)(m), expected, atol=tabled)
    with pytest.raises(ValueError, match="2 terms have 1 weights"):
        learned_force(terms[:2], w[:1], 1.0)


def test_a_term_without_weight_needs_no_signal(arm) -> None:
    terms = features("a", arm.machine)
    w = np.array([float(t.depends_on == "position") for t in terms])
    without = LawInputs(*(getattr(motion(), f) for f in ("time", "qpos", "qvel", "ctrl")), {}, 0.1)
    assert np.isfinite(learned_force(terms, w, 1.0)(without)).all()


def test_the_example_of_an_effect_of_ones_own_acts_at_its_place() -> None:
    kept = dict(CATALOGUE)
    (mine,) = load_effects(MINE)
    assert mine.id == "worn_spot"
    bench = Bench(SLIDE)
    site = Site("joint", "x")
    assert applicable(mine, bench.machine) == (site,)
    extent = mine.extent(site, bench.machine)
    assert len(extent.grid) == 5
    x = np.array([0.4, 0.2])
    (part,) = mine.parts(mujoco.MjSpec(), site, x, bench.machine)
    assert isinstance(part, Force)
    q = np.array([0.2, 0.2, 1.0])
    v = np.array([1.5, -1.5, 1.5])
    felt = part.law(LawInputs(0 * q, {"x": q}, {"x": v}, {}, {}, 0.001))
    np.testing.assert_allclose(felt, [-0.4, 0.4, 0.0], atol=1e-6)
    assert mine.parts(mujoco.MjSpec(), site, np.array([0.0, 0.2]), bench.machine) == ()
    assert dict(CATALOGUE) == kept


def test_the_unknown_is_a_law_of_position_and_speed() -> None:
    rod = pendulum()
    effect = CATALOGUE["unknown"]
    (part,) = effect.parts(
        mujoco.MjSpec(), Site("joint", "hinge"), np.eye(len(effect.components))[3], rod.machine
    )
    scale = rod.machine.joints["hinge"]
    count = sum(t.name.startswith("position") for t in features("hinge", rod.machine))
    low, step = scale.middle - 0.5 * scale.span, scale.span / (count - 1)
    q = np.array([low + 3 * step, low + 5 * step])
    force = part.law(LawInputs(0 * q, {"hinge": q}, {"hinge": 0 * q}, {}, {}, 0.001))
    np.testing.assert_allclose(force, scale.force * np.array([1.0, np.exp(-2.0)]), rtol=1e-3)


def test_beyond_what_was_recorded_a_law_stays_as_it_is_at_the_end() -> None:
    rod = pendulum()
    scale = rod.machine.joints["hinge"]
    terms = [t for t in features("hinge", rod.machine) if t.name.startswith("position")]
    half = 0.5 * scale.span
    edge = np.array([scale.middle - half, scale.middle + half])
    law = learned_force(terms, np.linspace(-1.0, 2.0, len(terms)), scale.force)

    def force(q: np.ndarray) -> np.ndarray:
        return law(LawInputs(0 * q, {"hinge": q}, {"hinge": 0 * q}, {}, {}, 0.001))

    at_the_ends = force(edge)
    assert (np.abs(at_the_ends) > 0.5 * scale.force).all()
    outwards = np.array([-scale.span, scale.span])
    for share in (0.3, 5.0):
        np.testing.assert_allclose(
            force(edge + share * outwards), at_the_ends, atol=1e-2 * scale.force
        )


def turned(rod: Bench, turns: float) -> Machine:
    """Return the machine of a pendulum that was recorded over so many turns."""
    joint = replace(rod.machine.joints["hinge"], span=turns * 2 * np.pi, middle=0.7)
    return replace(rod.machine, joints={"hinge": joint})


def test_the_unknown_does_not_jump_where_a_hinge_that_winds_comes_round() -> None:
    effect, machine = CATALOGUE["unknown"], turned(pendulum(), 40.0)
    x = np.random.default_rng(0).standard_normal(len(effect.components))
    (part,) = effect.parts(mujoco.MjSpec(), Site("joint", "hinge"), x, machine)
    q = 0.7 + np.pi + np.array([-1e-6, 1e-6, 2 * np.pi])  # where its positions begin again
    before, after, later = part.law(LawInputs(0 * q, {"hinge": q}, {"hinge": 0 * q}, {}, {}, 0.001))
    near = 1e-3 * machine.joints["hinge"].force
    assert after == pytest.approx(before, abs=near)
    assert later == pytest.approx(before, abs=near)


@pytest.mark.parametrize("turns", [0.4, 1.5, 40.0])
def test_a_narrow_place_is_seen_however_far_a_hinge_turned(turns) -> None:
    machine = turned(pendulum(), turns)
    terms = [t for t in features("hinge", machine) if t.name.startswith("position")]
    half = 0.5 * machine.joints["hinge"].span
    q = np.linspace(0.7 - half, 0.7 + half, 40_000)
    at = (q - 1.0 + np.pi) % (2 * np.pi) - np.pi if turns > 2 else q - 1.0
    magnet = at * np.exp(-((at / 0.15) ** 2))
    m = LawInputs(0 * q, {"hinge": q}, {"hinge": 0 * q}, {}, {}, 0.001)
    table = np.stack([t.value(m) for t in terms], axis=1)
    w = np.linalg.lstsq(table, magnet, rcond=1e-6)[0]
    assert np.var(magnet - table @ w) < 0.01 * np.var(magnet)
    felt = learned_force(terms, w, 1.0)(m)
    assert np.var(magnet - felt) < 0.01 * np.var(magnet)

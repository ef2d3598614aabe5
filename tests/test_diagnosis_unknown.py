"""What is not in the catalogue is flagged, located and described; what is there is not flagged."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest
from diagnosis_helpers import SIGMA, arm, candidate, posed, record

from bo_sysid.diagnosis.answer import explain as explaining
from bo_sysid.diagnosis.answer.explain import (
    _better,
    _learned,
    _outdone,
    _placed,
    _refuted,
    explain,
)
from bo_sysid.diagnosis.answer.prediction_error import PredictionError
from bo_sysid.diagnosis.answer.sessions import by_recording
from bo_sysid.diagnosis.answer.unexplained import Unexplained, unexplained_of
from bo_sysid.diagnosis.search.locate import Located
from bo_sysid.diagnosis.search.search import Search
from bo_sysid.diagnosis.sets.decide import Decision
from bo_sysid.diagnosis.sets.fit import Fit
from bo_sysid.diagnosis.sets.refit import Effort, refit
from bo_sysid.diagnosis.sets.signatures import response_to_forces
from bo_sysid.diagnosis.unexplained.law import law_candidate, learn, terms_of
from bo_sysid.diagnosis.unexplained.left_out import RIDGES, LeftOut
from bo_sysid.diagnosis.unexplained.unknown import (
    Clue,
    Unknown,
    examine,
    needed_with_law,
    slopes_reach,
)
from bo_sysid.diagnosis.windows.evidence import make_evidence
from bo_sysid.diagnosis.windows.linear import linearise
from bo_sysid.diagnosis.windows.problem import ROUGH, Problem
from bo_sysid.diagnosis.windows.projection import project
from bo_sysid.diagnosis.windows.reference_motion import smoothed
from bo_sysid.diagnosis.windows.windowing import prepare
from bo_sysid.effects.learned import learned_force
from bo_sysid.mjcf.touching import touching
from bo_sysid.simulation import LawInputs

AT_ELBOW = Clue("elbow", ("position",), 1.0)


def spring_law(q: np.ndarray) -> np.ndarray:
    """A magnet near 0.2 rad: no spring, no cogging."""
    z = (q - 0.2) / 0.15
    return -0.08 * z * np.exp(-(z**2))


def moving(q: np.ndarray) -> LawInputs:
    """Both joints at some positions, with as much speed."""
    both = {"elbow": q, "shoulder": q}
    return LawInputs(q, both, both, ctrl={}, signals={}, timestep=0.002)


def settled(nominal: Fit) -> Decision:
    """The decision that nothing in the catalogue is missing."""
    return Decision(nominal, nominal, (nominal,), np.ones(1), ())


@pytest.fixture(scope="module")
def magnet():
    problem, _ = posed(record(duration=8.0, force=("elbow", spring_law)), horizon=150)
    ready = prepare(problem)
    nominal = refit(ready.linear, (), (), effort=Effort(10, 1.0, final=True))
    return ready, nominal


def test_a_magnet_is_flagged_at_its_joint_as_a_force_of_position(magnet) -> None:
    ready, nominal = magnet
    assert nominal.rms > 1.5
    unknown = examine(ready.problem, settled(nominal))
    assert unknown.flagged
    assert unknown.law is not None
    assert (unknown.law.joint, unknown.law.depends_on) == ("elbow", ("position",))


def test_friction_that_no_name_says_depends_on_speed_alone() -> None:
    rubbing = [("dry_friction", "joint", "elbow", [0.05])]
    ready = prepare(posed(record(duration=8.0, missing=rubbing), horizon=150)[0])
    nominal = refit(ready.linear, (), (), effort=Effort(10, 1.0, final=True))
    law = examine(ready.problem, settled(nominal)).law
    assert law is not None
    assert (law.joint, law.depends_on) == ("elbow", ("speed",))


def test_the_learned_law_is_the_force_that_acts(magnet) -> None:
    ready, nominal = magnet
    machine = ready.problem.machine
    terms = terms_of(machine, "elbow", ("position",))
    hypothesis, start, rms = learn(ready.problem, nominal, "elbow", terms)
    r = project(ready.linear.Q, ready.problem.residual(hypothesis, start))
    assert (r**2).sum() / ready.problem.dof == pytest.approx(rms**2, rel=0.02)
    assert (rms**2 - 1) < 0.02 * (nominal.rms**2 - 1)
    q = np.linspace(-0.2, 0.6, 41)
    force = learned_force(terms, hypothesis.x[-1], machine.joints["elbow"].force)
    np.testing.assert_allclose(force(moving(q)), spring_law(q), atol=0.1 * spring_law(q).max())


def test_along_the_recorded_motion_one_regression_finds_a_strong_law() -> None:
    """Along the prediction, which such a magnet holds back, the same regression leaves half."""

    def strong(q: np.ndarray) -> np.ndarray:
        z = (q - 0.2) / 0.06
        return -0.4 * z * np.exp(-(z**2))

    problem, _ = posed(record(duration=8.0, force=("elbow", strong)), horizon=150)
    ready = prepare(problem)
    nominal = refit(ready.linear, (), (), effort=Effort(10, 1.0, final=True))
    linear = linearise(problem, nominal.hypothesis, nominal.start)
    terms = terms_of(problem.machine, "elbow", ("position",))
    y = project(linear.Q, nominal.residual)
    left = []
    for along in (linear.recorded, linear.along):
        forces = [problem.machine.joints["elbow"].force * t.value(along) for t in terms]
        columns = response_to_forces(linear, "elbow", np.stack(forces, axis=-1))
        A = columns.reshape(-1, len(terms))
        x = np.linalg.lstsq(A, y.ravel(), rcond=1e-6)[0]
        left.append(float(((y.ravel() - A @ x) ** 2).sum()))
    assert left[0] < 0.1 * left[1]


def test_a_deviation_is_smoothed_by_a_polynomial_with_its_rate() -> None:
    time = np.sort(np.random.default_rng(0).uniform(0, 0.3, (4, 60)))
    seen = np.ones(time.shape, bool)
    seen[1, ::3] = False
    seen[2, 5:] = False
    at = np.broadcast_to(np.linspace(0, 0.3, 31), (4, 31))
    values, rates = smoothed(time, np.where(seen, np.sin(9 * time), 99.0), seen, at)
    told = [0, 1, 3]  # five samples tell nothing of the third
    np.testing.assert_allclose(values[told], np.sin(9 * at[told]), atol=1e-5)
    np.testing.assert_allclose(rates[told], 9 * np.cos(9 * at[told]), atol=2e-3)
    assert not values[2].any()
    assert not rates[2].any()


def test_the_gain_is_what_fits_without_a_block_predict_of_it() -> None:
    rng = np.random.default_rng(1)
    A, block = rng.normal(size=(12, 5, 3)), np.repeat(np.arange(4), 3)
    y = A @ np.array([1.0, -0.5, 0.2]) + 0.3 * rng.normal(size=(12, 5))
    gain, ridge = LeftOut.of(A, y, block).gain([0, 1], [2], 1e-9)
    gains = {}
    for r in RIDGES:
        root, total = np.diag(np.sqrt([r, r, min(r, 1e-9)])), 0.0
        for i in range(4):
            X, z = A[block != i].reshape(-1, 3), y[block != i].ravel()
            x = np.linalg.lstsq(np.vstack([X, root]), np.append(z, np.zeros(3)), rcond=None)[0]
            own = y[block == i]
            total += float((own**2).sum() - ((own - A[block == i] @ x) ** 2).sum())
        gains[r] = total
    assert ridge == max(gains, key=gains.__getitem__)
    assert gain == pytest.approx(max(gains.values()))


def test_a_name_that_a_law_at_its_joint_makes_needless_goes(magnet) -> None:
    ready, nominal = magnet
    spring = candidate(ready.problem.machine, "joint_spring", "elbow")
    named = refit(ready.linear, (spring,), (spring.probe,), effort=Effort(10, 1.0, final=True))
    assert needed_with_law(ready.problem, named, AT_ELBOW) == (False,)
    assert named.rms > ROUGH  # far, but what is left without the spring is foretold by its slope
    assert slopes_reach(ready.problem, named, nominal)
    assert not slopes_reach(ready.problem, named, replace(nominal, rms=3 * nominal.rms))
    assert slopes_reach(ready.problem, nominal, nominal)


def test_a_name_that_is_there_stays_beside_a_law_that_could_say_it() -> None:
    rubs = [("dry_friction", "joint", "elbow", [0.03])]
    problem, machine = posed(record(rubs, duration=8.0, force=("elbow", spring_law)), horizon=150)
    ready = prepare(problem)
    friction = candidate(machine, "dry_friction", "elbow")
    x = np.array([0.03])
    named = refit(ready.linear, (friction,), (x,), effort=Effort(10, 1.0, final=True))
    # friction at each position, with bumps of its own, is among what the law can say
    assert needed_with_law(problem, named, AT_ELBOW) == (True,)


def test_chance_is_the_gain_of_what_has_no_sign() -> None:
    """A law that acts stands out from all draws; what turns its sign from window to window not."""
    rng = np.random.default_rng(2)
    A, block = rng.normal(size=(60, 5, 3)), np.repeat(np.arange(12), 5)
    force = A @ np.array([0.5, -0.3, 0.2])
    turned = force * rng.choice([-1.0, 1.0], (60, 1))
    acts, none = (
        LeftOut.of(A, y + rng.normal(size=y.shape), block, draws=39) for y in (force, turned)
    )
    gain, by_chance = acts.against_chance([0, 1], [2])
    assert by_chance.shape == (39,)
    assert gain == pytest.approx(acts.gain([0, 1], [2])[0])
    assert gain > 2 * by_chance.max()
    gain, by_chance = none.against_chance([0, 1], [2])
    assert gain < by_chance.max()


def test_noise_in_the_recorded_commands_is_no_law() -> None:
    """The machine was told something else than the log says; much is left, and nothing predicts it.

    What is left is said all the same.
    """
    recorded, rng = record(duration=12.0), np.random.default_rng(0)
    channels = {
        n: replace(c, values=c.values + 0.2 * c.values.std() * rng.normal(size=len(c.values)))
        if n.startswith("ctrl.") else c
        for n, c in recorded.channels.items()
    }  # fmt: skip
    problem, _ = posed(replace(recorded, channels=channels), horizon=150)
    ready = prepare(problem)
    nominal = refit(ready.linear, (), (), effort=Effort(10, 1.0, final=True))
    unknown = examine(ready.problem, settled(nominal))
    assert nominal.rms > 1.1
    assert unknown.law is None


def test_noise_alone_is_not_flagged() -> None:
    problem, _ = posed(record(duration=6.0), horizon=150)
    ready = prepare(problem)
    nominal = refit(ready.linear, (), (), effort=Effort(10, 1.0, final=True))
    decision = settled(nominal)
    assert not examine(ready.problem, decision).flagged


def test_the_law_is_a_force_on_its_joint() -> None:
    _, machine = posed(record(duration=2.0))
    terms = terms_of(machine, "elbow", ("position",))
    law = law_candidate(machine, "elbow", terms)
    weights = np.zeros(len(terms))
    weights[3] = 2.0
    (part,) = law.effect.parts(arm().spec(), law.site, law.full(weights), machine)
    q = np.linspace(-1, 1, 5)
    motion = moving(q)
    expected = 2.0 * machine.joints["elbow"].force * terms[3].value(motion)
    np.testing.assert_allclose(part.law(motion), expected, atol=1e-3 * np.abs(expected).max())


def test_contact_is_seen_where_geoms_touch() -> None:
    ball = mujoco.MjModel.from_xml_string(
        """<mujoco><worldbody><geom type="plane" size="1 1 .1"/>
        <body><joint name="z" type="slide" axis="0 0 1"/><geom size=".1"/></body>
        </worldbody></mujoco>"""
    )
    heights = np.array([[0.09], [0.5], [0.095], [1.0]])
    assert touching(ball, heights) == 0.5
    assert touching(arm().compile(), np.zeros((3, 2))) == 0.0


def left_over(nominal: Fit, rms: float) -> Fit:
    """A fit that leaves noise of a size, which no law predicts."""
    noise = np.random.default_rng(0).normal(size=nominal.residual.shape)
    return replace(nominal, residual=rms * noise, rms=rms)


@pytest.mark.parametrize(("rms", "in_contact"), [(1.5, False), (3.0, True)])
def test_in_contact_more_must_be_left_to_be_flagged(
    magnet, monkeypatch: pytest.MonkeyPatch, rms: float, in_contact: bool
) -> None:
    ready, nominal = magnet
    loud = settled(left_over(nominal, rms))
    assert examine(ready.problem, loud).flagged
    monkeypatch.setattr(
        "bo_sysid.diagnosis.unexplained.unknown.meets_impacts", lambda problem: True
    )
    assert examine(ready.problem, loud).flagged == in_contact
    assert examine(ready.problem, loud).law is None
    assert examine(ready.problem, settled(nominal)).law.joint == "elbow"


@pytest.fixture(scope="module")
def judged(magnet):
    """What forecasts of the training recordings leave, and a law that was learned from them."""
    ready, nominal = magnet
    made = make_evidence(
        arm(), ready.problem.recordings, effects=[], noise={"qpos": SIGMA}, threads=1
    )
    terms = terms_of(ready.problem.machine, "elbow", ("position",))
    law = learn(ready.problem, nominal, "elbow", terms)[0]
    return PredictionError(made, ready.problem.windows.timestep), law


def test_names_go_where_a_law_or_nothing_forecasts_better(magnet, judged) -> None:
    nominal, (error, law) = magnet[1], judged
    rubs = candidate(magnet[0].problem.machine, "dry_friction", "elbow")
    beside = replace(law, members=(rubs, *law.members), x=(np.array([0.03]), *law.x))
    alone = replace(nominal.hypothesis, members=(rubs,), x=(np.array([0.03]),))
    named, right = replace(nominal, hypothesis=alone), replace(nominal, hypothesis=law, rms=1.1)
    assert _refuted(error, right, nominal, beside, law)
    assert not _refuted(error, right, nominal, law, beside)
    assert not _refuted(error, right, nominal, law, law)  # it harms nothing
    assert _refuted(error, replace(right, rms=2.7), nominal, law, law)  # nor explains
    assert not _refuted(error, replace(right, rms=2.7), nominal, law, beside)
    assert not _refuted(error, right, nominal, beside, None)
    assert error(alone) > error(nominal.hypothesis)
    assert _refuted(error, named, nominal, law, beside)  # a law makes good for it
    half = replace(law, x=tuple(0.5 * x for x in law.x))
    some = replace(nominal, hypothesis=half, rms=0.99 * ROUGH)  # says less than a law does alone
    assert error(law) < error(half) < error(nominal.hypothesis)
    assert not _refuted(error, some, nominal, law, half)
    far = replace(some, rms=1.01 * ROUGH)
    assert not _refuted(error, far, nominal, law, half)
    between = replace(law, x=tuple(0.7 * x for x in law.x))
    assert not _refuted(error, some, nominal, law, between)
    assert _refuted(error, far, nominal, law, between)
    assert not _refuted(error, far, nominal, law, None)


@pytest.mark.parametrize(("rms", "kept"), [(2.0, True), (20.0, False)])
def test_names_far_off_go_where_a_law_alone_forecasts_far_better(
    magnet, monkeypatch: pytest.MonkeyPatch, rms: float, kept: bool
) -> None:
    """A soft stop was named rotor and spring: no law predicts what such names leave."""
    ready, nominal = magnet
    rubs = candidate(ready.problem.machine, "dry_friction", "elbow")
    hypothesis = replace(nominal.hypothesis, members=(rubs,), x=(np.array([0.3]),))
    named = replace(
        nominal, hypothesis=hypothesis, rms=rms, covariance=np.eye(1) * 1e-6,
        jacobian=nominal.residual[..., None],
    )  # fmt: skip
    made = make_evidence(
        arm(), ready.problem.recordings, effects=[rubs.effect], noise={"qpos": SIGMA}, threads=1
    )
    settled_on = Decision(named, nominal, (named, nominal), np.array([1.0, 0.0]), ())
    located = Located(settled_on, ready, Search.on(ready, [rubs], 1, None), made)

    def seen(problem: Problem, decision: Decision) -> Unknown:
        return examine(problem, decision) if not decision.best.members else Unknown(False, 0.04)

    monkeypatch.setattr(explaining, "examine", seen)
    monkeypatch.setattr(
        explaining, "_agreed", lambda located, fit: (fit, by_recording(ready.problem, nominal))
    )
    outcome = explain(located)
    assert bool(outcome.fit.members) is kept
    assert outcome.unexplained.flagged is not kept
    if not kept:
        assert (outcome.unexplained.site, outcome.unexplained.depends_on) == (
            "elbow",
            ("position",),
        )
        assert outcome.repaired is outcome.law_alone


def test_names_far_off_stay_where_a_law_alone_is_not_far_better(magnet, judged) -> None:
    """Of a real slide a law alone leaves .69 of what three right names leave."""
    nominal, (error, law) = magnet[1], judged
    rubs = candidate(magnet[0].problem.machine, "dry_friction", "elbow")
    bad = replace(nominal.hypothesis, members=(rubs,), x=(np.array([0.3]),))
    near = replace(law, x=tuple(0.9 * x for x in law.x))
    assert error(law) < 0.25 * error(bad)
    assert 0.25 * error(near) < error(law) < error(near)
    assert _outdone(error, replace(nominal, hypothesis=bad, rms=20.0), law)
    assert not _outdone(error, replace(nominal, hypothesis=near, rms=20.0), law)
    assert not _outdone(error, replace(nominal, hypothesis=bad, rms=ROUGH), law)
    assert not _outdone(error, replace(nominal, hypothesis=bad, rms=20.0), None)
    assert not _outdone(None, replace(nominal, hypothesis=bad, rms=20.0), law)


def test_a_law_that_forecasts_worse_than_none_is_left_out(magnet, judged) -> None:
    (error, law), bare = judged, magnet[1].hypothesis
    told = Unexplained(0.5, "joint", "elbow", ("position",))
    assert _better(error, bare, law, told) == (law, told)
    assert _better(None, bare, law, told) == (law, told)  # too short for a forecast
    assert "A learned force law stands for it" in told.sentences[0]
    against = replace(law, x=(*law.x[:-1], -law.x[-1]))
    kept, told = _better(error, bare, against, told)
    assert kept is bare
    assert "it depends on where the joint is. Nothing stands for it" in told.sentences[0]


@pytest.mark.parametrize(("site", "where"), [("elbow", "elbow"), ("shoulder", "world")])
def test_what_no_law_predicts_sits_where_everything_else_was_found(magnet, site, where) -> None:
    ready, nominal = magnet
    named = candidate(ready.problem.machine, "armature", site)
    hypothesis = replace(nominal.hypothesis, members=(named,), x=(named.probe,))
    best = replace(left_over(nominal, 3.0), hypothesis=hypothesis)
    search = Search.on(ready, [named], 1, None)
    made = make_evidence(
        arm(), ready.problem.recordings, effects=[named.effect], noise={"qpos": SIGMA}, threads=1
    )
    located = Located(replace(settled(nominal), best=best), ready, search, made)
    found = _placed(located, Unexplained(0.5, "world", "world"))
    assert found.site == where
    assert "Nothing stands for it" in found.sentences[0]


@pytest.mark.parametrize(("left", "tells"), [(2.9, True), (4.0, True), (6.0, False)])
def test_a_law_that_leaves_most_tells_no_joint(magnet, monkeypatch, left, tells) -> None:
    """Of 10 sigma; what leaves a quarter of the squares, or little, is told."""
    ready, nominal = magnet
    far = replace(left_over(nominal, 10.0), hypothesis=nominal.hypothesis)
    monkeypatch.setattr(explaining, "learn", lambda *_: (nominal.hypothesis, None, left))
    made = make_evidence(arm(), ready.problem.recordings, effects=[], threads=1)
    located = Located(settled(far), ready, Search.on(ready, [], 1, None), made)
    _, clue = _learned(located, far, (AT_ELBOW,), None)
    assert clue.tells is tells
    told = unexplained_of(Unknown(True, 1.0, (clue,)))
    assert (told.site, told.depends_on) == (("elbow", ("position",)) if tells else ("world", ()))
    assert told.much is not tells

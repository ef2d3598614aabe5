"""The choice between sets: as a search of the arg-min, and by what to record next."""

from dataclasses import replace

import mujoco
import numpy as np
import pandas as pd
import pytest
from choice_machines import located, walled
from diagnosis_helpers import SIGMA, arm, candidate, record
from numpy.testing import assert_allclose

from bo_sysid.diagnosis.answer.answer import make_answer
from bo_sysid.diagnosis.answer.argmin import argmin_sets
from bo_sysid.diagnosis.answer.experiment import next_experiment, recording_at_rest
from bo_sysid.diagnosis.answer.explain import explain
from bo_sysid.diagnosis.answer.findings import findings
from bo_sysid.diagnosis.answer.hints import (
    balls,
    compliance_or_motor_lag,
    compliance_or_presliding,
    doubtful,
    hints,
    leaves_much,
    left_sentence,
    perhaps_nothing,
    stuck_joints,
    unswept_cogging,
)
from bo_sysid.diagnosis.answer.sentences import disputed_sentence, doubts, rivals
from bo_sysid.diagnosis.answer.unexplained import Unexplained
from bo_sysid.diagnosis.search.locate import Located
from bo_sysid.diagnosis.search.moves import fit_some
from bo_sysid.diagnosis.search.window_lengths import windows_of
from bo_sysid.diagnosis.sets.fit import Fit
from bo_sysid.diagnosis.sets.meshing import backlash_suspects
from bo_sysid.diagnosis.unexplained.missing_force import missing_force
from bo_sysid.diagnosis.windows.candidate import candidates
from bo_sysid.diagnosis.windows.evidence import make_evidence
from bo_sysid.diagnosis.windows.problem import Problem
from bo_sysid.effects import CATALOGUE, survey
from bo_sysid.mjcf import Model
from bo_sysid.recording import Recording
from bo_sysid.simulation import Controller
from bo_sysid.study.outer import Limit


@pytest.fixture(scope="module")
def friction() -> Located:
    missing = [("dry_friction", "joint", "elbow", [0.02])]
    return located(record(missing, duration=6.0), effects=("dry_friction", "viscous_damping"))


@pytest.fixture(scope="module")
def rotor() -> Located:
    """A rotor's inertia at a vertical base, which is the link's own about that axis."""
    missing = [("armature", "joint", "shoulder", [0.01])]
    return located(record(missing, duration=6.0), effects=("armature", "link_inertia"))


def test_a_large_offset_is_fitted_as_far_as_what_stands_for_it() -> None:
    """A shifted centre of mass does the same in fewer steps, and is no better a name for that."""
    bent = ("dry_friction", "joint", "shoulder", [0.1, 1.0, 8e-4])
    frame = record([bent], duration=6.0, finer=16).to_frame()
    frame["qpos.elbow"] += 0.25
    shifted, effects = Recording.from_frame(frame), ("dry_friction", "encoder_offset", "com_shift")
    answer = located(shifted, effects=effects)
    decision, problem = answer.decision, answer.prepared.problem
    for fit in answer.search.fits.values():  # all are compared on the same windows and weights
        assert_allclose(fit.residual, problem.residual(fit.hypothesis, fit.start), atol=1e-9)
    found = {frozenset(c.effect.id for c in f.members): f for f in decision.fits[:2]}
    offset, shift = (frozenset({"dry_friction", e}) for e in effects[1:])
    assert found.keys() == {offset, shift}
    assert {*decision.equivalents, decision.best} == {*decision.fits[:2]}
    told = {c.effect.id: x for c, x in zip(found[offset].members, found[offset].x, strict=True)}
    assert abs(told["encoder_offset"][0]) == pytest.approx(0.25, rel=0.01)


def test_a_set_that_leaves_more_than_a_part_of_it_is_fitted_from_there(friction) -> None:
    search = friction.search
    alone = next(f for f in search.fits.values() if f.members and f.members[0].may_preslide)
    damping = next(c for c in search.candidates if c.effect.id == "viscous_damping")
    members, far = (damping, *alone.members), (100 * damping.probe, *alone.x)
    fresh = replace(search, fits={k: f for k, f in search.fits.items() if not k}, _screen=None)
    stuck = replace(fresh.fit(members, far), cost=10 * alone.cost)
    fresh.fits[stuck.key] = stuck
    fit_some(fresh, stuck, [1])
    assert fresh.fits[stuck.key].rss <= fresh.fits[alone.key].rss < stuck.rss


def test_the_search_of_the_argmin_finds_the_set_that_is_there(friction) -> None:
    problem, Q = friction.prepared.problem, friction.search.frame.Q
    found = argmin_sets(problem, Q, friction.decision)
    assert [c.effect.id for c in found.best.members] == ["dry_friction"]
    assert found.of(found.best) > 0.95
    assert found.bootstrap.sum() == pytest.approx(1.0)
    assert doubts(friction.decision, found) == []


def test_the_search_of_the_argmin_keeps_magnitudes_within_their_bounds(friction, monkeypatch):
    problem, Q = friction.prepared.problem, friction.search.frame.Q
    wide = tuple(replace(f, covariance=1e6 * f.covariance) for f in friction.decision.fits)
    asked, residual = [], Problem.residual

    def spied(self, hypothesis, *args):
        asked.append(hypothesis)
        return residual(self, hypothesis, *args)

    monkeypatch.setattr(Problem, "residual", spied)
    argmin_sets(problem, Q, replace(friction.decision, fits=wide))
    assert asked
    for h in asked:
        for c, x in zip(h.members, h.x, strict=True):
            assert (c.low <= x).all()
            assert (x <= c.high).all()


def test_the_search_of_the_argmin_bears_sets_that_were_not_fitted_to_their_end(friction) -> None:
    best = friction.decision.best
    worse = [replace(f, cost=3 * f.cost) for f in friction.decision.fits if f is not best]
    decision = replace(friction.decision, fits=(best, *worse))
    found = argmin_sets(friction.prepared.problem, friction.search.frame.Q, decision)
    assert found.best is best


def test_one_block_of_a_short_recording_tells_no_other_recordings(friction) -> None:
    one, Q = friction.prepared.problem.rows(np.array([0])), friction.search.frame.Q[:1]
    found = argmin_sets(one, Q, friction.decision)
    assert found.of(friction.decision.best) is None
    assert not found.disagrees(friction.decision.best)


def test_a_disagreement_is_said(friction) -> None:
    problem, Q = friction.prepared.problem, friction.search.frame.Q
    found = argmin_sets(problem, Q, friction.decision)
    other = next(f for f in found.sets if f is not found.best)
    assert found.disagrees(other)
    assert not found.disagrees(found.best)


def test_sets_that_predict_the_same_share_their_probability(rotor) -> None:
    problem, Q = rotor.prepared.problem, rotor.search.frame.Q
    found = argmin_sets(problem, Q, rotor.decision)
    names = [tuple(c.effect.id for c in f.members) for f in found.sets]
    two = [found.bootstrap[names.index((n,))] for n in ("armature", "link_inertia")]
    np.testing.assert_allclose(two, two[0])
    assert sum(two) > 0.95


def test_nothing_is_to_be_recorded_where_nothing_is_open(friction) -> None:
    assert next_experiment(friction, explain(friction), {}) is None


def test_a_motion_that_is_proposed_holds_joints_that_never_moved() -> None:
    """Their positions are no evidence, but a simulation begins with them."""
    time = 0.01 * np.arange(400)
    noise = 1e-4 * np.random.default_rng(0).standard_normal(400)
    log = Recording.from_arrays(
        time, qpos={"shoulder": 0.5 * np.sin(3 * time) + noise, "elbow": 0 * time},
        ctrl={"shoulder": np.sin(4 * time), "elbow": 0 * time},
    )  # fmt: skip
    evidence = make_evidence(arm(), [log], effects=[CATALOGUE["dry_friction"]], threads=1)
    problem = windows_of(evidence, 30, 0.002)
    assert problem.windows.channels == ("qpos.shoulder",)
    still = recording_at_rest(problem, np.zeros((50, 2)))
    np.testing.assert_array_equal(still.channels["qpos.elbow"].values, np.zeros(50))


def test_what_no_motion_separates_is_said_in_words(rotor) -> None:
    found = next_experiment(rotor, explain(rotor), {})
    assert found.controls is None
    assert found.separation < 0.1
    assert "rotor inertia at the shoulder" in found.sentence
    assert {e["effect"] for s in found.separates for e in s} == {"armature", "link_inertia"}


def test_a_tilt_that_the_first_encoder_copies_stands_in_one_class_with_it() -> None:
    tilt = [("gravity_tilt", "world", "world", [0.0, 0.0685])]
    made = located(record(tilt, duration=6.0), effects=("gravity_tilt", "encoder_offset"))
    alike = [made.decision.best, *made.decision.equivalents]
    assert {c.key for f in alike for c in f.members} == {
        ("gravity_tilt", "world"),
        ("encoder_offset", "shoulder"),
    }
    (beside,) = rivals(made.decision, made.evidence.machine)
    assert beside.startswith("Instead of an encoder offset at the shoulder it may be a tilt (0.0")
    said = next_experiment(made, explain(made), {}).sentence
    assert "tells an encoder offset at the shoulder from a tilt by" in said
    assert said.endswith("apart by several postures; a known posture at rest.")


def test_a_motion_is_proposed_that_tells_and_keeps_the_limits(friction) -> None:
    decision = friction.decision
    rival = next(f for f in decision.fits if f.members and f is not decision.best)
    open_ = replace(friction, decision=replace(decision, equivalents=(rival,)))
    limits = {j: Limit(position=(-0.6, 0.6), velocity=6.0) for j in ("shoulder", "elbow")}
    told = next_experiment(open_, explain(friction), limits)
    assert told.controls is not None
    assert told.separation > 0.5
    assert "dry friction at the elbow" in told.sentence
    assert told.as_json()["file"] == "next_experiment.csv"
    model = arm().compile([lambda spec: setattr(spec.joint("elbow"), "frictionloss", 0.02)])
    data = mujoco.MjData(model)
    for _, row in told.controls.iterrows():
        data.ctrl[:] = row[["ctrl.shoulder", "ctrl.elbow"]]
        mujoco.mj_step(model, data)
        assert np.abs(data.qpos).max() < 0.62


def touched(model: mujoco.MjModel, controls: pd.DataFrame) -> bool:
    """Return whether anything touches while the arm follows controls."""
    model.dof_frictionloss[1] = 0.02
    data, touching = mujoco.MjData(model), False
    for _, row in controls.iterrows():
        data.ctrl[:] = row[["ctrl.shoulder", "ctrl.elbow"]]
        mujoco.mj_step(model, data)
        touching |= data.ncon > 0
    return touching


def test_no_motion_is_proposed_in_which_parts_of_the_machine_would_touch(friction) -> None:
    """Contact is left out of what explains free motion, and not of what is to be recorded next."""
    decision = friction.decision
    rival = next(f for f in decision.fits if f.members and f is not decision.best)
    free = replace(friction, decision=replace(decision, equivalents=(rival,)))
    between = replace(free, evidence=replace(free.evidence, given=walled()))
    outcome = explain(friction)
    anywhere = next_experiment(free, outcome, {}).controls
    assert touched(walled().compile(), anywhere)
    clear = next_experiment(between, outcome, {}).controls
    assert clear is not None
    assert not touched(walled().compile(), clear)


def test_what_recordings_disagree_on_is_no_finding_and_is_left_unexplained() -> None:
    spring = [("joint_spring", "joint", "elbow", [0.15, 0.0])]
    with_it, without = record(spring, duration=4.0, seed=1), record(duration=4.0, seed=2)
    found = located(with_it, without, effects=("joint_spring",))
    outcome = explain(found)
    assert outcome.fit.members == ()
    assert outcome.unexplained.flagged
    assert outcome.unexplained.share == 1.0  # of what the nominal model leaves
    assert outcome.sessions.table.empty


def test_names_that_recordings_dispute_are_told_and_count_as_unknown(friction) -> None:
    machine, outcome = friction.evidence.machine, explain(friction)
    spring = candidate(machine, "joint_spring", "elbow")
    said = disputed_sentence((spring,))
    assert said.startswith("The recordings do not agree on a spring at the elbow: no finding")
    assert disputed_sentence(()) == ""
    withdrawn = replace(
        outcome, fit=friction.decision.nominal, disputed=(spring,), unexplained=Unexplained(0.2)
    )
    answer = make_answer(friction.decision, withdrawn, machine)
    assert answer.findings == ()
    stranger = next(a for a in answer.alternatives if a["findings"][0]["effect"] == "unknown")
    assert stranger["probability"] == max(a["probability"] for a in answer.alternatives)
    flagged = replace(withdrawn, unexplained=Unexplained(0.2, "joint", "elbow"))
    told = make_answer(friction.decision, flagged, machine).alternatives
    assert sum(a["probability"] for a in told) == pytest.approx(1.0, abs=0.01)
    assert [] in [a["findings"] for a in told]  # that nothing is missing is one of them


def test_a_compliance_beside_friction_of_its_joint_may_be_its_bend(friction) -> None:
    best, machine = friction.decision.best, friction.prepared.problem.machine

    def beside(joint: str):
        springy = candidate(machine, "joint_compliance", joint)
        members, x = (*best.members, springy), (*best.x, springy.point[: springy.size])
        hypothesis = replace(best.hypothesis, members=members, x=x)
        n, p = len(members), sum(c.size for c in members)
        J = 10.0 * np.ones((*best.residual.shape, p))
        return replace(
            best, hypothesis=hypothesis, groups=(None,) * n, jacobian=J, unique=(4.0,) * n,
            covariance=1e-12 * np.eye(p),
        )  # fmt: skip

    assert compliance_or_presliding(best) == compliance_or_presliding(beside("shoulder")) == ()
    assert stuck_joints(best) == ()
    assert compliance_or_presliding(beside("elbow")) == ("elbow",)
    assert not doubtful(best, machine)
    assert doubtful(beside("elbow"), machine)
    (said,) = hints(beside("elbow"), machine)
    assert "The compliance at elbow may be the friction there" in said


@pytest.mark.parametrize(
    ("beside", "sizes", "gap"),
    [
        (("link_inertia", "upper"), (5.5, 0.4), ["shoulder"]),
        (("actuator_gain", "shoulder"), (5.5, 0.4), ["shoulder"]),
        (("dry_friction", "shoulder"), (5.5, 2.0), []),
        (("dry_friction", "elbow"), (5.5, 0.4), []),
    ],
)
def test_a_late_motor_beside_a_small_effect_at_its_joint_may_be_a_gap(
    friction, beside, sizes, gap
) -> None:
    best, machine = friction.decision.best, friction.prepared.problem.machine
    members = [candidate(machine, "actuator_lag", "shoulder"), candidate(machine, *beside)]
    x = tuple(c.point[: c.size] for c in members)
    p = sum(c.size for c in members)
    fit = replace(
        best, hypothesis=replace(best.hypothesis, members=tuple(members), x=x), groups=(None, None),
        jacobian=np.ones((*best.residual.shape, p)), covariance=1e-12 * np.eye(p), unique=sizes,
    )  # fmt: skip
    assert list(backlash_suspects(fit, machine)) == gap
    assert any("may both be a gap" in s for s in hints(fit, machine)) == bool(gap)


@pytest.mark.parametrize(
    ("effect", "site", "more", "late"),
    [
        ("actuator_lag", "elbow", 0.4, ["elbow"]),
        ("actuator_delay", "elbow", 0.4, ["elbow"]),
        ("actuator_lag", "elbow", 0.8, []),
        ("actuator_lag", "shoulder", 0.4, []),
        ("viscous_damping", "elbow", 0.4, []),
    ],
)
def test_a_compliance_that_explains_hardly_more_than_a_late_motor_is_a_hint(
    friction, effect, site, more, late
) -> None:
    best, machine = friction.decision.best, friction.prepared.problem.machine

    def alone(effect: str, joint: str, excess: float) -> Fit:
        c = candidate(machine, effect, joint)
        hypothesis = replace(best.hypothesis, members=(c,), x=(c.point[: c.size],))
        return replace(
            best, hypothesis=hypothesis, rms=np.sqrt(1.0 + excess), groups=(None,), unique=(4.0,),
            jacobian=np.ones((*best.residual.shape, c.size)),
            covariance=1e-12 * np.eye(c.size),
        )  # fmt: skip

    soft, other = alone("joint_compliance", "elbow", 0.01), alone(effect, site, 0.01 + more**2)
    assert list(compliance_or_motor_lag(soft, [soft, other], machine)) == late
    said = [
        s for s in hints(soft, machine, [other]) if "hardly more than a motor that is late" in s
    ]
    assert len(said) == len(late)
    assert not compliance_or_motor_lag(other, [soft, other], machine)


def test_names_at_a_joint_that_does_not_move_are_hints(friction) -> None:
    best, machine = friction.decision.best, friction.prepared.problem.machine
    assert not hints(best, machine, still=("shoulder", "elbow"))  # friction may well hold them
    mass = candidate(machine, "link_mass", "upper")
    made = replace(best, hypothesis=replace(best.hypothesis, members=(mass,), x=(mass.probe,)))
    assert any("shoulder does not move" in s for s in hints(made, machine, still=("shoulder",)))
    assert doubtful(made, machine, still=("shoulder",))
    assert not any("does not move" in s for s in hints(made, machine, still=("elbow",)))


def test_names_on_a_machine_with_a_ball_joint_are_hints(friction) -> None:
    """Damping of a ball joint is no effect of the catalogue: masses and gains stood in for it."""
    best, machine = friction.decision.best, friction.prepared.problem.machine
    hangs = Model.from_xml(
        '<mujoco><worldbody><body><joint name="socket" type="ball"/><geom size=".1"/></body>'
        "</worldbody></mujoco>"
    )
    hanging = replace(machine, model=hangs.compile())
    assert balls(machine) == ()
    assert balls(hanging) == ("socket",)
    assert any("at the ball joint socket" in s for s in hints(best, hanging))
    assert doubtful(best, hanging)


@pytest.mark.parametrize(("half", "held"), [(0.9, False), (1.1, True)])
@pytest.mark.parametrize("most", [False, True])
def test_an_effect_whose_interval_holds_zero_is_a_hint(friction, half, held, most) -> None:
    """Far from the recordings a magnitude at its bound was named with an interval of [0, bound]."""
    best, machine = friction.decision.best, friction.prepared.problem.machine
    c = candidate(machine, "armature", "elbow")
    value = c.high[:1] if most else 0.5 * c.high[:1]
    fit = replace(
        best, hypothesis=replace(best.hypothesis, members=(c,), x=(value,)), groups=(None,),
        jacobian=np.zeros((*best.residual.shape, 1)), unique=(9.0,),
        covariance=np.array([[(half * value[0] / 1.96) ** 2]]),
    )  # fmt: skip
    assert [told[0] for told in perhaps_nothing(fit, machine)] == [c] * held
    assert doubtful(fit, machine) == held
    for said in hints(fit, machine):
        assert said.startswith("The rotor inertia at the elbow (")
        assert (", the most that was looked for, may as well be none" in said) == most


@pytest.mark.parametrize(("size", "hinted"), [(1.5, True), (2.5, False)])
def test_a_small_load_at_a_place_of_its_own_is_a_hint(friction, size, hinted) -> None:
    best, machine = friction.decision.best, friction.prepared.problem.machine
    usual = candidate(machine, "payload", "forearm")
    for c in (usual, usual.free):
        J = np.zeros((*best.residual.shape, c.size))
        hypothesis = replace(best.hypothesis, members=(c,), x=(c.point[: c.size],))
        fit = replace(
            best, hypothesis=hypothesis, jacobian=J, covariance=1e-12 * np.eye(c.size),
            unique=(size,), groups=(None,),
        )  # fmt: skip
        told = [s for s in hints(fit, machine) if "with a place of its own it has four" in s]
        assert bool(told) == (hinted and c.moved)


@pytest.mark.parametrize("swept", [0.9, 1.1])
def test_cogging_of_which_no_whole_period_was_seen_is_a_hint(friction, swept) -> None:
    best, machine = friction.decision.best, friction.prepared.problem.machine
    period = machine.joints["elbow"].span / swept
    c = candidate(machine, "cogging", "elbow").with_shapes(np.array([2 * np.pi / period]))
    J = np.zeros((*best.residual.shape, c.size))
    hypothesis = replace(best.hypothesis, members=(c,), x=(c.point[: c.size],))
    fit = replace(best, hypothesis=hypothesis, jacobian=J, covariance=1e-12 * np.eye(c.size))
    assert unswept_cogging(fit, machine) == ({"elbow": pytest.approx(period)} if swept < 1 else {})
    said = hints(fit, machine)
    assert [f"Motion of elbow over more than {period:.3g} rad" in s for s in said] == [True] * (
        swept < 1
    )


@pytest.mark.parametrize("bend", [0.0, 1e-4])
def test_the_speed_of_stribeck_friction_is_told_and_its_bend_where_it_has_one(
    friction, bend
) -> None:
    best, machine = friction.decision.best, friction.prepared.problem.machine
    probed = candidate(machine, "stribeck_friction", "elbow", 1)  # at the speed of its probe
    c = probed.with_shapes(np.array([probed.shapes[0], bend]))
    assert (c.preslides, c.shapes[0]) == (bend > 0, c.extent.probe[c.size])
    J, covariance = np.zeros((*best.residual.shape, c.size)), np.eye(c.size)
    hypothesis = replace(best.hypothesis, members=(c,), x=(c.point[: c.size],))
    (finding,) = findings(
        replace(best, hypothesis=hypothesis, jacobian=J, covariance=covariance), machine, 1.0
    )
    assert set(finding.details) == {"coulomb", "speed"} | ({"bend"} if bend else set())


def test_intervals_of_details_end_where_nothing_was_searched_for(friction) -> None:
    best, machine = friction.decision.best, friction.prepared.problem.machine
    c = candidate(machine, "joint_compliance", "elbow")
    hypothesis = replace(best.hypothesis, members=(c,), x=(c.point[: c.size],))
    J, covariance = np.zeros((*best.residual.shape, c.size)), 1e20 * np.eye(c.size)
    blind = replace(best, hypothesis=hypothesis, jacobian=J, covariance=covariance)
    (finding,) = findings(blind, machine, 1.0)
    for i, name in enumerate(("damping over stiffness", "damping on the link"), 1):
        assert finding.details[name].interval == (c.low[i], c.high[i])


def test_a_speed_beyond_its_grid_lies_in_its_interval(friction) -> None:
    best, machine = friction.decision.best, friction.prepared.problem.machine
    grid = candidate(machine, "stribeck_friction", "elbow", 1)
    speed = 2.0 * grid.extent.high[grid.size]
    c = grid.with_shapes(np.array([speed, 0.0]))
    hypothesis = replace(best.hypothesis, members=(c,), x=(c.point[: c.size],))
    J, covariance = np.zeros((*best.residual.shape, c.size)), np.eye(c.size)
    fit = replace(best, hypothesis=hypothesis, jacobian=J, covariance=covariance)
    fit = replace(fit, spread=(np.array([0.3 * speed, 0.0]),))
    low, high = findings(fit, machine, 1.0)[0].details["speed"].interval
    half = 1.96 * np.hypot(0.3, 0.15)  # what is unsure of the fit, and of the time step
    assert (low, high) == pytest.approx(((1 - half) * speed, (1 + half) * speed))


def test_details_have_the_units_of_a_slide_but_a_phase_is_an_angle_there(friction) -> None:
    text = """<mujoco><worldbody><body><joint name="rail" type="slide" axis="1 0 0"/>
    <geom size=".1" mass="1"/></body></worldbody></mujoco>"""
    log = Recording.from_arrays(t := np.arange(0.0, 4.0, 0.01), qpos={"rail": np.sin(t)})
    machine = survey(mujoco.MjModel.from_xml_string(text), [log])

    def units(effect: str) -> dict[str, str]:
        best, c = friction.decision.best, candidate(machine, effect, "rail")
        hypothesis = replace(best.hypothesis, members=(c,), x=(c.point[: c.size],))
        J, covariance = np.zeros((*best.residual.shape, c.size)), np.eye(c.size)
        fit = replace(best, hypothesis=hypothesis, jacobian=J, covariance=covariance)
        (finding,) = findings(fit, machine, 1.0)
        return {name: q.unit for name, q in finding.details.items()}

    assert units("cogging")["phase"] == "rad"
    assert units("joint_spring")["rest angle"] == "m"


def test_names_that_leave_much_are_hints(friction) -> None:
    best = friction.decision.best
    assert not leaves_much(best)
    poor = replace(best, rms=3.0)
    assert leaves_much(poor)
    assert leaves_much(replace(best, rms=float(np.sqrt(1.25))))
    little = replace(best, unique=(2.0,))
    doubt, none = (replace(little, rms=float(np.hypot(1.0, left))) for left in (0.4, 0.25))
    assert leaves_much(doubt)
    assert not leaves_much(none)
    near = replace(best, rms=1.4)
    assert "3 sensor sigmas are left" in left_sentence(poor, 3, poor)
    assert "No further effect" in left_sentence(poor, 3, poor)
    assert "Other sets leave down to 1.4 (dry friction at the elbow), but" in left_sentence(
        poor, 3, near
    )
    assert "All 1 effects" in left_sentence(poor, 1, near)
    assert "does not stand out" in left_sentence(doubt, 3, doubt)
    assert "does not stand out" not in left_sentence(poor, 3, poor)
    machine, outcome = friction.prepared.problem.machine, explain(friction)
    sure, hint = (
        make_answer(friction.decision, outcome, machine, doubtful=d).findings[0].probability
        for d in (False, True)
    )
    assert hint == pytest.approx(sure * 0.7 / 0.98)


@pytest.mark.parametrize(("rms", "share"), [(2.9, 0.7), (3.1, 0.2)])
def test_something_unknown_is_likelier_than_names_far_from_the_recordings(
    friction, rms: float, share: float
) -> None:
    machine, outcome = friction.prepared.problem.machine, explain(friction)
    sure = make_answer(friction.decision, outcome, machine).findings[0].probability / 0.98
    unknown = Unexplained(0.2, "joint", "elbow")
    far = replace(outcome, fit=replace(outcome.fit, rms=rms), unexplained=unknown)
    (found,) = make_answer(friction.decision, far, machine).findings
    assert found.probability == pytest.approx(share * sure)


@pytest.mark.parametrize(
    ("deviance", "probability", "said"),
    [
        (0.0, 0.4, "these recordings do not tell."),
        (1.0, 0.001, "the former is the simpler or more usual explanation."),
        (14.0, 0.001, "the recordings are for the former, but by differences so small"),
    ],
)
def test_what_speaks_for_an_answer_beside_its_equal_is_said(
    friction, deviance: float, probability: float, said: str
) -> None:
    best, machine = friction.decision.best, friction.prepared.problem.machine
    damped = replace(
        best.hypothesis,
        members=(candidate(machine, "viscous_damping", "elbow"),),
        x=(np.array([0.1]),),
    )
    other = replace(best, hypothesis=damped, cv=best.cv + deviance / len(best.cv))
    decision = replace(
        friction.decision,
        fits=(best, other),
        probability=np.array([1 - probability, probability]),
        equivalents=(other,),
    )
    (sentence,) = rivals(decision, machine)
    assert said in sentence


def test_forces_at_hinges_and_slides_have_units_of_their_own(friction) -> None:
    cart = """<mujoco><worldbody><body><joint name="rail" type="slide" axis="1 0 0"/>
      <geom size=".1"/><body><joint name="pole" axis="0 1 0"/><geom size=".05" pos="0 0 .3"/></body>
      </body></worldbody></mujoco>"""
    time = np.arange(0.0, 2.0, 0.01)
    log = Recording.from_arrays(time, qpos={"rail": np.sin(time), "pole": np.sin(2 * time)})
    machine = survey(Model.from_xml(cart).compile(), [log])
    forces = tuple(candidates([CATALOGUE["constant_force"]], machine))
    best = friction.decision.best
    both = replace(best.hypothesis, members=forces, x=(np.array([-0.346]), np.array([0.07])))
    other = replace(best, hypothesis=both, groups=("constant_force",) * 2)
    decision = replace(friction.decision, best=replace(best, cv=best.cv), equivalents=(other,))
    (sentence,) = rivals(decision, machine)
    assert "(-0.346 N, 0.07 N m)" in sentence


def test_however_many_sets_are_open_something_unheard_of_is_one_of_the_alternatives(
    friction,
) -> None:
    best = friction.decision.best
    (rubs,) = best.members
    bent = [rubs.with_shapes(rubs.shapes + 0.01 * k) for k in range(1, 9)]
    others = [replace(best, hypothesis=replace(best.hypothesis, members=(c,))) for c in bent]
    even = np.full(len(others) + 1, 1 / (len(others) + 1))
    decision = replace(friction.decision, fits=(best, *others), probability=even)
    answer = make_answer(decision, explain(friction), friction.prepared.problem.machine)
    told = [a["probability"] for a in answer.alternatives]
    unheard = [a for a in answer.alternatives if a["findings"][0:1] and
               a["findings"][0]["effect"] == "unknown"]  # fmt: skip
    assert len(unheard) == 1
    assert told == sorted(told, reverse=True)
    assert answer.findings[0].probability + sum(told) == pytest.approx(1.0)


@pytest.mark.parametrize("late", [0.4e-3, 3e-3])
def test_a_delay_is_named_and_nothing_else_is_flagged(late: float) -> None:
    recorded = record(duration=4.0, seed=3)
    shown = recorded.channels["qpos.elbow"]
    moved = np.interp(shown.time - late, shown.time, shown.values)
    channels = {**recorded.channels, "qpos.elbow": replace(shown, values=moved)}
    outcome = explain(located(replace(recorded, channels=channels), effects=("sensor_delay",)))
    assert [c.effect.id for c in outcome.fit.members] == ["sensor_delay"]
    assert outcome.fit.x[0][0] == pytest.approx(late, abs=1e-4)
    assert not outcome.unexplained.flagged


def test_a_machine_without_hinges_and_slides_has_no_missing_force_at_joints(friction) -> None:
    recorded = record([("dry_friction", "joint", "elbow", [0.02])], duration=6.0)
    evidence = make_evidence(arm(), [recorded], noise={"qpos": SIGMA}, threads=1)
    outcome = explain(friction)
    joints = missing_force(evidence, outcome.repaired, outcome.timestep)
    assert set(joints["joint"]) == {"shoulder", "elbow"}
    thrown = replace(evidence, machine=replace(evidence.machine, joints={}))
    nothing = missing_force(thrown, outcome.repaired, outcome.timestep)
    assert nothing.empty
    assert list(nothing.columns) == list(joints.columns)


def test_missing_forces_are_those_of_the_model_with_its_controllers(friction) -> None:
    """The elbow's command is not recorded; a controller passes on a goal that is."""
    recorded = record([("dry_friction", "joint", "elbow", [0.02])], duration=6.0)
    channels = dict(recorded.channels)
    channels["goal.elbow"] = channels.pop("ctrl.elbow")
    passed = Controller("elbow", lambda inputs: inputs.signals["goal.elbow"])
    told = [
        make_evidence(arm(), [r], noise={"qpos": SIGMA}, threads=1, laws=laws)
        for r, laws in ((recorded, ()), (Recording("goals", channels), (passed,)))
    ]
    outcome = explain(friction)
    expected, found = (missing_force(e, outcome.repaired, outcome.timestep) for e in told)
    assert_allclose(found["nominal"], expected["nominal"], rtol=1e-6, atol=1e-9)


def test_a_fit_is_kept_with_the_candidates_that_are_listed(friction) -> None:
    """An equal candidate, made anew, is found in the list by identity."""
    search = friction.search
    best = search.best
    again = tuple(c.with_shapes(c.shapes) for c in best.members)
    search.listed(replace(best, hypothesis=replace(best.hypothesis, members=again)))
    for c in search.fits[best.key].members:
        assert any(c is listed for listed in search.candidates)

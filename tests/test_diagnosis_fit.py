"""Fits through the simulator recover what the plant has; their statistics against brute force."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from diagnosis_helpers import arm, candidate, posed, record
from scipy.optimize import lsq_linear

from bo_sysid.diagnosis.answer.findings import findings
from bo_sysid.diagnosis.answer.quantities import parameters_of
from bo_sysid.diagnosis.answer.sentences import parameters_sentence
from bo_sysid.diagnosis.search.locate import locate
from bo_sysid.diagnosis.sets.cross_validation import cross_validated
from bo_sysid.diagnosis.sets.fit import assess, sandwich
from bo_sysid.diagnosis.sets.refit import FINAL, Effort, refit
from bo_sysid.diagnosis.sets.screen import Screen
from bo_sysid.diagnosis.sets.signatures import signatures
from bo_sysid.diagnosis.windows.candidate import Candidate
from bo_sysid.diagnosis.windows.evidence import make_evidence
from bo_sysid.diagnosis.windows.hypothesis import Hypothesis, edits_and_parts
from bo_sysid.diagnosis.windows.linear import linearise
from bo_sysid.diagnosis.windows.problem import ROUGH
from bo_sysid.diagnosis.windows.projection import project
from bo_sysid.diagnosis.windows.settling import first_start, settle
from bo_sysid.diagnosis.windows.timestep import SHARE_BOUNDS
from bo_sysid.diagnosis.windows.windowing import prepare
from bo_sysid.effects import CATALOGUE
from bo_sysid.intervals import amount
from bo_sysid.parameters import Parameter

TRUTH = [("dry_friction", "joint", "elbow", [0.02]), ("payload", "body", "forearm", [0.02])]


@pytest.fixture(scope="module")
def fitted():
    problem, machine = posed(record(TRUTH, duration=5.0), horizon=60)
    ready = prepare(problem)
    held = [candidate(machine, "dry_friction", "elbow"), candidate(machine, "payload", "forearm")]
    fit = refit(ready.linear, held, [c.probe for c in held], effort=Effort(12, 0.5, final=True))
    return ready, held, fit


def test_magnitudes_are_recovered_and_the_residual_is_noise(fitted) -> None:
    _, _, fit = fitted
    assert fit.rms == pytest.approx(1.0, abs=0.06)
    for x, (_, _, _, truth), k in zip(fit.x, TRUTH, (0, 1), strict=True):
        assert x[0] == pytest.approx(truth[0], rel=0.03)
        assert abs(x[0] - truth[0]) < 4 * np.sqrt(fit.covariance[k, k]) + 0.01 * truth[0]


def test_leaving_a_block_out_equals_solving_without_it(fitted) -> None:
    ready, _, fit = fitted
    S, y = (
        project(ready.linear.Q, fit.jacobian.astype(float)),
        project(ready.linear.Q, fit.residual),
    )
    S = S / np.sqrt((S**2).sum(axis=(0, 1)))
    out = ready.problem.block == 3
    solve = lambda rows: np.linalg.solve(  # noqa: E731
        sum(A.T @ A for A in S[rows]) + 0.02 * np.eye(S.shape[-1]),
        sum(A.T @ z for A, z in zip(S[rows], y[rows], strict=True)),
    )
    step = solve(~out) - solve(np.ones_like(out))
    assert fit.cv[3] == pytest.approx(((y[out] - S[out] @ step) ** 2).sum(), rel=1e-4)


def test_a_magnitude_that_cannot_be_seen_lies_anywhere_between_its_bounds(fitted) -> None:
    ready, (friction, payload), fit = fitted
    hidden = fit.jacobian.copy()
    hidden[..., 1] = 0.0  # as of a shift out of the plane of motion
    made = assess(
        ready.problem, ready.linear.Q, fit.hypothesis, fit.groups, fit.start, fit.residual, hidden
    )
    width = float((payload.high - payload.low)[0])
    assert made.covariance[1, 1] == pytest.approx(width**2 / 12, rel=1e-3)
    alone = assess(
        ready.problem,
        ready.linear.Q,
        replace(fit.hypothesis, members=(friction,), x=fit.x[:1]),
        (None,),
        fit.start,
        fit.residual,
        np.delete(hidden, 1, axis=-1),
    )
    assert made.covariance[0, 0] == pytest.approx(alone.covariance[0, 0], rel=1e-6)


def test_unique_size_is_what_no_other_column_can_take_over(fitted) -> None:
    ready, _, fit = fitted
    S = project(ready.linear.Q, fit.jacobian.astype(float)).reshape(-1, fit.jacobian.shape[-1])
    own = S[:, 0] * fit.x[0][0]
    rest = np.delete(S, 0, axis=1)
    room = np.array([-np.inf, np.inf]), np.array(SHARE_BOUNDS) - fit.hypothesis.numerics
    left = own - rest @ lsq_linear(rest, own, np.transpose(room)).x
    assert fit.unique[0] == pytest.approx(np.sqrt(left @ left / ready.problem.dof), rel=1e-3)


def test_a_member_that_does_nothing_has_no_unique_size(fitted) -> None:
    ready, _, fit = fitted
    x = (fit.x[0], np.zeros(1))
    made = assess(
        ready.problem, ready.linear.Q, replace(fit.hypothesis, x=x), (None, None), fit.start,
        fit.residual, fit.jacobian,
    )  # fmt: skip
    assert made.unique[1] == 0.0
    assert made.size == 2


def test_bounds_hold(fitted) -> None:
    ready, held, _ = fitted
    fit = refit(ready.linear, [held[0]], [np.array([1e9])], effort=Effort(3))
    assert held[0].low[0] <= fit.x[0][0] <= held[0].high[0]


def test_a_finer_step_is_fitted_as_a_nuisance(fitted) -> None:
    ready, _, fit = fitted
    assert ready.correction_rms > 0.05
    assert 0.4 < fit.hypothesis.numerics < 2.0


def test_a_parameter_takes_over_only_what_its_bounds_allow(fitted) -> None:
    ready, held, fit = fitted
    friction, share = held[0], 0.3
    x = fit.x[0]
    beside, narrow = (
        Candidate(
            friction.effect,
            friction.site,
            replace(friction.extent, low=(0.0, 0.0, 0.0), high=(k * float(x[0]), 1.0, 1.0)),
            friction.point,
        )
        for k in (1.0, share)
    )
    S = fit.jacobian[..., [0, 0]]  # the parameter does what the member does
    made = {}
    for parameter in (beside, narrow):
        hypothesis = Hypothesis((friction,), (x,), (parameter,), (np.zeros(1),))
        made[parameter] = assess(
            ready.problem, ready.linear.Q, hypothesis, (None,), fit.start, fit.residual, S
        )
    alone = assess(
        ready.problem, ready.linear.Q, Hypothesis((friction,), (x,)), (None,), fit.start,
        fit.residual, S[..., :1],
    )  # fmt: skip
    assert made[beside].unique[0] == pytest.approx(0.0, abs=1e-2 * alone.unique[0])
    assert made[narrow].unique[0] == pytest.approx((1 - share) * alone.unique[0], rel=1e-3)
    widths = [np.sqrt(made[c].covariance[0, 0]) for c in (beside, narrow)]
    assert widths == pytest.approx([x[0] / np.sqrt(12), share * x[0] / np.sqrt(12)], rel=0.2)


@pytest.mark.parametrize(("share", "left"), [(0.5, 0.0), (1.7, 0.7)])
def test_a_finer_step_takes_over_only_what_its_bounds_allow(fitted, share, left) -> None:
    ready, (friction, _), fit = fitted
    x = fit.x[0]
    own = fit.jacobian[..., :1]
    S = np.concatenate([own, own * x[0]], axis=-1)  # a share of one does what the member does
    hypothesis = Hypothesis((friction,), (x,), numerics=share)
    known = ready.problem, ready.linear.Q
    made = assess(*known, hypothesis, (None,), fit.start, fit.residual, S)
    alone = assess(*known, replace(hypothesis, numerics=0.0), (None,), fit.start, fit.residual, own)
    assert made.unique[0] == pytest.approx(left * alone.unique[0], abs=1e-3 * alone.unique[0])


@pytest.mark.parametrize("share", [1.0, 2.0])
def test_a_finer_step_at_its_bound_explains_nothing_more(fitted, share) -> None:
    ready, held, fit = fitted
    at = replace(fit, hypothesis=replace(fit.hypothesis, numerics=share))
    table = Screen.at(at, ready.linear, held).gram((), {})
    Q, problem = ready.linear.Q, ready.problem
    (column,) = signatures(ready.linear, held[:1]).reshape(1, -1)
    other = project(Q, problem.correction).ravel()
    beside = column - other * (other @ column) / (other @ other)
    expected = column if share == 2.0 else beside
    assert np.linalg.norm(beside) < 0.9999 * np.linalg.norm(column)
    assert table.scale[0] == pytest.approx(np.linalg.norm(expected), rel=1e-5)


def test_an_effect_is_found_beside_a_parameter_that_is_at_its_bound() -> None:
    parameter = Parameter("damping", ("joint[elbow].damping",), 0.04, 0.06, 5)
    truth = [("viscous_damping", "joint", "elbow", [0.05])]
    evidence = make_evidence(
        arm(),
        [record(truth, duration=5.0)],
        effects=[CATALOGUE[e] for e in ("viscous_damping", "dry_friction", "payload")],
        parameters=[parameter],
        threads=1,
    )
    best = locate(evidence).decision.best
    assert [c.key for c in best.members] == [("viscous_damping", "elbow")]
    whole = best.x[0][0] + best.hypothesis.nuisance_x[0][0]
    assert whole == pytest.approx(0.05, rel=0.03)
    edits, _ = edits_and_parts(replace(best.hypothesis, members=(), x=()), evidence.machine)
    fitted = replace(evidence.machine, model=arm().compile(edits))
    (finding,) = findings(best, evidence.machine, 1.0, fitted)
    repaired = arm().compile(edits_and_parts(best.hypothesis, evidence.machine)[0])
    assert finding.after == pytest.approx(repaired.joint("elbow").damping[0])
    assert finding.before == arm().compile().joint("elbow").damping[0]
    told = float(finding.sentence.split(" is ")[1].split(" ±")[0])
    assert told == pytest.approx(finding.after, abs=1e-3)


@pytest.mark.parametrize("high", [0.3, 0.1])
def test_a_parameter_is_told_with_an_interval_within_its_bounds(high: float) -> None:
    parameter = Parameter("damping", ("joint[elbow].damping",), 0.0, high, unit="N m s/rad")
    own = float(arm().compile().joint("elbow").damping[0])
    recording = record([("viscous_damping", "joint", "elbow", [0.1 - own])], duration=5.0)
    friction = [CATALOGUE["dry_friction"]]
    evidence = make_evidence(
        arm(), [recording], effects=friction, parameters=[parameter], threads=1
    )
    best = locate(evidence).decision.best
    (told,) = parameters_of(best, evidence.machine)
    assert not best.members
    low, last = told.interval
    assert 0.095 < low < 0.1 <= last < 0.105
    assert last == 0.1 if high == 0.1 else last > 0.1005
    assert told.value == own + best.hypothesis.nuisance_x[0][0]
    table = pd.DataFrame(
        [("damping", told.unit, own, told.value, *told.interval, False)],
        columns=["name", "unit", "model", "fitted", "low95", "high95", "at_bound"],
    )
    assert f"damping {amount(told)} ({own:.4g})" in parameters_sentence(table)


def test_a_magnitude_that_acts_in_second_order_does_not_hold_up_the_others() -> None:
    # to turn gravity in the plane of the arm is to turn its first joint, whose encoder leaves as
    # much; a tilt out of that plane does next to nothing
    problem, machine = posed(record([("gravity_tilt", "world", "world", [0.0, 0.2])], seed=2))
    shift = candidate(machine, "encoder_offset", "shoulder")
    frame, x = prepare(problem).linear, np.array([0.2])
    for _ in range(2):  # linearised where it ends
        offset = refit(frame, [shift], [x], effort=FINAL)
        frame, x = prepare(problem, offset.hypothesis).linear, offset.x[0]
    tilt = candidate(machine, "gravity_tilt", "world")
    fit = refit(frame, [tilt], [np.array([4e-4, 0.2])], effort=FINAL)
    assert fit.x[0][1] == pytest.approx(0.2, rel=0.002)
    assert fit.rss < offset.rss + 2.0


def test_one_block_has_the_covariance_of_white_noise() -> None:
    """There is no scatter between blocks to see; an interval of no width is no answer."""
    covariance = sandwich(100.0 * np.eye(2), np.zeros((1, 2)), 1.0)
    np.testing.assert_allclose(covariance, 0.01 * np.eye(2), rtol=1e-6)


def test_far_off_a_block_is_left_out_as_by_fitting_without_it() -> None:
    """Against brute force: a fit of all other blocks, simulated in the block."""
    missing = [("dry_friction", "joint", "elbow", [0.15]), TRUTH[1]]
    problem, machine = posed(record(missing, duration=5.0), horizon=60)
    ready = prepare(problem)
    frame, block = ready.linear, ready.problem.block
    held = [candidate(machine, "viscous_damping", "elbow")]
    effort = Effort(12, 0.5, final=True)
    fit = refit(frame, held, [held[0].probe], effort=effort)
    assert fit.rms > ROUGH
    made = cross_validated(frame, fit)
    assert made.simulated
    assert made.x is fit.x
    brute = []
    for k in np.unique(block):
        others, own = frame.rows(block != k), frame.rows(block == k)
        without = refit(others, held, fit.x, start=fit.start.rows(block != k), effort=effort)
        start, r = first_start(own.problem, without.hypothesis, fit.start.rows(block == k))
        r = settle(own.problem, own, without.hypothesis, start, r=r)[1]
        brute.append(float((project(own.Q, r) ** 2).sum()))
    assert made.cv.sum() == pytest.approx(sum(brute), rel=0.02)


def test_without_a_limit_the_screen_has_what_the_model_without_it_leaves() -> None:
    """Another limit beside it is no more of it: looser, it does nothing."""
    truth = [("actuator_saturation", "actuator", "elbow", [0.6])]
    problem, machine = posed(record(truth, duration=5.0), horizon=75)
    ready = prepare(problem)
    limit, damping, friction = (
        candidate(machine, e, "elbow")
        for e in ("actuator_saturation", "viscous_damping", "dry_friction")
    )
    fit = refit(ready.linear, [limit], [limit.probe], effort=FINAL)
    frame = linearise(problem, fit.hypothesis, fit.start)
    held = [limit, damping, friction]
    table = Screen.at(fit, frame, held).without([limit], fit.x)
    left = project(frame.Q, problem.residual(Hypothesis(), fit.start))
    assert (left**2).sum() > 1.3 * fit.rss
    beside = signatures(frame, held[1:])
    for k, column in enumerate(np.moveaxis(beside, -1, 0), start=1):
        expected = float((column * left).sum())
        assert table.b[k] == pytest.approx(expected, rel=0.02, abs=1e-3 * np.abs(table.b[0]))

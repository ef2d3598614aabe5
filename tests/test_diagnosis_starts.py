"""Starts estimated from the past against SciPy's least squares on plain MuJoCo."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest
from diagnosis_helpers import SIGMA, arm, candidate, posed, record
from scipy.optimize import least_squares

from bo_sysid.diagnosis.windows import fitted_starts
from bo_sysid.diagnosis.windows.coordinates import Coordinates
from bo_sysid.diagnosis.windows.cutting import cut_problem
from bo_sysid.diagnosis.windows.estimated_starts import _far, caught_up, estimated
from bo_sysid.diagnosis.windows.fitted_starts import FittedStarts, prior, start_noise
from bo_sysid.diagnosis.windows.forecast import forecast
from bo_sysid.diagnosis.windows.hypothesis import Hypothesis
from bo_sysid.diagnosis.windows.linear import linearise
from bo_sysid.diagnosis.windows.settling import settle
from bo_sysid.effects import survey
from bo_sysid.mjcf import Model
from bo_sysid.recording import Recording
from bo_sysid.simulation import Engine

HORIZON = 60


@pytest.fixture(scope="module")
def windows():
    return posed(record([("viscous_damping", "joint", "elbow", [0.05])], duration=2.0), HORIZON)


def test_starts_are_the_least_squares_ones(windows):
    problem, _ = windows
    model = arm().compile()
    data = mujoco.MjData(model)
    about = prior(problem, Coordinates.between(model, model, []))
    found = estimated(problem, Hypothesis(), 1)
    for w in (0, 5):
        begin = problem.windows.start

        def misfit(away, w=w, begin=begin):
            mujoco.mj_resetData(model, data)
            data.qpos, data.qvel = begin.qpos[w] + away[:2], begin.qvel[w] + away[2:]
            shown = [data.qpos.copy()]
            for u in problem.windows.ctrl[w]:
                data.ctrl = u
                mujoco.mj_step(model, data)
                shown.append(data.qpos.copy())
            steps = problem.windows.step[w]
            r = (np.array(shown)[steps] - problem.windows.observed[w]) / SIGMA
            return np.concatenate([r.ravel(), away / about])

        best = least_squares(misfit, np.zeros(4), x_scale=[1e-3, 1e-3, 0.1, 0.1], method="lm")
        ours = np.concatenate([found.qpos[w] - begin.qpos[w], found.qvel[w] - begin.qvel[w]])
        # starts to judge by are not moved for less than a thousandth of what a window leaves
        assert (misfit(ours) ** 2).sum() < 1.001 * 2 * best.cost + 0.1


def test_a_window_is_fitted_as_if_it_were_alone(windows):
    problem, machine = windows
    friction = candidate(machine, "dry_friction", "elbow")
    hypothesis = replace(Hypothesis(), members=(friction,), x=(np.array([0.02]),))
    together = estimated(problem, hypothesis, 1, resting=True)
    for w in (0, 7, 12):
        alone = estimated(problem.rows(np.array([w])), hypothesis, 1, resting=True)
        np.testing.assert_allclose(alone.qpos[0], together.qpos[w], atol=1e-3 * SIGMA)
        np.testing.assert_allclose(alone.qvel[0], together.qvel[w], atol=1e-4)


def test_a_window_that_stale_slopes_lead_nowhere_is_linearised_anew_also_alone(
    windows, monkeypatch
):
    problem, machine = windows
    monkeypatch.setattr(fitted_starts, "_BEHIND", np.inf)  # others say who is a straggler
    friction = candidate(machine, "dry_friction", "elbow")
    hypothesis = replace(Hypothesis(), members=(friction,), x=(np.array([0.3]),))
    begin = problem.windows.start
    together = FittedStarts(problem, hypothesis, begin, 1)
    together.fit()
    for w in range(len(begin)):
        own = np.array([w])
        alone = FittedStarts(problem.rows(own), hypothesis, begin.rows(own), 1)
        alone.fit()
        assert alone.cost[0] == pytest.approx(together.cost[w], rel=1e-9)


def test_windows_settle_as_if_each_were_alone_and_those_that_are_done_are_left(
    windows, monkeypatch
):
    problem, machine = windows
    friction = candidate(machine, "dry_friction", "elbow")
    hypothesis = replace(Hypothesis(), members=(friction,), x=(np.array([0.3]),))
    begin = problem.windows.start
    frame, simulated, rollout = linearise(problem, Hypothesis(), begin), [], Engine.rollout

    def counted(engine, models, start, *args, **kwargs):
        simulated.append(len(start))
        return rollout(engine, models, start, *args, **kwargs)

    monkeypatch.setattr(Engine, "rollout", counted)
    together, r = settle(problem, frame, hypothesis, begin, 2, (1.0, 0.3, 0.09))
    assert min(simulated) < max(simulated) == len(begin)
    for w in range(0, len(begin), 3):
        own = np.arange(len(begin)) == w
        one, alone = problem.rows(own), frame.rows(own)
        start, left = settle(one, alone, hypothesis, begin.rows(own), 2, (1.0, 0.3, 0.09))
        np.testing.assert_array_equal(start.qvel[0], together.qvel[w])
        np.testing.assert_array_equal(left[0], r[w])


def test_a_simulation_is_not_repeated_and_shows_what_its_windows_observe(windows, monkeypatch):
    problem, machine = windows
    friction = candidate(machine, "dry_friction", "elbow")
    first, second = (
        replace(Hypothesis(), members=(friction,), x=(np.array([x]),)) for x in (0.02, 0.021)
    )
    begin, calls, rollout = problem.windows.start, [], Engine.rollout

    def counted(engine, *args, **kwargs):
        calls.append(args)
        return rollout(engine, *args, **kwargs)

    monkeypatch.setattr(Engine, "rollout", counted)
    r = problem.residual(first, begin)
    assert np.abs(problem.residual(second, begin) - r).max() > 0
    np.testing.assert_array_equal(problem.residual(first, begin), r)
    assert len(calls) == 2
    observed = problem.windows.observed + 3 * SIGMA
    other = replace(problem, windows=replace(problem.windows, observed=observed))
    np.testing.assert_allclose(other.residual(first, begin) - r, 3.0, atol=1e-6)
    assert len(calls) == 2
    few = np.arange(len(begin)) < 2
    np.testing.assert_array_equal(problem.rows(few).residual(first, begin.rows(few)), r[few])
    assert len(calls) == 3


def test_a_joint_that_is_kept_still_begins_as_it_was_given_and_others_follow(windows):
    problem, _ = windows
    begin = problem.windows.start
    given = replace(begin, qvel=np.where([False, True], 0.0, begin.qvel + 0.05))
    found = FittedStarts(problem, Hypothesis(), given, 1, still=1)
    before = found.cost.copy()
    found.fit()
    np.testing.assert_allclose(found.start.qvel[:, 1], 0.0, atol=1e-6)
    assert np.abs(found.start.qvel[:, 0] - given.qvel[:, 0]).max() > 0.01
    assert (found.cost <= before).all()


@pytest.fixture(scope="module")
def of_two_rates():
    """The fast log's windows and a slow one's, which last as long with a tenth of the samples."""
    fast, whole = record(duration=1.2), record(duration=1.2, seed=1)
    thinned = {
        n: replace(c, time=c.time[::10], values=c.values[::10]) if n.startswith("qpos") else c
        for n, c in whole.channels.items()
    }
    recordings = [fast, replace(whole, channels=thinned)]
    sigma = {"qpos.shoulder": SIGMA, "qpos.elbow": SIGMA}
    machine = survey(arm().compile(), recordings)
    return cut_problem(
        arm(), machine, recordings, sigma, (), horizon=[HORIZON, HORIZON // 10], engine=Engine(1)
    )


def test_a_straggler_among_windows_with_few_samples_is_fitted_on(of_two_rates):
    problem = of_two_rates
    slow = np.flatnonzero(problem.windows.recording == 1)
    assert problem.seen_in_each[slow].max() < 0.2 * problem.seen_in_each.max()
    found = FittedStarts(problem, Hypothesis(), problem.windows.start, 1)
    found.fit()
    assert found.level.max() < 2.0
    astray = found.start.qvel.copy()
    astray[slow[0]] += 0.02
    begun = FittedStarts(problem, Hypothesis(), replace(found.start, qvel=astray), 1)
    assert 6.0 < begun.level[slow[0]] < 60.0
    begun._linearise(np.arange(len(begun.start)), first=True)
    begun._fit_stragglers()
    assert begun.level[slow[0]] < 2.0


def test_windows_are_far_from_recordings_whatever_their_rate(of_two_rates):
    found = FittedStarts(of_two_rates, Hypothesis(), of_two_rates.windows.start, 1)
    found.cost = 20.0 * of_two_rates.seen_in_each
    assert _far(found)
    found.cost = 5.0 * of_two_rates.seen_in_each
    assert not _far(found)


def test_a_window_that_leaves_more_than_noise_in_one_channel_is_left_behind(windows):
    problem, _ = windows
    found = FittedStarts(problem, Hypothesis(), problem.windows.start, 1)
    found.residual = np.ones_like(found.residual)
    shaped = found.residual.reshape(problem.weight.shape)
    shaped[2, :, 1], shaped[5] = np.sqrt(1.8), np.sqrt(1.6)
    assert found.left_behind().tolist() == [5]
    assert found.left_behind(anywhere=True).tolist() == [2, 5]


def test_windows_whose_slope_says_nothing_catch_up(windows, monkeypatch):
    problem, machine = windows
    friction = candidate(machine, "viscous_damping", "elbow")
    hypothesis = replace(Hypothesis(), members=(friction,), x=(np.array([0.05]),))
    well = estimated(problem, hypothesis, 1)
    blind, linearise = np.zeros(len(well), bool), fitted_starts.linearise
    blind[[3, 8]] = True
    begin = problem.windows.start
    far = replace(begin, qvel=begin.qvel + np.where(blind, 0.5, 0.0)[:, None])
    problem = replace(problem, windows=replace(problem.windows, start=far))

    def told(part, *args):
        linear = linearise(part, *args)
        off = np.isin(part.windows.time, problem.windows.time[blind])
        return replace(linear, J=np.where(off[:, None, None], 0.0, linear.J))

    monkeypatch.setattr(fitted_starts, "linearise", told)
    found = estimated(problem, hypothesis, 1)
    left = (problem.residual(hypothesis, found)[blind] ** 2).mean(axis=1)
    least = (problem.residual(hypothesis, well)[blind] ** 2).mean(axis=1)
    assert ((problem.residual(hypothesis, far)[blind] ** 2).mean(axis=1) > 100 * least).all()
    assert (left < 1.2 * least).all()


def test_windows_that_leave_much_more_than_others_begin_anew(windows):
    """Starts that went astray are no place to go on from; those of the other windows stay."""
    problem, machine = windows
    h = Hypothesis((candidate(machine, "viscous_damping", "elbow"),), (np.array([0.05]),))
    good = estimated(problem, h, 1)
    far = np.zeros((len(good), 4))
    far[3] = 1.0, -2.0, 5.0, -30.0
    start, r = caught_up(problem, h, problem.moved(good, far))
    cost = (r**2).sum(axis=1) / problem.count
    assert (problem.residual(h, problem.moved(good, far))[3] ** 2).mean() > 1e4
    assert cost[3] < 1.5
    rest = np.arange(len(good)) != 3
    assert np.array_equal(start.qpos[rest], good.qpos[rest])


def test_the_beginning_of_windows_is_simulated_as_in_the_whole(windows):
    problem, _ = windows
    part, start = problem.beginning(17), problem.windows.start
    assert part.windows.steps < problem.windows.steps
    whole = problem.residual(Hypothesis(), start)
    np.testing.assert_array_equal(part.residual(Hypothesis(), start), whole[:, : part.count])


def landing(step, duration, sigma, seed=0):
    """Return windows of a tenth of a second of a hopper that lands."""
    model = Model.from_dm_control("hopper", "hop")
    compiled, held = model.compile(timestep=step), round(0.1 / step)
    data, rng = mujoco.MjData(compiled), np.random.default_rng(seed)
    time = np.arange(0, duration, step)
    goals = rng.normal(0, 0.5, (len(time) // held, compiled.nu))
    ctrl = np.clip(goals.repeat(held, axis=0), -1, 1)
    qpos = np.empty((len(time), compiled.nq))
    for k, u in enumerate(ctrl):
        qpos[k], data.ctrl[:] = data.qpos, u
        mujoco.mj_step(compiled, data)
    qpos += sigma * rng.normal(size=qpos.shape)
    names = [compiled.joint(j).name for j in range(compiled.njnt)]
    actuators = [compiled.actuator(a).name for a in range(compiled.nu)]
    recording = Recording.from_arrays(
        time,
        qpos=dict(zip(names, qpos.T, strict=True)),
        ctrl=dict(zip(actuators, ctrl.T, strict=True)),
    )
    return cut_problem(
        model, survey(model.compile(), [recording]), [recording],
        {f"qpos.{n}": sigma for n in names}, (), horizon=held, timestep=step, engine=Engine(1),
    )  # fmt: skip


def test_in_contact_windows_that_are_left_behind_catch_up():
    """A hopper that lands: the start decides when, and no step for all windows leads there."""
    problem = landing(0.0025, 4, 3e-4)
    h, start = Hypothesis(), problem.windows.start
    start, r = settle(problem, linearise(problem, h, start), h, start, 3, (1.0, 0.3, 0.1))
    later, left = caught_up(problem, h, start)
    before, after = ((x**2).mean(axis=1) ** 0.5 for x in (r, left))
    np.testing.assert_allclose(problem.residual(h, later), left)
    assert np.mean(before < 1.2) < 0.5
    assert np.mean(after < 1.2) > 0.6
    assert np.mean(after < 4.0) == 1.0
    assert (after <= before).all()
    np.testing.assert_array_equal(left[before < 1.2], r[before < 1.2])
    found = problem.residual(h, estimated(problem, h, 1))
    assert np.mean((found**2).mean(axis=1) ** 0.5 < 1.2) > 0.6


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_in_contact_drawn_starts_lead_where_growing_does_not(seed):
    problem = landing(0.005, 8, 7e-4, seed)
    found = FittedStarts(problem, Hypothesis(), problem.windows.start, 1)
    found.fit()
    found.grown()
    before, behind = found.cost.copy(), found.left_behind()
    found.multistart()
    # the plant is the model: what its own starts leave is noise
    beyond = np.array([cost.sum() / problem.count - len(cost) for cost in (before, found.cost)])
    assert beyond[1] < 0.8 * beyond[0]
    assert (found.cost <= before).all()
    np.testing.assert_array_equal(np.delete(found.cost, behind), np.delete(before, behind))
    np.testing.assert_allclose(problem.residual(Hypothesis(), found.start), found.residual)


def test_a_smoothers_rate_is_as_unsure_as_said(windows):
    problem, machine = windows
    rng, n = np.random.default_rng(0), 400
    time = np.arange(5 * n) * machine.sampling
    noise = SIGMA * rng.normal(size=(len(time), 2))
    middles = np.arange(n) * 5 + 2
    slopes = [
        np.polynomial.polynomial.polyfit(time[:5] - time[2], noise[m - 2 : m + 3], 3)[1]
        for m in middles
    ]
    unsure = start_noise(problem)
    np.testing.assert_allclose(unsure[:2], SIGMA)
    np.testing.assert_allclose(np.std(slopes), np.sqrt(130) / 12 * unsure[2], rtol=0.1)


def test_only_the_past_is_used(windows):
    problem, _ = windows
    first = forecast(problem, 30, Hypothesis())
    later = problem.windows.observed.copy()
    later[:, 30:] += 1.0
    changed = replace(problem, windows=replace(problem.windows, observed=later))
    again = forecast(changed, 30, Hypothesis())
    np.testing.assert_array_equal(first.start.qpos, again.start.qpos)
    assert again.ahead > 10 * first.ahead
    assert (estimated(changed, Hypothesis(), 1).qpos != first.start.qpos).any()

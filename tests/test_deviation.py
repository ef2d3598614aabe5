"""The deviation against hand-computed numbers, analytic solutions and known statistics."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from oscillator import Oscillator
from scipy.signal import lfilter

from bo_sysid.deviation import Blocks, Deviation, Whitening, fit_starts
from bo_sysid.deviation.forecast import fit_residual, forecast_residual, prediction_residual
from bo_sysid.deviation.measure import PENALTY, correlation_time
from bo_sysid.deviation.problem import DeviationProblem
from bo_sysid.mjcf import Model
from bo_sysid.parameters import CandidateSet, Parameter
from bo_sysid.recording import Channel, Recording
from bo_sysid.simulation import Engine, MujocoSimulator, State, Windows, cut

STIFFNESS = Parameter("stiffness", ("joint[x].stiffness",), 1.0, 9.0, 5)
DAMPING = Parameter("damping", ("joint[x].damping",), 0.0, 0.8, 5)
TRUTH = np.array([5.0, 0.2])


def oscillator_windows(
    count: int = 30, horizon: int = 4, noise: float = 0.0, velocities: bool = True
) -> Windows:
    """Windows of the exact solution at TRUTH, one after the other."""
    dt, rng = 0.05, np.random.default_rng(0)
    start = State(rng.normal(size=(count, 1)), rng.normal(size=(count, 1)), np.zeros((count, 0)))
    channels = ("qpos.x", "qvel.x") if velocities else ("qpos.x",)
    step = np.tile(np.arange(1, horizon + 1), (count, 1))
    empty = Windows(
        start, np.zeros((count, horizon, 0)), {}, channels,
        np.zeros((count, horizon, len(channels))), step, np.zeros(step.shape),
        np.arange(count) * 1.0, np.zeros(count, int), dt,
    )  # fmt: skip
    exact = next(iter(Oscillator((STIFFNESS, DAMPING)).predictions(TRUTH[None], empty))).values
    observed = exact + noise * rng.normal(size=exact.shape)
    return Windows(
        start, empty.ctrl, {}, channels, observed, step, empty.fraction, empty.time,
        empty.recording, dt,
    )  # fmt: skip


def unit(windows: Windows) -> Whitening:
    return Whitening(windows.channels, np.ones(len(windows.channels)), ("sensor noise",) * 2)


def test_deviation_is_the_mean_whitened_norm_of_the_residual() -> None:
    windows = oscillator_windows(horizon=1)
    simulator = Oscillator((STIFFNESS, DAMPING))
    scale = np.array([0.5, 2.0])
    whitening = Whitening(windows.channels, scale, ("sensor noise",) * 2)
    other = np.array([[4.0, 0.1], [7.0, 0.6]])
    got = Deviation(simulator, windows, whitening)(other).deviation
    for point, value in zip(other, got, strict=True):
        predicted = next(iter(simulator.predictions(point[None], windows))).values[:, 0]
        by_hand = [
            np.hypot((o[0] - p[0]) / 0.5, (o[1] - p[1]) / 2.0)
            for o, p in zip(windows.observed[:, 0], predicted, strict=True)
        ]
        assert value == pytest.approx(np.mean(by_hand), rel=1e-12)


def test_deviation_vanishes_at_the_truth_and_only_there() -> None:
    windows = oscillator_windows()
    deviation = Deviation(Oscillator((STIFFNESS, DAMPING)), windows, Whitening.of(windows))
    assert deviation(TRUTH[None]).deviation[0] < 1e-14
    near = TRUTH + np.array([[0.1, 0.0], [-0.1, 0.0], [0.0, 0.05], [0.0, -0.05]])
    assert (deviation(near).deviation > 1e-3).all()


def test_deviation_keeps_its_scale_as_recordings_grow() -> None:
    few, many = oscillator_windows(count=200), oscillator_windows(count=2000)
    values = [
        Deviation(Oscillator((STIFFNESS, DAMPING)), w, unit(w))(np.array([[4.0, 0.1]])).deviation[0]
        for w in (few, many)
    ]
    assert values[0] == pytest.approx(values[1], rel=0.1)


def test_contributions_average_to_the_deviation() -> None:
    windows = oscillator_windows(count=37)
    deviation = Deviation(Oscillator((STIFFNESS, DAMPING)), windows, unit(windows))
    result = deviation(np.array([[4.0, 0.1], [6.0, 0.3]]))
    blocks = deviation.blocks
    np.testing.assert_allclose(result.contributions @ blocks.weight, result.deviation)
    assert blocks.weight.sum() == pytest.approx(1.0)


def test_fitted_starts_recover_the_true_starts() -> None:
    windows = oscillator_windows(horizon=20, velocities=False)
    wrong = windows.with_start(
        State(windows.start.qpos + 0.05, windows.start.qvel - 0.3, windows.start.act)
    )
    fitted = fit_starts(Oscillator((STIFFNESS, DAMPING)), TRUTH, wrong, np.ones(1))
    np.testing.assert_allclose(fitted.start.qpos, windows.start.qpos, atol=1e-6)
    np.testing.assert_allclose(fitted.start.qvel, windows.start.qvel, atol=1e-5)


def test_errors_at_the_truth_are_the_noise() -> None:
    sigma = 0.01
    windows = oscillator_windows(count=600, horizon=24, noise=sigma, velocities=False)
    whitening = Whitening(windows.channels, np.array([sigma]), ("sensor noise",))
    deviation = Deviation(Oscillator((STIFFNESS, DAMPING)), windows, whitening)
    measured = prediction_residual(deviation, TRUTH).rms()[0]  # starts are exact here
    assert measured == pytest.approx(sigma, rel=0.02)
    # 24 instants less 2 fitted numbers: without the correction it would be 4 % lower
    assert fit_residual(deviation, TRUTH).rms()[0] == pytest.approx(sigma, rel=0.02)
    # a forecast carries the noise of its start: larger than the noise, and shrinking with the past
    short = forecast_residual(deviation, TRUTH, past=6).rms()[0]
    long = forecast_residual(deviation, TRUTH, past=18).rms()[0]
    assert sigma < long < short


def test_a_diverged_window_has_a_finite_penalty() -> None:
    model = Model.from_xml(
        "<mujoco><option timestep='0.01'/><worldbody><body><joint name='x' type='slide'/>"
        "<geom name='g' size='.1' mass='1'/></body></worldbody></mujoco>"
    )
    time = np.arange(11) * 0.01
    recording = Recording.from_arrays(
        time, qpos={"x": np.sin(time)}, qvel={"x": np.where(time == time[4], 1e14, np.cos(time))}
    )
    windows = cut(model, [recording], horizon=1)
    mass = Parameter("mass", ("geom[g].mass",), 0.5, 2.0)
    deviation = Deviation(MujocoSimulator(model, (mass,), Engine()), windows, Whitening.of(windows))
    result = deviation(np.array([[1.0]]))
    assert result.diverged[0] == pytest.approx(0.1)
    extent = np.ptp(windows.observed[:, 0], axis=0) / deviation.whitening.scale
    assert deviation.penalty == pytest.approx(PENALTY * np.linalg.norm(extent))
    assert deviation.penalty / 10 <= result.deviation[0] <= deviation.penalty
    again = deviation(np.array([[1.0]]))  # as of the next candidate
    np.testing.assert_array_equal(again.diverged, result.diverged)
    np.testing.assert_array_equal(again.deviation, result.deviation)


@pytest.mark.parametrize("fitted", [False, True])
def test_a_channel_without_a_sample_in_any_window_has_no_error(fitted: bool) -> None:
    """As of a hold-out whose channel has samples between the windows alone."""
    windows = oscillator_windows(count=50, horizon=8)
    observed = windows.observed.copy()
    observed[..., 1] = np.nan
    blind = replace(windows, observed=observed)
    simulator = Oscillator((STIFFNESS, DAMPING))
    deviation = Deviation(simulator, blind, unit(windows), fitted_starts=fitted)
    assert deviation.penalty == pytest.approx(PENALTY * np.ptp(observed[..., 0]))
    assert deviation(TRUTH[None]).deviation[0] < 1e-9
    other = np.array([4.0, 0.1])
    found, seen = (prediction_residual(Deviation(simulator, w, unit(w)), other).rms()
                   for w in (blind, windows))  # fmt: skip
    assert found[0] == seen[0]
    assert np.isnan(found[1])


def test_a_channel_without_a_sample_in_any_window_is_not_compared() -> None:
    """Nothing tells its spread; what the other channels say is as without it."""
    windows = oscillator_windows(count=50, horizon=8)
    observed = windows.observed.copy()
    observed[..., 1] = np.nan
    blind, alone = replace(windows, observed=observed), Whitening.of(windows)
    whitening = Whitening.of(blind)
    np.testing.assert_array_equal(whitening.scale, [alone.scale[0], np.inf])
    simulator, other = Oscillator((STIFFNESS, DAMPING)), np.array([[4.0, 0.1]])
    deviation = Deviation(simulator, blind, whitening)(other).deviation
    own = Whitening(windows.channels, np.array([alone.scale[0], np.inf]), alone.source)
    assert deviation == Deviation(simulator, windows, own)(other).deviation > 0


@pytest.mark.parametrize("rest", [0.0, 0.1, -1.7])
def test_a_channel_that_rests_is_not_compared_wherever_it_rests(rest: float) -> None:
    """The mean of many equal numbers is one of them up to rounding, and so is their spread."""
    windows = oscillator_windows(count=1000, horizon=1)
    observed = windows.observed.copy()
    observed[..., 1] = rest
    whitening = Whitening.of(replace(windows, observed=observed))
    np.testing.assert_array_equal(np.isfinite(whitening.scale), [True, False])


def test_whitening_takes_known_noise_before_spread() -> None:
    windows = oscillator_windows()
    whitening = Whitening.of(windows, {"qpos": 0.003})
    assert whitening.source == ("sensor noise", "recorded spread")
    assert whitening.scale[0] == 0.003
    assert whitening.scale[1] == pytest.approx(windows.observed[..., 1].std())


def test_correlation_time_of_a_first_order_process() -> None:
    phi, rng = 0.8, np.random.default_rng(0)
    x = np.zeros(100_000)
    for k in range(1, len(x)):
        x[k] = phi * x[k - 1] + rng.normal()
    assert correlation_time([x]) == pytest.approx((1 + phi) / (1 - phi), rel=0.1)
    assert correlation_time([x + 9, x - 9]) == pytest.approx((1 + phi) / (1 - phi), rel=0.1)
    assert correlation_time([rng.normal(size=10_000)]) == pytest.approx(1.0, abs=0.1)


def test_what_differs_between_recordings_is_no_correlation_within_them() -> None:
    white = np.random.default_rng(0).normal(size=400)
    apart = np.repeat([0.0, 10.0], 200)
    found = Blocks.of(white + apart, np.repeat([0, 1], 200))
    assert len(found.weight) == 40
    assert not found.short


def test_blocks_are_longer_than_the_correlation_time_and_know_their_recording() -> None:
    rng = np.random.default_rng(1)
    recording = np.repeat(np.arange(5), 200)
    blocks = Blocks.of(rng.normal(size=1000), recording)
    assert blocks.session is not None
    for b in range(len(blocks.weight)):
        assert set(recording[blocks.index == b]) == {blocks.session[b]}
    smooth = np.repeat(rng.normal(size=20), 50)
    assert len(Blocks.of(smooth, np.zeros(1000, int)).weight) == 8
    assert Blocks.of(smooth, np.zeros(1000, int)).session is None


def alike(phi: float, count: int, seed: int) -> np.ndarray:
    """Return a first-order autoregressive series of unit variance."""
    rng = np.random.default_rng(seed)
    shock = rng.normal(size=count) * np.sqrt(1 - phi**2)
    shock[0] = rng.normal()
    return lfilter([1.0], [1.0, -phi], shock)


@pytest.mark.parametrize(("phi", "short"), [(0.0, False), (0.5, False), (0.97, True)])
def test_blocks_that_are_too_much_alike_are_told(phi: float, short: bool) -> None:
    """Those of which a bootstrap says too little: the spread of its means is that of the mean."""
    series = [alike(phi, 400, seed) for seed in range(200)]
    true = np.std([x.mean() for x in series])
    told, flagged = [], []
    for x in series:
        blocks = Blocks.of(x, np.zeros(400, int))
        means = np.bincount(blocks.index, x) / np.bincount(blocks.index)
        told.append(means.std(ddof=1) / np.sqrt(len(means)))
        flagged.append(blocks.short)
    assert np.mean(flagged) > 0.5 if short else not any(flagged)
    if not short:
        assert np.mean(told) == pytest.approx(true, rel=0.1)


@pytest.mark.parametrize("count", [2, 8, 12, 16, 20, 40])
def test_few_windows_whose_errors_are_not_alike_are_not_told_to_be(count: int) -> None:
    told = [Blocks.of(alike(0.0, count, s), np.zeros(count, int)).short for s in range(200)]
    assert np.mean(told) < 0.03
    if count >= 40:
        told = [Blocks.of(alike(0.97, count, s), np.zeros(count, int)).short for s in range(200)]
        assert np.mean(told) > 0.5


def test_what_goes_as_far_astray_as_a_diverged_window_counts_as_one() -> None:
    windows = oscillator_windows(horizon=20)
    deviation = Deviation(Oscillator((STIFFNESS, DAMPING)), windows, Whitening.of(windows))
    deviation.penalty = 1e-3  # below what every window of a wrong candidate deviates by
    assert deviation(np.array([[9.0, 0.5]])).diverged[0] == 1.0
    assert deviation(TRUTH[None]).diverged[0] == 0.0


def test_problem_is_the_deviation_in_torch() -> None:
    windows = oscillator_windows()
    deviation = Deviation(Oscillator((STIFFNESS, DAMPING)), windows, unit(windows))
    candidates = CandidateSet.from_grid((STIFFNESS, DAMPING))
    problem = DeviationProblem(deviation, candidates)
    assert problem.is_minimization_problem
    assert problem.candidates.shape == (25, 2)
    values = problem(problem.candidates.reshape(5, 5, 2))
    assert values.shape == (5, 5)
    assert values.dtype == torch.float64
    np.testing.assert_array_equal(values.ravel(), deviation(candidates.points).deviation)
    low, high = problem.bounds
    np.testing.assert_array_equal(torch.stack([low, high]), candidates.bounds)
    turned = DeviationProblem(deviation, candidates, negate=True)
    assert not turned.is_minimization_problem
    np.testing.assert_array_equal(turned(problem.candidates), -values.ravel())


BRICK = """<mujoco><option timestep="0.002" gravity="0 0 0"/><worldbody>
  <body><freejoint name="brick"/><geom type="box" size=".1 .06 .03" mass="1"/></body>
</worldbody></mujoco>"""


def test_fitted_starts_and_forecasts_know_both_signs_of_an_orientation() -> None:
    """The model's own motion, told with w >= 0, leaves nothing under any measure."""
    model = Model.from_xml(BRICK)
    compiled = model.compile()
    start = State(compiled.qpos0[None], np.array([[0, 0, 0, 9.0, 1.0, 2.0]]), np.zeros((1, 0)))
    t = Engine(1).rollout(compiled, start, np.zeros((1, 900, 0)))
    told = t.qpos[0].copy()
    told[:, 3:] *= np.where(told[:, 3:4] < 0, -1.0, 1.0)
    channels = dict(zip(model.qpos_channels, told.T, strict=True))
    channels |= dict(zip(model.qvel_channels, t.qvel[0].T, strict=True))
    time = np.arange(901) * 0.002
    recording = Recording("brick", {n: Channel(time, x) for n, x in channels.items()})
    windows = cut(model, [recording], horizon=100)
    assert (np.diff(windows.observed[..., 3], axis=1).min() < -0.5) or (
        np.abs(np.diff(windows.observed[..., 4:7], axis=1)).max() > 0.5
    )
    scale = np.ones(len(windows.channels))
    whitening = Whitening(windows.channels, scale, ("sensor noise",) * len(scale))
    simulator = MujocoSimulator(model, (), Engine(1))
    fitted = Deviation(simulator, windows, whitening, fitted_starts=True)
    assert fitted(np.zeros((1, 0))).deviation[0] < 1e-6
    ahead = prediction_residual(Deviation(simulator, windows, whitening), np.zeros(0))
    assert ahead.rms().max() < 1e-6

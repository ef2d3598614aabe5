import itertools

import numpy as np
import pytest

from bo_sysid.errors import RecordingError
from bo_sysid.recording import Channel, Sampling, control_steps


def held(time, values):
    return Channel(np.asarray(time, float), np.asarray(values, float), hold="zero")


def brute_force_mean(channel, start, stop):
    """Integrate the hold piece by piece, with no cleverness."""
    inside = channel.time[(channel.time > start) & (channel.time < stop)]
    edges = [start, *inside, stop]
    total = 0.0
    for a, b in itertools.pairwise(edges):
        middle = 0.5 * (a + b)
        earlier = np.flatnonzero(channel.time <= middle)
        total += channel.values[earlier[-1] if earlier.size else 0] * (b - a)
    return total / (stop - start)


@pytest.mark.parametrize("dt", [0.0013, 0.01, 0.4], ids=["fine", "like the clock", "coarse"])
def test_control_steps_equal_a_brute_force_integral(dt):
    rng = np.random.default_rng(0)
    channel = held(np.cumsum(rng.uniform(0.003, 0.02, 200)), rng.normal(size=200))
    starts = rng.uniform(-0.5, channel.time[-1] + 0.2, 30)
    got = control_steps(channel, starts, 7, dt)
    wanted = [
        [brute_force_mean(channel, s + k * dt, s + (k + 1) * dt) for k in range(7)] for s in starts
    ]
    assert got.shape == (30, 7)
    np.testing.assert_allclose(got, wanted, atol=1e-12)


@pytest.mark.parametrize("dt", [0.0013, 0.01, 0.4], ids=["fine", "like the clock", "coarse"])
def test_control_steps_of_a_sampled_input_are_means_of_its_interpolant(dt):
    rng = np.random.default_rng(0)
    time = np.cumsum(rng.uniform(0.003, 0.02, 200))
    channel = Channel(time, rng.normal(size=200), hold="linear")
    starts = np.r_[rng.uniform(-0.5, time[-1] + 0.2, 30), time[0] - 0.3 * dt, time[-1] - 0.3 * dt]
    got = control_steps(channel, starts, 7, dt)
    wanted = []
    for left in starts[:, None] + dt * np.arange(7):
        for a in left:  # the trapezoidal rule is exact between corners
            corners = np.unique(np.r_[a, time[(time > a) & (time < a + dt)], a + dt])
            wanted.append(np.trapezoid(channel.at(corners), corners) / dt)
    np.testing.assert_allclose(got.ravel(), wanted, atol=1e-10)


def test_control_steps_on_the_stamps_are_the_samples_bit_for_bit():
    values = np.random.default_rng(1).normal(size=1000)
    dt = 0.001
    channel = held(np.arange(1000) * dt, values)
    rows = np.arange(0, 900, 7)
    # stamps reached by another rounding than the edges of the steps
    got = control_steps(channel, channel.time[rows] + 1e-17, 50, dt)
    np.testing.assert_array_equal(got, values[rows[:, None] + np.arange(50)])


def test_control_steps_keep_their_precision_at_large_times():
    values = np.random.default_rng(2).normal(size=100)
    time = 1.7e9 + np.arange(100) * 0.004
    got = control_steps(held(time, values), time[10:11], 40, 0.004)
    np.testing.assert_allclose(got[0], values[10:50], atol=1e-3)


def test_control_before_the_first_and_after_the_last_stamp_is_held():
    channel = held([1.0, 2.0], [3.0, 5.0])
    np.testing.assert_allclose(
        control_steps(channel, np.array([-4.0, 0.5, 7.0]), 1, 1.0), [[3.0], [3.0], [5.0]]
    )
    np.testing.assert_allclose(control_steps(channel, np.array([1.75]), 1, 1.0), [[4.5]])


@pytest.mark.parametrize(("n_steps", "dt"), [(0, 0.1), (3, 0.0), (3, -0.1), (3, np.nan)])
def test_control_steps_refuse_steps_that_do_not_advance(n_steps, dt):
    with pytest.raises(RecordingError, match="must be positive"):
        control_steps(held([0, 1], [0, 1]), np.zeros(1), n_steps, dt)


def test_sampling_counts_gaps_and_missing_samples():
    time = np.delete(np.arange(100) * 0.01, [20, 50, 51, 52])
    s = Sampling.of(time)
    assert (s.gaps, s.missing) == (2, 4)
    assert s.median_dt == pytest.approx(0.01)
    assert s.longest == pytest.approx(0.04)
    assert s.jitter == pytest.approx(0.0, abs=1e-12)


def test_sampling_jitter_is_the_spread_of_the_intervals():
    rng = np.random.default_rng(3)
    time = np.cumsum(0.01 + 0.0005 * rng.normal(size=20_000))
    assert Sampling.of(time).jitter == pytest.approx(0.0005, rel=0.03)

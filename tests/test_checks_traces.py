"""Smoothed traces: exact on parabolas, aligned with each other, blind to gaps."""

import numpy as np
import pytest

from bo_sysid.checks.traces import LATEST, Trace, Traces, blocks
from bo_sysid.recording import Channel, Recording


@pytest.mark.parametrize("width", [0.006, 0.02, 0.07])
def test_a_parabola_keeps_its_derivatives(width: float) -> None:
    time = np.arange(0.0, 2.0, 0.004)
    channel = Channel(time, 1.0 + 2.0 * time + 3.0 * time**2)
    trace = Trace.of(channel, time, width, held=False)
    inner = slice(80, -80)
    assert trace.rate[inner] == pytest.approx(2.0 + 6.0 * time[inner], abs=1e-8)
    assert trace.second_derivative[inner] == pytest.approx(6.0, abs=1e-6)


def test_a_held_channel_lags_a_measured_one_by_half_an_interval() -> None:
    time = np.arange(0.0, 4.0, 0.01)
    channel = Channel(time, time.copy())
    grid = np.arange(0.5, 3.5, 0.002)
    held = Trace.of(channel, grid, 0.05, held=True).value
    measured = Trace.of(channel, grid, 0.05, held=False).value
    assert (measured - held)[300:-300] == pytest.approx(0.005, abs=1e-5)


def test_instants_keep_away_from_ends_and_gaps() -> None:
    time = np.concatenate([np.arange(0.0, 2.0, 0.004), np.arange(3.0, 5.0, 0.004)])
    recording = Recording.from_arrays(time, qpos={"x": np.sin(7 * time)})
    traces = Traces([recording], ["qpos.x"])
    instants = traces.instants[0]
    assert instants.min() > LATEST
    assert instants.max() < 5.0 - LATEST
    wide = 3.0 * traces.width  # what smoothing next to a gap would make up
    assert not ((instants > 2.0 - wide) & (instants < 3.0 + wide)).any()


def test_more_noise_takes_a_wider_filter() -> None:
    time = np.arange(0.0, 8.0, 0.002)
    noise = np.random.default_rng(0).standard_normal(len(time))
    widths = [
        Traces(
            [Recording.from_arrays(time, qpos={"x": np.sin(6 * time) + s * noise})], ["qpos.x"]
        ).width
        for s in (1e-5, 3e-4, 1e-2)
    ]
    assert widths == sorted(widths)
    assert widths[0] < widths[-1]


def test_blocks_take_every_instant_once() -> None:
    assert np.sum(blocks(101, 8), axis=0).tolist() == [1] * 101

"""Filters over whole commands, against their closed forms."""

import numpy as np
import pytest

from bo_sysid.effects.filters import lagged, limited
from bo_sysid.recording import Channel, control_steps

SENT = np.array([0.0, 1.0, 3.0])  # commands are sent when they change


@pytest.mark.parametrize("later", [0.05, 0.5, 1.2, 60.0])
def test_a_filter_goes_on_after_the_last_command(later: float) -> None:
    step = Channel(SENT, np.array([0.0, 0.0, 1.0]), hold="zero")
    at, dt = np.array([3.0 + later]), 1e-3
    np.testing.assert_allclose(lagged(step, 0.1, dt).at(at), 1 - np.exp(-later / 0.1), atol=0.006)
    np.testing.assert_allclose(limited(step, 0.8, dt).at(at), min(0.8 * later, 1.0), atol=1e-3)


def test_commands_of_a_wide_range_and_a_slow_rate_stay_within_reason() -> None:
    """A rate at which the command is never reached asks for no endless grid."""
    step = Channel(SENT, np.array([0.0, 0.0, 1e6]), hold="zero")
    assert len(limited(step, 1e-3, 1e-3).time) < 1e5


@pytest.mark.parametrize("dt", [0.001, 0.004])
def test_a_lag_of_a_sampled_input_is_that_of_its_interpolant(dt: float) -> None:
    """A ramp comes out as late as the lag is long, whatever the stamps."""
    stamps = np.cumsum(np.random.default_rng(1).uniform(0.003, 0.02, 200))
    ramp = Channel(stamps, 2.0 * stamps, hold="linear")
    middle = 1.0 + 0.5 * dt  # a step's mean is its value in the middle
    for out, late in ((lagged(ramp, 0.03, dt), 0.03), (limited(ramp, 1e6, dt), 0.0)):
        got = control_steps(out, np.array([1.0]), 20, dt)[0]
        np.testing.assert_allclose(got, 2.0 * (middle + dt * np.arange(20) - late), atol=1e-7)


@pytest.mark.parametrize(("dt", "off"), [(0.002, 1e-4), (0.005, 4e-4)])
def test_a_lag_of_jittered_commands_does_not_depend_on_the_step(dt: float, off: float) -> None:
    """In units of the lag of 4 ms: what differs from its output at 10 µs, along its change."""
    rng = np.random.default_rng(0)
    stamps = 0.01 * np.arange(600) + rng.uniform(0.0, 0.003, 600)
    control = Channel(stamps, np.sin(4 * np.pi * stamps), "", "", "zero")

    def out(lag: float, step: float) -> np.ndarray:
        return control_steps(lagged(control, lag, step), 1 + 0.002 * np.arange(2000), 1, 0.002)[
            :, 0
        ]

    slope = (out(4.5e-3, 1e-5) - out(3.5e-3, 1e-5)) / 1e-3
    error = out(4e-3, dt) - out(4e-3, 1e-5)
    assert abs(slope @ error / (slope @ slope)) < off

"""When controls act: what a log can tell of it."""

import pytest

from bo_sysid.checks.clocks import LATE, clock_of, least_delay
from bo_sysid.checks.estimate import Estimate


@pytest.mark.parametrize(
    ("sampling", "timestep", "least"),
    [(0.01, 0.002, 0.006), (0.004, 0.002, 0.003), (0.001, 0.001, LATE)],
)
def test_less_than_half_a_sample_is_no_other_clock(
    sampling: float, timestep: float, least: float
) -> None:
    assert least_delay(sampling, timestep) == pytest.approx(least)


@pytest.mark.parametrize(("least", "told"), [(LATE, -0.0035), (0.006, 0.0)])
def test_a_short_delay_is_told_by_logs_that_resolve_it(least: float, told: float) -> None:
    late = {"ctrl.a": Estimate(-0.0035, 2e-4), "ctrl.b": Estimate(-0.0035, 2e-4)}
    assert clock_of(late, least).delay == pytest.approx(told)


@pytest.mark.parametrize(
    ("early", "sampling", "half"),
    [
        (0.0031, 0.005, True),
        (0.0031, 0.002, False),  # more than an interval: another clock
        (0.009, 0.005, False),
        (-0.0031, 0.005, False),  # late
    ],
)
def test_half_an_interval_early_is_what_changes_between_samples(
    early: float, sampling: float, half: bool
) -> None:
    late = {"ctrl.a": Estimate(-early, 2e-4), "ctrl.b": Estimate(-early, 2e-4)}
    assert clock_of(late, LATE, sampling).half_early == half

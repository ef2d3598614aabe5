"""`init`: logs that are fast, gappy, or no logs that can be read."""

import numpy as np
import pytest

from bo_sysid.mjcf import Model
from bo_sysid.recording import RawTable
from bo_sysid.starter.guess import guess_rules, read

WHEEL = """
<mujoco><worldbody><body><joint name="wheel"/><geom size=".1"/></body></worldbody>
  <actuator><motor name="wheel" joint="wheel"/></actuator></mujoco>"""


@pytest.mark.parametrize(
    ("interval", "unit", "sure"),
    [
        (250e-6, "us", False),
        (250e-6, "ms", False),
        (1e-3, "us", True),
        (1e-3, "ms", True),
        (1e-3, "ns", True),
        (1e-3, "s", True),
        (0.02, "ms", True),
        (0.02, "us", True),
        (0.02, "s", True),
        (0.1, "ms", False),
        (0.1, "s", False),
    ],
)
def test_the_unit_of_a_clock_that_names_none_is_told_by_its_steps(
    interval: float, unit: str, sure: bool
) -> None:
    """A step of 250 may be 250 µs of a fast log, or 250 ms of a slow one: the first, marked."""
    ticks = interval / {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}[unit] * np.arange(400.0)
    wave = np.sin(0.05 * np.arange(400.0))
    table = RawTable("log", {"time": ticks, "wheel_pos": wave, "wheel_torque": wave**2})
    rules = guess_rules(Model.from_xml(WHEEL), table)
    stamps = read(table, rules).channels["qpos.wheel"].time
    np.testing.assert_allclose(np.diff(stamps), interval, rtol=1e-6)
    guess = rules.guesses.get("time")
    assert (guess is None or guess.confidence >= 0.55) == sure
    if not sure:
        assert f"of {1e3 * interval:g} ms in {unit}, but" in guess.reason

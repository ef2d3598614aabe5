"""How numbers are said with their uncertainty."""

import pytest

from bo_sysid.intervals import Quantity, amount


@pytest.mark.parametrize(
    ("value", "half", "unit", "said"),
    [
        (0.15087, 0.0021, "N m", "0.151 ± 0.002 N m"),
        (0.15087, 0.0013, "N m", "0.1509 ± 0.0013 N m"),
        (123456.0, 5432.0, "N m", "123000 ± 5000 N m"),
        (1500.0, 123.0, "N m", "1500 ± 120 N m"),
        (31.0, 9.0, "N", "31 ± 9 N"),
        (0.0312, 0.0041, "relative", "+3.1 ± 0.4 %"),
        (13.12, 4.1, "relative", "+1300 ± 400 %"),
        (2.5, 0.0, "kg", "2.5 kg"),
    ],
)
def test_the_uncertainty_has_one_digit_and_two_where_it_begins_with_one(
    value: float, half: float, unit: str, said: str
) -> None:
    assert amount(Quantity(value, unit, (value - half, value + half))) == said


@pytest.mark.parametrize(
    ("value", "interval", "unit", "said"),
    [
        (0.001, (0.0, 0.004), "s", "0.001 (0.000 to 0.004) s"),
        (0.0, (0.0, 0.039), "N m", "0.000 (0.000 to 0.039) N m"),
        (-0.02, (-0.05, 0.0), "relative", "-2 (-5 to 0) %"),
        (0.1, (0.098, 0.1021), "N m", "0.100 ± 0.002 N m"),
    ],
)
def test_an_interval_that_ends_at_a_bound_is_said_by_its_ends(
    value: float, interval: tuple[float, float], unit: str, said: str
) -> None:
    assert amount(Quantity(value, unit, interval)) == said

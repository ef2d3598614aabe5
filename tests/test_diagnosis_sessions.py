"""Intervals where parts of the recordings disagree, against the spread that was put in."""

import numpy as np
import pytest
from diagnosis_helpers import SIGMA, arm, candidate, record

from bo_sysid.diagnosis.answer.sessions import between, by_recording, by_stretch
from bo_sysid.diagnosis.sets.refit import refit
from bo_sysid.diagnosis.windows.cutting import cut_problem
from bo_sysid.diagnosis.windows.windowing import prepare
from bo_sysid.effects import survey
from bo_sysid.simulation import Engine


def fitted(dampings: tuple[float, float]):
    recordings = [
        record([("viscous_damping", "joint", "elbow", [d])], seed=k, duration=4.0)
        for k, d in enumerate(dampings)
    ]
    machine = survey(arm().compile(), recordings)
    sigma = {"qpos.shoulder": SIGMA, "qpos.elbow": SIGMA}
    problem = cut_problem(arm(), machine, recordings, sigma, (), horizon=100, engine=Engine(1))
    ready = prepare(problem)
    member = candidate(machine, "viscous_damping", "elbow")
    return ready.problem, refit(ready.linear, [member], [member.probe])


LOW, HIGH = 0.02, 0.05


def test_the_interval_holds_what_recordings_differ_by() -> None:
    problem, fit = fitted((LOW, HIGH))
    assert LOW < fit.x[0][0] < HIGH
    expected = np.std([LOW, HIGH], ddof=1) / np.sqrt(2)  # of a mean of two
    found = by_recording(problem, fit).covariance
    assert np.sqrt(found[0, 0]) == pytest.approx(expected, rel=0.15)
    assert np.sqrt(fit.covariance[0, 0]) < expected


def test_each_recording_has_its_own_magnitude() -> None:
    problem, fit = fitted((LOW, HIGH))
    table = by_recording(problem, fit).table
    assert list(table["effect"]) == ["viscous_damping"] * 2
    assert list(table["unit"]) == ["N m s/rad"] * 2
    np.testing.assert_allclose(table["value"], [LOW, HIGH], rtol=0.05)
    half = 0.5 * (table["high"] - table["low"])
    assert (abs(table["value"] - [LOW, HIGH]) < 2 * half).all()  # four standard deviations
    assert (half < 0.05 * table["value"]).all()


def test_the_interval_holds_what_stretches_end_at() -> None:
    problem, fit = fitted((LOW, HIGH))
    ends = [fit.x[0][0], LOW, LOW, HIGH, HIGH]
    found = np.sqrt(by_stretch(problem, fit)[0, 0])
    assert found == pytest.approx(np.std(ends, ddof=1), rel=0.15)


def test_the_interval_stays_where_parts_agree() -> None:
    problem, fit = fitted((0.03, 0.03))
    assert abs(fit.x[0][0] - 0.03) < 3e-3
    assert by_stretch(problem, fit)[0, 0] < 2.0 * fit.covariance[0, 0]


@pytest.mark.parametrize("count", [2, 3, 5])
def test_an_interval_over_few_recordings_that_differ_holds_their_mean_at_its_rate(count) -> None:
    rng = np.random.default_rng(count)
    x = 1.0 + 0.1 * rng.standard_normal((4000, count, 1))
    own = np.array([1e-6])
    half = np.array([1.96 * np.sqrt(between(v, own)[1][0] + own[0] / count) for v in x])
    assert np.mean(np.abs(x.mean(axis=(1, 2)) - 1.0) < half) == pytest.approx(0.95, abs=0.012)


def test_recordings_that_differ_by_chance_leave_the_interval_as_it_is() -> None:
    rng = np.random.default_rng(0)
    found = [between(v, np.array([0.01])) for v in 0.1 * rng.standard_normal((2000, 3, 1))]
    assert np.mean([more[0] == stated[0] for more, stated in found]) > 0.94

"""The noise floor of a forecast against the straight line through noisy points."""

import numpy as np
import pytest

from bo_sysid.diagnosis.forecast import forecast, forecast_problem, noise_floor
from bo_sysid.diagnosis.hypothesis import Hypothesis
from bo_sysid.effects import survey
from bo_sysid.mjcf import Model
from bo_sysid.recording import Recording
from bo_sysid.simulation import Engine

SIGMA, SAMPLING = 1e-3, 0.005
MASS = """<mujoco><option timestep="0.005" gravity="0 0 0"/><worldbody>{floor}
<body pos="0 0 1"><joint name="slide" type="slide" axis="1 0 0"/><geom size=".1" mass="1"/></body>
</worldbody><actuator><motor name="slide" joint="slide"/></actuator></mujoco>"""
FLOOR = '<geom type="plane" size="1 1 .1" pos="0 0 -5"/>'
"""Never reached; that it could be is what decides how the floor is computed."""


@pytest.mark.parametrize(("floor", "within"), [("", 0.01), (FLOOR, 0.05)])
def test_the_noise_floor_is_that_of_a_line_through_noisy_points(floor, within):
    model, rng = Model.from_xml(MASS.format(floor=floor)), np.random.default_rng(0)
    time = np.arange(0, 60, SAMPLING)
    shown = 0.2 * time + SIGMA * rng.normal(size=len(time))
    still = {"slide": np.zeros(len(time))}
    recording = Recording.from_arrays(time, qpos={"slide": shown}, ctrl=still)
    problem, past = forecast_problem(
        model, survey(model.compile(), [recording]), [recording], {"qpos.slide": SIGMA},
        past=0.1, ahead=0.1, timestep=0.005, engine=Engine(1),
    )  # fmt: skip
    X = np.stack([np.ones(problem.count), np.arange(problem.count)], axis=1)
    spread = np.linalg.inv(X[:past].T @ X[:past])
    expected = np.sqrt(1 + np.mean(np.einsum("ij,jk,ik->i", X[past:], spread, X[past:])))
    errors = forecast(problem, past, Hypothesis())
    assert expected > 1.25
    assert noise_floor(problem, past, Hypothesis(), errors) == pytest.approx(expected, rel=within)
    assert errors.ahead == pytest.approx(expected, rel=0.05)

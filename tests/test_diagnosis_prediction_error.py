"""In contact time step and magnitudes of the repaired model are those that forecast best."""

from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest

from bo_sysid.diagnosis.answer.prediction_error import PredictionError
from bo_sysid.diagnosis.windows.evidence import Evidence, make_evidence
from bo_sysid.diagnosis.windows.hypothesis import Hypothesis
from bo_sysid.diagnosis.windows.kept_fits import FitCache
from bo_sysid.effects import CATALOGUE
from bo_sysid.mjcf import Model
from bo_sysid.recording import Recording

STEP, SIGMA = 0.004, 2e-4
BALL = f"""<mujoco><option timestep="{STEP}" integrator="implicitfast"/>
<worldbody><geom name="floor" type="plane" size="5 5 .1"/>
<body pos="0 0 .1"><joint name="z" type="slide" axis="0 0 1"/>
<geom size=".1" mass="1" solref="0.02 0.2"/></body></worldbody>
<actuator><motor name="lift" joint="z" gear="1"/></actuator></mujoco>"""


def bounces(division: int, mass: float = 1.0) -> Recording:
    """A ball thrown up again and again, of a plant that steps so many times finer."""
    model = mujoco.MjModel.from_xml_string(BALL.replace('mass="1"', f'mass="{mass}"'))
    model.opt.timestep = STEP / division
    data, rng = mujoco.MjData(model), np.random.default_rng(0)
    time = np.arange(0, 8, STEP)
    ctrl = rng.uniform(-10, 30, len(time) // 40).repeat(40)
    place = np.empty(len(time))
    for k, u in enumerate(ctrl):
        place[k], data.ctrl[0] = data.qpos[0], u if data.qpos[0] < 0.5 else -5.0
        ctrl[k] = data.ctrl[0]
        mujoco.mj_step(model, data, division)
    noisy = place + SIGMA * rng.normal(size=place.shape)
    return Recording.from_arrays(time, qpos={"z": noisy}, ctrl={"lift": ctrl})


def gathered(recording: Recording) -> Evidence:
    return make_evidence(
        Model.from_xml(BALL), [recording], effects=[CATALOGUE["link_mass"]],
        noise={"qpos": SIGMA}, threads=1,
    )  # fmt: skip


@pytest.mark.parametrize(("division", "numerics"), [(1, 0.0), (4, 1.0)])
def test_the_step_at_which_the_plant_is_forecast_best_is_taken(division, numerics) -> None:
    evidence = gathered(bounces(division))
    assert PredictionError(evidence, STEP).stepped(Hypothesis()).numerics == numerics


def test_a_magnitude_that_is_off_comes_to_the_one_that_forecasts_best() -> None:
    evidence = gathered(bounces(4, mass=1.2))
    (heavier,) = (c for c in evidence.candidates if c.effect.id == "link_mass")
    off = Hypothesis(members=(heavier,), x=(np.array([0.22]),))
    error = PredictionError(evidence, STEP)
    found = error.fitted(off)
    assert found.numerics == 1.0
    assert found.x[0][0] == pytest.approx(0.2, abs=0.004)
    assert error(found) < 0.5 * error(off)


def test_a_forecast_that_took_long_is_found_again_after_a_kill(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("bo_sysid.diagnosis.windows.kept_fits._LONG", 0.0)
    evidence = replace(gathered(bounces(1)), kept=FitCache(tmp_path))
    coarse, fine = Hypothesis(), Hypothesis(numerics=1.0)
    left = PredictionError(evidence, STEP)(coarse)

    def killed(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("bo_sysid.diagnosis.answer.prediction_error.forecast", killed)
    again = PredictionError(evidence, STEP)
    assert again(coarse) == left
    with pytest.raises(KeyboardInterrupt):
        again(fine)

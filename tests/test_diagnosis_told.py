"""What is said beside an answer."""

import mujoco
import numpy as np
import pandas as pd
import pytest
from diagnosis_helpers import arm

from bo_sysid.diagnosis.answer.holdout import Holdout
from bo_sysid.diagnosis.answer.judge import beyond
from bo_sysid.diagnosis.windows.forecast import AHEAD, LONGER
from bo_sysid.effects import survey
from bo_sysid.recording import Recording


@pytest.mark.parametrize(
    ("parameters", "nominal", "after", "words"),
    [
        (True, 20.0, 1.1, "falls from 20 to 1.1 sensor sigmas"),
        (True, 20.3, 1.1, "falls from 20.3 to 1.1 sensor sigmas"),  # as the table has it
        (True, 60.0, 1.1, "falls from 60 (20 with the study's parameters fitted) to 1.1 sensor"),
        (False, 60.0, 1.1, "falls from 60 (20 with a finer time step) to 1.1 sensor"),
        (True, 60.0, 20.0, "falls from 60 to 20 sensor sigmas"),
        (False, 60.0, 20.0, "falls from 60 to 20 sensor sigmas"),
        (True, 20.0, 20.0, "goes from 20 to 20 sensor sigmas"),
        (True, 5.0, 6.0, "goes from 5 (20 with the study's parameters fitted) to 6 sensor"),
        (True, 5.0, 20.0, "goes from 5 to 20 sensor sigmas"),
        (True, 5.0, 1.1, "falls from 5 (20 with the study's parameters fitted) to 1.1 sensor"),
    ],
)
def test_what_parameters_and_the_time_step_do_is_said(parameters, nominal, after, words) -> None:
    models = {"nominal": nominal, "refitted": 20.0, "repaired": after, "noise_floor": 1.0}
    rows = [
        {"measure": "forecast", "horizon_s": AHEAD, "model": m, "error": e, "unit": ""}
        for m, e in models.items()
    ]
    told = Holdout(pd.DataFrame(rows), {}, pd.DataFrame(), parameters=parameters)
    assert words in told.sentences[0]
    worse = after > 1.1 * nominal  # than the model was, whatever the study's parameters did to it
    assert (told.sentences[1:] == ("The unseen recording does not confirm the repair.",)) == worse


@pytest.mark.parametrize(
    ("after", "said"),
    [(1.1, ""), (4.0, "The floor is not reached"), (30.0, "does not confirm the repair")],
)
def test_a_forecast_that_misses_the_floor_is_said(after: float, said: str) -> None:
    models = {"refitted": 20.0, "repaired": after, "noise_floor": 1.0}
    rows = [
        {"measure": "forecast", "horizon_s": AHEAD, "model": m, "error": e, "unit": ""}
        for m, e in models.items()
    ]
    first, *more = Holdout(pd.DataFrame(rows), {}, pd.DataFrame()).sentences
    assert first.startswith("Forecast error on the unseen recording")
    assert [said in m for m in more] == ([True] if said else [])


@pytest.mark.parametrize("after", [1.1, 4.0])
def test_a_hold_out_of_another_rate_is_what_is_said_where_the_floor_is_missed(
    after: float,
) -> None:
    models = {"refitted": 20.0, "repaired": after, "noise_floor": 1.0}
    rows = [
        {"measure": "forecast", "horizon_s": AHEAD, "model": m, "error": e, "unit": ""}
        for m, e in models.items()
    ]
    told = Holdout(pd.DataFrame(rows), {}, pd.DataFrame(), rates="It is slow.").sentences[1:]
    said = "It is slow. What is left may be that: record both at one rate."
    assert told == ((said,) if after > 2 else ())


def test_a_repair_that_makes_longer_windows_worse_is_not_confirmed() -> None:
    errors = {"refitted": (1.1, 1.06), "repaired": (1.0, 3.68), "noise_floor": (1.0, 1.0)}
    rows = [
        {"measure": measure, "horizon_s": ahead, "model": m, "error": e[k], "unit": ""}
        for m, e in errors.items()
        for k, (measure, ahead) in enumerate([("forecast", AHEAD), ("fit", LONGER)])
    ]
    said = Holdout(pd.DataFrame(rows), {}, pd.DataFrame()).sentences[1]
    assert "follows the unseen recording worse than without what was found (3.68 for 1.06" in said
    assert "does not confirm the repair" in said


@pytest.mark.parametrize(("after", "missed"), [(1.3, False), (3.68, True)])
def test_longer_forecasts_that_miss_the_floor_are_told(after: float, missed: bool) -> None:
    errors = {"refitted": (1.1, after), "repaired": (1.1, after), "noise_floor": (1.0, 1.06)}
    rows = [
        {"measure": "forecast", "horizon_s": ahead, "model": m, "error": e[k], "unit": ""}
        for m, e in errors.items()
        for k, ahead in enumerate([AHEAD, LONGER])
    ]
    said = Holdout(pd.DataFrame(rows), {}, pd.DataFrame()).sentences[1:]
    assert said == (
        f"Over {LONGER:g} s 3.68 sensor sigmas are left, where the floor is 1.06: these "
        "recordings do not show all that is missing.",
    ) * missed  # fmt: skip


@pytest.mark.parametrize("after", [1.1, 4.0])
def test_where_the_hold_out_goes_and_no_training_recording_went_is_said(after: float) -> None:
    models = {"refitted": 20.0, "repaired": after, "noise_floor": 1.0}
    rows = [
        {"measure": "forecast", "horizon_s": AHEAD, "model": m, "error": e, "unit": ""}
        for m, e in models.items()
    ]
    time = np.linspace(0.0, 1.0, 101)
    known, unseen = (
        Recording.from_arrays(
            time, qpos={"elbow": amplitude * time, "shoulder": 0.1 * time}, ctrl={}
        )
        for amplitude in (1.0, 2.0)
    )
    shares = beyond([known], [unseen], survey(arm().compile(), [known]).joints)
    assert shares == {"elbow": pytest.approx(50 / 101)}
    said = Holdout(pd.DataFrame(rows), {}, pd.DataFrame(), beyond=shares).sentences[1:]
    told = "The unseen recording goes where no training recording was: the elbow in 50% of it."
    assert (told in said) == (after > 2)


@pytest.mark.parametrize(("kind", "turned", "told"), [
    ("hinge", 1.2, {}), ("hinge", 0.8, {"wheel": 1.0}), ("slide", 1.2, {"wheel": 1.0}),
])  # fmt: skip
def test_a_wheel_that_has_gone_round_comes_to_no_new_place(kind, turned, told) -> None:
    model = mujoco.MjModel.from_xml_string(
        f'<mujoco><worldbody><body><joint name="wheel" type="{kind}"/><geom size=".1"/></body>'
        "</worldbody></mujoco>"
    )
    time = np.linspace(0.0, 1.0, 101)
    known, unseen = (
        Recording.from_arrays(time, qpos={"wheel": 2 * np.pi * turned * (time + begin)})
        for begin in (0.0, 1.01)  # it turns on
    )
    assert beyond([known], [unseen], survey(model, [known]).joints) == told

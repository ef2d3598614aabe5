"""The diagnosis from a study to the repaired model, on recordings of a plant with a finer step."""

import hashlib
import json
import sys
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pandas as pd
import pytest
import yaml
from diagnosis_helpers import ARM, NAMES, arm, record
from threadpoolctl import threadpool_info, threadpool_limits

from bo_sysid.diagnosis import Diagnosis, diagnose
from bo_sysid.diagnosis.answer.judge import judge
from bo_sysid.diagnosis.answer.notes import (
    clipped_commands,
    effects_without_site,
    not_compared,
    parameters_out_of_bounds,
    unsought_sentence,
)
from bo_sysid.diagnosis.gather import gather
from bo_sysid.diagnosis.search.window_lengths import windows_of
from bo_sysid.diagnosis.windows.evidence import make_evidence
from bo_sysid.diagnosis.windows.forecast import (
    AHEAD,
    LONGER,
    PAST,
    Errors,
    forecast,
    forecast_problem,
)
from bo_sysid.diagnosis.windows.hypothesis import Hypothesis
from bo_sysid.diagnosis.windows.problem import Problem
from bo_sysid.errors import UserError
from bo_sysid.mjcf import Model
from bo_sysid.recording import Recording
from bo_sysid.recording.alignment import rates_note
from bo_sysid.runs import Run, plain
from bo_sysid.study import Study
from bo_sysid.study.inputs import load_train

FRICTION = [("dry_friction", "joint", "elbow", [0.03])]


def write_study(folder: Path, missing=(), **more) -> Study:
    for name, seed, duration in (("train", 1, 8.0), ("holdout", 2, 4.0)):
        frame = record(missing, seed=seed, duration=duration).to_frame()
        frame.to_parquet(folder / f"{name}.parquet")
    content = {
        "version": 1,
        "name": "arm",
        "model": str(ARM),
        "recordings": {"train": ["train.parquet"], "holdout": ["holdout.parquet"]},
        "diagnosis": {"effects": list(NAMES)},
        **more,
    }
    (folder / "arm.yaml").write_text(yaml.safe_dump(content))
    return Study.load(folder / "arm.yaml")


@pytest.fixture(scope="module")
def diagnosed(tmp_path_factory) -> tuple[Diagnosis, Path]:
    folder = tmp_path_factory.mktemp("friction")
    study = write_study(folder, FRICTION)
    with Run.open(folder / "run", study.resolved(folder / "run"), "diagnose") as run:
        return diagnose(study, run), folder / "run"


def test_dry_friction_is_found_at_the_elbow_and_nothing_else(diagnosed) -> None:
    result, _ = diagnosed
    assert result.verdict == "missing-physics"
    (finding,) = result.answer.findings
    assert (finding.effect, finding.kind, finding.site) == ("dry_friction", "joint", "elbow")
    assert finding.quantity.value == pytest.approx(0.03, rel=0.02)
    assert finding.quantity.interval[0] < 0.03 < finding.quantity.interval[1]
    assert finding.sentence.startswith("The elbow has dry friction of 0.030")
    assert finding.sentence.endswith("N m that the model lacks.")


def test_an_effect_that_is_asked_for_and_can_act_nowhere_is_said(tmp_path: Path) -> None:
    """The arm has motors, and no position servo."""
    for asked, words in ((["servo_kp", "dry_friction"], "servo_kp can act nowhere"), ("all", "")):
        study = write_study(tmp_path, diagnosis={"effects": asked})
        (note,) = effects_without_site(study, gather(study, load_train(study))) or ("",)
        assert words in note
        assert "dry_friction" not in note


def test_the_time_step_is_no_candidate_and_that_is_said(tmp_path: Path) -> None:
    study = write_study(tmp_path, diagnosis={"effects": ["timestep", "dry_friction"]})
    evidence = gather(study, load_train(study))
    assert {c.effect.id for c in evidence.candidates} == {"dry_friction"}
    (note,) = effects_without_site(study, evidence)
    assert "every fit takes a finer one along" in note


def test_the_forecast_error_falls_to_the_noise(diagnosed) -> None:
    result, _ = diagnosed
    floor = result.holdout.error("forecast", 0.08, "noise_floor")
    assert result.holdout.error("forecast", 0.08, "repaired") < 1.15 * floor
    assert result.holdout.error("forecast", 0.08, "refitted") > 3 * floor
    assert "falls from" in result.sentences[-1]


def test_a_short_recording_costs_the_others_no_proof(diagnosed) -> None:
    result, _ = diagnosed
    whole = record(FRICTION, seed=2, duration=4.0)
    brief = replace(whole.between(0.0, 0.25), name="brief")
    alone, both = (
        judge(result.frozen.evidence, result.frozen.outcome, told)
        for told in ([whole], [whole, brief])
    )
    assert (alone.short, both.short) == ((), ("brief",))
    pd.testing.assert_frame_equal(both.table, alone.table)
    none = judge(result.frozen.evidence, result.frozen.outcome, [brief])
    assert none.as_json() == {"forecast": {}, "fit": {}, "free_run": {}}
    assert none.sentences[0].startswith("The hold-out cannot be judged: ")


def test_a_hold_out_that_is_sampled_more_rarely_is_told(diagnosed) -> None:
    result, _ = diagnosed
    whole = record(FRICTION, seed=2, duration=4.0)
    rare = replace(
        whole,
        channels={
            n: replace(c, time=c.time[::5], values=c.values[::5]) for n, c in whole.channels.items()
        },
    )
    assert judge(result.frozen.evidence, result.frozen.outcome, [whole]).rates == ""
    told = judge(result.frozen.evidence, result.frozen.outcome, [rare])
    assert "every 0.01 s, training every 0.002 s: forecasts last as long, and" in told.rates


def test_half_a_second_is_enough_for_the_headline(diagnosed) -> None:
    result, _ = diagnosed
    half = record(FRICTION, seed=2, duration=4.0).between(0.0, 0.5)
    told = judge(result.frozen.evidence, result.frozen.outcome, [half])
    assert set(told.table[told.table.measure == "forecast"].horizon_s) == {AHEAD}
    before, after, floor = (
        told.error("forecast", AHEAD, m) for m in ("refitted", "repaired", "noise_floor")
    )
    assert after < 1.5 * floor < before
    assert "falls from" in told.sentences[0]


def test_recordings_of_other_rates_are_told_with_their_intervals() -> None:
    fast, slow = record(duration=1.0), record(seed=1, duration=1.0, sampling=0.02)
    (note,) = rates_note([fast, slow], arm().qpos_channels)
    assert note.startswith("arm 0 is sampled every 0.002 s and arm 1 every 0.02 s: ")
    channels = arm().qpos_channels
    again = replace(fast, name="again")
    assert rates_note([fast, again], channels) == rates_note([], channels) == ()


def test_a_slow_log_is_forecast_beside_a_fast_one_as_by_itself() -> None:
    """Its past and future last as long, of fewer instants, and all futures begin at one."""
    fast, slow = record(FRICTION, duration=3.0), record(FRICTION, seed=1, duration=3.0)
    tenths = {
        n: replace(c, time=c.time[::10], values=c.values[::10]) for n, c in slow.channels.items()
    }
    rare = replace(slow, channels=tenths)
    evidence = make_evidence(arm(), [fast, rare])

    def forecasts(recordings: list[Recording]) -> tuple[Problem, Errors]:
        problem, past = forecast_problem(
            arm(), evidence.machine, recordings, evidence.sigma, past=PAST, ahead=LONGER,
            timestep=0.002, engine=evidence.engine,
        )  # fmt: skip
        return problem, forecast(problem, past, Hypothesis())

    both, found = forecasts([fast, rare])
    alone, expected = forecasts([rare])
    own = both.windows.recording == 1
    assert own.sum() == len(alone.windows)
    instants = expected.residual.shape[1]
    np.testing.assert_allclose(found.residual[own, :instants], expected.residual, atol=1e-6)
    assert not found.residual[own, instants:].any()
    times = (both.windows.step + both.windows.fraction).max(axis=1) * 0.002
    np.testing.assert_allclose(times, PAST + LONGER, atol=1e-9)


def test_windows_of_a_slow_log_last_as_long_as_those_of_a_fast_one() -> None:
    fast, slow = record(duration=3.0), record(seed=1, duration=2.0, sampling=0.02)
    evidence = make_evidence(arm(), [fast, slow])
    windows = windows_of(evidence, 150, 0.002).windows  # 0.3 s of the fast one
    last = (windows.step[:, -1] + windows.fraction[:, -1]) * windows.timestep
    np.testing.assert_allclose(last, 0.3, atol=1e-9)
    assert set(windows.recording) == {0, 1}


def test_a_slow_log_that_holds_windows_is_not_left_out() -> None:
    fast, slow = record(duration=3.0), record(seed=1, duration=1.0, sampling=0.02)
    assert make_evidence(arm(), [fast, slow]).too_short == ()
    brief = record(seed=1, duration=0.2, sampling=0.02)
    assert make_evidence(arm(), [fast, brief]).too_short == ("arm 1",)


def test_bounds_that_leave_out_the_model_are_said(tmp_path: Path) -> None:
    heavy = {"name": "m", "address": "body[forearm].mass", "low": 2.0, "high": 3.0, "steps": 5}
    study = write_study(tmp_path, parameters=[heavy])
    (note,) = parameters_out_of_bounds(study, gather(study, load_train(study)))
    assert note.startswith("The model as it is lies outside the bounds of m (")


def test_commands_that_the_model_clips_are_said(tmp_path: Path) -> None:
    limits = np.abs(record(seed=1, duration=8.0).channels["ctrl.elbow"].values)
    narrow = arm().spec()
    for name, high in (("elbow", float(np.quantile(limits, 0.9))), ("shoulder", 1e3)):
        narrow.actuator(name).ctrlrange = (-high, high)
        narrow.actuator(name).ctrllimited = True
    (tmp_path / "narrow.xml").write_text(narrow.to_xml())
    study = write_study(tmp_path, model="narrow.xml")
    (note,) = clipped_commands(gather(study, load_train(study)))
    assert note.startswith("train: ctrl.elbow leaves the model's control range")
    assert "for 10 % of the time; the model will clip it." in note


def test_joints_and_sensors_that_are_left_out_are_said() -> None:
    whole = record(duration=1.0)
    position = whole.channels["qpos.shoulder"]
    channels = {"qpos.shoulder": position, "sensor.link": position}
    channels |= {n: c for n, c in whole.channels.items() if n.startswith("ctrl.")}
    model = Model.from_file(ARM, unrecorded={"elbow": None})
    evidence = make_evidence(model, [replace(whole, channels=channels)])
    assert not_compared(evidence) == ("Positions of joints are compared, not sensor.link.",)
    assert unsought_sentence(evidence).startswith(
        "Nothing is looked for at elbow, whose position was not recorded"
    )
    as_recorded = make_evidence(arm(), [whole])
    assert not_compared(as_recorded) == ()
    assert unsought_sentence(as_recorded) == ""


def test_the_repaired_model_loads_and_holds_the_friction(diagnosed) -> None:
    result, folder = diagnosed
    model = mujoco.MjModel.from_xml_path(str(folder / "model_repaired.xml"))
    value = result.answer.findings[0].quantity.value
    assert model.joint("elbow").frictionloss[0] == pytest.approx(value, rel=1e-5)
    assert model.joint("shoulder").frictionloss[0] == 0


def test_the_repaired_study_is_a_study_with_the_finding_as_parameter(diagnosed) -> None:
    _, folder = diagnosed
    study = Study.load(folder / "study_repaired.yaml")
    (parameter,) = study.parameters
    assert parameter.address == ("joint[elbow].frictionloss",)
    assert parameter.low < 0.03 < parameter.high
    assert study.train_files


def test_the_answer_is_hashed_before_the_holdout_is_read(tmp_path: Path, monkeypatch) -> None:
    """Reading the hold-out finds the answer written with its hash, and nothing about errors."""
    study, seen = write_study(tmp_path, FRICTION), []

    def reading(*_, **__):
        seen.append(json.loads((tmp_path / "run" / "answer.json").read_text()))
        assert not (tmp_path / "run" / "diagnosis.json").exists()
        raise UserError("stop here")

    monkeypatch.setattr(sys.modules["bo_sysid.diagnosis.diagnose"], "load_holdout", reading)
    with (
        pytest.raises(UserError, match="stop here"),
        Run.open(tmp_path / "run", study.resolved(tmp_path / "run"), "diagnose") as run,
    ):
        diagnose(study, run)
    (answer,) = seen
    sha256 = answer.pop("sha256")
    text = json.dumps(answer, sort_keys=True, separators=(",", ":"))
    assert sha256 == hashlib.sha256(text.encode()).hexdigest()
    assert "holdout" not in answer
    assert [f["effect"] for f in answer["findings"]] == ["dry_friction"]


def test_the_hash_is_that_of_the_answer(diagnosed) -> None:
    result, folder = diagnosed
    content = json.loads((folder / "diagnosis.json").read_text())
    answer = {k: v for k, v in content.items() if k not in ("holdout", "sha256")}
    text = json.dumps(plain(answer), sort_keys=True, separators=(",", ":"))
    assert content["sha256"] == hashlib.sha256(text.encode()).hexdigest() == result.frozen.sha256


def test_the_json_has_the_keys_of_the_contract(diagnosed) -> None:
    _, folder = diagnosed
    content = json.loads((folder / "diagnosis.json").read_text())
    assert list(content) == [
        "verdict", "findings", "alternatives", "located", "holdout", "unexplained",
        "next_experiment", "model", "study", "sha256",
    ]  # fmt: skip
    assert set(content["findings"][0]) == {
        "effect", "kind", "site", "value", "unit", "interval", "before", "after", "details",
        "group", "probability", "equivalents", "sentence",
    }  # fmt: skip
    forecast = content["holdout"]["forecast"]
    assert forecast["unit"] == "sensor sigma"
    assert {"nominal", "refitted", "repaired", "learned_residual", "noise_floor"} < set(forecast)
    assert content["located"][0]["site"] == "elbow"


def test_nothing_missing_is_nothing_found(tmp_path: Path) -> None:
    result = diagnose(write_study(tmp_path))
    assert result.verdict == "nothing-missing"
    assert result.findings.empty
    assert result.sentences[0].startswith("Nothing")


def test_a_wrong_parameter_is_no_missing_physics(tmp_path: Path) -> None:
    study = write_study(
        tmp_path,
        [("link_mass", "body", "forearm", [0.05])],
        parameters=[
            {"address": "geom[forearm].mass", "low": 0.4, "high": 0.8, "name": "forearm mass"}
        ],
    )
    assert diagnose(study).verdict == "nothing-missing"


def test_one_blas_thread_is_enough(tmp_path: Path, monkeypatch) -> None:
    """Threads that spin while they wait take the cores that simulate."""
    seen = []

    def watched(*_):
        seen.extend(p["num_threads"] for p in threadpool_info() if p["user_api"] == "blas")
        raise UserError("seen")

    monkeypatch.setattr("bo_sysid.diagnosis.frozen.locate", watched)
    with threadpool_limits(2), pytest.raises(UserError, match="seen"):
        diagnose(write_study(tmp_path))
    assert set(seen) == {1}


def test_a_recording_without_the_joint_is_refused(tmp_path: Path) -> None:
    study = write_study(tmp_path)
    frame = record(duration=2.0).to_frame().drop(columns="qpos.elbow")
    frame.to_parquet(tmp_path / "train.parquet")
    with pytest.raises(UserError, match=r"qpos\.elbow"):
        diagnose(study)

"""`bo-sysid diagnose` from the command line: what it says and leaves, and what it refuses."""

import json
import shutil
import sys
from pathlib import Path

import pandas as pd
import pytest
import yaml

from bo_sysid.cli import main

pytestmark = pytest.mark.slow

MODEL = """
<mujoco>
  <option timestep="0.005" integrator="implicitfast"/>
  <default>
    <joint solreffriction="0.002 1" solimpfriction="0.999 0.9999 0.001 0.5 2"/>
    <geom contype="0" conaffinity="0"/>
  </default>
  <worldbody>
    <body name="rod">
      <joint name="hinge" axis="0 1 0" damping="0.01"/>
      <geom name="rod" type="capsule" size=".02" fromto="0 0 0 0 0 -.4" mass=".5"/>
    </body>
  </worldbody>
  <actuator><motor name="hinge" joint="hinge" ctrlrange="-1 1"/></actuator>
</mujoco>
"""
STUDY = """
name: a pendulum that rubs
model: pendulum.xml
recordings: {train: [made/train-*.parquet], holdout: [made/holdout-*.parquet]}
diagnosis: {effects: [dry_friction, viscous_damping, armature]}
plant:
  parameters: {"joint[hinge].frictionloss": 0.08}
  noise: {qpos: 0.0005}
  timestep: 0.00125
  record: {train: 1, holdout: 1, seconds: 5, excitation: multisine}
"""


@pytest.fixture(scope="module")
def diagnosed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with a study and its finished diagnosis."""
    folder = tmp_path_factory.mktemp("pendulum")
    (folder / "pendulum.xml").write_text(MODEL)
    (folder / "pendulum.yaml").write_text(STUDY)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        assert main(["record", "pendulum.yaml", "--out", "made"]) == 0
        assert main(["diagnose", "pendulum.yaml", "--out", "run"]) == 0
    return folder


def test_it_says_what_is_missing(diagnosed: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["report", str(diagnosed / "run")]) == 0
    out = capsys.readouterr().out
    assert "The model lacks physics." in out
    assert "The hinge has dry friction of 0.08" in out
    assert "Forecast error on the unseen recording falls from" in out
    row = next(line for line in out.splitlines() if line.startswith("dry_friction")).split()
    assert row[1:3] == ["joint", "hinge"]
    assert float(row[3]) == pytest.approx(0.08, rel=0.03)
    assert "nothing is missing" in out


def test_it_leaves_the_repaired_model_and_what_pictures_show(diagnosed: Path) -> None:
    run = diagnosed / "run"
    drawn = {p.name for p in (run / "figures").iterdir()}
    assert drawn - {"render.png"} == {
        "robot.png",
        "forces.png",
        "evidence.png",
        "held_out.png",
        "before_after.gif",
    }
    assert json.loads((run / "run.json").read_text())["status"] == "finished"
    study = yaml.safe_load((run / "study_repaired.yaml").read_text())
    assert study["model"] == {"file": "model_repaired.xml"}
    traces = pd.read_parquet(run / "traces.parquet")
    error = {m: (traces["recorded"] - traces[m]).std() for m in ("nominal", "repaired")}
    assert error["repaired"] < 2 * 0.0005
    assert error["nominal"] > 10 * error["repaired"]


def test_the_missing_force_is_the_friction_against_the_motion(diagnosed: Path) -> None:
    pieces = pd.read_parquet(diagnosed / "run" / "forces.parquet")
    fast = pieces[(pieces["speed"].abs() > 1.5) & (pieces["sigma"] < 0.02)]
    assert len(fast) > 10
    against = -fast["nominal"] * fast["speed"] / fast["speed"].abs()
    assert against.median() == pytest.approx(0.08, abs=0.01)
    assert fast["repaired"].abs().median() < 0.01


def test_a_finished_diagnosis_is_told_again(
    diagnosed: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(diagnosed)
    shutil.copytree("run", "again")

    def computed(*_: object, **__: object) -> None:
        raise AssertionError("computed again")

    monkeypatch.setattr("bo_sysid.cli.diagnose.diagnose_into", computed)
    assert main(["diagnose", "pendulum.yaml", "--out", "again"]) == 0
    out = capsys.readouterr().out
    assert out.startswith("again: finished 20")
    assert "The hinge has dry friction of 0.08" in out
    assert main(["diagnose", "pendulum.yaml", "--out", "again", "--strict"]) != 0
    assert "computed again" in capsys.readouterr().err


def test_a_new_diagnosis_that_is_killed_leaves_no_proof_of_the_old_one(
    diagnosed: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The model and the answer in the folder are those of the new one by then."""
    monkeypatch.chdir(diagnosed)
    shutil.copytree("run", "stopped")

    def killed(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(sys.modules["bo_sysid.diagnosis.diagnose"], "load_holdout", killed)
    assert main(["diagnose", "pendulum.yaml", "--out", "stopped", "--strict"]) == 130
    capsys.readouterr()
    assert main(["report", "stopped", "--text"]) == 0
    out = capsys.readouterr().out
    assert out.startswith("stopped: diagnose, interrupted")
    assert "The unseen recordings were not compared yet." in out
    assert "Forecast error" not in out


def test_wrong_input_gives_one_message(
    diagnosed: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(diagnosed)
    assert main(["diagnose", "pendulum.yaml", "--set", "diagnosis.effects=[dry_frction]"]) == 2
    err = capsys.readouterr().err
    assert "dry_frction" in err
    assert "dry_friction" in err
    assert "Traceback" not in err
    assert not (diagnosed / "runs").exists()


def test_the_demo_finds_what_the_arm_had(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["demo"]) == 0
    out = capsys.readouterr().out
    assert "The elbow has dry friction of 0.15" in out
    assert "The recorded arm had: joint[elbow].frictionloss 0.15." in out
    answer = json.loads((tmp_path / "runs/demo/diagnose/diagnosis.json").read_text())
    (finding,) = answer["findings"]
    assert finding["value"] == pytest.approx(0.15, rel=0.03)
    forecast = answer["holdout"]["forecast"]
    assert forecast["repaired"] < 1.15 * forecast["noise_floor"]
    assert forecast["refitted"] > 10 * forecast["noise_floor"]

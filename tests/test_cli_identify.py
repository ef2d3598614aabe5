"""`bo-sysid identify` from the command line: what it leaves, and that a killed run goes on."""

import json
import os
import signal
import subprocess
import sys
import time
from io import BytesIO
from pathlib import Path

import pandas as pd
import pytest

from bo_sysid.cli import main
from bo_sysid.report.page import write_page

MODEL = """
<mujoco>
  <option timestep="0.005"/>
  <worldbody>
    <body name="rod">
      <joint name="hinge" axis="0 1 0" damping="0.05"/>
      <geom name="rod" type="capsule" size=".02" fromto="0 0 0 0 0 -.4" mass=".5"/>
    </body>
  </worldbody>
  <actuator><motor name="motor" joint="hinge" ctrlrange="-1 1"/></actuator>
</mujoco>
"""
STUDY = """
model: pendulum.xml
recordings: {train: [made/train-*.parquet], holdout: [made/holdout-*.parquet]}
parameters:
  - {name: mass, address: "geom[rod].mass", low: 0.4, high: 0.8, steps: 21, unit: kg}
  - {name: damping, address: "joint[hinge].damping", low: 0, high: 0.1, steps: 11}
deviation: {horizon: 5}
search: {budget: 14, stop: {entropy: 0}}
plant:
  parameters: {mass: 0.62, damping: 0.03}
  noise: {qpos: 0.001, qvel: 0.01}
  record: {train: 2, holdout: 1, seconds: 2.0}
"""
RESULTS = ("identification.json", "evaluations.parquet", "belief.parquet", "model_identified.xml")


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    (tmp_path / "pendulum.xml").write_text(MODEL)
    (tmp_path / "pendulum.yaml").write_text(STUDY)
    monkeypatch.chdir(tmp_path)
    assert main(["record", "pendulum.yaml", "--out", "made"]) == 0
    return tmp_path


def contents(run: Path) -> dict[str, object]:
    """Return what a run found, as values."""
    return {
        "identification": json.loads((run / "identification.json").read_text()),
        "evaluations": pd.read_parquet(run / "evaluations.parquet").to_json(),
        "belief": pd.read_parquet(run / "belief.parquet").to_json(),
        "model": (run / "model_identified.xml").read_text(),
    }


def test_a_run_holds_the_answer_and_report_prints_it(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["identify", "pendulum.yaml", "--seed", "1"]) == 0
    out, err = capsys.readouterr()
    run = folder / "runs" / "pendulum-identify"
    assert {p.name for p in run.iterdir()} >= {"run.json", "study.yaml", *RESULTS}
    assert "identify 14/14" in err
    rows = {line.split()[0]: line.split() for line in out.splitlines() if line.strip()}
    # the candidate nearest to the plant, to a step of the grid
    assert float(rows["mass"][3]) == pytest.approx(0.62, abs=0.021)
    assert float(rows["damping"][2]) == pytest.approx(0.03, abs=0.011)
    assert json.loads((run / "run.json").read_text())["seed"] == 1
    assert main(["report", str(run), "--text"]) == 0
    again = capsys.readouterr().out.replace(f"{run}:", "runs/pendulum-identify:")
    assert out.startswith(again)
    assert {p.name for p in (run / "figures").iterdir()} == {
        "marginals.png",
        "progress.png",
        "predictions.png",
    }
    assert main(["identify", "pendulum.yaml", "--seed", "2"]) == 2
    assert "search.seed: 1 there, 2 now" in capsys.readouterr().err


def test_a_killed_run_goes_on_to_the_same_result(folder: Path) -> None:
    whole, killed = folder / "whole", folder / "killed"
    assert main(["identify", "pendulum.yaml", "--out", "whole"]) == 0
    command = [sys.executable, "-m", "bo_sysid.cli", "identify", "pendulum.yaml", "--out", "killed"]
    process = subprocess.Popen(command, stderr=subprocess.DEVNULL)  # noqa: S603
    try:
        for _ in range(600):
            path = killed / "evaluations.parquet"  # replaced at any moment: read at once
            if path.exists() and len(pd.read_parquet(BytesIO(path.read_bytes()))) >= 11:
                break
            assert process.poll() is None
            time.sleep(0.05)
    finally:
        os.kill(process.pid, signal.SIGKILL)
        process.wait()
    assert not (killed / "identification.json").exists()
    assert main(["identify", "pendulum.yaml", "--out", "killed"]) == 0
    assert contents(killed) == contents(whole)
    assert not list(killed.rglob(".tmp-*"))


def test_without_velocities_starts_are_fitted_and_the_truth_is_found(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """One step from an estimated velocity shows the encoder's noise and hardly the mass."""
    for path in (folder / "made").glob("*.parquet"):
        frame = pd.read_parquet(path)
        frame.drop(columns="qvel.hinge").to_parquet(path)
    study = STUDY.replace("deviation: {horizon: 5}\n", "").replace("budget: 14", "budget: 20")
    (folder / "positions.yaml").write_text(study)
    assert main(["identify", "positions.yaml"]) == 0
    out = capsys.readouterr().out
    assert "no velocity was recorded" in out
    found = json.loads((folder / "runs" / "positions-identify" / "identification.json").read_text())
    mass = found["parameters"][0]
    assert mass["value"] == pytest.approx(0.62, abs=0.021)
    assert mass["low95"] <= 0.62 <= mass["high95"]


def test_a_finished_run_is_told_again_and_not_computed(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["identify", "pendulum.yaml", "--out", "run"]) == 0
    first, before = capsys.readouterr().out, contents(folder / "run")

    def computed(*_: object, **__: object) -> None:
        raise AssertionError("computed again")

    with monkeypatch.context() as patch:
        patch.setattr("bo_sysid.cli.identify.identify_into", computed)
        assert main(["identify", "pendulum.yaml", "--out", "run"]) == 0
    said = capsys.readouterr().out
    assert said.startswith("run: finished 20")
    assert "use another --out or remove the folder" in said
    assert said.endswith(first)
    assert contents(folder / "run") == before
    held = next((folder / "made").glob("holdout-*.parquet"))
    pd.read_parquet(held).iloc[:-1].to_parquet(held)
    assert main(["identify", "pendulum.yaml", "--out", "run"]) == 0  # errors on it are others
    assert "finished 20" not in capsys.readouterr().out
    after = contents(folder / "run")
    assert after["evaluations"] == before["evaluations"]
    assert after["identification"] != before["identification"]


def test_a_model_that_diverges_in_every_window_ends_in_an_answer(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A mass that was left at next to nothing; the search used to end in a traceback."""
    (folder / "pendulum.xml").write_text(
        MODEL.replace('mass=".5"', 'mass="1e-9"').replace(
            'joint="hinge"', 'joint="hinge" gear="1e6"'
        )
    )
    study = STUDY.split("plant:", maxsplit=1)[0].replace(
        "low: 0.4, high: 0.8", "low: 4e5, high: 8e5"
    )
    (folder / "light.yaml").write_text(study.replace("budget: 14", "budget: 4"))
    assert main(["identify", "light.yaml"]) == 0
    out = capsys.readouterr().out
    assert "the nominal model diverges in every window" in out
    run = folder / "runs" / "light-identify"
    found = json.loads((run / "identification.json").read_text())
    assert {e["nominal"] for e in found["errors"]} == {None}
    assert all(e["identified"] > 0 and e["nominal_diverged"] == 1 for e in found["errors"])
    assert pd.read_parquet(run / "traces.parquet")["nominal"].isna().all()
    page = write_page(run).read_text()
    assert "nominal model (no prediction)" in page


def test_time_left_counts_no_more_than_there_are_candidates(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text = (folder / "pendulum.yaml").read_text()
    few = text.replace("steps: 21", "steps: 3").replace("steps: 11", "steps: 3")
    (folder / "few.yaml").write_text(few)
    assert main(["identify", "few.yaml", "--out", "few"]) == 0
    assert "identify 9/9" in capsys.readouterr().err

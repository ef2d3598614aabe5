"""The outer loop: it finds the plant, counts, survives a kill, and waits for a person."""

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pandas as pd
import pytest
import torch
import yaml
from learning import learned, pendulum

from bo_sysid.cli import main
from bo_sysid.errors import RecordingError, RunError, StudyError, UserError
from bo_sysid.learn.identified import evaluated_again, identified, long_enough
from bo_sysid.learn.learn import learn
from bo_sysid.learn.play import play, render
from bo_sysid.learn.scene import Scene
from bo_sysid.mjcf import Model, address_edit
from bo_sysid.plants.build import build_plant
from bo_sysid.policy.store import LearnedPolicy
from bo_sysid.recording import Recording, read_recording
from bo_sysid.recording.writers import write_recording
from bo_sysid.report.learning import learning_summary
from bo_sysid.report.text import run_text
from bo_sysid.study import Study
from bo_sysid.study.inputs import load_model

RESULTS = ("learning.json", "iterations.parquet", "trajectories.parquet", "training.parquet")


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a finished run."""
    folder = tmp_path_factory.mktemp("whole")
    (folder / "study.yaml").write_text(yaml.safe_dump(pendulum()))
    assert main(["learn", str(folder / "study.yaml"), "--out", str(folder / "run")]) == 0
    return folder / "run"


def contents(run: Path) -> dict[str, object]:
    """Return what a run found, as values."""
    found: dict[str, object] = {"learning": json.loads((run / "learning.json").read_text())}
    for name in sorted(run.rglob("belief.parquet")):
        found[str(name.relative_to(run))] = pd.read_parquet(name).to_json(double_precision=15)
    for name in sorted((run / "trajectories").glob("*.parquet")):
        found[name.name] = pd.read_parquet(name).to_json(double_precision=15)
    for name in sorted(run.glob("iterations/*/policy.npz")):
        found[str(name.relative_to(run))] = LearnedPolicy.load(name).theta.tolist()
    return found


def test_a_run_holds_everything_and_finds_the_plant(whole: Path) -> None:
    told = json.loads((whole / "learning.json").read_text())
    assert told["status"] == "finished"
    assert told["trajectories"] == len(list((whole / "trajectories").glob("*.parquet"))) == 2
    first = told["iterations"][0]
    assert first["most_probable"]["mass"] == pytest.approx(1.2, abs=0.101)
    assert first["most_probable"]["damping"] == pytest.approx(0.8, abs=0.101)
    assert {"mean", "error", "samples"} == set(first["plant_return"])
    assert all((whole / name).is_file() for name in RESULTS)
    assert (whole / "figures" / "learning.png").stat().st_size > 5_000
    log = pd.read_parquet(whole / "training.parquet")
    assert {"learned", "kl", "cg_residual", "trials", "explained_variance"} <= set(log)
    belief = pd.read_parquet(whole / "iterations" / "01" / "belief.parquet")
    assert belief["P"].sum() == pytest.approx(1.0)


SLOW = """
import sys, time
from bo_sysid.cli import main
from bo_sysid.runs import Run
write = Run.write_bytes
def slowly(self, name, content):
    time.sleep(0.15)
    return write(self, name, content)
Run.write_bytes = slowly
sys.exit(main(sys.argv[1:]))
"""


@pytest.mark.parametrize("after", ["iterations/01/identified.json", "iterations/02/policy.npz"])
def test_a_killed_run_goes_on_to_the_same_result(whole: Path, tmp_path: Path, after: str) -> None:
    study = tmp_path / "study.yaml"
    study.write_text((whole.parent / "study.yaml").read_text())
    command = ["learn", str(study), "--out", str(tmp_path / "run")]
    process = subprocess.Popen([sys.executable, "-c", SLOW, *command])  # noqa: S603
    until = time.monotonic() + 60
    while not (tmp_path / "run" / after).exists() and time.monotonic() < until:
        time.sleep(0.01)
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    assert (tmp_path / "run" / after).exists()
    assert not (tmp_path / "run" / "learning.json").exists()
    assert main(command) == 0
    assert contents(tmp_path / "run") == contents(whole)


def test_a_run_without_a_folder_finds_the_same(whole: Path) -> None:
    told = learn(Study.from_dict(pendulum()))
    stored = LearnedPolicy.load(whole / "policy.npz")
    assert told.policy is not None
    np.testing.assert_array_equal(told.policy.theta, stored.theta)


def test_every_evaluated_candidate_is_evaluated_again_on_all_recordings() -> None:
    scene = Scene.of(Study.from_dict(pendulum()))
    plant = build_plant(scene.study)
    one, two = (plant.record(np.sin(np.arange(200)[:, None] * f)) for f in (0.1, 0.23))
    alone = identified(scene, [one], np.zeros(0, int))
    both = identified(scene, [one, two], alone.rows)
    assert both.rows[: len(alone.rows)].tolist() == alone.rows.tolist()
    assert both.fresh == len(both.rows) - len(alone.rows)
    from bo_sysid.identify.problem import make_problem

    deviation = make_problem(scene.study, [one, two]).deviation
    truth = deviation(scene.candidates.points[both.rows]).deviation
    np.testing.assert_allclose(both.deviation, truth, rtol=1e-12)
    assert (np.abs(both.deviation[: len(alone.rows)] - alone.deviation) > 1e-6).all()
    assert len(evaluated_again(deviation, scene.candidates.points, alone.rows)) == len(alone.rows)


@pytest.mark.parametrize(
    "changed",
    [
        {"policy": {"batch": 400, "steps": 400, "hidden": [8], "start": "warm"}},
        {"learn": {"trajectories": 2, "episodes": 2, "stop": "zhu", "choose": "argmax"}},
        {"learn": {"trajectories": 2, "episodes": 2, "models": "bootstrap", "stop": "timeout"}},
    ],
)
def test_variants_run_and_resume(tmp_path: Path, changed: dict[str, object]) -> None:
    study = pendulum(**changed)
    told = learned(tmp_path, study)
    assert len(told.trajectories) == 2
    again = learned(tmp_path, study)
    pd.testing.assert_frame_equal(again.iterations, told.iterations)
    if "policy" in changed:
        log = pd.read_parquet(tmp_path / "run" / "training.parquet")
        assert log[["learned", "steps"]].to_numpy().tolist() == [[1, 400], [2, 800]]


def test_policies_that_cannot_be_the_last_are_drafts(tmp_path: Path) -> None:
    policy = {"batch": 400, "steps": 1200, "hidden": [8], "draft": 400}
    rule = {"trajectories": 3, "episodes": 2, "stop": "timeout", "choose": "argmax"}
    study = pendulum(policy=policy, learn=rule)
    told = learned(tmp_path, study)
    log = pd.read_parquet(tmp_path / "run" / "training.parquet")
    # the second takes the first's over as it is: every batch is there once
    assert log[["learned", "steps"]].to_numpy().tolist() == [[1, 400], [3, 800], [3, 1200]]
    assert told.iterations["training_steps"].tolist() == [400, 0, 800]
    # one that goes on from its draft is the one that was learned at once
    summary = json.loads((tmp_path / "run" / "learning.json").read_text())
    assert summary["iterations"][1]["row"] == summary["iterations"][2]["row"]
    at_once = {**policy, "draft": 1200}
    other = learned(tmp_path, pendulum(policy=at_once, learn=rule), "other")
    assert told.policy is not None
    assert other.policy is not None
    assert other.chosen == told.chosen
    np.testing.assert_array_equal(other.policy.theta, told.policy.theta)


def test_the_seeds_rule_needs_no_draft_where_it_may_end(tmp_path: Path) -> None:
    policy = {"batch": 400, "steps": 800, "hidden": [8], "draft": 400}
    learned(tmp_path, pendulum(policy=policy, learn={"trajectories": 1, "episodes": 2}))
    log = pd.read_parquet(tmp_path / "run" / "training.parquet")
    assert log["steps"].max() == 800


def test_a_loop_that_only_time_ends_says_so_and_its_policy_names_the_task(tmp_path: Path) -> None:
    study = pendulum(learn={"trajectories": 1, "episodes": 2, "stop": "timeout"})
    told = learned(tmp_path, {**study, "task": {**study["task"], "repeat": 2}})
    assert told.reason == "All 1 trajectories of learn.trajectories are spent."
    assert told.policy.about["task"] == "PendulumSwingup"


def test_a_loop_whose_trajectories_are_spent_goes_on_with_more(tmp_path: Path) -> None:
    rule = {"trajectories": 1, "episodes": 2, "stop": "timeout"}
    (tmp_path / "study.yaml").write_text(yaml.safe_dump(pendulum(learn=rule)))
    command = ["learn", str(tmp_path / "study.yaml"), "--out", str(tmp_path / "run")]
    assert main(command) == 0
    first = (tmp_path / "run" / "iterations" / "01" / "policy.npz").read_bytes()
    more = [*command, "--set", "learn.trajectories=2"]
    assert main(more) == 0
    assert (tmp_path / "run" / "iterations" / "01" / "policy.npz").read_bytes() == first
    at_once = learned(tmp_path, pendulum(learn={**rule, "trajectories": 2}), "at_once")
    pd.testing.assert_frame_equal(
        pd.read_parquet(tmp_path / "run" / "iterations.parquet"), at_once.iterations
    )
    assert main(more) == 0  # it is finished
    assert main(command) == 2  # one trajectory is not what it holds
    assert main([*more, "--set", "learn.episodes=3"]) == 2


def test_a_trajectory_that_would_be_repeated_ends_the_loop(tmp_path: Path) -> None:
    # no value is within r; without noise P settles soon
    rule = {"trajectories": 9, "episodes": 2, "epsilon": 0.2, "r": 1e-9}
    told = learned(
        tmp_path, pendulum(learn=rule, plant={"parameters": {"mass": 1.2, "damping": 0.8}})
    )
    assert len(told.trajectories) < 9
    assert "another one would tell no more" in told.reason


RUNAWAY = {"effect": "asymmetric_damping", "kind": "joint", "site": "hinge", "value": 150.0}


@pytest.mark.filterwarnings("ignore")
def test_a_plant_that_breaks_off_keeps_what_was_recorded(tmp_path: Path) -> None:
    study = pendulum(learn={"trajectories": 1, "episodes": 2})
    study["plant"] = {"effects": [RUNAWAY]}
    told = learned(tmp_path, study)
    (fault,) = told.trajectories["fault"]
    assert "diverged at" in fault
    assert any("what was recorded until then is used" in n for n in told.notes)
    kept = read_recording(tmp_path / "run" / "trajectories" / "01.parquet")
    assert 2 <= len(kept.channels["qpos.hinge"].values) < 1001
    study["deviation"] = {"horizon": 1000}
    with pytest.raises(RecordingError, match=r"too few for a window of 1000.*diverged at"):
        learned(tmp_path, study, "longer")


def test_a_recording_that_is_too_short_counts_for_nothing_beside_others() -> None:
    scene = Scene.of(Study.from_dict(pendulum(deviation={"horizon": 20})))
    plant = build_plant(scene.study)
    one = plant.record(np.sin(0.1 * np.arange(200)[:, None]))
    short = plant.record(np.sin(np.arange(15)[:, None]))
    assert long_enough([one, short], 20) == (one,)
    assert long_enough([short], 20) == (short,)
    alone, both = (identified(scene, r, np.zeros(0, int)) for r in ([one], [one, short]))
    np.testing.assert_array_equal(both.deviation, alone.deviation)
    with pytest.raises(RecordingError, match=r"too few for a window of 20 \(deviation.horizon"):
        identified(scene, [short], np.zeros(0, int))


# --- a person's machine ---


def machine_study(tmp_path: Path) -> dict[str, object]:
    """A study without a plant, and the machine's first recording."""
    study = pendulum(limits={"hinge": {"effort": 0.5, "velocity": 40.0}})
    plant = build_plant(Study.from_dict(study, tmp_path), seed=7)
    write_recording(plant.record(np.full((300, 1), 0.2)), tmp_path / "first.csv")
    del study["plant"]
    study["recordings"] = {"train": ["first.csv"], "noise": {"qpos": 0.001, "qvel": 0.01}}
    return study


@pytest.mark.filterwarnings("ignore:.*torch.jit.*:DeprecationWarning")
def test_a_persons_machine_is_waited_for(tmp_path: Path) -> None:
    study = machine_study(tmp_path)
    told = learned(tmp_path, study)
    assert "waiting for recording 1" in told.waiting
    assert any("no hold-out is named; the last quarter" in n for n in told.notes)
    assert "recordings/trajectory-01.parquet" in told.waiting
    assert told.trajectories.empty
    module = torch.jit.load(str(tmp_path / "run" / "policies" / "policy-01.pt"))
    commands = module(torch.randn(200, 3) * 30).numpy()
    about = json.loads((tmp_path / "run" / "policies" / "policy-01.json").read_text())
    assert np.abs(commands).max() <= 0.5 + 1e-6  # the motor's gear is 1: 0.5 N m
    assert about["high"] == [pytest.approx(0.5)]
    assert about["observed"] == ["orientation (2)", "velocity"]  # as dm_control's pendulum has it
    assert "3 observations (orientation (2), velocity, in this order)" in told.waiting
    again = learned(tmp_path, study)
    assert again.waiting == told.waiting

    policy = LearnedPolicy.load(tmp_path / "run" / "policy.npz")
    plant = build_plant(Study.from_dict(pendulum(limits=study["limits"]), tmp_path), seed=8)
    recording = plant.record(policy.act, steps=400)
    assert np.abs(recording.channels["ctrl.torque"].values).max() <= 0.5 + 1e-9
    write_recording(recording, tmp_path / "run" / "recordings" / "trajectory-01.csv")
    went_on = learned(tmp_path, study)
    assert len(went_on.trajectories) == 1
    assert len(went_on.iterations) == 2
    assert went_on.iterations["plant_return"].isna().all()
    assert any("trajectory-01 ends after 8 of 20 s" in note for note in went_on.notes)

    with_a_gap(tmp_path / "run" / "recordings" / "trajectory-01.csv")
    with pytest.raises(RunError, match=r"trajectory-01\.csv: changed since this run used it"):
        learned(tmp_path, study)


def test_what_to_record_has_the_columns_and_units_of_the_study(tmp_path: Path) -> None:
    study = machine_study(tmp_path)
    first = pd.read_csv(tmp_path / "first.csv")
    other = pd.DataFrame(
        {
            "t": 1e3 * first["time"],
            "angle": -np.degrees(first["qpos.hinge"]),
            "ctrl.torque": 1e3 * first["ctrl.torque"],
        }
    )
    other.to_csv(tmp_path / "first.csv", index=False)
    study["recordings"] = {
        "train": ["first.csv"],
        "columns": {
            "time": {"from": "t", "unit": "ms"},
            "qpos.hinge": {"from": "angle", "unit": "deg", "sign": -1},
            "ctrl.torque": {"unit": "mN m"},
        },
    }
    waiting = learned(tmp_path, study).waiting
    assert "time, qpos.<joint>" not in waiting
    assert (
        "'t' in ms (time), 'angle' in deg (qpos.hinge), ctrl.torque in mN m, as under "
        "recordings.columns of the study, which is applied to the file; velocities" in waiting
    )
    place = tmp_path / "run" / "recordings" / "trajectory-01.csv"
    other.to_csv(place, index=False)
    with pytest.raises(
        RecordingError, match=r"trajectory-01.csv: the positions are those of first"
    ):
        learned(tmp_path, study)
    other.iloc[5:].to_csv(place, index=False)
    assert len(learned(tmp_path, study).trajectories) == 1  # read as it was asked for


@pytest.mark.filterwarnings("ignore:.*torch.jit.*:DeprecationWarning")
def test_what_cannot_be_a_recording_of_the_policy_is_refused(tmp_path: Path) -> None:
    study = machine_study(tmp_path)
    folder = tmp_path / "run" / "recordings"
    assert "s, every 0.02 s or more often" in learned(tmp_path, study).waiting
    policy = LearnedPolicy.load(tmp_path / "run" / "policy.npz")
    plant = build_plant(Study.from_dict(pendulum(limits=study["limits"]), tmp_path), seed=8)
    frame = plant.record(policy.act, steps=400).to_frame()
    frame.to_csv(folder / "trajectory-1.csv", index=False)
    frame.to_csv(folder / "trajectory-01.CSV", index=False)
    waiting = learned(tmp_path, study).waiting
    assert (
        f"- trajectory-01.CSV, trajectory-1.csv in {folder} are not read: the recording" in waiting
    )
    milli = frame.assign(**{"ctrl.torque": 1e3 * frame["ctrl.torque"]})
    milli.to_csv(folder / "trajectory-01.csv", index=False)
    with pytest.raises(RecordingError, match=r"ctrl.torque goes from .* clipped to \[-0.5, 0.5\]"):
        learned(tmp_path, study)
    frame.iloc[::5].to_csv(folder / "trajectory-01.csv", index=False)
    told = learned(tmp_path, study)
    assert len(told.trajectories) == 1
    assert any("recorded every 0.1 s, and the policy acts every 0.02 s" in n for n in told.notes)
    assert "waiting for recording 2" in told.waiting
    shutil.copyfile(folder / "trajectory-01.csv", folder / "trajectory-02.csv")
    with pytest.raises(RecordingError, match=r"02.csv: the positions are those of trajectory-01"):
        learned(tmp_path, study)
    (folder / "trajectory-01.csv").unlink()
    with pytest.raises(RunError, match=r"trajectory-01.* this run has used it and it is gone"):
        learned(tmp_path, study)
    (folder / "trajectory-01.csv").touch()
    with pytest.raises(RunError, match=r"name .*/recordings/trajectory-01.* under recordings.trai"):
        learned(tmp_path, {**study, "search": {"budget": 13}})


@pytest.mark.filterwarnings("ignore:.*torch.jit.*:DeprecationWarning")
def test_a_finished_loop_says_how_its_policy_is_run_on_the_machine(tmp_path: Path) -> None:
    study = machine_study(tmp_path)
    study["learn"] = {"trajectories": 1, "episodes": 2, "stop": "timeout"}
    assert learned(tmp_path, study).waiting
    assert "The policy for the machine is" not in run_text(tmp_path / "run")
    frame = pd.read_csv(tmp_path / "first.csv").iloc[7:]
    frame.to_csv(tmp_path / "run" / "recordings" / "trajectory-01.csv", index=False)
    assert not learned(tmp_path, study).waiting
    text = run_text(tmp_path / "run")
    assert (
        f"The policy for the machine is {tmp_path / 'run' / 'policy.pt'}. The module takes" in text
    )
    about = json.loads((tmp_path / "run" / "policy.json").read_text())
    assert (about["actuators"], about["high"]) == (["torque"], [pytest.approx(0.5)])
    said = learning_summary(json.loads((tmp_path / "run" / "learning.json").read_text()))
    assert said["verdict"].startswith("The policy was learned after 1 real trajectory")
    assert any(s.startswith("The policy for the machine is") for s in said["sentences"])


def test_a_bad_recording_of_a_person_is_said_and_can_be_replaced(tmp_path: Path) -> None:
    study = machine_study(tmp_path)
    learned(tmp_path, study)
    place = tmp_path / "run" / "recordings" / "trajectory-01.csv"
    place.write_text("time,qpos.hinge,ctrl.torque\n0,0.1,0\n0.02,nan,0\n0.04,0.1,x\n")
    with pytest.raises(UserError, match=r"trajectory-01"):
        learned(tmp_path, study)
    assert place.exists()
    shutil.copyfile(tmp_path / "first.csv", place)
    write_recording(read_recording(tmp_path / "first.csv"), place.with_suffix(".parquet"))
    with pytest.raises(UserError, match=r"trajectory-01.* are there; only one may be"):
        learned(tmp_path, study)
    place.with_suffix(".parquet").unlink()
    place.unlink()
    assert "waiting for recording 1" in learned(tmp_path, study).waiting


def with_a_gap(path: Path) -> None:
    rows = path.read_text().splitlines()
    path.write_text("\n".join(rows[:100] + rows[140:]) + "\n")


def test_strict_refuses_a_machines_recordings_with_a_gap(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "mine.yaml").write_text(yaml.safe_dump(machine_study(tmp_path)))
    strict = ["learn", str(tmp_path / "mine.yaml"), "--out", str(tmp_path / "run"), "--strict"]
    assert main(strict) == 0
    trajectory = tmp_path / "run" / "recordings" / "trajectory-01.csv"
    shutil.copyfile(tmp_path / "first.csv", trajectory)
    with_a_gap(trajectory)
    assert main(strict) == 2
    assert re.search(r"trajectory-01.csv: refused because of --strict", capsys.readouterr().err)
    with_a_gap(tmp_path / "first.csv")
    assert main([*strict[:-2], str(tmp_path / "other"), "--strict"]) == 2
    assert re.search(r"first.csv: refused because of --strict", capsys.readouterr().err)


def test_first_recordings_must_not_change(tmp_path: Path) -> None:
    study = machine_study(tmp_path)
    learned(tmp_path, study)
    text = (tmp_path / "first.csv").read_text().splitlines()
    (tmp_path / "first.csv").write_text("\n".join(text[:-20]) + "\n")
    with pytest.raises(RunError, match="recordings that the study names changed"):
        learned(tmp_path, study)


def test_a_run_does_not_go_on_with_another_model(tmp_path: Path) -> None:
    study = machine_study(tmp_path)
    model = load_model(Study.from_dict(study, tmp_path))
    model.export(tmp_path / "model.xml", [])
    study["model"] = "model.xml"
    learned(tmp_path, study)
    model.export(tmp_path / "model.xml", [address_edit(model, ["joint[hinge].damping"], 0.2)])
    with pytest.raises(RunError, match="the model changed since this run began; use another --out"):
        learned(tmp_path, study)
    model.export(tmp_path / "model.xml", [])
    assert "waiting for recording 1" in learned(tmp_path, study).waiting


def test_a_machine_of_ones_own_needs_a_run_folder(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="needs a run folder"):
        learn(Study.from_dict(machine_study(tmp_path), tmp_path))


def test_waiting_is_no_failure(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "mine.yaml").write_text(yaml.safe_dump(machine_study(tmp_path)))
    monkeypatch.chdir(tmp_path)
    assert main(["learn", "mine.yaml", "--out", "run"]) == 0
    assert "waiting for recording 1" in capsys.readouterr().out
    assert main(["play", "run"]) == 2
    assert "play needs a simulated plant" in capsys.readouterr().err


# --- play ---


def test_play_evaluates_and_records(
    whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    played = play(whole, episodes=3, out=tmp_path)
    assert played.returns.shape == (3,)
    assert "± " in played.sentence
    recording = read_recording(played.recording)
    assert recording.span[1] == pytest.approx(20.0)
    assert played.pictures is None
    assert "MUJOCO_GL" in played.not_rendered
    np.testing.assert_array_equal(play(whole, episodes=3, out=tmp_path).returns, played.returns)


def test_pictures_leave_joints_that_were_not_recorded_where_the_model_puts_them(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    class Renderer:
        """Stands for MuJoCo's, which needs OpenGL: what it renders is the pose."""

        def __init__(self, *_: object) -> None:
            pass

        def __enter__(self) -> "Renderer":
            return self

        def __exit__(self, *_: object) -> None:
            pass

        def update_scene(self, data: mujoco.MjData, camera: int) -> None:
            self.shown = data.qpos.copy()

        def render(self) -> np.ndarray:
            return self.shown.reshape(2, 1, 1)

    monkeypatch.setattr(mujoco, "Renderer", Renderer)
    model = Model.from_xml("""<mujoco><worldbody><body><joint name="a"/><geom size=".1"/>
    <body><joint name="b" ref="90"/><geom size=".1"/></body></body></worldbody></mujoco>""")
    seen = Recording.from_arrays([0.0, 1.0], qpos={"a": [0.2, 0.2]})
    np.testing.assert_allclose(render(model, seen)[:, 0, 0], [0.2, np.pi / 2])


def test_play_without_working_graphics_says_so(whole: Path, tmp_path: Path) -> None:
    command = [sys.executable, "-m", "bo_sysid.cli", "play", str(whole), "--episodes", "1"]
    done = subprocess.run(  # noqa: S603
        [*command, "--out", str(tmp_path)],
        capture_output=True,
        text=True,
        env={**os.environ, "MUJOCO_GL": "nonsense"},
    )
    assert done.returncode == 0, done.stderr
    assert "No pictures: MUJOCO_GL=nonsense does not work on this machine" in done.stdout
    assert (tmp_path / "recording.parquet").is_file()


# --- bad input ---


def test_a_policy_of_another_model_is_refused(whole: Path, tmp_path: Path) -> None:
    from bo_sysid.policy.network import GaussianPolicy
    from bo_sysid.policy.normalisation import Normaliser

    policy = GaussianPolicy.of_size(5, 2, (4,))
    theta = policy.initial(np.random.default_rng(0))
    other = LearnedPolicy(policy, theta, Normaliser(np.zeros(5), np.ones(5)), {"task": "arm"})
    other.save(tmp_path / "arm.npz")
    with pytest.raises(UserError, match=r"takes 5 observations and gives 2 actions.*on arm"):
        play(whole, policy=tmp_path / "arm.npz")
    own = LearnedPolicy.load(whole / "policy.npz")
    names = {"joints": ["knee"], "actuators": ["torque"]}
    replace(own, about={**own.about, "machine": names}).save(tmp_path / "leg.npz")
    with pytest.raises(
        UserError, match=r"leg.npz: learned for the joints knee; those .* are hinge"
    ):
        play(whole, policy=tmp_path / "leg.npz")
    with pytest.raises(RunError, match="no such policy"):
        play(whole, policy=tmp_path / "none.npz")
    with pytest.raises(RunError, match=r"policy.pt: a TorchScript module.*play takes the .npz"):
        play(whole, policy=whole / "policy.pt")


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"task": None, "model": "arm.xml", "parameters": []}, "learn needs a task with a reward"),
        ({"parameters": []}, "at least one uncertain parameter"),
        ({"plant": None}, r"matches no file.*begins with a recording"),
        (
            {"actuators": {"torque": {"law": "servo.py:law", "uses": ["goal.torque"]}}},
            "actuators.torque.*a policy commands the actuators itself",
        ),
        (
            {"parameters": [{"address": "actuator[torque].ctrlrange[1]", "low": 0.5, "high": 1}]},
            "actions are commands within the ctrlrange, which must be known",
        ),
        ({"limits": {"hing": {"effort": 1.0}}}, "no such joint; did you mean 'hinge'"),
        (
            {"task": {"dm_control": {"domain": "pendulum", "task": "swigup"}}},
            "no 'pendulum swigup'",
        ),
        (
            {"task": {"dm_control": {"domain": "hopper", "task": "stand"}}},
            "^study: task: task HopperStand does not fit the model",
        ),
        (
            {"plant": {"effects": [RUNAWAY]}, "model": "wild.xml"},
            "plant.effects: the model does not bear .*diverged at 0 s",
        ),
    ],
)
def test_wrong_studies_are_told(tmp_path: Path, changed: dict[str, object], message: str) -> None:
    (tmp_path / "arm.xml").write_text(
        '<mujoco><worldbody><body><joint name="hinge"/><geom size="1"/></body></worldbody></mujoco>'
    )
    study = {k: v for k, v in pendulum(**changed).items() if v is not None}
    (tmp_path / "wild.xml").write_text(FREE.replace("<motor", '<motor gear="1e12" ctrlrange="0 1"'))
    (tmp_path / "servo.py").write_text("def law(now):\n    return now.signals['goal.torque']\n")
    if "arm.xml" in changed.values():
        study.pop("plant")
    with pytest.raises(UserError, match=f"(?s){message}"):
        learned(tmp_path, study)


@pytest.mark.parametrize(
    ("section", "key"),
    [("learn", "trajectories"), ("learn", "episodes"), ("policy", "steps"), ("search", "budget")],
)
def test_budgets_of_zero_are_refused(section: str, key: str) -> None:
    with pytest.raises(StudyError, match=rf"{section}\.{key}.*greater than or equal to 1"):
        Study.from_dict(pendulum(**{section: {key: 0}}))


TASK = """
import collections
from dm_control.rl import control
from dm_control.suite import base


class Hold(base.Task):
    control_timestep, time_limit = 0.02, 0.4

    def get_observation(self, physics):
        return collections.OrderedDict(q=physics.data.qpos.copy(), v=physics.data.qvel.copy())

    def get_reward(self, physics):
        return REWARD
"""


FREE = """
<mujoco>
  <option timestep="0.02"/>
  <worldbody><body name="pole">
    <joint name="hinge" axis="0 1 0" damping="0.1"/>
    <geom type="capsule" size=".04" fromto="0 0 0 0 0 .5" mass="1"/>
  </body></worldbody>
  <actuator><motor name="torque" joint="hinge"/></actuator>
</mujoco>
"""

OTHER_ACTIONS = {
    "scaled": "    def before_step(self, action, physics):\n"
    "        super().before_step(0.2 * action, physics)\n",
    "wide": "    def action_spec(self, physics):\n"
    "        return specs.BoundedArray((1,), float, -5 * np.ones(1), 5 * np.ones(1))\n",
    "none": "",
}


@pytest.mark.parametrize("what", OTHER_ACTIONS)
def test_on_a_persons_machine_actions_are_commands(tmp_path: Path, what: str) -> None:
    head = "import numpy as np\nfrom dm_env import specs\n"
    task = TASK.replace("REWARD", "1.0 - abs(float(physics.data.qpos[0]))")
    (tmp_path / "hold.py").write_text(f"{head}{task}\n{OTHER_ACTIONS[what]}")
    study = {
        **machine_study(tmp_path),
        "task": {"file": "hold.py", "class": "Hold"},
        "limits": {"hinge": {"effort": 0.5}},
    }
    made = Study.from_dict(study, tmp_path, trust_code=True)
    if what == "none":
        assert Scene.of(made).task.name == "Hold"
        return
    with pytest.raises(StudyError, match=r"task: the actions .* of Hold command .*range ends at"):
        Scene.of(made)


def test_what_cannot_be_learned_is_refused_before_a_trajectory(tmp_path: Path) -> None:
    (tmp_path / "hold.py").write_text(TASK.replace("REWARD", "1.0"))
    study = pendulum(task={"file": "hold.py", "class": "Hold"})
    study["learn"]["models"] = "bootstrap"
    with pytest.raises(StudyError, match=r"learn.models: bootstrap needs a vectorised task"):
        Scene.of(Study.from_dict(study, tmp_path, trust_code=True))
    with pytest.raises(StudyError, match=r"policy: kl is 1e-10; it must be from 1e-09"):
        Scene.of(Study.from_dict(pendulum(policy={"kl": 1e-10}), tmp_path))


def test_a_model_without_actuators_is_refused(tmp_path: Path) -> None:
    (tmp_path / "hold.py").write_text(TASK.replace("REWARD", "1.0"))
    (tmp_path / "free.xml").write_text(
        '<mujoco><worldbody><body><joint name="h"/><geom name="g" size=".1" mass="1"/></body>'
        "</worldbody></mujoco>"
    )
    mass = {"address": "geom[g].mass", "low": 0.5, "high": 1.5}
    changed = {"model": "free.xml", "task": {"file": "hold.py", "class": "Hold"}, "plant": {}}
    study = pendulum(**changed, parameters=[mass])
    with pytest.raises(StudyError, match="model: learn needs actuators; the model has none"):
        Scene.of(Study.from_dict(study, tmp_path, trust_code=True))


@pytest.mark.parametrize(
    ("task", "message"),
    [
        (
            {"dm_control": {"domain": "pendulum", "task": "swingup"}},
            "model: actuator 'torque' has no control range; give it a ctrlrange in the model",
        ),
        (
            {"file": "hold.py", "class": "Hold"},
            r"task Hold: its action 0 \(actuator 'torque'\) has no bounds .*a ctrlrange",
        ),
    ],
)
def test_an_actuator_without_a_range_is_named(tmp_path: Path, task, message: str) -> None:
    (tmp_path / "hold.py").write_text(TASK.replace("REWARD", "1.0"))
    (tmp_path / "free.xml").write_text(FREE)
    study = pendulum(model="free.xml", task=task)
    with pytest.raises(UserError, match=message):
        learned(tmp_path, study)
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("reward", "message"),
    [
        ("1.0 - abs(float(physics.data.qpos[0]))", ""),
        ("float('nan')", "gave a reward of nan"),
        ("None", "gave no reward"),
    ],
)
def test_a_users_own_task(tmp_path: Path, reward: str, message: str) -> None:
    (tmp_path / "hold.py").write_text(TASK.replace("REWARD", reward))
    changed = {
        "task": {"file": "hold.py", "class": "Hold"},
        "policy": {"batch": 40, "steps": 40, "hidden": [4]},
        "learn": {"trajectories": 1, "episodes": 2},
    }
    study = Study.from_dict(pendulum(**changed), tmp_path, trust_code=True)
    if message:
        with pytest.raises(UserError, match=message):
            learn(study)
        return
    told = learn(study)
    assert told.policy is not None
    assert any("not vectorised" in note for note in told.notes)

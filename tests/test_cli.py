"""The command line: exit codes, one message for wrong input, nothing heavy before it is needed."""

import argparse
import importlib
import json
import re
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import jsonschema
import numpy as np
import pytest
import yaml

from bo_sysid import __version__
from bo_sysid.cli import VERBS, main
from bo_sysid.cli.common import arguments
from bo_sysid.errors import UserError, is_input_error
from bo_sysid.recording import Recording, read_recording
from bo_sysid.recording.writers import write_recording
from bo_sysid.runs import Run

MODEL = """
<mujoco>
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
recordings: {train: [log.csv]}
parameters:
  - {name: mass, address: "geom[rod].mass", low: 0.3, high: 0.8, steps: 21, unit: kg}
  - {name: damping, address: "joint[hinge].damping", low: 0, high: 0.1, steps: 5}
"""
LOG = "time,qpos.hinge,ctrl.motor\n" + "".join(
    f"{k * 0.01:.2f},{(k % 40) / 40:.4f},{k % 3}\n" for k in range(80)
)

Say = Callable[..., tuple[int, str, str]]


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    for name, content in (("pendulum.xml", MODEL), ("arm.yaml", STUDY), ("log.csv", LOG)):
        (tmp_path / name).write_text(content)
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def say(capsys: pytest.CaptureFixture[str]) -> Say:
    """Return a function that runs a command and returns exit code, stdout and stderr."""

    def run(*arguments: str) -> tuple[int, str, str]:
        code = main(arguments)
        out, err = capsys.readouterr()
        return code, out, err

    return run


def test_help_names_every_verb(say: Say) -> None:
    code, out, _ = say("--help")
    assert code == 0
    names = [verb.__name__.rsplit(".", 1)[1] for verb in VERBS]
    assert {"check", "identify", "diagnose", "record", "report", "demo"} < set(names)
    assert all(name in out for name in names)
    for name in names:
        code, out, _ = say(name, "--help")
        assert code == 0
        assert f"bo-sysid {name}" in out
    assert say("--version") == (0, f"bo-sysid {__version__}\n", "")


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["identfy", "arm.yaml"], r"invalid choice: 'identfy' \(choose from"),
        ([], "required: VERB"),
        (["check"], "required: STUDY"),
        (["check", "arm.yaml", "--sed", "x"], "unrecognized arguments"),
        (["check", "arm.yaml", "--seed", "x"], "argument --seed: invalid int value: 'x'"),
        (["check", "amr.yaml"], "amr.yaml: no such file; did you mean 'arm.yaml'"),
        (["check", "arm.yaml", "--set", "serach.budget=3"], "unknown key; did you mean 'search'"),
        (["check", "arm.yaml", "--set", "recordings={dataset: empz}"], "unknown dataset 'empz'; d"),
        (["check", "arm.yaml", "--set", "search.acquisition=grredy"], "acquisition 'grredy'; did"),
        (
            ["check", "arm.yaml", "--set", "diagnosis.exclude=[dry]"],
            "unknown effect .dry.; valid: ",
        ),
        (
            ["check", "arm.yaml", "--set", "parameters.0.address=geom[rd].mass"],
            "did you mean 'rod'",
        ),
        (["check", "arm.yaml", "--set", "model=pendulm.xml"], "did you mean 'pendulum.xml'"),
        (["check", "arm.yaml", "--set", "actuators={motr: {law: a.py:b}}"], "--trust-code"),
        (["check", "arm.yaml", "--set", "budget"], "must be key=value"),
        (["report", "nowhere"], "nowhere: not a run folder"),
        (["identify", "arm.yaml", "--threads", "0"], "--threads 0: at least 1"),
        (["record", "arm.yaml"], "plant: record needs this key"),
        (
            ["record", "arm.yaml", "--set", "parameters=[]", "--set", "plant={parameters: {m: 1}}"],
            "no parameter 'm'; the study has none \\(or an MJCF address\\)",
        ),
    ],
)
def test_wrong_input_gives_one_message(
    folder: Path, say: Say, arguments: list[str], expected: str
) -> None:
    code, out, err = say(*arguments)
    assert (code, out) == (2, "")
    assert err.startswith("bo-sysid: ")
    assert "Traceback" not in err
    assert re.search(expected, err)
    assert not list(folder.glob("runs/*"))


@pytest.mark.parametrize(
    ("log", "expected"),
    [
        (
            "time,qpos.hing,ctrl.motor\n0,0,0\n1,1,1\n2,3,0\n",
            r"'qpos.hing' is not in the model.*'q",
        ),
        ("time,qpos.hinge\n0,0\n1,1\n2,3\n", r"no channel 'ctrl.motor', which the model needs"),
        (
            "time,qpos.hinge,i_A\n0,0,0\n1,1,2\n2,3,1\n",
            r"no channel 'ctrl.motor', which the model needs; it has 'qpos.hinge'; "
            r"columns not used: i_A",
        ),
        ("time,qvel.hinge\n0,0\n1,1\n2,3\n", r"no channel 'qpos.hinge', which the model needs"),
        ("time,qpos.hinge\n0,0\n1,nan\n2,3\n", "qpos.hinge"),
        ("time,qpos.hinge\n0,0\n2,1\n1,3\n", "row"),
        ("qpos.hinge\n0\n2\n", "time"),
    ],
)
@pytest.mark.parametrize("verb", ["check", "identify"])
def test_wrong_recordings_give_one_message(
    folder: Path, say: Say, verb: str, log: str, expected: str
) -> None:
    (folder / "log.csv").write_text(log)
    code, out, err = say(verb, "arm.yaml")
    assert (code, out) == (2, "")
    assert "log.csv" in err or "log:" in err
    assert re.search(expected, err)
    assert not list(folder.glob("runs/*"))


def test_a_model_that_does_not_compile_gives_one_message(folder: Path, say: Say) -> None:
    (folder / "pendulum.xml").write_text(MODEL.replace('joint="hinge"', 'joint="hing"'))
    code, _, err = say("check", "arm.yaml")
    assert code == 2
    assert "pendulum.xml" in err
    assert "hing" in err


def test_a_file_that_cannot_be_read_gives_one_message(folder: Path, say: Say) -> None:
    (folder / "arm.yaml").unlink()
    (folder / "arm.yaml").mkdir()
    code, _, err = say("check", "arm.yaml")
    assert (code, err) == (2, "bo-sysid: arm.yaml: is a folder, not a study file\n")


@pytest.mark.parametrize(
    ("error", "code", "expected"),
    [
        (FileNotFoundError(2, "No such file", "x.csv"), 2, "x.csv: No such file\n"),
        (OSError(28, "No space left on device"), 1, "bo-sysid: No space left on device\n"),
        (PermissionError(13, "Permission denied", "new"), 1, "new: Permission denied\n"),
        (KeyboardInterrupt(), 130, "bo-sysid: interrupted\n"),  # a check begins anew
        (ZeroDivisionError("division by zero"), 1, "Traceback"),
    ],
)
def test_errors_have_exit_codes(
    folder: Path,
    say: Say,
    monkeypatch: pytest.MonkeyPatch,
    error: BaseException,
    code: int,
    expected: str,
) -> None:
    def fail(*_: object, **__: object) -> None:
        raise error

    monkeypatch.setattr("bo_sysid.checks.check.check", fail)
    found, _, err = say("check", "arm.yaml")
    assert found == code
    assert expected in err
    assert ("Traceback" in err) == isinstance(error, ZeroDivisionError)


def test_an_interrupt_in_a_compiled_module_that_is_being_imported_is_no_defect(
    folder: Path, say: Say, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object, **__: object) -> None:
        try:
            try:
                raise KeyboardInterrupt
            except KeyboardInterrupt as error:  # as pybind11 does, module by module
                raise ImportError("initialization failed") from error
        except ImportError as error:
            raise ImportError("initialization failed") from error

    monkeypatch.setattr("bo_sysid.cli.identify.identify_into", fail)
    code, _, err = say("identify", "arm.yaml", "--out", str(folder / "run"))
    assert (code, "Traceback" in err) == (130, False)
    assert err.endswith("bo-sysid: interrupted; run the same command again to resume\n")
    assert json.loads((folder / "run" / "run.json").read_text())["status"] == "interrupted"


def test_a_log_that_must_not_be_read_is_wrong_input_a_folder_to_write_to_is_not(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("os.access", lambda path, mode: Path(path).name != "log.csv")
    assert is_input_error(PermissionError(13, "Permission denied", str(folder / "log.csv")))
    assert not is_input_error(PermissionError(13, "Permission denied", str(folder / "runs")))
    assert not is_input_error(PermissionError(13, "Permission denied", str(folder / "arm.yaml")))
    assert not is_input_error(PermissionError(13, "Permission denied"))


def test_check_tells_what_fits_what(folder: Path, say: Say) -> None:
    code, out, err = say("check", "arm.yaml")
    assert (code, err) == (0, "")
    rows: dict[str, list[str]] = {}
    for line in filter(str.strip, out.splitlines()):
        rows.setdefault(line.split()[0], line.split())
    expected = ["in", "the", "model", "1", "of", "1", "60", "10", "0", "0.975"]
    assert rows["qpos.hinge"][1:11] == expected
    assert "estimated from qpos" in " ".join(rows["qvel.hinge"])
    assert rows["mass"] == ["mass", "kg", "geom[rod].mass", "set", "0.5", "0.3", "0.8", "21"]
    assert "B has 105 candidates." in out
    assert "set aside" in out
    assert not (folder / "runs").exists()


def test_check_renders_the_model_or_says_what_to_install(folder: Path, say: Say) -> None:
    code, out, _ = say("check", "arm.yaml", "--render", "--out", str(folder / "c"))
    assert code == 0
    drawn = (folder / "c" / "render.png").is_file()
    assert ("works with MUJOCO_GL=" in out) == drawn
    assert ("apt-get install libegl1" in out) != drawn


def test_check_keeps_every_picture_in_its_folder(folder: Path, say: Say) -> None:
    time = 0.01 * np.arange(80)
    arrays = {"qpos": {"hinge": np.sin(time)}, "ctrl": {"motor": np.cos(9 * time)}}
    log = Recording.from_arrays(time, name=str(folder / "ESCAPED"), **arrays)
    write_recording(log, folder / "sneaky.parquet")
    for place in ("a", "b"):
        (folder / place).mkdir()
        (folder / place / "log.csv").write_text(LOG)
    logs = "recordings.train=[sneaky.parquet, a/log.csv, b/log.csv]"
    code, _, _ = say("check", "arm.yaml", "--set", logs, "--out", "c")
    assert code == 0
    assert not list(folder.glob("*.png"))
    drawn = {p.name for p in (folder / "c").glob("*.png")}
    assert {"a-log.png", "b-log.png"} < drawn
    (other,) = drawn - {"a-log.png", "b-log.png"}
    assert other.endswith("-ESCAPED.png")


def test_check_names_pictures_of_logs_with_long_names(folder: Path, say: Say) -> None:
    long = "ა" * 80  # of three bytes each
    for name in (f"{long}a.csv", f"{long}b.csv"):
        (folder / name).write_text(LOG)
    code, _, err = say("check", "arm.yaml", "--set", f"recordings.train=['{long}*']", "--out", "c")
    assert (code, err) == (0, "")
    assert sorted(len(p.stem.rstrip("-2")) for p in (folder / "c").glob("*.png")) == [53, 53]


def test_check_refuses_messy_recordings_when_strict(folder: Path, say: Say) -> None:
    rows = LOG.splitlines()
    (folder / "log.csv").write_text("\n".join(rows[:20] + rows[30:]) + "\n")
    assert say("check", "arm.yaml")[0] == 0
    code, _, err = say("check", "arm.yaml", "--strict")
    assert code == 2
    assert "gap" in err


STRICT = {"check", "identify", "diagnose", "learn", "compare"}


@pytest.mark.parametrize("verb", sorted(STRICT | {"record", "excite"}))
def test_strict_is_an_option_of_verbs_that_read_recordings(verb: str, say: Say) -> None:
    assert ("--strict" in say(verb, "--help")[1]) == (verb in STRICT)


@pytest.mark.parametrize(
    ("verb", "called"), [("check", "checks.check.check"), ("excite", "excite.excite.excite")]
)
def test_threads_are_those_of_the_option(
    folder: Path, say: Say, monkeypatch: pytest.MonkeyPatch, verb: str, called: str
) -> None:
    from bo_sysid.execution import threads

    def count(*_: object, **__: object) -> None:
        raise UserError(f"{threads()} threads")

    monkeypatch.setenv("BO_SYSID_THREADS", "2")
    monkeypatch.setattr(f"bo_sysid.{called}", count)
    assert say(verb, "arm.yaml", "--threads", "3")[2] == "bo-sysid: 3 threads\n"
    assert say(verb, "arm.yaml")[2] == "bo-sysid: 2 threads\n"


def test_excite_refuses_a_folder_that_is_a_file_before_its_search(
    folder: Path, say: Say, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("bo_sysid.excite.excite.excite", None)  # never called
    code, _, err = say("excite", "arm.yaml", "--out", "log.csv")
    assert (code, err) == (2, "bo-sysid: log.csv: File exists\n")


def test_options_change_the_study(folder: Path, say: Say) -> None:
    code, out, _ = say("check", "arm.yaml", "--set", "search.candidates={sobol: 77}", "--seed", "3")
    assert code == 0
    assert "B has 77 candidates." in out


def test_report_says_how_far_an_unfinished_run_came(folder: Path, say: Say) -> None:
    import pandas as pd

    with Run.open(folder / "run", {}, "identify") as run:
        assert "Nothing was computed yet." in say("report", "run")[1]
        run.write_frame("evaluations.parquet", pd.DataFrame({"deviation": [0.5, 0.25]}))
        code, out, _ = say("report", "run")
    assert code == 0
    assert (
        "2 evaluations so far, lowest deviation 0.25. Run the same command again to resume." in out
    )
    (folder / "run" / "evaluations.parquet").write_text("no")
    with Run.open(folder / "run2", {}, "diagnose"):
        (folder / "run2" / "fits").mkdir()
        (folder / "run2" / "fits" / "0a.npz").touch()
        (folder / "run2" / "fits" / "made_from.json").touch()
        said = say("report", "run2")[1]
        answer = {"findings": [{"sentence": "The elbow has dry friction of 0.1 N m."}]}
        (folder / "run2" / "answer.json").write_text(json.dumps(answer))
        frozen = say("report", "run2")[1]
    assert "Nothing is decided yet; fits so far: 1. Run the same command again to resume." in said
    assert "The elbow has dry friction of 0.1 N m.\nThe unseen recordings were not" in frozen
    with Run.open(folder / "run4", {}, "learn") as run:
        run.write_frame("trajectories/01.parquet", pd.DataFrame({"time": [0.0]}))
        run.write_json("iterations/01/identified.json", {})
        said = say("report", "run4")[1]
    assert "learn, running\n" in said
    assert (
        "Real trajectories so far: 1 (trajectories/*.parquet). The model is identified "
        "(iterations/*/belief.parquet). No policy was learned yet. "
        "Run the same command again to resume." in said
    )
    record = (folder / "run4" / "run.json").read_text().replace("finished", "running")
    (folder / "run4" / "run.json").write_text(record)  # as a process that was killed leaves it
    assert "learn, interrupted\n" in say("report", "run4")[1]
    with Run.open(folder / "run3", {}, "compare"):
        (folder / "run3" / "records" / "small" / "greedy").mkdir(parents=True)
        for name in ("000.json", "001.json", "plan.json"):
            (folder / "run3" / "records" / "small" / "greedy" / name).touch()
        assert (
            "Runs of arms so far: 2. Run the same command again to resume."
            in say("report", "run3")[1]
        )
    code, _, err = say("report", "run")
    assert code == 2
    assert "evaluations.parquet: damaged" in err
    with Run.open(folder / "run", {}, "identify") as run:
        run.write_frame("evaluations.parquet", pd.DataFrame({"entropy": [0.5]}))
    code, _, err = say("report", "run")
    assert code == 2
    assert "evaluations.parquet: damaged, without 'deviation'" in err


@pytest.mark.parametrize("name", ["identification", "learning", "comparison", "diagnosis"])
def test_report_names_an_answer_that_is_damaged_and_shows_the_rest(
    folder: Path, say: Say, name: str
) -> None:
    with Run.open(folder / "run", {}, "identify") as run:
        run.write_json(f"{name}.json", {"name": "arm"})
    code, out, err = say("report", "run")
    assert code == 2
    assert re.search(rf"{name}\.json: damaged|(iterations|summary)\.parquet: missing", err)
    assert "Traceback" not in err
    assert out == f"Page: {Path('run') / 'report.html'}\n"
    assert say("report", "run", "--text")[:2] == (2, "")


@pytest.mark.parametrize("port", ["-5", "65536", "99999"])
def test_report_refuses_what_is_no_port(folder: Path, say: Say, port: str) -> None:
    Run.open(folder / "run", {}, "identify").close("finished")
    code, out, err = say("report", "run", "--serve", "--port", port)
    assert (code, out) == (2, "")
    assert f"--port {port}: must be from 0 (any that is free) to 65535" in err


def test_report_names_a_port_that_is_taken(folder: Path, say: Say) -> None:
    Run.open(folder / "run", {}, "identify").close("finished")
    with socket.create_server(("127.0.0.1", 0)) as other:
        port = other.getsockname()[1]
        code, _, err = say("report", "run", "--serve", "--port", str(port))
    assert code == 2
    assert f"--port {port}: Address already in use; name another one" in err


def test_schema_is_one_that_takes_the_study(say: Say) -> None:
    code, out, _ = say("schema")
    assert code == 0
    schema = json.loads(out)
    jsonschema.validate(yaml.safe_load(STUDY), schema)
    assert "emps" in schema["$defs"]["Recordings"]["properties"]["dataset"]["anyOf"][0]["enum"]


def test_record_makes_recordings_and_a_study_on_them(folder: Path, say: Say) -> None:
    plant = "plant={parameters: {mass: 0.613}, record: {train: 2, holdout: 1, seconds: 0.5}}"
    code, out, _ = say("record", "arm.yaml", "--set", plant, "--out", "made")
    assert code == 0
    assert "bo-sysid identify made/arm.yaml" in out
    made = {p.name for p in (folder / "made").glob("*.parquet")}
    assert made == {"train-0.parquet", "train-1.parquet", "holdout-0.parquet"}
    code, out, _ = say("check", "made/arm.yaml")
    assert code == 0
    assert "2 training recordings" in out
    before = (folder / "made" / "train-1.parquet").read_bytes()
    assert say("record", "arm.yaml", "--set", plant, "--out", "made")[0] == 0
    assert (folder / "made" / "train-1.parquet").read_bytes() == before


def test_record_refused_for_want_of_a_range_begins_anew_with_one(folder: Path, say: Say) -> None:
    (folder / "pendulum.xml").write_text(MODEL.replace(' ctrlrange="-1 1"', ""))
    plant = ("--set", "plant={record: {train: 1, holdout: 1, seconds: 0.5}}", "--out", "made")
    code, _, err = say("record", "arm.yaml", *plant)
    assert code == 2
    assert "arm.yaml, line 2: model: actuator 'motor' has no control range; give it a" in err
    assert say("record", "arm.yaml", *plant, "--set", "limits={hinge: {effort: 1}}")[0] == 0
    assert read_recording("made/train-0.parquet").to_frame()["ctrl.motor"].abs().max() <= 1.0


def test_record_refused_once_its_plant_was_told_begins_anew(folder: Path, say: Say) -> None:
    plant = "plant={record: {train: 1, holdout: 1, seconds: SECONDS}}"
    for seconds, expected in (("0.001", 2), ("0.5", 0)):
        made = plant.replace("SECONDS", seconds)
        assert say("record", "arm.yaml", "--set", made, "--out", "made")[0] == expected


def test_record_says_what_broke_off(folder: Path, say: Say) -> None:
    (folder / "pole.yaml").write_text(
        "model: {dm_control: {domain: cartpole, task: swingup}}\n"
        "recordings: {train: [none.parquet]}\n"
        "plant: {record: {train: 1, holdout: 1, seconds: 2}}\n"
    )
    narrow = ("--set", "limits={slider: {position: [-0.1, 0.1]}}")
    for _ in range(2):  # what was recorded before is said again
        code, out, _ = say("record", "pole.yaml", *narrow, "--out", "made")
        assert code == 0
        assert re.search(r"train-0 breaks off after 0\.\d+ s: the task ended, or the machine", out)
    assert "breaks off" not in say("record", "pole.yaml", "--out", "whole")[1]


def test_record_of_a_study_called_study_keeps_both_and_goes_on(folder: Path, say: Say) -> None:
    plant = "plant={parameters: {mass: 0.613}, record: {train: 1, holdout: 1, seconds: 0.5}}"
    (folder / "study.yaml").write_text(STUDY)
    for _ in range(2):
        code, out, err = say("record", "study.yaml", "--set", plant, "--out", "made")
        assert (code, err.count("Traceback")) == (0, 0)
    assert "bo-sysid identify made/study_recorded.yaml" in out
    kept = {n: yaml.safe_load((folder / "made" / n).read_text())["recordings"]["train"]
            for n in ("study.yaml", "study_recorded.yaml")}  # fmt: skip
    assert kept == {"study.yaml": ["../log.csv"], "study_recorded.yaml": ["train-*.parquet"]}
    code, out, _ = say("check", "made/study_recorded.yaml")
    assert code == 0
    code, _, err = say("record", "study.yaml", "--set", plant, "--out", ".")
    assert code == 2
    assert "use another --out" in err
    assert (folder / "study.yaml").read_text() == STUDY


QUICK = """
import sys, time
from bo_sysid.cli import main
code = main(sys.argv[1:])
heavy = {"torch", "botorch", "gpytorch", "dm_control", "matplotlib", "numpy"} & set(sys.modules)
print(time.process_time(), code, *sorted(heavy), file=sys.stderr)
"""
LIBRARIES = """
import sys, time
import mujoco, numpy, pandas, pydantic, scipy.stats, yaml
print(time.process_time(), file=sys.stderr)
"""


def _last_words(program: str, *arguments: str) -> list[str]:
    """Return the last line that a program of its own writes to stderr, split."""
    command = [sys.executable, "-c", program, *arguments]
    done = subprocess.run(command, capture_output=True, text=True, check=True)  # noqa: S603
    return done.stderr.splitlines()[-1].split()


def test_a_process_that_is_terminated_says_what_goes_on(folder: Path) -> None:
    command = [sys.executable, "-m", "bo_sysid", "identify", "arm.yaml", "--out", "run"]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process:  # noqa: S603
        while process.poll() is None and not (folder / "run" / "run.json").is_file():
            time.sleep(0.01)
        process.send_signal(signal.SIGTERM)
        _, err = process.communicate()
    assert process.returncode == 130
    assert err.endswith("bo-sysid: interrupted; run the same command again to resume\n")
    assert json.loads((folder / "run" / "run.json").read_text())["status"] == "interrupted"


@pytest.mark.parametrize(
    ("arguments", "code", "loaded", "times"),
    [
        (["--help"], 0, set(), 0.6),
        (["identify", "--help"], 0, set(), 0.6),
        (["identify", "arm.yaml", "--set", "search.budgett=3"], 2, set(), 1.0),
        (["identify", "arm.yaml", "--set", "recordings.train=nothing.csv"], 2, {"numpy"}, 4.0),
        (["check", "arm.yaml"], 0, {"numpy"}, 4.0),
        (["schema"], 0, {"numpy"}, 4.0),
    ],
)
def test_answers_at_once_without_torch(
    folder: Path, arguments: list[str], code: int, loaded: set[str], times: float
) -> None:
    # CPU time, against that of importing the libraries without torch, on this machine and now:
    # .8 s on a quiet one, where help takes .1 s
    taken, *said = _last_words(QUICK, *arguments)
    assert said == [str(code), *sorted(loaded)]
    assert float(taken) < times * float(_last_words(LIBRARIES)[0])


def test_an_actuator_with_a_bias_alone_needs_no_control(folder: Path, say: Say) -> None:
    bias = '<general name="offset" joint="hinge" gainprm="0" biastype="affine" biasprm="1"/>'
    (folder / "pendulum.xml").write_text(MODEL.replace("</actuator>", f"{bias}</actuator>"))
    code, out, _ = say("check", "arm.yaml")
    assert code == 0
    assert re.search(r"ctrl.offset +without effect +0 of 1", out)


def test_figures_are_drawn_before_a_run_counts_as_finished(
    folder: Path, say: Say, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(run: Run) -> None:
        raise UserError("no figure")

    for verb, figures in (("learn", "learning"), ("compare", "comparison")):
        module = importlib.import_module(f"bo_sysid.{verb}.{verb}")  # not the function of its name
        monkeypatch.setattr(module, verb, lambda study, run, **_: run.write_text("a", "b"))
        monkeypatch.setattr(f"bo_sysid.report.{figures}.write_{figures}_figures", fail)
        assert say(verb, "arm.yaml", "--out", verb)[0] == 2
        assert json.loads((folder / verb / "run.json").read_text())["status"] == "failed"


def test_a_run_tells_the_command_that_made_it(
    folder: Path, say: Say, monkeypatch: pytest.MonkeyPatch
) -> None:
    from bo_sysid.report.parts import Found
    from bo_sysid.report.provenance import again

    module = importlib.import_module("bo_sysid.learn.learn")
    monkeypatch.setattr(module, "learn", lambda study, run, **_: None)
    monkeypatch.setattr("bo_sysid.report.learning.write_learning_figures", lambda run: None)
    monkeypatch.setattr("bo_sysid.report.text.run_text", lambda folder: "")
    (folder / "my arm.yaml").write_text(STUDY)
    for out in (["--out", "run"], ["--ou=run"]):
        assert say("learn", "my arm.yaml", *out, "--strict", "--set", "search.budget=20")[0] == 0
        section = again(Found(folder / "run"))
        told = dict(section.code)["Command"]
        assert told == "bo-sysid learn 'my arm.yaml' --strict --set search.budget=20"


def test_an_interrupted_record_goes_on_as_if_it_had_not_been(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from bo_sysid.execution import Progress
    from bo_sysid.plants.recorded import record_into
    from bo_sysid.study import Study

    plant = {"noise": {"qpos": 0.01}, "record": {"train": 2, "holdout": 1, "seconds": 0.5}}
    names = ("train-0", "train-1", "holdout-0")

    def made(out: str, stop: int = -1) -> list[str]:
        study = Study.load("arm.yaml", {"plant": plant})
        told: list[str] = []

        def watch(progress: Progress) -> None:
            told.append(progress.message)
            if progress.step == stop:
                raise KeyboardInterrupt

        with Run.open(folder / out, study.resolved(folder / out), "record") as run:
            record_into(run, study, "arm", watch)
        return told

    assert made("whole") == list(names)
    with pytest.raises(KeyboardInterrupt):
        made("cut", stop=1)
    assert made("cut") == list(names[1:])
    for name in names:
        whole, cut = ((folder / o / f"{name}.parquet").read_bytes() for o in ("whole", "cut"))
        assert whole == cut
    (folder / "pendulum.xml").write_text(MODEL.replace("0.05", "0.2"))
    assert made("cut") == list(names)  # of another model now


def test_a_grid_that_is_too_large_is_for_identify_alone_to_refuse(folder: Path, say: Say) -> None:
    """A diagnosis searches no grid, and its study can be checked."""
    large = ("--set", "parameters.0.steps=300001")
    code, out, _ = say("check", "arm.yaml", *large)
    assert code == 0
    assert "For identify a grid of" in out
    code, _, err = say("identify", "arm.yaml", *large)
    assert code == 2
    assert "search.candidates: a grid of" in err
    assert "{candidates: {sobol: 20000}}" in err


@pytest.mark.parametrize("out", [["--out", "there"], ["--out=there"], ["--out="], ["--ou=there"]])
def test_the_command_that_a_run_keeps_is_all_but_where_it_writes_to(out: list[str]) -> None:
    given = argparse.Namespace(given=["identify", "arm.yaml", *out, "--seed", "3"])
    assert arguments(given) == ["identify", "arm.yaml", "--seed", "3"]

"""Run folders: files are whole or absent, one process writes, the same command goes on."""

import hashlib
import json
import os
import shutil
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from importlib import metadata
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import yaml

from bo_sysid.errors import RunError, StudyError, UserError
from bo_sysid.runs import (
    FORMAT,
    Run,
    atomic,
    canonical,
    digest,
    held,
    plain,
    read_frame,
    read_json,
    read_record,
)
from bo_sysid.runs.lock import locked

STUDY = {"name": "arm", "search": {"budget": 60, "seed": 0}}


def opened(folder: Path, study: dict[str, object] = STUDY, command: str = "identify") -> Run:
    return Run.open(folder, study, command, seed=3)


@pytest.fixture
def run(tmp_path: Path) -> Iterator[Run]:
    with opened(tmp_path / "arm-identify") as run:
        yield run


def write_and_raise(path: Path, error: BaseException) -> None:
    path.write_text("half")
    raise error


def names(folder: Path) -> set[str]:
    return {p.name for p in folder.iterdir()} - {".lock"}


def test_says_what_made_it(tmp_path: Path) -> None:
    with opened(tmp_path / "run") as run:
        assert read_record(run.folder)["status"] == "running"
    record = read_record(tmp_path / "run")
    assert record["command"] == "identify"
    assert record["status"] == "finished"
    assert record["seed"] == 3
    text = b'{"name":"arm","search":{"budget":60,"seed":0}}'
    assert record["study_sha256"] == hashlib.sha256(text).hexdigest()
    (session,) = record["sessions"]
    assert session["versions"]["numpy"] == np.__version__
    assert session["started"] <= session["ended"]
    assert yaml.safe_load((tmp_path / "run" / "study.yaml").read_text()) == STUDY


def test_what_is_written_is_read(run: Run) -> None:
    frame = pd.DataFrame({"row": [3, 1], "deviation": [0.5, np.nan]})
    run.write_frame("evaluations.parquet", frame)
    pd.testing.assert_frame_equal(run.read_frame("evaluations.parquet"), frame)
    value = {"b": np.arange(2), "a": {"x": np.float64(1.5), "y": (True, None, "é")}}
    run.write_json("answer.json", value)
    assert run.read_json("answer.json") == {"b": [0, 1], "a": {"x": 1.5, "y": [True, None, "é"]}}
    assert list(run.read_json("answer.json")) == ["b", "a"]
    run.write_text("figures/note.txt", "ü")
    assert run.path("figures/note.txt").read_text(encoding="utf-8") == "ü"
    assert run.has("figures/note.txt")
    assert not run.has("figures/other.txt")


@pytest.mark.parametrize("number", [np.nan, float("inf"), np.array([1.0, np.nan])])
def test_json_takes_only_finite_numbers(run: Run, number: object) -> None:
    with pytest.raises(ValueError, match=r"answer.json\.holdout\.forecast.* is (nan|inf)"):
        run.write_json("answer.json", {"holdout": {"forecast": number}})
    assert not run.has("answer.json")


def test_equal_values_have_one_canonical_json() -> None:
    value = {"b": np.arange(2), "a": (np.float64(0.1), None, "é"), 3: True}
    same = {"3": True, "a": [0.1, None, "é"], "b": [0, 1]}
    assert canonical(value) == b'{"3":true,"a":[0.1,null,"\\u00e9"],"b":[0,1]}'
    assert digest(value) == digest(same) == hashlib.sha256(canonical(same)).hexdigest()
    assert digest({**same, "b": [1, 0]}) != digest(same)
    with pytest.raises(ValueError, match=r"value\.a\.1 is inf"):
        digest({"a": [1.0, float("inf")]})


def test_nothing_leaves_the_folder(run: Run) -> None:
    for name in ("../other.json", str(run.folder.parent / "other.json")):
        with pytest.raises(RunError, match="leads out of the run folder"):
            run.write_text(name, "x")


def test_a_failed_write_leaves_the_old_file(run: Run) -> None:
    run.write_text("model.xml", "old")
    with pytest.raises(RuntimeError), run.writing("model.xml") as path:
        write_and_raise(path, RuntimeError())
    assert run.path("model.xml").read_text() == "old"
    assert names(run.folder) == {"model.xml", "run.json", "study.yaml"}


def test_an_error_of_the_disk_names_the_file_that_was_to_be(tmp_path: Path) -> None:
    def failing(name: str, error: OSError) -> str:
        try:
            with atomic(tmp_path / name) as place:
                write_and_raise(place, error)
        except OSError as told:
            return str(told.filename)
        return "nothing failed"

    full, missing = OSError(28, "No space left"), OSError(2, "No such file", "other.csv")
    assert failing("figure.png", full) == str(tmp_path / "figure.png")
    assert failing("figure.png", missing) == "other.csv"
    assert failing("n" * 250, full) == str(tmp_path / ("n" * 250))  # the temporary one is too long


def test_the_ending_is_kept_while_writing(tmp_path: Path) -> None:
    with atomic(tmp_path / "figure.png") as path:
        assert path.suffix == ".png"
        path.write_bytes(b"png")
    assert [p.name for p in tmp_path.iterdir()] == ["figure.png"]


def test_the_same_command_goes_on(tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt), opened(tmp_path / "run") as run:
        write_and_raise(run.path("evaluations.txt"), KeyboardInterrupt())
    assert read_record(tmp_path / "run")["status"] == "interrupted"
    with opened(tmp_path / "run") as run:
        assert run.has("evaluations.txt")
    record = read_record(tmp_path / "run")
    assert record["status"] == "finished"
    assert len(record["sessions"]) == 2


def test_a_refusal_leaves_a_finished_run_finished(tmp_path: Path) -> None:
    with opened(tmp_path / "run") as run:
        run.write_text("evaluations.txt", "1")
    with pytest.raises(RunError), opened(tmp_path / "run"):
        raise RunError("the recordings changed")
    assert read_record(tmp_path / "run")["status"] == "finished"
    with pytest.raises(RunError), opened(tmp_path / "run") as run:
        write_and_raise(run.write_text("evaluations.txt", "2"), RunError("half of it is new"))
    assert read_record(tmp_path / "run")["status"] == "failed"


def test_another_study_is_refused_with_what_differs(tmp_path: Path) -> None:
    opened(tmp_path / "run").close("finished")
    other = {"name": "arm", "search": {"budget": 20, "seed": 0}}
    with pytest.raises(
        RunError, match=r"(?s)another study; use another --out.*budget: 60 there, 2"
    ):
        opened(tmp_path / "run", other)
    with pytest.raises(RunError, match="holds a run of identify, not diagnose; use another --out"):
        opened(tmp_path / "run", command="diagnose")
    opened(tmp_path / "run").close("finished")


def test_what_differs_in_a_list_is_named_by_its_key(tmp_path: Path) -> None:
    study = {"name": "arm", "parameters": [{"low": 0, "high": 4}, {"low": 1, "high": 2}]}
    opened(tmp_path / "run", study).close("finished")
    other = {"name": "arm", "parameters": [{"low": 0, "high": 4}, {"low": 1, "high": 3}]}
    with pytest.raises(RunError, match=r"It differs in\n  parameters.1.high: 2 there, 3 now$"):
        opened(tmp_path / "run", other)


def test_a_file_is_no_run_folder(tmp_path: Path) -> None:
    (tmp_path / "run").write_text("x")
    with pytest.raises(RunError, match="run: a file; --out names the folder of a run"):
        opened(tmp_path / "run")


def test_whether_a_process_writes_to_a_run_is_told(tmp_path: Path) -> None:
    assert not held(tmp_path)
    assert names(tmp_path) == set() == {p.name for p in tmp_path.iterdir()}  # asking makes no lock
    with opened(tmp_path / "run") as run:
        assert held(run.folder)
    assert not held(tmp_path / "run")


def test_what_says_how_much_is_computed_may_be_raised(tmp_path: Path) -> None:
    opened(tmp_path / "run").close("finished")
    more = {"name": "arm", "search": {"budget": 70, "seed": 0}}
    with Run.open(tmp_path / "run", more, "identify", raised=["search.budget", "a.b"]) as run:
        assert run.record["study_sha256"] == digest(more)
    with opened(tmp_path / "run", more):
        assert yaml.safe_load((tmp_path / "run" / "study.yaml").read_text()) == more
    with pytest.raises(RunError, match="budget: 70 there, 60 now"):
        Run.open(tmp_path / "run", STUDY, "identify", raised=["search.budget"])
    other = {"name": "leg", "search": {"budget": 80, "seed": 0}}
    with pytest.raises(RunError, match=r"It differs in\n  name: \"arm\" there, \"leg\" now$"):
        Run.open(tmp_path / "run", other, "identify", raised=["search.budget"])


def test_a_folder_that_is_no_run_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").write_text("x")
    with pytest.raises(RunError, match="not a run folder"):
        opened(tmp_path)
    assert names(tmp_path) == {"thesis.tex"}


def test_a_study_of_the_user_is_not_replaced(tmp_path: Path) -> None:
    (tmp_path / "study.yaml").write_text("name: mine  # with remarks\n")
    with pytest.raises(RunError, match=r"no run.json\) and not empty \(it holds study.yaml\); use"):
        opened(tmp_path)
    assert (tmp_path / "study.yaml").read_text() == "name: mine  # with remarks\n"
    assert names(tmp_path) == {"study.yaml"}


def test_a_run_that_was_killed_before_its_record_goes_on(tmp_path: Path) -> None:
    opened(tmp_path / "run").close("finished")
    (tmp_path / "run" / "run.json").unlink()
    opened(tmp_path / "run").close("finished")
    assert read_record(tmp_path / "run")["status"] == "finished"


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        ("{", "run.json: damaged, not JSON"),
        ("{}", "run.json: damaged"),
        (f'{{"format": {FORMAT}, "command": "identify", "status": ""}}', "run.json: damaged"),
        ('{"format": 99, "command": "identify", "status": ""}', f"format 99, .* reads {FORMAT}"),
    ],
)
def test_a_damaged_record_is_reported(tmp_path: Path, content: str, expected: str) -> None:
    opened(tmp_path / "run").close("finished")
    (tmp_path / "run" / "run.json").write_text(content)
    with pytest.raises(RunError, match=expected):
        opened(tmp_path / "run")
    with pytest.raises(RunError, match=expected):
        read_record(tmp_path / "run")


def test_damaged_and_missing_files_are_reported(run: Run) -> None:
    run.write_text("belief.parquet", "no")
    with pytest.raises(RunError, match=r"belief.parquet: damaged, not Parquet"):
        read_frame(run.folder, "belief.parquet")
    with pytest.raises(RunError, match=r"other.json: missing; the run is unfinished or damaged"):
        read_json(run.folder, "other.json")


def test_wrong_input_leaves_no_folder(tmp_path: Path) -> None:
    with pytest.raises(StudyError), opened(tmp_path / "run"):
        raise StudyError("wrong")
    assert not (tmp_path / "run").exists()
    with pytest.raises(StudyError), opened(tmp_path / "run") as run:
        write_and_raise(run.path("inputs.json"), StudyError("wrong"))  # of what it would be made
    assert not (tmp_path / "run").exists()
    with pytest.raises(StudyError), opened(tmp_path / "run") as run:
        write_and_raise(run.path("evaluations.txt"), StudyError("wrong"))
    assert read_record(tmp_path / "run")["status"] == "failed"


def test_plain_gives_types_of_json() -> None:
    assert json.dumps(plain({1: np.int64(2), "x": np.bool_(True)})) == '{"1": 2, "x": true}'


WRITER = """
import sys, time
from bo_sysid.runs import Run
run = Run.open(sys.argv[1], {"name": "arm"}, "identify")
k = 0
while True:
    run.write_json("state.json", {"k": [k] * 20_000})
    if k == 0:
        print("writing", flush=True)
    k += 1
"""


def test_a_killed_process_leaves_whole_files_and_no_lock(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    command = [sys.executable, "-c", WRITER, str(folder)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)  # noqa: S603
    try:
        assert process.stdout is not None
        assert process.stdout.readline() == "writing\n"
        with pytest.raises(RunError, match=rf"process {process.pid} on .* is writing to this run"):
            opened(folder, {"name": "arm"})
    finally:
        os.kill(process.pid, signal.SIGKILL)
        process.communicate()
    with opened(folder, {"name": "arm"}) as run:
        assert len(set(run.read_json("state.json")["k"])) == 1
        assert names(folder) == {"run.json", "study.yaml", "state.json"}
        assert len(run.record["sessions"]) == 2


def test_two_writers_of_one_file_write_apart(tmp_path: Path) -> None:
    path = tmp_path / "answer.json"
    with atomic(path) as mine:  # as two machines that share a folder, with one process number
        mine.write_text("mine")
        with atomic(path) as other:
            other.write_text("other")
        assert path.read_text() == "other"
    assert path.read_text() == "mine"
    assert names(tmp_path) == {"answer.json"}


def test_what_a_killed_process_was_writing_is_removed(tmp_path: Path) -> None:
    with opened(tmp_path / "run") as run:
        (run.folder / ".tmp-1-answer.json").write_text("half")
        (run.folder / ".tmp-1-folder").mkdir()
    with opened(tmp_path / "run") as run:
        assert not (run.folder / ".tmp-1-answer.json").exists()


@pytest.mark.parametrize("content", [b"a: [1\nb: {", b"\xff\xfe\x00"])
def test_a_damaged_study_of_a_run_is_named(tmp_path: Path, content: bytes) -> None:
    """As of somebody who edited it there."""
    with Run.open(tmp_path / "run", {"name": "arm"}, "identify"):
        pass
    (tmp_path / "run" / "study.yaml").write_bytes(content)
    with pytest.raises(RunError, match=r"study\.yaml: damaged, not YAML"):
        Run.open(tmp_path / "run", {"name": "arm"}, "identify")


def test_numbers_of_other_packages_are_not_mixed(tmp_path: Path, monkeypatch) -> None:
    with opened(tmp_path / "run") as run:
        run.require_same_packages()
    monkeypatch.setattr(metadata, "version", lambda name: "0.0.1" if name == "mujoco" else "9")
    with opened(tmp_path / "run") as run, pytest.raises(RunError, match=r"mujoco .*here 0.0.1"):
        run.require_same_packages()


def test_a_look_at_whether_a_run_is_written_to_keeps_nobody_from_it(tmp_path: Path) -> None:
    """Who looks takes the lock for a moment."""
    locked(tmp_path).close()
    looking = locked(tmp_path)
    end = threading.Timer(0.06, looking.close)
    end.start()
    locked(tmp_path).close()
    end.join()
    writing = locked(tmp_path)
    with pytest.raises(RunError, match="is writing to this run"):
        locked(tmp_path)
    writing.close()


def test_a_bare_folder_is_removed_by_the_one_that_holds_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Another process may begin in it as soon as it is let go."""
    seen, remove = [], shutil.rmtree

    def removing(folder: Path) -> None:
        seen.append(held(folder))
        remove(folder)

    monkeypatch.setattr("bo_sysid.runs.run.shutil.rmtree", removing)
    with pytest.raises(UserError), Run.open(tmp_path / "run", {}, "identify"):
        raise UserError("a wrong study")
    assert seen == [True]
    assert not (tmp_path / "run").exists()

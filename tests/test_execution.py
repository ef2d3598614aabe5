"""Threads and processes: results are the same wherever they run, failures stay with their job."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import Mock

import numpy as np
import pytest
from threadpoolctl import threadpool_info

from bo_sysid.errors import StudyError
from bo_sysid.execution import LocalEngine, cores, limit_threads, map_jobs, threads, use_threads
from bo_sysid.execution.cluster import job_outcome
from bo_sysid.execution.jobs import JobOutcome


def square(x: float) -> float:
    if x < 0:
        raise ValueError("negative")
    return x * x


def blas_threads(_: object) -> int:
    np.linalg.inv(np.eye(3))
    return max(int(p["num_threads"]) for p in threadpool_info())


def die_at_three(x: int) -> int:
    if x == 3:
        os.kill(os.getpid(), signal.SIGKILL)
    return x


def wrong_study(_: object) -> None:
    raise StudyError("the study is wrong")


def read(path: str) -> str:
    return Path(path).read_text()


def unsendable(_: object) -> object:
    return lambda: None


def sleep(path: str) -> None:
    if path:
        Path(path).write_text(str(os.getpid()))
        time.sleep(60)


def test_every_job_comes_back_once() -> None:
    jobs = {f"job {k}": float(k) for k in range(9)}
    outcomes = list(map_jobs(square, jobs, engine=LocalEngine(2)))
    assert {o.key: o.result for o in outcomes} == {k: x * x for k, x in jobs.items()}
    assert len(outcomes) == 9


def test_jobs_that_are_done_are_not_run_again() -> None:
    jobs = {"a": 1.0, "b": 2.0}
    outcomes = list(map_jobs(square, jobs, engine=LocalEngine(2), done={"a"}))
    assert [(o.key, o.result) for o in outcomes] == [("b", 4.0)]
    assert list(map_jobs(square, jobs, engine=LocalEngine(2), done={"a", "b"})) == []


def test_a_failing_job_is_reported_and_the_others_go_on() -> None:
    outcomes = {o.key: o for o in LocalEngine(1).run(square, {"a": 2.0, "b": -1.0, "c": 3.0})}
    assert outcomes["a"].result == 4
    assert outcomes["c"].result == 9
    assert "ValueError: negative" in str(outcomes["b"].error)
    assert not outcomes["b"].wrong_input
    (outcome,) = LocalEngine(1).run(wrong_study, {"a": None})
    assert (outcome.error, outcome.wrong_input) == ("the study is wrong", True)
    (outcome,) = LocalEngine(1).run(read, {"a": "nothing.csv"})
    assert (outcome.error, outcome.wrong_input) == ("nothing.csv: No such file or directory", True)


def test_a_process_that_dies_takes_only_its_job_along() -> None:
    outcomes = {o.key: o for o in LocalEngine(2).run(die_at_three, {str(k): k for k in range(7)})}
    assert [outcomes[str(k)].result for k in range(7)] == [0, 1, 2, None, 4, 5, 6]
    assert outcomes["3"].error == "its process ended with code -9"
    assert not outcomes["3"].wrong_input


def test_a_result_that_cannot_be_sent_is_an_error() -> None:
    first, second = LocalEngine(1).run(unsendable, {"a": None, "b": None})
    assert "pickle" in str(first.error).lower()
    assert "pickle" in str(second.error).lower()


class UnreadableError(Exception):
    """One that is sent, and cannot be made again from what was sent."""

    def __init__(self, one: str, two: str) -> None:
        super().__init__(one)


def unreadable(job: str) -> object:
    return UnreadableError(job, job) if job == "b" else job


def test_a_result_that_cannot_be_read_is_an_error_and_the_others_go_on() -> None:
    done = {o.key: o for o in map_jobs(unreadable, {k: k for k in "abc"}, engine=LocalEngine(1))}
    assert [done[k].result for k in "ac"] == ["a", "c"]
    assert "missing 1 required positional argument" in str(done["b"].error)


def test_a_job_that_cannot_be_sent_is_an_error_and_the_others_go_on() -> None:
    jobs = {"a": 2.0, "b": lambda: None, "c": 3.0}
    outcomes = {o.key: o for o in LocalEngine(1).run(square, jobs)}
    assert (outcomes["a"].result, outcomes["c"].result) == (4, 9)
    assert "pickle" in str(outcomes["b"].error).lower()
    assert not outcomes["b"].wrong_input


def test_processes_that_die_leave_no_open_file() -> None:
    def opened() -> int:
        return len(list(Path("/proc/self/fd").iterdir()))

    if not Path("/proc/self/fd").is_dir():
        pytest.skip("the system does not list open files")
    kept = list(LocalEngine(1).run(die_at_three, {"a": 1}))  # with what multiprocessing keeps
    before = opened()
    held = LocalEngine(1).run(die_at_three, {str(k): 3 for k in range(3)} | {"end": 1})
    for outcome in held:
        kept.append(outcome)
        if outcome.key != "end":
            assert opened() <= before + 3  # of the one process
    assert len(kept) == 5


def test_processes_use_one_thread_each() -> None:
    (outcome,) = LocalEngine(1).run(blas_threads, {"a": None})
    assert outcome.result == 1


def ended(path: Path, within: float = 10) -> bool:
    """Return whether the process whose number stands in a file ends in time."""
    pid = int(path.read_text())
    for _ in range(int(within * 20)):
        try:
            os.kill(pid, 0)
        except ProcessLookupError:
            return True
        time.sleep(0.05)
    return False


def wait_for(path: Path, within: float = 10) -> None:
    for _ in range(int(within * 20)):
        if path.exists() and path.read_text():
            return
        time.sleep(0.05)
    raise TimeoutError(path)


def test_leaving_the_loop_ends_the_processes(tmp_path: Path) -> None:
    outcomes = LocalEngine(2).run(sleep, {"short": "", "long": str(tmp_path / "pid")})
    assert next(outcomes).key == "short"
    wait_for(tmp_path / "pid")
    outcomes.close()  # type: ignore[attr-defined]
    assert ended(tmp_path / "pid")


PARENT = """
import sys
from bo_sysid.execution import LocalEngine
if __name__ == "__main__":
    import test_execution
    list(LocalEngine(1).run(test_execution.sleep, {"long": sys.argv[1]}))
"""


def test_processes_end_with_a_killed_parent(tmp_path: Path) -> None:
    (tmp_path / "parent.py").write_text(PARENT)
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parent)}
    command = [sys.executable, str(tmp_path / "parent.py"), str(tmp_path / "pid")]
    parent = subprocess.Popen(command, env=environment)  # noqa: S603
    try:
        wait_for(tmp_path / "pid")
    finally:
        parent.kill()
        parent.wait()
    assert ended(tmp_path / "pid")


def test_threads_are_all_cores_unless_told_otherwise() -> None:
    assert threads() == cores() >= 1
    with use_threads(3):
        assert threads() == 3
        with use_threads(None):
            assert threads() == cores()
        assert threads() == 3
    assert threads() == cores()
    with pytest.raises(StudyError, match=r"--threads 0: at least 1 \(this m"), use_threads(0):
        pass
    with pytest.raises(StudyError, match="0 processes: at least 1"):
        LocalEngine(0)


def test_processes_import_nothing_from_the_folder_they_are_started_in(tmp_path: Path) -> None:
    """Also not in their first imports: a study's folder may hold any file."""
    (tmp_path / "socket.py").write_text("open('imported', 'w')")
    (tmp_path / "multiprocessing.py").write_text("open('imported', 'w')")
    program = (
        "import math; from bo_sysid.execution import LocalEngine\n"
        "if __name__ == '__main__':\n"
        "    print([o.result for o in LocalEngine(1).run(math.sqrt, {'a': 4})])\n"
    )
    (tmp_path / "elsewhere").mkdir()
    script = tmp_path / "elsewhere" / "program.py"
    script.write_text(program)
    done = subprocess.run(  # noqa: S603
        [sys.executable, "-P", str(script)],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout.strip() == "[2.0]"
    assert not (tmp_path / "imported").exists()


def test_limits_linear_algebra_and_torch() -> None:
    import torch

    before = torch.get_num_threads()
    with limit_threads(1):
        assert blas_threads(None) == 1
        assert torch.get_num_threads() == 1
    assert torch.get_num_threads() == before


def test_the_environment_says_how_many_cores(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("BO_SYSID_THREADS", "3")
    assert cores() == threads() == 3
    monkeypatch.setenv("BO_SYSID_THREADS", "many")
    with pytest.raises(StudyError, match="BO_SYSID_THREADS is 'many'"):
        cores()


@pytest.mark.parametrize(("said", "told"), [("", "RuntimeError"), ("gone\nfar", "gone")])
def test_a_job_that_a_cluster_lost_without_a_word_is_told(said: str, told: str) -> None:
    ray = SimpleNamespace(exceptions=SimpleNamespace(RayError=RuntimeError), get=Mock())
    ray.get.side_effect = RuntimeError(said)
    assert job_outcome(ray, "a", None) == JobOutcome("a", error=f"lost on the cluster: {told}")

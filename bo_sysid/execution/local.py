"""Jobs in processes of this machine."""

import contextlib
import multiprocessing
import os
import signal
import threading
import traceback
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Set
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from multiprocessing.reduction import ForkingPickler
from typing import Any

from bo_sysid.errors import JobError, StudyError
from bo_sysid.execution.jobs import JobEngine, JobOutcome, answer
from bo_sysid.execution.threads import threads

_SAFE_PATH = "PYTHONSAFEPATH"
_THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


@dataclass(frozen=True)
class LocalEngine:
    """Processes of this machine, one thread each.

    A job that raises, or whose process dies, is reported as an outcome with an error; the others
    go on. The processes end with the loop over the outcomes, and with this process.

    Attributes:
        processes: number of processes.
    """

    processes: int

    def __post_init__(self) -> None:
        if self.processes < 1:
            raise StudyError(f"{self.processes} processes: at least 1")

    def run(self, function: Callable[[Any], Any], jobs: Mapping[str, Any]) -> Iterator[JobOutcome]:
        """Yield the outcome of ``function(job)`` for every job, in the order they end."""
        waiting = deque(jobs.items())
        busy: dict[Connection, _Worker] = {}
        try:
            for _ in range(min(self.processes, len(waiting))):
                worker = _Worker.start()
                busy[worker.connection] = worker
                worker.give(function, *waiting.popleft())
            while busy:
                for connection in wait(list(busy)):
                    worker = busy.pop(connection)  # type: ignore[call-overload]
                    outcome, alive = worker.take()
                    if not (waiting and alive):
                        worker.stop()
                    if waiting:
                        worker = worker if alive else _Worker.start()
                        busy[worker.connection] = worker
                        worker.give(function, *waiting.popleft())
                    yield outcome
        finally:
            for worker in busy.values():
                worker.stop()


class _Worker:
    """A process that computes one job after the other."""

    def __init__(self, process: BaseProcess, connection: Connection):
        self.process = process
        self.connection = connection
        self.key = ""

    @classmethod
    def start(cls) -> "_Worker":
        context = multiprocessing.get_context("spawn")
        here, there = context.Pipe()
        process = context.Process(target=_work, args=(there,), daemon=True)
        with _safe_path():
            process.start()
        there.close()  # so that the end of the process is the end of the connection
        return cls(process, here)

    def give(self, function: Callable[[Any], Any], key: str, job: Any) -> None:
        self.key = key
        try:
            payload = ForkingPickler.dumps((function, job))
        except Exception:  # the job cannot be sent: the process says so, as of any that fails
            payload = ForkingPickler.dumps((_fail, traceback.format_exc()))
        # a process that has just died is noticed when its answer is taken
        with contextlib.suppress(BrokenPipeError):
            self.connection.send_bytes(payload)

    def take(self) -> tuple[JobOutcome, bool]:
        """Return the outcome of the job, and whether the process lives on."""
        try:
            answer = self.connection.recv_bytes()
        except (EOFError, OSError):
            self.process.join()
            code = self.process.exitcode
            return JobOutcome(self.key, error=f"its process ended with code {code}"), False
        try:
            found = ForkingPickler.loads(answer)
        except Exception:  # a result that cannot be read is that of its job alone
            return JobOutcome(self.key, error=traceback.format_exc()), True
        return JobOutcome(self.key, *found), True

    def stop(self) -> None:
        self.connection.close()
        self.process.terminate()
        self.process.join()
        self.process.close()


@contextlib.contextmanager
def _safe_path() -> Iterator[None]:
    """Let processes that start meanwhile import nothing from the folder that they are started in.

    They take over this process's path, but only after their first imports.
    """
    before = os.environ.get(_SAFE_PATH)
    os.environ[_SAFE_PATH] = "1"
    try:
        yield
    finally:
        if before is None:
            del os.environ[_SAFE_PATH]
        else:
            os.environ[_SAFE_PATH] = before


def _fail(message: str) -> None:
    raise JobError(message)


def _work(connection: Connection) -> None:
    """Compute jobs until the other end of the connection is closed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent says when it is over
    threading.Thread(target=_end_with_parent, daemon=True).start()
    os.environ.update(dict.fromkeys(_THREAD_VARIABLES, "1"))
    while True:
        try:
            found = answer(*connection.recv())
        except (EOFError, OSError):
            return
        except Exception:  # the function cannot be imported here
            found = None, traceback.format_exc(), False
        try:
            connection.send(found)
        except BrokenPipeError:
            return
        except Exception:  # the result cannot be sent
            connection.send((None, traceback.format_exc(), False))


def _end_with_parent() -> None:
    """End this process when its parent ends, also where that was killed."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def map_jobs(
    function: Callable[[Any], Any],
    jobs: Mapping[str, Any],
    *,
    engine: JobEngine | None = None,
    done: Set[str] = frozenset(),
) -> Iterator[JobOutcome]:
    """Yield the outcome of ``function(job)`` for every job that is not in `done`.

    Args:
        function: a function of a module, so that a process can import it.
        jobs: argument by the job's key.
        engine: where the jobs run; a process of this machine for every thread where left out.
        done: keys of jobs that an earlier, interrupted call has finished.
    """
    engine = engine or LocalEngine(threads())
    return engine.run(function, {k: v for k, v in jobs.items() if k not in done})

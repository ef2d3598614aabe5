"""Answer: diagnose every case, and freeze each answer before any seal is opened.

Each case is diagnosed in a process of its own, which is given the folder of the case and nothing
else. When it ends, a record with the hash of every file of the answer and of the commitments is
written; from then on the answer counts, also where it is an error. An interrupted call goes on with
the cases that have no record.

A diagnosis that has not ended after its time limit is ended with its process, and the case counts
as unanswered. The watchdog is Python's own (faulthandler): it needs no lock of the interpreter, so
that it also ends what hangs in compiled code, and it leaves where every thread was.
"""

import contextlib
import faulthandler
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from bo_sysid.errors import RunError, StudyError
from bo_sysid.execution import JobEngine, OnProgress, Progress, map_jobs, silent
from bo_sysid.proof.conceal import CASES, COMMITMENTS
from bo_sysid.proof.seal import file_digest, write_json
from bo_sysid.runs import Run, digest, read_json, versions
from bo_sysid.runs.files import UNFINISHED
from bo_sysid.study import Study

ANSWERS, OPENED = "answers", "opened.json"
LIMIT = 3600.0
"""Longest time that the diagnosis of one case may take, in [s]."""
_SHORTEST = 1e-3  # [s] of a time limit
_HUNG = "hung.txt"  # where the threads were when the time was over
_NOT_THE_ANSWER = {"run.json", ".lock"}


@dataclass(frozen=True)
class AnswerJob:
    """What a process needs to answer one case.

    Attributes:
        folder: of the run.
        name: of the case.
        limit: longest time that it may take, in [s].
    """

    folder: Path
    name: str
    limit: float


def answer(
    run: Run,
    *,
    first: int | None = None,
    engine: JobEngine | None = None,
    limit: float = LIMIT,
    progress: OnProgress = silent,
) -> None:
    """Diagnose the cases of a run that have no answer yet.

    Args:
        run: with cases and commitments.
        first: only so many of them, see `judged`.
        engine: where the cases are diagnosed; on a cluster the run folder must be one that all its
            machines see. Processes of this machine by default.
        limit: longest time that a case may take, in [s]; then it counts as unanswered.
        progress: told after every case.

    Raises:
        RunError: a case is missing, or the seal of one without an answer was opened.
        StudyError: the limit is none that a clock keeps, or there are fewer cases than `first`.
    """
    if not _SHORTEST <= limit <= threading.TIMEOUT_MAX:
        raise StudyError(
            f"--limit {limit:g}: the time for a case must be from {_SHORTEST:g} s to "
            f"{threading.TIMEOUT_MAX:.1g} s"
        )
    names = judged(run.folder, first)
    done = {n for n in names if run.has(record_of(n))}
    if len(done) == len(names):
        return
    opened = answers_at_opening(openings_in(run.folder)) if run.has(OPENED) else {}
    late = [n for n in names if n in opened and n not in done]
    if late:
        raise RunError(
            f"{run.folder}: the seals of {len(late)} cases without an answer were opened "
            f"({late[0]} first); an answer that is given now does not count"
        )
    jobs = {n: AnswerJob(run.folder.resolve(), n, limit) for n in names}
    step = len(done)
    for outcome in map_jobs(answer_case, jobs, engine=engine, done=done):
        job = jobs[outcome.key]
        if outcome.error is not None and not _frozen_as_hung(job):
            # the process died, or the answer could not be written
            freeze(job.folder, job.name, 0.0, outcome.error)
        step += 1
        progress(Progress(step, len(names), outcome.key))


def commitments(folder: Path) -> Mapping[str, Any]:
    """Return what was published about a run.

    Raises:
        RunError: nothing was, or it is damaged.
    """
    found = read_json(folder, COMMITMENTS)
    if not isinstance(found, dict) or not isinstance(found.get("cases"), dict):
        raise RunError(f"{folder / COMMITMENTS}: damaged")
    return found


def openings_in(folder: Path) -> list[dict[str, Any]]:
    """Return the record of opened seals in a folder, in the order of the openings.

    Raises:
        RunError: it is damaged.
    """
    record = read_json(folder, OPENED)
    if not isinstance(record, dict) or {"commitments", "openings"} != set(record):
        raise RunError(f"{folder / OPENED}: is damaged; nothing is scored")
    return list(record["openings"])


def answers_at_opening(openings: Sequence[Mapping[str, Any]]) -> dict[str, str]:
    """Return the SHA-256 of the answer to each case whose seal was opened."""
    return {n: sha256 for o in openings for n, sha256 in o["answers"].items()}


def judged(folder: Path, first: int | None = None) -> list[str]:
    """Return the names of the cases that are answered and revealed: all, or the first so many.

    They are numbered in random order, so that the first ones are a fair sample; no other choice is
    offered, since one that is made after an answer was seen would not be.

    Raises:
        RunError: nothing was published about the run.
        StudyError: it does not have so many cases.
    """
    names = sorted(commitments(folder)["cases"])
    if first is not None and not 1 <= first <= len(names):
        raise StudyError(f"--first {first}: {folder} has {len(names)} cases")
    return names[:first]


def record_of(name: str) -> str:
    """Return the name of the record that freezes an answer."""
    return f"{ANSWERS}/{name}.json"


def answer_case(job: AnswerJob) -> None:
    """Diagnose one case and freeze the answer, an error included."""
    from bo_sysid.diagnosis import diagnose

    if (job.folder / record_of(job.name)).is_file() or _frozen_as_hung(job):
        return  # a cluster runs a job again whose machine was lost, or whose time was over
    place, began, error = job.folder / ANSWERS / job.name, time.monotonic(), None
    try:
        study = Study.load(job.folder / CASES / job.name / "study.yaml")
        with (
            Run.open(place, study.resolved(relative_to=place), "diagnose") as run,
            _ended_after(job.limit, place / _HUNG),
        ):
            diagnose(study, run)
    except Exception as failure:  # whatever went wrong is the answer
        error = f"{type(failure).__name__}: {failure}"
    freeze(job.folder, job.name, time.monotonic() - began, error)


@contextlib.contextmanager
def _ended_after(seconds: float, trace: Path) -> Iterator[None]:
    """End this process where the block takes longer, after writing where it was."""
    with open(trace, "w", encoding="utf-8") as file:
        faulthandler.dump_traceback_later(seconds, exit=True, file=file)
        try:
            yield
        finally:
            faulthandler.cancel_dump_traceback_later()
    trace.unlink()


def _frozen_as_hung(job: AnswerJob) -> bool:
    """Freeze a case as unanswered where its time was over; return whether it was."""
    trace = job.folder / ANSWERS / job.name / _HUNG
    if not trace.is_file() or not trace.stat().st_size:
        return False
    freeze(job.folder, job.name, job.limit, f"no answer within {job.limit:g} s")
    return True


def answer_files(folder: Path, name: str) -> dict[str, str]:
    """Return the SHA-256 of every file of an answer."""
    place = folder / ANSWERS / name
    found = (f for f in sorted(place.rglob("*")) if f.is_file() and f.name not in _NOT_THE_ANSWER)
    files = [f for f in found if not f.name.startswith(UNFINISHED)]
    return {f.relative_to(place).as_posix(): file_digest(f) for f in files}


def frozen_digest(folder: Path, first: int | None) -> str:
    """Return the hash of all frozen answers, to be published before anything is opened."""
    names = judged(folder, first)
    return digest({name: file_digest(folder / record_of(name)) for name in names})


def freeze(folder: Path, name: str, seconds: float, error: str | None) -> None:
    """Write the record after which an answer counts.

    Args:
        folder: of the run.
        name: of the case.
        seconds: that the diagnosis took.
        error: why there is no answer, None where there is one.
    """
    record = {
        "case": name,
        "frozen": datetime.now(UTC).isoformat(timespec="microseconds"),
        "commitments": file_digest(folder / COMMITMENTS),
        "files": answer_files(folder, name),
        "seconds": round(seconds, 2),
        "error": error,
        "versions": versions(),
    }
    write_json(folder / record_of(name), record)

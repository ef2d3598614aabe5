"""Conceal: draw the cases of a suite, write what a person would have, seal the answers.

A run folder has

    cases/<name>/      model.xml, study.yaml, train.parquet, holdout.parquet: all that is shown
    commitments.json   per case SHA-256(nonce ‖ answer) and the SHA-256 of each file that is shown

and beside it the folder of seals, with the plan and the answers. The calling process never sees
the plan: it is drawn, and each case with it, in processes of their own. What is shown tells
nothing by itself: names are numbered in random order, cases appear only when all are drawn, one
after the other and with one fixed time stamp (how long a case took to draw would tell its plant),
recordings hold no notes, and studies differ only in what the machine is and which parameters are
listed.
"""

import os
import shutil
import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from bo_sysid.errors import RunError, StudyError
from bo_sysid.execution import LocalEngine, OnProgress, Progress, map_jobs, silent, threads
from bo_sysid.proof.case import Case, NoCase, draw_case
from bo_sysid.proof.plan import Draw, plan
from bo_sysid.proof.seal import Seal, file_digest, write_json
from bo_sysid.proof.suite import LoadedSuite, load_suite
from bo_sysid.recording.writers import write_recording
from bo_sysid.runs import Run, atomic, digest, read_json, read_record, versions
from bo_sysid.runs.files import UNFINISHED
from bo_sysid.yaml_text import dumped

COMMITMENTS, CASES = "commitments.json", "cases"

_PLAN = "plan.json"
_STAMP = 946_684_800  # 2000-01-01: every file of every case carries this time
_PART = "commitment-{}.json"
_REDRAWS = 5  # cases that are tried in the place of one that cannot be had
_REDRAWN = 1  # key of the random numbers for that, beside the seed of the case


@dataclass(frozen=True)
class DrawJob:
    """What a process needs to draw one case.

    Attributes:
        suite: file of the suite.
        overrides: values that replace what it says.
        seals: folder of the seals.
        name: of the case.
    """

    suite: Path
    overrides: Mapping[str, Any]
    seals: Path
    name: str


def seals_of(folder: Path) -> Path:
    """Return where the seals of a run are unless said otherwise: beside it."""
    return folder.parent / f"{folder.name}-sealed"


def concealed_run(folder: str | Path) -> Run:
    """Open a run that `conceal` finished, to answer and reveal it.

    Raises:
        RunError: it is no such run, or another process writes to it.
    """
    folder = Path(folder)
    record = read_record(folder)
    if record["command"] != "conceal" or not (folder / COMMITMENTS).is_file():
        raise RunError(f"{folder}: not a finished run of conceal; make one with bo-sysid conceal")
    study = yaml.safe_load((folder / "study.yaml").read_text(encoding="utf-8"))
    return Run.open(folder, study, "conceal", seed=record.get("seed"))


def suite_record(path: Path, overrides: Mapping[str, Any]) -> dict[str, Any]:
    """Return a suite as it is stored in a run, with the hashes of its machines' models."""
    loaded = load_suite(path, overrides)
    machines = {
        name: {
            "file": m.file.model_dump(mode="json", exclude_none=True),
            "model_sha256": m.model.sha256,
        }
        for name, m in loaded.machines.items()
    }
    return {"suite": loaded.suite.model_dump(mode="json", exclude_none=True), "machines": machines}


def conceal(
    run: Run,
    suite: str | Path,
    *,
    overrides: Mapping[str, Any] | None = None,
    seals: str | Path | None = None,
    progress: OnProgress = silent,
) -> dict[str, Any]:
    """Draw the cases of a suite into a run folder; an interrupted call goes on.

    Args:
        run: where what is shown is written.
        suite: file of the suite.
        overrides: values by key that replace what it says.
        seals: folder of the seals; beside the run where left out.
        progress: told after each case.

    Returns:
        The commitments, as they are in `commitments.json`. Publish their digest.

    Raises:
        StudyError: the suite is wrong, or a case of it cannot be drawn.
        JobError: drawing failed for no fault of the suite.
    """
    path, overrides = Path(suite).resolve(), dict(overrides or {})
    load_suite(path, overrides)
    if run.has(COMMITMENTS):
        return dict(run.read_json(COMMITMENTS))
    sealed = Path(seals).resolve() if seals else seals_of(run.folder.resolve())
    engine = LocalEngine(threads())
    everything = DrawJob(path, overrides, sealed, "")
    names = _only(map_jobs(_draw_plan, {"plan": everything}, engine=LocalEngine(1)))
    done = {n for n in names if (sealed / _PART.format(n)).is_file()}
    jobs = {n: DrawJob(path, overrides, sealed, n) for n in names}
    step = len(done)
    for outcome in map_jobs(_draw_one, jobs, engine=engine, done=done):
        if outcome.error is not None:
            why = outcome.error.strip().splitlines()[-1]
            raise outcome.failure(StudyError, f"{path}: {outcome.key} cannot be drawn: {why}")
        step += 1
        progress(Progress(step, len(names)))  # nothing about the case: not even its time
    _show(sealed, run.path(CASES), names)
    commitments = _published(path, overrides, sealed, names)
    run.write_json(COMMITMENTS, commitments)
    return commitments


def write_case(case: Case, loaded: LoadedSuite, folder: Path) -> dict[str, str]:
    """Write what is shown of a case and return the SHA-256 of each file."""
    machine = loaded.machines[case.draw.machine]
    folder.mkdir(parents=True, exist_ok=True)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*settotalmass")  # speaks to the suite's author
        machine.model.export(folder / "model.xml")
    for part, recording in case.recordings.items():
        write_recording(recording, folder / f"{part}.parquet")
    study: dict[str, Any] = {
        "version": 1,
        "name": case.draw.name,
        "model": "model.xml",
        "recordings": {"train": ["train.parquet"], "holdout": ["holdout.parquet"]},
        "limits": {
            joint: limit.model_dump(mode="json", exclude_none=True)
            for joint, limit in machine.file.limits.items()
        },
    }
    if case.parameters:
        study["parameters"] = [
            {"name": p.name, "address": list(p.addresses), "apply": p.apply,
             "low": p.low, "high": p.high, "steps": p.steps, "unit": p.unit}
            for p in case.parameters
        ]  # fmt: skip
    with atomic(folder / "study.yaml") as beside:
        beside.write_text(dumped(study), encoding="utf-8")
    return {f.relative_to(folder).as_posix(): file_digest(f) for f in _files(folder)}


def _files(folder: Path) -> list[Path]:
    files = (f for f in sorted(folder.rglob("*")) if f.is_file())
    return [f for f in files if not f.name.startswith(UNFINISHED)]


def _draw_plan(job: DrawJob) -> list[str]:
    """Draw the plan, unless an interrupted call drew it, and return the names of the cases."""
    path = job.seals / _PLAN
    record = suite_record(job.suite, job.overrides)
    if path.is_file():
        there = read_json(job.seals, _PLAN)
        if there["suite_sha256"] != digest(record):
            raise RunError(f"{job.seals}: holds the seals of another suite; use another folder")
        if there.get("versions") != versions():
            raise RunError(f"{job.seals}: was begun by other versions; use another folder")
        return [d["name"] for d in there["cases"]]
    draws = plan(load_suite(job.suite, job.overrides))
    content = {
        "suite_sha256": digest(record),
        "versions": versions(),
        "cases": [d.plain() for d in draws],
    }
    write_json(path, content)
    return [d.name for d in draws]


def _draw_one(job: DrawJob) -> None:
    """Draw, write and seal one case; its process alone knows what is in it."""
    loaded = load_suite(job.suite, job.overrides)
    draws = [Draw.of(d) for d in read_json(job.seals, _PLAN)["cases"]]
    case = _drawn(next(d for d in draws if d.name == job.name), draws, loaded)
    shutil.rmtree(job.seals / job.name, ignore_errors=True)  # what a killed call was writing
    files = write_case(case, loaded, job.seals / job.name)
    seal = Seal.of({**case.truth, "files": files})
    write_json(job.seals / f"{job.name}.json", seal.plain())
    write_json(job.seals / _PART.format(job.name), {"sha256": seal.commitment, "files": files})


def _drawn(draw: Draw, plan: Sequence[Draw], loaded: LoadedSuite) -> Case:
    """Draw a case; where it cannot be had, one like another of its tier, from a seed of its own."""
    same_kind = [d for d in plan if d.tier == draw.tier and bool(d.effects) == bool(draw.effects)]
    rng = np.random.default_rng((draw.seed, _REDRAWN))
    tried = draw
    for _ in range(_REDRAWS):
        try:
            return draw_case(tried, loaded)
        except NoCase:
            other = same_kind[int(rng.integers(len(same_kind)))]
            tried = replace(other, name=draw.name, seed=int.from_bytes(rng.bytes(16), "big"))
    return draw_case(tried, loaded)


def _show(seals: Path, cases: Path, names: list[str]) -> None:
    """Copy what is shown out of the folder of seals, in the order of the names."""
    for name in names:
        place = cases / name
        for file in _files(seals / name):
            target = place / file.relative_to(seals / name)
            target.parent.mkdir(parents=True, exist_ok=True)
            target.write_bytes(file.read_bytes())
        for path in (*place.rglob("*"), place):
            os.utime(path, (_STAMP, _STAMP))


def _published(
    suite: Path, overrides: Mapping[str, Any], seals: Path, names: list[str]
) -> dict[str, Any]:
    """Return what is published: nothing that depends on the answers but their commitments."""
    return {
        "format": 1,
        "suite_sha256": digest(suite_record(suite, overrides)),
        "versions": versions(),
        "cases": {n: read_json(seals, _PART.format(n)) for n in names},
    }


def _only(outcomes: Iterator[Any]) -> list[str]:
    outcome = next(outcomes)
    if outcome.error is not None:
        raise outcome.failure(StudyError, outcome.error)
    return list(outcome.result)

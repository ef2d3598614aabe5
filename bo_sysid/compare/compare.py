"""The comparison: arms on problems with paired seeds, resumable, in processes or on a cluster.

tables of Δ → one run an arm, problem and seed → paths → costs → intervals and paired tests
"""

import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import pandas as pd

from bo_sysid.compare.arms import Arm, ComparedProblem, arms_of, problems_of
from bo_sysid.compare.plan import Plan, keys_of, record_name
from bo_sysid.compare.statistics import agreement, costs, paired, summary
from bo_sysid.compare.tables import (
    INNER_UNITS,
    OUTER_UNITS,
    Records,
    ends,
    inner_paths,
    outer_paths,
)
from bo_sysid.errors import RecordingError, RunError
from bo_sysid.execution import OnProgress, silent
from bo_sysid.recording import load_dataset
from bo_sysid.runs import Run, digest, read_json
from bo_sysid.study import Study
from bo_sysid.study.inputs import changed, fingerprints, load_train

PROBLEMS, SUMMARY = "problems.json", "comparison.json"
_STUDY = "the study"


@dataclass(frozen=True)
class Comparison:
    """What a comparison found.

    Attributes:
        name: of the study.
        paths: one row an evaluation (inner) or an iteration (outer) of every run.
        costs: one row a run and level of regret: what it took to reach it.
        summary: their means by problem, arm and level, with 95 % intervals.
        paired: each arm against the first on the same seeds: ratio, interval, p.
        agreement: how much the arms' picks agree; empty for outer loops.
        ends: how each search ended; empty for outer loops.
        skipped: why a problem was left out, by its name.
    """

    name: str
    paths: pd.DataFrame
    costs: pd.DataFrame
    summary: pd.DataFrame
    paired: pd.DataFrame
    agreement: pd.DataFrame
    ends: pd.DataFrame
    skipped: Mapping[str, str]


def compare(
    study: Study,
    run: Run | None = None,
    *,
    progress: OnProgress = silent,
    trust_code: bool = False,
    strict: bool = False,
) -> Comparison:
    """Compare the arms of a study on its problems, with paired seeds.

    The runs are made in processes of their own: a script that calls this does so under
    ``if __name__ == "__main__":``, as Python requires of all that start processes.

    Args:
        study: its key `compare` names arms, seeds and problems; `execution` says where they run.
        run: folder that keeps every finished run and the tables; a comparison that was interrupted
            goes on. A temporary one by default.
        progress: called after every table and every run.
        trust_code: run the Python files that the studies under `compare.problems` name.
        strict: refuse messy recordings.

    Raises:
        UserError: a study, its model or its recordings are wrong, or a run failed.
    """
    if run is None:
        with tempfile.TemporaryDirectory() as place:
            folder = Path(place) / "run"
            with Run.open(folder, study.resolved(relative_to=folder), "compare") as own:
                return compare(study, own, progress=progress, trust_code=trust_code, strict=strict)
    arms = arms_of(study)
    problems, skipped = _available(problems_of(study, trust_code=trust_code))
    _require_unchanged(run, problems)
    if strict:
        _require_clean(problems)
    records = Plan(study, run, arms, problems, progress).carried_out()
    found = _gathered(study, arms, records, skipped)
    _write(run, study, arms, found)
    return found


def _available(
    problems: tuple[ComparedProblem, ...],
) -> tuple[tuple[ComparedProblem, ...], dict[str, str]]:
    """Return the problems whose recordings there are, and why others are left out.

    Raises:
        RecordingError: none is left.
    """
    kept, skipped = [], {}
    for problem in problems:
        dataset = problem.study.recordings.dataset
        try:
            if dataset is not None and not problem.fresh:
                _ = load_dataset(dataset).train  # opens the files
            kept.append(problem)
        except RecordingError as missing:
            skipped[problem.name] = str(missing)
    if not kept:
        raise RecordingError("; ".join(skipped.values()))
    return tuple(kept), skipped


def _require_unchanged(run: Run, problems: tuple[ComparedProblem, ...]) -> None:
    """Refuse to resume a run whose problems were others.

    Raises:
        RunError: the message names the problem, and what of it changed.
    """
    run.require_same_packages()
    there = run.read_json(PROBLEMS) if run.has(PROBLEMS) else {}
    now = {}
    for name, study in ((p.name, p.study) for p in problems):
        files = fingerprints(study, recorded=study.plant is None)
        settings = {k: v for k, v in study.resolved().items() if k != "compare"}
        now[name] = {_STUDY: digest(settings), **files}
        what = changed(there.get(name, now[name]), now[name])
        if what:
            raise RunError(
                f"{run.folder}: the problem {name!r} changed since this run began ({what} is "
                "another); use another --out, or remove the folder"
            )
    run.write_json(PROBLEMS, {**there, **now})


def _require_clean(problems: tuple[ComparedProblem, ...]) -> None:
    """Refuse messy recordings.

    Raises:
        RecordingError: the message names the recording and what is wrong with it.
    """
    for problem in problems:
        if not problem.fresh:
            load_train(problem.study, strict=True)


def so_far(study: Study, folder: Path) -> Comparison:
    """Return what the finished runs of a comparison say, also while others are going on.

    Args:
        study: that the folder is a comparison of.
        folder: of the run; nothing is written to it.

    Raises:
        RunError: no run has finished yet.
        StudyError: a study under `compare.problems` names Python files.
    """
    arms, problems = arms_of(study), problems_of(study, trust_code=False)
    keys = {record_name(key): key for key in keys_of(study, arms, problems)}
    records = {k: read_json(folder, name) for name, k in keys.items() if (folder / name).is_file()}
    if not records:
        raise RunError(f"{folder}: no run of the comparison has finished yet")
    left_out = read_json(folder, SUMMARY)["skipped"] if (folder / SUMMARY).is_file() else {}
    return _gathered(study, arms, records, left_out)


def _gathered(
    study: Study, arms: tuple[Arm, ...], records: Records, skipped: Mapping[str, str]
) -> Comparison:
    outer = study.compare.loop == "outer"
    units = OUTER_UNITS if outer else INNER_UNITS
    paths = outer_paths(records) if outer else inner_paths(records)
    spent = costs(paths, study.compare.regrets, units)
    return Comparison(
        study.name,
        paths,
        spent,
        summary(spent, units),
        paired(spent, units, arms[0].name),
        pd.DataFrame() if outer else agreement(paths),
        pd.DataFrame() if outer else ends(records),
        skipped,
    )


def _write(run: Run, study: Study, arms: tuple[Arm, ...], found: Comparison) -> None:
    for name in ("paths", "costs", "summary", "paired", "agreement", "ends"):
        frame = getattr(found, name)
        if len(frame.columns):
            run.write_frame(f"{name}.parquet", frame)
    runs = found.paths[["problem", "arm", "seed"]].drop_duplicates()
    run.write_json(
        SUMMARY,
        {
            "name": study.name,
            "loop": study.compare.loop,
            "arms": [a.name for a in arms],
            "runs": len(runs),
            "skipped": dict(found.skipped),
        },
    )

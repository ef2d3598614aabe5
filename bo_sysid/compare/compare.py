"""The comparison: arms on problems with paired seeds, resumable, in processes or on a cluster.

tables of Δ → one run an arm, problem and seed → paths → costs → intervals and paired tests
"""

import tempfile
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd

from bo_sysid.compare.arms import Arm, Posed, arms_of, problems_of, slug
from bo_sysid.compare.gathered import (
    INNER_UNITS,
    OUTER_UNITS,
    Key,
    Records,
    ends,
    inner_paths,
    outer_paths,
)
from bo_sysid.compare.inner import SearchJob, run_search
from bo_sysid.compare.outer import LearnJob, run_learn
from bo_sysid.compare.statistics import agreement, costs, paired, summary
from bo_sysid.compare.table import Table, TableJob, tabulate
from bo_sysid.errors import RecordingError, RunError
from bo_sysid.execution import Progress, Report, map_jobs, open_engine, silent
from bo_sysid.recording import load_dataset
from bo_sysid.runs import Run
from bo_sysid.study import Study
from bo_sysid.study.check import candidate_set
from bo_sysid.study.inputs import load_model

PROBLEMS = "problems.json"


@dataclass(frozen=True)
class Comparison:
    """What a comparison found.

    Attributes:
        name: of the study.
        paths: one row an evaluation (inner) or an iteration (outer) of every run.
        costs: one row a run and level of regret: what it took to reach it.
        summary: their means by problem, arm and level, with 95 % intervals.
        paired: each arm against the first on the same seeds: ratio, interval, p.
        agreement: how alike the arms pick; empty for outer loops.
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


def compare(study: Study, run: Run | None = None, *, progress: Report = silent) -> Comparison:
    """Compare the arms of a study on its problems, with paired seeds.

    Args:
        study: its key `compare` names arms, seeds and problems; `execution` says where they run.
        run: folder that keeps every finished run and the tables; a comparison that was interrupted
            goes on. A temporary one by default.
        progress: told after every table and every run.

    Raises:
        UserError: a study, its model or its recordings are wrong, or a run failed.
    """
    if run is None:
        with tempfile.TemporaryDirectory() as place:
            folder = Path(place) / "run"
            with Run.open(folder, study.resolved(relative_to=folder), "compare") as own:
                return compare(study, own, progress=progress)
    arms = arms_of(study)
    problems, skipped = _available(problems_of(study))
    _require_unchanged(run, problems)
    records = _Plan(study, run, arms, problems, progress).carried_out()
    return _gathered(study, run, arms, records, skipped)


def _available(problems: tuple[Posed, ...]) -> tuple[tuple[Posed, ...], dict[str, str]]:
    """Return the problems whose recordings there are, and why others are left out.

    Raises:
        RecordingError: none is left.
    """
    kept, skipped = [], {}
    for problem in problems:
        dataset = problem.study.recordings.dataset
        try:
            if dataset is not None and not problem.fresh:
                load_dataset(dataset)
            kept.append(problem)
        except RecordingError as missing:
            skipped[problem.name] = str(missing)
    if not kept:
        raise RecordingError("; ".join(skipped.values()))
    return tuple(kept), skipped


def _require_unchanged(run: Run, problems: tuple[Posed, ...]) -> None:
    """Refuse to go on with a run whose further problems were others.

    Raises:
        RunError: the message names the problem that changed.
    """
    now = {problem.name: problem.study.sha256 for problem in problems}
    there = run.read_json(PROBLEMS) if run.has(PROBLEMS) else {}
    changed = [name for name in now if there.get(name, now[name]) != now[name]]
    if changed:
        raise RunError(
            f"{run.folder}: the problem {changed[0]!r} changed since this run began; use another "
            "--out, or remove the folder"
        )
    run.write_json(PROBLEMS, {**there, **now})


@dataclass(frozen=True)
class _Plan:
    """What is to be run, and where it is kept."""

    study: Study
    run: Run
    arms: tuple[Arm, ...]
    problems: tuple[Posed, ...]
    progress: Report

    def carried_out(self) -> dict[Key, dict[str, Any]]:
        """Run what was not run yet, and return the records of all."""
        keys = {_record(key): key for key in self._keys()}
        done = {name for name in keys if self.run.has(name)}
        if len(done) < len(keys):
            outer = self.study.compare.loop == "outer"
            jobs = self._learning(keys, done) if outer else self._searches(keys, done)
            work: Callable[[Any], Any] = run_learn if outer else run_search
            total = len(jobs) + len(done)
            self._stream(work, jobs, self.run.write_json, len(done), total)
        return {key: self.run.read_json(name) for name, key in keys.items()}

    def _keys(self) -> Iterator[Key]:
        """Yield every run, seed by seed: what is finished of a killed comparison is paired.

        Arms with fewer seeds take long, and come last.
        """
        seeds = self.study.compare.seeds
        for group in (
            [a for a in self.arms if a.seeds == seeds],
            [a for a in self.arms if a.seeds < seeds],
        ):
            for seed in range(seeds):
                for problem in self.problems:
                    for arm in group:
                        if seed < arm.seeds:
                            yield Key(problem.name, arm.name, seed)

    def _searches(self, keys: Mapping[str, Key], done: set[str]) -> dict[str, SearchJob]:
        todo = {name: key for name, key in keys.items() if name not in done}
        tables = self._tables(list(todo.values()))
        arms, problems = {a.name: a for a in self.arms}, {p.name: p for p in self.problems}
        seeded = {where: self._seeded(problems[where[0]], where[1]) for where in _paired(todo)}
        return {
            name: SearchJob(
                seeded[key.problem, key.seed],
                _folder(problems[key.problem]),
                arms[key.arm],
                key.seed,
                _data_seed(problems[key.problem], key.seed),
                tables.get(_table(problems[key.problem], key.seed)),
            )
            for name, key in todo.items()
        }

    def _tables(self, keys: list[Key]) -> dict[str, Table]:
        """Compute the tables that are missing, and return all that `keys` need."""
        jobs: dict[str, TableJob] = {}
        for problem in self.problems:
            if not self._small(problem):
                continue
            for key in keys:
                if key.problem == problem.name:
                    seed = _data_seed(problem, key.seed)
                    name = _table(problem, seed)
                    if name not in jobs:
                        jobs[name] = TableJob(self._seeded(problem, seed), _folder(problem), seed)
        todo = {name: job for name, job in jobs.items() if not self.run.has(name)}

        def keep(name: str, table: Table) -> None:
            table.write(self.run.path(name))

        self._stream(tabulate, todo, keep, len(jobs) - len(todo), len(jobs))
        return {name: Table.read(self.run.path(name)) for name in jobs}

    def _learning(self, keys: Mapping[str, Key], done: set[str]) -> dict[str, LearnJob]:
        arms, problems = {a.name: a for a in self.arms}, {p.name: p for p in self.problems}
        return {
            name: LearnJob(
                self._seeded(problems[key.problem], key.seed),
                _folder(problems[key.problem]),
                arms[key.arm],
                key.seed,
                str(self.run.path(name.removesuffix(".json")).resolve()),
            )
            for name, key in keys.items()
            if name not in done
        }

    def _stream(
        self,
        work: Callable[[Any], Any],
        jobs: Mapping[str, Any],
        keep: Callable[[str, Any], Any],
        step: int,
        of: int,
    ) -> None:
        """Run jobs and keep each result as it comes; what failed is told at the end.

        Raises:
            RunError: a job failed; the others are kept.
        """
        if not jobs:
            return
        execution = self.study.execution
        engine = open_engine(execution.engine, execution.address)
        failed: dict[str, str] = {}
        for outcome in map_jobs(work, jobs, engine=engine):
            if outcome.error is None:
                keep(outcome.key, outcome.result)
            else:
                failed[outcome.key] = outcome.error
            step += 1
            self.progress(Progress(step, of, Path(outcome.key).with_suffix("").as_posix()))
        if failed:
            name, why = next(iter(failed.items()))
            raise RunError(
                f"{self.run.folder}: {len(failed)} of {len(jobs)} runs failed, the others are "
                f"kept; the same command tries these again. {name}: {why}"
            )

    def _seeded(self, problem: Posed, seed: int) -> dict[str, Any]:
        return problem.seeded(seed, self.study.compare.truth)

    def _small(self, problem: Posed) -> bool:
        parameters = problem.study.parameter_set(load_model(problem.study))
        return len(candidate_set(problem.study, parameters)) <= self.study.compare.table


def _gathered(
    study: Study, run: Run, arms: tuple[Arm, ...], records: Records, skipped: dict[str, str]
) -> Comparison:
    """Write the tables of a comparison, and return them."""
    outer = study.compare.loop == "outer"
    units = OUTER_UNITS if outer else INNER_UNITS
    paths = outer_paths(records) if outer else inner_paths(records)
    spent = costs(paths, study.compare.regrets, units)
    found = Comparison(
        study.name,
        paths,
        spent,
        summary(spent, units),
        paired(spent, units, arms[0].name),
        pd.DataFrame() if outer else agreement(paths),
        pd.DataFrame() if outer else ends(records),
        skipped,
    )
    for name in ("paths", "costs", "summary", "paired", "agreement", "ends"):
        frame = getattr(found, name)
        if len(frame):
            run.write_frame(f"{name}.parquet", frame)
    run.write_json(
        "comparison.json",
        {
            "name": study.name,
            "loop": study.compare.loop,
            "arms": [a.name for a in arms],
            "runs": len(records),
            "skipped": skipped,
        },
    )
    return found


def _paired(keys: Mapping[str, Key]) -> list[tuple[str, int]]:
    return list(dict.fromkeys((key.problem, key.seed) for key in keys.values()))


def _record(key: Key) -> str:
    return f"records/{key.problem}/{slug(key.arm)}/{key.seed:03d}.json"


def _table(problem: Posed, seed: int) -> str:
    return f"tables/{problem.name}/{_data_seed(problem, seed):03d}.npz"


def _data_seed(problem: Posed, seed: int) -> int:
    return seed if problem.fresh else 0


def _folder(problem: Posed) -> str:
    return str(problem.study.folder.resolve())

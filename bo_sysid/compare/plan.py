"""The runs of a comparison: which there are, where they are kept, and how they are carried out."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bo_sysid.compare.arms import Arm, ComparedProblem, slug
from bo_sysid.compare.inner import SearchJob, run_search
from bo_sysid.compare.outer import LearnJob, run_learn
from bo_sysid.compare.table import Table, TableJob, tabulate
from bo_sysid.compare.tables import Key
from bo_sysid.errors import RunError
from bo_sysid.execution import JobOutcome, OnProgress, Progress, map_jobs, open_engine
from bo_sysid.runs import Run
from bo_sysid.study import Study
from bo_sysid.study.inputs import load_model
from bo_sysid.study.overview import candidate_count


@dataclass(frozen=True)
class Plan:
    """What is to be run, and where it is kept.

    Attributes:
        study: with the key `compare`.
        run: keeps every finished run and the tables of Δ.
        arms: of the study.
        problems: whose recordings there are.
        progress: called after every table and every run.
    """

    study: Study
    run: Run
    arms: tuple[Arm, ...]
    problems: tuple[ComparedProblem, ...]
    progress: OnProgress

    def carried_out(self) -> dict[Key, dict[str, Any]]:
        """Run what was not run yet, and return the records of all."""
        keys = {record_name(key): key for key in keys_of(self.study, self.arms, self.problems)}
        done = {name for name in keys if self.run.has(name)}
        if len(done) < len(keys):
            outer = self.study.compare.loop == "outer"
            jobs = self._learning(keys, done) if outer else self._searches(keys, done)
            work: Callable[[Any], Any] = run_learn if outer else run_search
            total = len(jobs) + len(done)
            self._stream(work, jobs, self.run.write_json, len(done), total)
        return {key: self.run.read_json(name) for name, key in keys.items()}

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
        """Run jobs and keep each result as it comes; what failed is reported at the end.

        Raises:
            RunError: what a job was given is wrong; the others are kept.
            JobError: a job failed otherwise; the others are kept.
        """
        if not jobs:
            return
        execution = self.study.execution
        engine = open_engine(execution.engine, execution.address)
        failed: list[JobOutcome] = []
        for outcome in map_jobs(work, jobs, engine=engine):
            if outcome.error is None:
                keep(outcome.key, outcome.result)
            else:
                failed.append(outcome)
            step += 1
            self.progress(Progress(step, of, Path(outcome.key).with_suffix("").as_posix()))
        if failed:
            first = min(failed, key=lambda outcome: outcome.wrong_input)  # what is worse first
            raise first.failure(
                RunError,
                f"{self.run.folder}: {len(failed)} of {len(jobs)} runs failed, the others are "
                f"kept; the same command tries these again. {first.key}: {first.error}",
            )

    def _seeded(self, problem: ComparedProblem, seed: int) -> dict[str, Any]:
        return problem.seeded(seed, self.study.compare.truth)

    def _small(self, problem: ComparedProblem) -> bool:
        parameters = problem.study.parameter_set(load_model(problem.study))
        return candidate_count(problem.study, parameters) <= self.study.compare.table


def keys_of(
    study: Study, arms: tuple[Arm, ...], problems: tuple[ComparedProblem, ...]
) -> Iterator[Key]:
    """Yield every run, seed by seed: what is finished of a killed comparison is paired.

    Arms with fewer seeds take long, and come last.
    """
    seeds = study.compare.seeds
    whole, short = [a for a in arms if a.seeds == seeds], [a for a in arms if a.seeds < seeds]
    for group in (whole, short):
        for seed in range(seeds):
            for problem in problems:
                yield from (Key(problem.name, a.name, seed) for a in group if seed < a.seeds)


def _paired(keys: Mapping[str, Key]) -> list[tuple[str, int]]:
    return list(dict.fromkeys((key.problem, key.seed) for key in keys.values()))


def record_name(key: Key) -> str:
    """Return where the record of a run is kept."""
    return f"records/{key.problem}/{slug(key.arm)}/{key.seed:03d}.json"


def _table(problem: ComparedProblem, seed: int) -> str:
    return f"tables/{problem.name}/{_data_seed(problem, seed):03d}.npz"


def _data_seed(problem: ComparedProblem, seed: int) -> int:
    return seed if problem.fresh else 0


def _folder(problem: ComparedProblem) -> str:
    return str(problem.study.folder.resolve())

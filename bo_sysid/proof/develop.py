"""Development cases: the same generator, with answers that may be looked at.

>>> from bo_sysid.proof.develop import develop
>>> for study, truth in develop("studies/concealed/development.yaml", "runs/development"):
...     print(study.name, truth["effects"])
"""

import json
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path
from typing import Any

from bo_sysid.errors import StudyError
from bo_sysid.execution import OnProgress, Progress, map_jobs, silent
from bo_sysid.proof.case import draw_case
from bo_sysid.proof.conceal import write_case
from bo_sysid.proof.plan import Draw, plan
from bo_sysid.proof.suite import load_suite
from bo_sysid.runs import atomic
from bo_sysid.study import Study


def develop(
    suite: str | Path,
    folder: str | Path,
    *,
    cases: Collection[int] | None = None,
    overrides: Mapping[str, Any] | None = None,
    progress: OnProgress = silent,
) -> Iterator[tuple[Study, dict[str, Any]]]:
    """Yield the study of each case with its answer; cases that are on the disk are not drawn anew.

    Args:
        suite: file of a suite with a stated seed.
        folder: where the cases are kept, each with its answer as `truth.json`.
        cases: numbers of the cases, from 0; all where left out.
        overrides: values by key that replace what the suite says, such as ``{"cases": 200}``.
        progress: told after each case that is drawn.

    Raises:
        StudyError: the suite has no seed: it is for the proof, where nobody looks at answers.
        JobError: drawing failed for no fault of the suite.
    """
    path, folder, overrides = Path(suite).resolve(), Path(folder), dict(overrides or {})
    loaded = load_suite(path, overrides)
    if loaded.suite.seed is None:
        raise StudyError(f"{path}: has no seed; only development suites are drawn with answers")
    draws = plan(loaded)
    wanted = [d for k, d in enumerate(draws) if cases is None or k in cases]
    missing = {
        d.name: (path, overrides, folder, d)
        for d in wanted
        if not (folder / d.name / "truth.json").is_file()
    }
    for step, outcome in enumerate(map_jobs(_draw, missing), 1):
        if outcome.error is not None:
            raise outcome.failure(StudyError, f"{path}: {outcome.key}: {outcome.error}")
        progress(Progress(step, len(missing), outcome.key))
    for draw in wanted:
        place = folder / draw.name
        truth = json.loads((place / "truth.json").read_text(encoding="utf-8"))
        yield Study.load(place / "study.yaml"), truth


def _draw(job: tuple[Path, dict[str, Any], Path, Draw]) -> None:
    suite, overrides, folder, draw = job
    loaded = load_suite(suite, overrides)
    case = draw_case(draw, loaded)
    write_case(case, loaded, folder / draw.name)
    with atomic(folder / draw.name / "truth.json") as beside:
        beside.write_text(json.dumps(case.truth, indent=1), encoding="utf-8")

"""From a suite to scores: conceal, answer, reveal, each resumable."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from bo_sysid.execution import JobEngine, OnProgress, Progress, map_jobs, silent
from bo_sysid.proof.answer import LIMIT, answer, answers_at_opening, judged, openings_in
from bo_sysid.proof.conceal import CASES, COMMITMENTS
from bo_sysid.proof.page import page
from bo_sysid.proof.reveal import Revealed, require_published, require_seals, reveal
from bo_sysid.proof.score import Scores, score
from bo_sysid.proof.seal import file_digest
from bo_sysid.runs import Run, digest, versions

CASE_TABLE, EFFECT_TABLE, PAGE = "cases.parquet", "effects.parquet", "proof.html"
_ORACLE = "oracle.json"


@dataclass(frozen=True)
class OracleJob:
    """What a process needs for the oracle's error on one case.

    Attributes:
        case: folder of the case.
        truth: its answer.
    """

    case: Path
    truth: Mapping[str, Any]


def prove(
    run: Run,
    *,
    first: int | None = None,
    seals: str | Path | None = None,
    published: str | None = None,
    engine: JobEngine | None = None,
    limit: float = LIMIT,
    progress: OnProgress = silent,
) -> Scores:
    """Answer what is unanswered in a concealed run, open the seals, score, and write the scores.

    The run then holds `cases.parquet` and `effects.parquet`, a row for each case and for each
    concealed effect, and `proof.html`.

    Args:
        run: made by `conceal`.
        first: only so many of its cases, see `judged`.
        seals: folder of the seals; beside the run where left out.
        published: SHA-256 of `commitments.json`, where it was published elsewhere.
        engine: where the cases are diagnosed; processes of this machine by default.
        limit: longest time that the diagnosis of a case may take, in [s].
        progress: told after every case.

    Raises:
        RunError: a hash differs, or an answer came after the seals were opened.
    """
    require_published(run.folder, published)
    require_seals(run.folder, seals, judged(run.folder, first))
    answer(run, first=first, engine=engine, limit=limit, progress=progress)
    revealed = reveal(run, first=first, seals=seals, published=published)
    scores = _with_oracle(score(revealed), _oracle(run, revealed, engine, progress))
    run.write_frame(CASE_TABLE, scores.cases)
    run.write_frame(EFFECT_TABLE, scores.effects)
    run.write_text(PAGE, page(scores, _facts(run, revealed)))
    return scores


def _oracle(
    run: Run, revealed: tuple[Revealed, ...], engine: JobEngine | None, progress: OnProgress
) -> dict[str, float]:
    """Return the oracle's error by case, computed once by a version; NaN where there is none."""
    own = versions()
    there = run.read_json(_ORACLE) if run.has(_ORACLE) else {}
    kept: dict[str, float | None] = there["errors"] if there.get("versions") == own else {}
    folder = run.folder.resolve()
    jobs = {r.name: OracleJob(folder / CASES / r.name, r.truth) for r in revealed}
    done = set(kept)
    outcomes = map_jobs(_oracle_of, jobs, engine=engine, done=done)
    for step, outcome in enumerate(outcomes, len(done) + 1):
        if not outcome.error:  # what died is computed again by the next call
            kept[outcome.key] = outcome.result
            run.write_json(_ORACLE, {"versions": own, "errors": kept})
        progress(Progress(step, len(jobs), f"oracle {outcome.key}"))
    return {name: float("nan") if e is None else float(e) for name, e in kept.items()}


def _oracle_of(job: OracleJob) -> float | None:
    from bo_sysid.proof.oracle import oracle_error

    return oracle_error(job.case, job.truth)


def _with_oracle(scores: Scores, errors: Mapping[str, float]) -> Scores:
    """Return the scores with the oracle's error beside the others."""
    from bo_sysid.proof.score import forecasts

    cases = scores.cases.assign(oracle=[errors.get(n, np.nan) for n in scores.cases.index])
    return replace(scores, cases=cases, forecasts=forecasts(cases))


def _facts(run: Run, revealed: tuple[Revealed, ...]) -> dict[str, Any]:
    openings, committed = openings_in(run.folder), run.read_json(COMMITMENTS)
    suite = yaml.safe_load(run.path("study.yaml").read_text(encoding="utf-8"))["suite"]
    known = "stated in the suite: whoever has it can draw the answers"
    return {
        "suite": suite["name"],
        "seed": "from the operating system" if suite.get("seed") is None else known,
        "cases": f"{len(revealed)} of {len(committed['cases'])} that were drawn",
        "seals opened": ", ".join(o["opened"] for o in openings),
        "SHA-256 of the commitments": file_digest(run.path(COMMITMENTS)),
        "SHA-256 of the frozen answers": digest(answers_at_opening(openings)),
        "SHA-256 of the suite": committed["suite_sha256"],
        "cases drawn by": _told([committed["versions"]]),
        "answered by": _told([r.versions for r in revealed]),
    }


def _told(found: Sequence[Mapping[str, str]]) -> str:
    """Return versions in words, each state of them once."""
    return "; ".join(dict.fromkeys(", ".join(f"{k} {v}" for k, v in f.items()) for f in found))

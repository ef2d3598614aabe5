"""What the diagnosis finds on machines whose missing physics nobody knew.

Cases are drawn with a seed from the operating system, diagnosed, and revealed; see
`bo-sysid conceal` and `bo-sysid reveal`, which this runs one after the other. The run is kept under
`runs/`: begun anew only after it has been removed, since a second look at the same cases would no
longer be a proof. Other revealed runs of the same suite are scored with it, and each of them by
itself; `--stored` does that alone. `--quick` takes twenty cases.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd
import yaml
from common import Cases, benchmark

from bo_sysid.cli.progress import Lines
from bo_sysid.proof.conceal import COMMITMENTS, conceal, concealed_run, suite_record
from bo_sysid.proof.proof import CASE_TABLE, EFFECT_TABLE, prove
from bo_sysid.proof.score import Scores
from bo_sysid.proof.seal import file_digest
from bo_sysid.runs import Run

SUITES = Path(__file__).parents[1] / "studies" / "concealed"
RUNS = Path(__file__).parents[1] / "runs"


def figures(scores: Scores) -> dict[str, object]:
    """The rates of the proof, each with its interval and number of cases, and the calibration."""
    table = scores.summary
    calibration = scores.calibration
    return {
        "rates": {
            r["what"]: [round(r["rate"], 4), round(r["low"], 3), round(r["high"], 3), r["of"]]
            for r in table[table["of"] > 0].to_dict("records")
        },
        "calibration_error": calibration.error,
        "calibration_expected": calibration.expected,
        "forecasts": {
            name: {k: None if np.isnan(v) else v for k, v in row.items()}
            for name, row in scores.forecasts.to_dict("index").items()
        },
        "seconds_a_case": float(scores.cases.seconds.median()),
    }


def revealed_runs(name: str) -> list[Path]:
    """Return the revealed runs of a suite, each with cases of its own.

    Runs whose number of cases or machines was set (`conceal --set`) are strata of the same suite.
    """

    def suite(run: Path) -> str:
        record = yaml.safe_load((run / "study.yaml").read_text(encoding="utf-8"))
        return str(record["suite"]["name"])

    concealed = sorted(f.parent for f in RUNS.glob(f"*/{COMMITMENTS}"))
    return [r for r in concealed if (r / CASE_TABLE).is_file() and suite(r) == name]


def pooled(folders: Sequence[Path]) -> Scores:
    """Return the scores of the cases of several revealed runs."""
    tables = [
        pd.concat([pd.read_parquet(f / name) for f in folders])
        for name in (CASE_TABLE, EFFECT_TABLE)
    ]
    return Scores.of(*tables)


def run(quick: bool, cases: Cases) -> dict[str, object]:
    """Conceal, answer, reveal."""
    suite = SUITES / ("twenty.yaml" if quick else "proof.yaml")
    folder = RUNS / f"{suite.stem}-conceal"
    if cases.stored:
        return told(suite.stem)
    if not (folder / COMMITMENTS).is_file():
        with Run.open(folder, suite_record(suite, {}), "conceal") as opened:
            conceal(opened, suite, progress=Lines("conceal"))
    commitments = file_digest(folder / COMMITMENTS)
    print(f"commitments {commitments}", flush=True)
    with concealed_run(folder) as opened:
        prove(opened, progress=Lines("answer"))
    return told(suite.stem)


def told(name: str) -> dict[str, object]:
    """Return the figures of all revealed runs of a suite, and the rates of each."""
    folders = revealed_runs(name)
    if not folders:
        raise SystemExit(f"{RUNS} has no revealed run of the suite {name!r}: bo-sysid reveal RUN")
    return {
        "commitments": {f.name: file_digest(f / COMMITMENTS) for f in folders},
        **figures(pooled(folders)),
        "runs": {f.name: figures(pooled([f]))["rates"] for f in folders},
    }


if __name__ == "__main__":
    benchmark("concealed", run, partial=True)

"""What the diagnosis finds on machines whose missing physics nobody knew.

Cases are drawn with a seed from the operating system, diagnosed, and revealed; see
`bo-sysid conceal` and `bo-sysid reveal`, which this runs one after the other. The run is kept under
`runs/`: begun anew only after it has been removed, since a second look at the same cases would no
longer be a proof. `--quick` takes twenty cases.
"""

from pathlib import Path

import numpy as np
from common import Cases, benchmark

from bo_sysid.cli.progress import Lines
from bo_sysid.proof.conceal import COMMITMENTS, conceal, concealed_run, suite_record
from bo_sysid.proof.proof import prove
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


def run(quick: bool, cases: Cases) -> dict[str, object]:
    """Conceal, answer, reveal."""
    suite = SUITES / ("twenty.yaml" if quick else "proof.yaml")
    folder = RUNS / f"{suite.stem}-conceal"
    if not (folder / COMMITMENTS).is_file():
        with Run.open(folder, suite_record(suite, {}), "conceal") as opened:
            conceal(opened, suite, progress=Lines("conceal"))
    commitments = file_digest(folder / COMMITMENTS)
    print(f"commitments {commitments}", flush=True)
    with concealed_run(folder) as opened:
        scores = prove(opened, progress=Lines("answer"))
    return {"commitments": commitments, **figures(scores)}


if __name__ == "__main__":
    benchmark("concealed", run)

"""How long a diagnosis with the whole catalogue takes.

Dry friction is missing at the elbow of two of the machines of the diagnosis' benchmark, which moves
as it does there: 20 s of the two-link arm, 60 s of the six-joint arm with position servos. Timed is
`diagnose` of a study, from its files to what is said of a recording set aside (8 s), without
libraries, pictures and page. Seconds, the median of three runs and all of them.
"""

import tempfile
import time
from pathlib import Path

import numpy as np
from common import Cases, benchmark
from diagnosis_plant import Planted, simulate
from diagnosis_rigs import MODELS, RIGS, load

from bo_sysid import Study, diagnose
from bo_sysid.effects import survey

RUNS = 3
MACHINES = {"two_link_arm": (20.0, 0.05), "six_servos": (60.0, 0.5)}
"""Length of the recording in [s], friction over the joint's typical force."""
_SIGMA = 5e-4  # [rad] of noise


def study_of(rig: str, duration: float, share: float, folder: Path) -> Study:
    """Return a study of a machine whose elbow rubs, its recordings written to a folder."""
    model = load(rig)
    nominal = simulate(model, RIGS[rig], None, (), seed=1, duration=10.0, sigma=_SIGMA)
    machine = survey(model.compile(), [nominal])
    level = share * machine.joints["elbow"].force
    truth = [Planted("dry_friction", "joint", "elbow", (level,))]
    for name, seed, seconds in (("train", 2, duration), ("holdout", 3, 8.0)):
        made = simulate(model, RIGS[rig], machine, truth, seed=seed, duration=seconds, sigma=_SIGMA)
        made.to_frame().to_parquet(folder / f"{name}.parquet")
    (folder / "study.yaml").write_text(
        f"version: 1\nname: {rig}\nmodel: {(MODELS / RIGS[rig].file).resolve()}\n"
        "recordings: {train: [train.parquet], holdout: [holdout.parquet]}\n"
    )
    return Study.load(folder / "study.yaml")


def timed(rig: str, duration: float, share: float, runs: int) -> dict[str, object]:
    """Return the seconds of some diagnoses, and what was found."""
    seconds = []
    with tempfile.TemporaryDirectory() as folder:
        study = study_of(rig, duration, share, Path(folder))
        for _ in range(runs):
            started = time.perf_counter()
            result = diagnose(study)
            seconds.append(round(time.perf_counter() - started, 1))
            print(f"  {rig}: {seconds[-1]} s", flush=True)
    found = [f"{f.effect} at {f.site}" for f in result.answer.findings]
    return {"seconds": float(np.median(seconds)), "all": seconds, "found": found}


def run(quick: bool, cases: Cases) -> dict[str, object]:
    return {rig: timed(rig, *how, 1 if quick else RUNS) for rig, how in MACHINES.items()}


if __name__ == "__main__":
    benchmark("diagnosis_time", run)

"""How long a diagnosis with the whole catalogue takes.

Dry friction is missing at the elbow of two of the machines of the diagnosis' benchmark, which moves
as it does there: 20 s of the two-link arm, 60 s of the six-joint arm with position servos. Timed is
`diagnose` of a study, from its files to what is said of a recording set aside (8 s), without
libraries, pictures and page. Seconds, the median of three runs and all of them; beside them how
many steps of MuJoCo a diagnosis takes, and how many a second the bare engine makes of the same
model in the same minutes, so that machines can be compared.
"""

import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import mujoco
import numpy as np
from common import Cases, benchmark
from diagnosis_plant import Planted, simulate
from diagnosis_rigs import MODELS, RIGS, load
from mujoco.batch import Batch

from bo_sysid import Study, diagnose
from bo_sysid.effects import survey
from bo_sysid.execution import threads

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


def bare_rate(model: mujoco.MjModel, count: int = 100, steps: int = 100) -> float:
    """Return the steps a second of the bare engine on all cores, over two seconds."""
    batch, ctrl = Batch(model, count, threads()), np.zeros((count, steps, model.nu))
    began, done = time.perf_counter(), 0
    while time.perf_counter() < began + 2.0:
        batch.rollout(steps, control=ctrl)
        done += count * steps
    return done / (time.perf_counter() - began)


@contextmanager
def counted() -> Iterator[list[int]]:
    """Yield a list to which the steps of every call of the engine are added."""
    found: list[int] = []
    rollout, step = Batch.rollout, Batch.step

    def rolled(batch: Batch, nstep: int, *args: object, **kwargs: object) -> object:
        ids = kwargs.get("ids")
        found.append(nstep * (batch.nsim if ids is None else len(ids)))
        return rollout(batch, nstep, *args, **kwargs)

    def stepped(batch: Batch, *args: object, **kwargs: object) -> object:
        ids = kwargs.get("ids")
        found.append(int(kwargs.get("nstep", 1)) * (batch.nsim if ids is None else len(ids)))
        return step(batch, *args, **kwargs)

    Batch.rollout, Batch.step = rolled, stepped
    try:
        yield found
    finally:
        Batch.rollout, Batch.step = rollout, step


def timed(rig: str, duration: float, share: float, runs: int) -> dict[str, object]:
    """Return the seconds of some diagnoses, and what was found."""
    seconds, rate = [], bare_rate(load(rig).compile())
    with tempfile.TemporaryDirectory() as folder, counted() as steps:
        study = study_of(rig, duration, share, Path(folder))
        steps.clear()
        for _ in range(runs):
            started = time.perf_counter()
            result = diagnose(study)
            seconds.append(round(time.perf_counter() - started, 1))
            print(f"  {rig}: {seconds[-1]} s", flush=True)
    found = [f"{f.effect} at {f.site}" for f in result.answer.findings]
    return {
        "seconds": float(np.median(seconds)),
        "all": seconds,
        "million_steps": round(sum(steps) / runs / 1e6, 2),
        "bare_million_steps_a_second": round(rate / 1e6, 3),
        "found": found,
    }


def run(quick: bool, cases: Cases) -> dict[str, object]:
    return {rig: timed(rig, *how, 1 if quick else RUNS) for rig, how in MACHINES.items()}


if __name__ == "__main__":
    benchmark("diagnosis_time", run)

"""One outer loop of an arm: `learn` with the arm's acquisition, choice of model and stop rule."""

import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bo_sysid.compare.arms import Arm, remade
from bo_sysid.learn.learn import learn
from bo_sysid.runs import Run


@dataclass(frozen=True)
class LearnJob:
    """What a process needs for one outer loop.

    Attributes:
        study: resolved, of one seed.
        folder: that its paths are relative to.
        arm: how to search, choose and stop.
        seed: of everything drawn at random.
        place: folder of its own run, which an interrupted job resumes.
    """

    study: Mapping[str, Any]
    folder: str
    arm: Arm
    seed: int
    place: str


def run_learn(job: LearnJob) -> dict[str, Any]:
    """Learn a policy with few real trajectories.

    Returns:
        One value an iteration: trajectories, plant_return, plant_error, model_return, evaluations
        (how often Δ was computed so far) and steps, those of all trainings so far; and at the end:
        stopped and seconds (of this call).
    """
    data = dict(job.study)
    data["search"] = {
        **data["search"], "acquisition": job.arm.acquisition, "seed": job.seed
    }  # fmt: skip
    data["learn"] = {**data["learn"], "choose": job.arm.choose, "stop": job.arm.stop}
    study = remade(data, job.folder)
    began = time.perf_counter()
    place = Path(job.place)
    own, raised = study.resolved(relative_to=place), ["compare.seeds"]
    with Run.open(place, own, "learn", seed=job.seed, raised=raised) as run:
        learned = learn(study, run)
    if learned.waiting:
        raise study.error(("plant",), "a comparison of outer loops needs a simulated plant")
    table = learned.iterations
    columns = ("trajectories", "plant_return", "plant_error", "model_return")
    return {
        **{name: table[name].tolist() for name in columns},
        "evaluations": table["evaluations"].cumsum().tolist(),
        "steps": table["training_steps"].cumsum().tolist(),
        "stopped": learned.reason,
        "seconds": time.perf_counter() - began,
    }

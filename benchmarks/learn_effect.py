"""The outer loop on plants with a concealed effect, with diagnosis in the loop and without.

Arms, each with the same simulated steps a policy, on paired seeds:

- reference: TRPO on the plant itself, its effect and its parameters known.
- nominal: TRPO on the model as the study has it.
- without: the outer loop with `diagnose: never`, the best that B can do.
- with: the outer loop with `diagnose: auto`.

Every policy is evaluated on the plant from the same starts. Figures: interquartile means over
seeds, the paired ratio to the reference with its bootstrap interval, what the diagnosis said, and
real trajectories.

    python benchmarks/learn_effect.py [--quick] [--stored]
"""

import itertools
import sys
import time
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))

from common import Cases, benchmark
from learn import compared, on_plant, own_folder

from bo_sysid.execution import limit_threads, threads
from bo_sysid.learn.learn import learn
from bo_sysid.learn.scene import Scene
from bo_sysid.plants.build import build_plant
from bo_sysid.plants.environment import Environment
from bo_sysid.plants.load import make_environment
from bo_sysid.policy.train import train
from bo_sysid.runs import Run
from bo_sysid.study import Study

ROOT = Path(__file__).parent.parent
ARMS = ("reference", "nominal", "without", "with")
STUDIES, SEEDS = ("cartpole", "reacher"), 5
QUICK = {"policy.steps": 20_000, "learn.trajectories": 2, "learn.episodes": 4}


def study_of(task: str, seed: int, quick: bool, changed: dict[str, Any] | None = None) -> Study:
    """Return the study of a task with a seed."""
    more = {"search.seed": seed, **(QUICK if quick else {}), **(changed or {})}
    return Study.load(ROOT / "studies" / "hidden" / f"{task}.yaml", more)


def true_environment(scene: Scene) -> Environment:
    """Return the plant itself as an environment of training, which only this benchmark may."""
    plant = build_plant(scene.study)
    return make_environment(
        plant.task, plant._model, scene.environments, seed=scene.seed, stagger=True,
        threads=threads(), laws=plant._laws,
    )  # fmt: skip


def single(task: str, arm: str, seed: int, quick: bool, folder: Path) -> dict[str, Any]:
    """Return what one policy learned without the loop is worth."""
    scene = Scene.of(study_of(task, seed, quick))
    ones = np.ones(len(scene.parameters))  # every parameter of these studies is a scale
    own_folder(folder, scene.study)
    with limit_threads(1):
        made = true_environment(scene) if arm == "reference" else scene.training(ones, None, 1)
        steps = scene.study.policy.steps
        training = train(made, scene.settings, steps=steps, seed=seed, folder=folder)
        return {"returns": on_plant(scene, training.policy)}


def looped(task: str, arm: str, seed: int, quick: bool, folder: Path) -> dict[str, Any]:
    """Return what the outer loop came to."""
    never = {"learn.diagnose": "never"} if arm == "without" else {}
    study = study_of(task, seed, quick, never)
    started = time.perf_counter()
    with Run.open(folder, study.resolved(relative_to=folder), "learn", seed=seed) as run:
        learning = learn(study, run)
    assert learning.policy is not None
    return {
        "seconds": time.perf_counter() - started,
        "returns": on_plant(Scene.of(study), learning.policy),
        "trajectories": len(learning.trajectories),
        "chosen": learning.chosen,
        "reason": learning.reason,
        "notes": list(learning.notes),
    }


def case(task: str, arm: str, seed: int, quick: bool) -> dict[str, Any]:
    """Return one arm on one task with one seed."""
    kind = "quick" if quick else "full"
    folder = ROOT / "runs" / "benchmark-learn-effect" / kind / f"{task}-{arm}-{seed}"
    work = looped if arm in ("with", "without") else single
    return work(task, arm, seed, quick, folder)


def run(quick: bool, cases: Cases) -> dict[str, Any]:
    """Run every arm on every task with every seed, or take what is there."""
    found: dict[str, dict[str, list[dict[str, Any]]]] = {t: {a: [] for a in ARMS} for t in STUDIES}
    for seed, task, arm in itertools.product(range(1 if quick else SEEDS), STUDIES, ARMS):
        key = f"{task} {arm} {seed}"
        if not cases.stored or key in cases:
            found[task][arm].append(cases.get(key, partial(case, task, arm, seed, quick)))
    figures: dict[str, Any] = {}
    for task, arms in found.items():
        seeds = min(len(c) for c in arms.values())
        mean = {a: np.array([np.mean(c["returns"]) for c in arms[a][:seeds]]) for a in ARMS}
        figures[task] = {"seeds": seeds}
        for arm in ARMS if seeds else ():
            figures[task][arm] = compared(mean[arm], mean["reference"])
            figures[task][arm]["returns"] = mean[arm].round(1).tolist()
        for arm in ("without", "with") if seeds else ():
            told = arms[arm][:seeds]
            figures[task][arm]["trajectories"] = [c["trajectories"] for c in told]
            figures[task][arm]["seconds"] = [round(c["seconds"]) for c in told]
        figures[task]["said"] = [c["notes"] for c in arms["with"][:seeds]]
    return figures


if __name__ == "__main__":
    benchmark("learn_effect", run, partial=True)

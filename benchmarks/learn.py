"""The outer loop against its reference and its rivals, on plants that differ from the model.

Arms, each with the same simulated steps a policy, on paired seeds:

- true: TRPO on the plant's own parameters, the reference; its log is also that of TRPO straight on
  the plant, with every whole episode's time counted as a real trajectory.
- worst: TRPO on the corner of B that predicts the plant worst.
- method: `learn` as the study says: P sampled, the original stop rule.
- zhu: argmax P, the search ended by values, the loop by time out: after as many real trajectories
  as the method needed with the same seed, so that both have the same data to spend.
- uniform: TRPO with a model drawn from all of B in every episode (domain randomisation).
- nominal: TRPO on the model as it is, on the sets with 50 %.

Every policy is evaluated on the plant from the same starts. Figures: interquartile means over
seeds, and the paired ratio to the reference with its bootstrap interval. Seeds are run in turn, so
that after an interruption every task has about as many; `--stored` makes the figures of what is
finished and says of how many seeds.

    python benchmarks/learn.py [--quick] [--stored]
"""

import itertools
import json
import shutil
import sys
import time
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

sys.path.insert(0, str(Path(__file__).parent))

from common import Cases, benchmark
from learn_figure import draw

from bo_sysid.execution import limit_threads, threads
from bo_sysid.identify.problem import make_problem
from bo_sysid.learn.learn import learn
from bo_sysid.learn.scene import Scene
from bo_sysid.plants.build import build_plant
from bo_sysid.plants.environment import Environment
from bo_sysid.plants.excitation import smooth_random
from bo_sysid.policy.store import LearnedPolicy
from bo_sysid.policy.train import Training, train
from bo_sysid.runs import Run, atomic, plain
from bo_sysid.study import Study

HERE = Path(__file__).parent
ROOT = HERE.parent
ARMS = ("true", "worst", "method", "zhu", "uniform", "nominal")
STUDIES = ("cheetah", "hopper", "swimmer", "cheetah-wide", "hopper-wide", "swimmer-wide")
SEEDS, EPISODES, EVALUATION = 5, 100, 900_001
MORE = 10  # seeds of the reference and the method, whose ratio's interval is wide, on B by 10 %

QUICK = {
    "policy.batch": 2000,
    "policy.steps": 20_000,
    "learn.trajectories": 2,
    "learn.episodes": 4,
    "search.budget": 12,
}


def study_of(task: str, seed: int, quick: bool, changed: dict[str, Any] | None = None) -> Study:
    """Return the study of a task with a seed."""
    more = {"search.seed": seed, **(QUICK if quick else {}), **(changed or {})}
    if not quick:
        return Study.load(ROOT / "studies" / "seed" / f"{task}.yaml", more)
    return Study.load(Path(__file__).parent / "learn_quick" / f"{task}.yaml", more)


def truth(scene: Scene) -> np.ndarray:
    """Return the plant's parameter values, which only this benchmark may look at."""
    plant = scene.study.plant
    assert plant is not None
    return np.array([plant.parameters[p.name] for p in scene.parameters])


def worst(scene: Scene) -> np.ndarray:
    """Return the corner of B with the largest deviation from one recording of the plant."""
    plant = build_plant(scene.study)
    compiled = scene.model.compile()
    controls = smooth_random(compiled, 10.0, plant.control_timestep, seed=scene.seed)
    problem = make_problem(scene.study, [plant.record(controls)], threads=threads())
    corners = np.array(list(itertools.product(*scene.candidates.bounds.T)))
    return corners[problem.deviation(corners).deviation.argmax()]


def own_folder(folder: Path, study: Study) -> Path:
    """Return a folder of a study, emptied where another study was trained in it."""
    text = json.dumps(plain(study.resolved(relative_to=folder)), sort_keys=True)
    told = folder / "study.json"
    if folder.is_dir() and (not told.is_file() or told.read_text() != text):
        shutil.rmtree(folder)
    folder.mkdir(parents=True, exist_ok=True)
    told.write_text(text)
    return folder


def trained(scene: Scene, environment: Environment, folder: Path) -> Training:
    """Return the training of one policy; one that was interrupted goes on."""
    own_folder(folder, scene.study)
    return train(
        environment,
        scene.settings,
        steps=scene.study.policy.steps,
        seed=scene.seed,
        threads=threads(),
        folder=folder,
    )


def on_plant(scene: Scene, policy: LearnedPolicy) -> list[float]:
    """Return the policy's returns on the plant."""
    plant = build_plant(scene.study)
    return [float(r) for r in plant.evaluate(policy.act, EPISODES, seed=EVALUATION)]


def single(task: str, arm: str, seed: int, quick: bool, folder: Path) -> dict[str, Any]:
    """Return what one policy learned without the loop is worth."""
    scene = Scene.of(study_of(task, seed, quick))
    centre, spread = truth(scene), None
    if arm == "worst":
        centre = worst(scene)
    elif arm == "nominal":
        centre = np.ones(len(scene.parameters))  # every parameter of these studies is a scale
    elif arm == "uniform":
        spread = np.full(len(scene.candidates), 1 / len(scene.candidates))
    started = time.perf_counter()
    with limit_threads(1):
        training = trained(scene, scene.training(centre, spread, threads()), folder)
        seconds = time.perf_counter() - started
        returns = on_plant(scene, training.policy)
    log: pd.DataFrame = training.log
    whole = scene.environment(scene.compiled(centre), 1).episode_steps
    log["batch_return"] *= whole / scene.training(centre, None, 1).episode_steps
    return {
        "returns": returns,
        "point": centre.tolist(),
        "seconds": seconds,
        "curve": [(log["steps"] / whole).tolist(), log["batch_return"].tolist()],
    }


def looped(
    task: str, arm: str, seed: int, quick: bool, folder: Path, most: int | None
) -> dict[str, Any]:
    """Return what the outer loop came to; `most` real trajectories where they are given."""
    zhu = {"learn.choose": "argmax", "learn.stop": "zhu", "learn.epsilon": 0.02}
    changed = zhu if arm == "zhu" else {}
    if most is not None:
        changed["learn.trajectories"] = most
    study = study_of(task, seed, quick, changed)
    started = time.perf_counter()
    with Run.open(folder, study.resolved(relative_to=folder), "learn", seed=seed) as run:
        learning = learn(study, run)
    seconds = time.perf_counter() - started
    assert learning.policy is not None
    scene = Scene.of(study)
    table = learning.iterations
    return {
        "returns": on_plant(scene, learning.policy),
        "point": list(learning.chosen.values()),
        "trajectories": len(learning.trajectories),
        "curve": [table["trajectories"].tolist(), table["plant_return"].tolist()],
        "reason": learning.reason,
        "seconds": seconds,
    }


def case(task: str, arm: str, seed: int, quick: bool, most: int | None) -> dict[str, Any]:
    """Return one arm on one task with one seed."""
    kind = "quick" if quick else "full"
    folder = ROOT / "runs" / "benchmark-learn" / kind / f"{task}-{arm}-{seed}"
    if arm in ("method", "zhu"):
        return looped(task, arm, seed, quick, folder, most)
    return single(task, arm, seed, quick, folder)


def interquartile_mean(values: np.ndarray) -> np.ndarray:
    """Return the mean of the middle half of the last axis."""
    ordered = np.sort(values, axis=-1)
    cut = ordered.shape[-1] // 4
    return ordered[..., cut : ordered.shape[-1] - cut].mean(axis=-1)


def compared(own: np.ndarray, reference: np.ndarray) -> dict[str, float | None]:
    """Return interquartile mean, and its ratio to the paired reference with a 95 % interval."""
    rng = np.random.default_rng(0)
    drawn = rng.integers(len(own), size=(10_000, len(own)))
    level = interquartile_mean(own)
    below = interquartile_mean(reference)
    if not below > 0:
        return {"return": float(level), "ratio": None, "low": None, "high": None}
    under = np.maximum(interquartile_mean(reference[drawn]), 1e-9)
    low, high = np.quantile(interquartile_mean(own[drawn]) / under, [0.025, 0.975])
    return {
        "return": float(level),
        "ratio": float(level / below),
        "low": float(low),
        "high": float(high),
    }


def needed(cases: list[dict[str, Any]], share: float = 0.95) -> float:
    """Return after how many real trajectories TRPO on the plant reaches a share of its end."""
    found = []
    for one in cases:
        trajectories, returns = np.array(one["curve"])
        end = np.mean(returns[-max(len(returns) // 10, 1) :])
        found.append(trajectories[np.argmax(returns >= share * end)])
    return float(np.median(found))


def curves(cases: list[dict[str, Any]]) -> list[list[list[float]]]:
    """Return each seed's real trajectories and returns; long ones as means of five points."""
    told = []
    for one in cases:
        curve = np.array(one["curve"], float)
        if curve.shape[1] > 20:
            whole = curve.shape[1] // 5 * 5
            curve = curve[:, :whole].reshape(2, -1, 5).mean(axis=2)
        told.append(np.round(curve, 2).tolist())
    return told


def told(found: Mapping[str, list[dict[str, Any]]]) -> dict[str, Any]:
    """Return the figures of one task from the finished cases of each arm, seeds in order."""
    figures: dict[str, Any] = {}
    reference = [np.mean(c["returns"]) for c in found["true"]]
    for arm, cases in found.items():
        seeds = min(len(cases), len(reference))  # paired
        if not seeds:
            continue
        own = np.array([np.mean(c["returns"]) for c in cases[:seeds]])
        figures[arm] = {"seeds": seeds, **compared(own, np.array(reference[:seeds]))}
        figures[arm]["returns"] = own.round(1).tolist()
        if "trajectories" in cases[0]:
            figures[arm]["trajectories"] = [c["trajectories"] for c in cases[:seeds]]
            figures[arm]["seconds"] = [round(c["seconds"]) for c in cases[:seeds]]
    if found["true"]:
        figures["plant_trajectories"] = needed(found["true"])
    return figures


def seeds_of(task: str, arm: str) -> int:
    """Return how many paired seeds an arm has on a task."""
    wide = task.endswith("-wide")
    if arm == "nominal":
        return SEEDS if wide else 0
    return MORE if arm in ("true", "method") and not wide else SEEDS


def run(quick: bool, cases: Cases) -> dict[str, Any]:
    """Run every arm on every task with every seed, or take what is there."""
    tasks = ("pendulum", "cartpole") if quick else STUDIES
    found: dict[str, dict[str, list[dict[str, Any]]]] = {t: {a: [] for a in ARMS} for t in tasks}
    # seed by seed, so that after any interruption every task has about as many
    for arms, seed, task in itertools.product((ARMS[:3], ARMS[3:]), range(MORE), tasks):
        for arm in arms:
            if seed >= (int(arm != "nominal") if quick else seeds_of(task, arm)):
                continue
            key = f"{task} {arm} {seed}"
            if cases.stored and key not in cases:
                continue
            most = found[task]["method"][seed]["trajectories"] if arm == "zhu" else None
            one = cases.get(key, partial(case, task, arm, seed, quick, most))
            found[task][arm].append(one)
    figures = {task: told(found[task]) for task in tasks if found[task]["true"]}
    curve = {t: {a: curves(c) for a, c in found[t].items() if c} for t in figures}
    if not quick:
        draw(figures, curve, HERE / "figures" / "learn.png")
        with atomic(HERE / "figures" / "learn.json") as path:
            path.write_text(json.dumps(curve) + "\n")
    return figures


if __name__ == "__main__":
    benchmark("learn", run, partial=True)

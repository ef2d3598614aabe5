"""What an iteration of the outer loop ended with, and how it is read again."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from bo_sysid.arrays import Point
from bo_sysid.learn.identified import Identified
from bo_sysid.learn.repair import Repair
from bo_sysid.learn.scene import Scene
from bo_sysid.learn.stops import Verdict
from bo_sysid.policy.store import LearnedPolicy
from bo_sysid.runs import Run
from bo_sysid.study import Study


@dataclass(frozen=True)
class Iteration:
    """What an iteration ended with.

    Attributes:
        number: from 1.
        scene: study and model, repaired where a diagnosis found something.
        found: the belief.
        row: of B, what the policy was learned on.
        policy: what was learned.
        verdict: whether the loop ends.
        repairs: the diagnoses of the loop so far.
        figures: its entry in `learning.json`.
    """

    number: int
    scene: Scene
    found: Identified
    row: int
    policy: LearnedPolicy
    verdict: Verdict
    repairs: tuple[Repair, ...]
    figures: dict[str, Any]

    @property
    def point(self) -> Point:
        """The chosen parameter values."""
        return np.asarray(self.scene.candidates.points[self.row])


def reread(scene: Scene, before: Iteration | None, run: Run) -> Iteration | None:
    """Return the next iteration as it was written; None where it is not complete."""
    number = before.number + 1 if before else 1
    folder = f"iterations/{number:02d}"
    if not run.has(f"{folder}/iteration.json"):
        return None
    figures = run.read_json(f"{folder}/iteration.json")
    repairs = before.repairs if before else ()
    repair = stored_repair(run, folder)
    if repair is not None:
        repairs += (repair,)
        if repair.study is not None:
            scene = repaired_scene(scene, run, repair)
            folder = f"{folder}/repaired"
    found = Identified.read(run, folder)
    assert found is not None  # noqa: S101 - written before the iteration was
    policy = LearnedPolicy.load(run.path(f"iterations/{number:02d}/policy.npz"))
    exhausted = figures.get("spent", False)
    more = figures["trajectories"] < scene.study.learn.trajectories  # than when it was written
    stop = figures["stop"] and not (exhausted and more)
    verdict = Verdict(stop, figures["verdict"], budget_exhausted=exhausted)
    return Iteration(number, scene, found, figures["row"], policy, verdict, repairs, figures)


def repaired_scene(scene: Scene, run: Run, repair: Repair) -> Scene:
    """Return the scene of a repaired study; the task stays what it was."""
    assert repair.study is not None  # noqa: S101 - the caller looked
    limit = {"learn.trajectories": scene.study.learn.trajectories}  # may have been raised since
    study = Study.load(run.path(repair.study), limit, trust_code=bool(scene.study.code))
    return Scene.of(study, scene.task)


def stored_repair(run: Run, folder: str) -> Repair | None:
    """Return the diagnosis of an iteration as it was written; None where there was none."""
    if not run.has(f"{folder}/repair.json"):
        return None
    stored = run.read_json(f"{folder}/repair.json")
    return Repair(stored["study"], tuple(stored["sentences"]))

"""TRPO on a model of the loop; importing this module loads torch."""

import shutil
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

from bo_sysid.errors import RunError
from bo_sysid.execution import threads
from bo_sysid.learn.scene import Scene
from bo_sysid.plants.environment import Environment
from bo_sysid.policy.store import LearnedPolicy, read_arrays
from bo_sysid.policy.train import CHECKPOINT, LOG, Watch, train
from bo_sysid.runs import Run, atomic


class Beginning(NamedTuple):
    """Where a training begins.

    Attributes:
        iteration: whose checkpoint is taken over; None for none.
        go_on: train `policy.steps` more on the new model; otherwise these are the total, those of
            the checkpoint included.
    """

    iteration: int | None = None
    go_on: bool = False


def train_on(
    scene: Scene,
    environment: Environment,
    run: Run,
    number: int,
    start: Beginning,
    steps: int,
    watch: Watch,
) -> LearnedPolicy:
    """Return the policy learned in an environment, with checkpoints in the run folder.

    It says under ``training_steps`` how many control steps it took beyond those taken over.

    Args:
        scene: gives the settings.
        environment: of the chosen model.
        run: folder of the loop.
        number: of the iteration.
        start: where it begins.
        steps: control steps in all, those of a checkpoint that it begins with included unless it
            continues on a new model.
        watch: called after every batch.
    """
    folder = run.path(f"iterations/{number:02d}/training")
    before = _taken_over(run, start, folder) * scene.settings.batch
    trained = train(
        environment,
        scene.settings,
        steps=steps + (before if start.go_on else 0),
        seed=scene.seed,
        threads=threads(),
        folder=folder,
        about={"task": scene.task.name, "model": scene.model.source},
        watch=watch,
    )
    own = int(trained.log["steps"].iloc[-1]) - before
    return replace(trained.policy, about={**trained.policy.about, "training_steps": own})


def _taken_over(run: Run, start: Beginning, folder: Path) -> int:
    """Copy the checkpoint that a training begins with; return its number of batches."""
    if start.iteration is None:
        return 0
    old = run.path(f"iterations/{start.iteration:02d}/training")
    if not (old / CHECKPOINT).is_file():
        raise RunError(f"{old / CHECKPOINT}: missing; the run is damaged")
    for name in (LOG, CHECKPOINT):  # the checkpoint last: it makes the copy complete
        if not (folder / CHECKPOINT).is_file():
            with atomic(folder / name) as place:
                shutil.copyfile(old / name, place)
    return int(read_arrays(old / CHECKPOINT)[0]["iterations"])

"""The diagnosis within the loop: what the recordings show to be missing, put into the model."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bo_sysid.errors import UserError
from bo_sysid.execution import OnProgress
from bo_sysid.learn.scene import Scene
from bo_sysid.runs import Run
from bo_sysid.study import Study
from bo_sysid.study.inputs import study_effects

MOST = 2
"""Most diagnoses in a loop."""

_UNSEEN = "What was unseen is the last quarter by time of the same recordings."


@dataclass(frozen=True)
class Repair:
    """What a diagnosis led to.

    Attributes:
        study: path of the repaired study in the run folder; None where the loop keeps its own.
        sentences: what was found, or why nothing could be repaired.
    """

    study: str | None
    sentences: tuple[str, ...]


def repaired(
    scene: Scene, run: Run, training: Mapping[str, Any], number: int, progress: OnProgress
) -> Repair:
    """Diagnose what was recorded, and return the study to continue with.

    Args:
        scene: whose model explains too little.
        run: folder of the loop; the diagnosis has a run folder in it.
        training: the study's key `recordings` for what was recorded.
        number: of the iteration.
        progress: called after every stage.
    """
    from bo_sysid.diagnosis import diagnose

    folder = run.path(f"diagnosis-{number:02d}")
    data = scene.study.resolved(relative_to=folder)
    data["recordings"] = _relocated(training, run, folder)
    effects = study_effects(scene.study).values()
    further = [e.id for e in effects if e.hidden]  # joints that no policy could observe
    diagnosis = data.get("diagnosis", {})
    data["diagnosis"] = {**diagnosis, "exclude": sorted({*diagnosis.get("exclude", ()), *further})}
    trusted = bool(scene.study.code)
    folder.mkdir(exist_ok=True)  # paths that lead out of a folder lead out of one that is there
    try:
        study = Study.from_dict(data, folder, trust_code=trusted)
        with Run.open(folder, data, "diagnose", seed=scene.seed) as own:
            found = diagnose(study, own, progress=progress)
        path = folder / "study_repaired.yaml"
        study = Study.load(path, trust_code=trusted)
        if found.findings.empty and not study.model.beside:  # nor a law without a name
            return Repair(None, ("The diagnosis found nothing that it can name.", *found.sentences))
        other = Scene.of(study, scene.task)
        _require_same_coordinates(scene, other)
    except UserError as error:
        text = f"The diagnosis gave no study to go on with: {error}. The loop goes on as it was."
        return Repair(None, (text,))
    unseen = () if data["recordings"].get("holdout") else (_UNSEEN,)
    return Repair(str(path.relative_to(run.folder)), (*found.sentences, *unseen))


def _relocated(training: Mapping[str, Any], run: Run, folder: Path) -> dict[str, Any]:
    """Return the key `recordings` with paths relative to the folder of the diagnosis."""
    own = dict(training)
    own["train"] = [t if Path(t).is_absolute() else f"../{t}" for t in own.get("train", ())]
    if own.get("holdout"):
        own["holdout"] = [t if Path(t).is_absolute() else f"../{t}" for t in own["holdout"]]
    return own


def _require_same_coordinates(scene: Scene, other: Scene) -> None:
    """Refuse a repaired model whose policy would observe or command something else."""
    sizes = []
    for s in (scene, other):
        environment = s.environment(s.compiled(s.candidates.points[0]), 1)
        model = s.model.compile()
        sizes.append((model.nq, model.nv, environment.observation_size, environment.action_size))
    if sizes[0] != sizes[1]:
        raise UserError(
            "the repaired model has further joints or actuators, which the task would observe "
            "or command"
        )

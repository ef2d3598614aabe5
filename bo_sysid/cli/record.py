"""`bo-sysid record`: roll the plant of a study out into recordings."""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from bo_sysid.cli.common import Verbs, add_out, add_study, load_study, open_run
from bo_sysid.cli.progress import shown

if TYPE_CHECKING:
    from bo_sysid.execution import Report
    from bo_sysid.runs import Run
    from bo_sysid.study import Study


def add_parser(verbs: "Verbs[argparse.ArgumentParser]") -> None:
    """Add the verb."""
    parser = verbs.add_parser(
        "record",
        help="roll a simulated plant out into recordings",
        description="Move the plant of a study (its key plant) and write what its sensors tell, "
        "with a study on these recordings beside them.",
    )
    add_study(parser)
    add_out(parser)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> None:
    """Record, and print where."""
    study = load_study(args)
    with open_run(args, study, "record") as run, shown("record") as progress:
        path = record_into(run, study, args.study.stem, progress)
    print(f"{path.parent}: recordings of the plant. Now: bo-sysid identify {path}")


def record_into(run: "Run", study: "Study", name: str, progress: "Report") -> Path:
    """Write recordings of the study's plant into a run folder.

    Args:
        run: the run folder.
        study: its `plant` says what is recorded.
        name: of the study file that is written beside the recordings; a run folder has a file
            `study.yaml` of its own, so that ``study`` becomes `study_recorded.yaml`.
        progress: told after every recording.

    Returns:
        The path of the study on these recordings.

    Raises:
        StudyError: the study has no plant.
        UserError: the plant cannot be built or fails.
    """
    import yaml

    from bo_sysid.execution import Progress
    from bo_sysid.plants.build import build_plant, record
    from bo_sysid.plants.limits import limit_edits
    from bo_sysid.plants.python_task import PythonTask
    from bo_sysid.recording.writers import write_recording
    from bo_sysid.study.inputs import load_model

    if study.plant is None:
        raise study.error(("plant",), "record needs this key: it says what the machine is like")
    wanted = study.plant.record
    names = [f"train-{k}" for k in range(wanted.train)]
    names += [f"holdout-{k}" for k in range(wanted.holdout)]
    plant, model = build_plant(study), load_model(study)
    if isinstance(plant.task, PythonTask):
        progress(Progress(0, len(names), plant.task.notice))
    for number, title in enumerate(names):
        (recording,) = record(
            plant,
            model,
            1,
            duration=wanted.seconds,
            excitation=wanted.excitation,
            seed=study.search.seed + number,
            warmstart=wanted.warmstart,
            limits=limit_edits(study, model),
        )
        write_recording(recording, run.path(f"{title}.parquet"))
        progress(Progress(number + 1, len(names), title))
    recorded = study.resolved(relative_to=run.folder)
    noise = recorded["recordings"].get("noise", {})
    recorded["recordings"] = {
        "train": ["train-*.parquet"],
        "holdout": ["holdout-*.parquet"],
        "noise": noise,
    }
    file = "study_recorded.yaml" if name.lower() == "study" else f"{name}.yaml"
    return run.write_text(file, yaml.safe_dump(recorded, sort_keys=False))

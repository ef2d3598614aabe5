"""Recordings of the plant that a study describes, with a study on them."""

from collections.abc import Iterator, Sequence
from pathlib import Path

from bo_sysid.execution import OnProgress, Progress, silent
from bo_sysid.plants.build import build_plant, driven_within, record
from bo_sysid.plants.limits import limit_edits, require_ranges
from bo_sysid.plants.plant import Trajectory
from bo_sysid.plants.python_task import PythonTask
from bo_sysid.recording import read_recording
from bo_sysid.recording.writers import write_recording
from bo_sysid.runs import Run, versions
from bo_sysid.study import Study
from bo_sysid.study.inputs import fingerprints, load_model
from bo_sysid.yaml_text import dumped

_MADE_OF = "recorded.json"
"""What the recordings of a run were made of: hashes of files, versions."""
_SEEDS = 1_009  # between two seeds of a study: none has an excitation of another
_ROUNDING = 1e-6  # [s]


def record_into(
    run: Run, study: Study, name: str, progress: OnProgress = silent
) -> tuple[Path, tuple[str, ...]]:
    """Write recordings of the study's plant into a run folder.

    Those that an interrupted call left are kept where nothing that they depend on has changed.

    Args:
        run: the run folder.
        study: its `plant` says what is recorded.
        name: of the study file that is written beside the recordings; a run folder has a file
            `study.yaml` of its own, so that ``study`` becomes `study_recorded.yaml`.
        progress: called after every recording.

    Returns:
        The path of the study on these recordings, and what to know of them.

    Raises:
        StudyError: the study has no plant.
        UserError: the plant cannot be built or fails, or an actuator has no control range.
    """
    if study.plant is None:
        raise study.error(("plant",), "record needs this key: it says what the machine is like")
    wanted = study.plant.record
    names = [f"train-{k}" for k in range(wanted.train)]
    names += [f"holdout-{k}" for k in range(wanted.holdout)]
    plant, model = build_plant(study), load_model(study)
    limits = limit_edits(study, model)
    if driven_within(plant) is None:
        require_ranges(study, model.compile(limits))
    if isinstance(plant.task, PythonTask):
        progress(Progress(0, len(names), plant.task.notice))
    done = _done(run, study, names)
    plant.resume([Trajectory(f"{plant.name}-{k}", 0, 0.0) for k in range(done)])
    for number, title in enumerate(names[done:], done):
        (recording,) = record(
            plant,
            model,
            1,
            duration=wanted.seconds,
            excitation=wanted.excitation,
            seed=study.search.seed * _SEEDS + number,
            warmstart=wanted.warmstart,
            limits=limits,
        )
        write_recording(recording, run.path(f"{title}.parquet"))
        progress(Progress(number + 1, len(names), title))
    recorded = study.resolved(relative_to=run.folder)
    recorded["recordings"] = {
        "train": ["train-*.parquet"],
        "holdout": ["holdout-*.parquet"],
        "noise": recorded["recordings"].get("noise", {}),
    }
    file = "study_recorded.yaml" if name.lower() == "study" else f"{name}.yaml"
    path = run.write_text(file, dumped(recorded))
    return path, tuple(_broken_off(run, names, wanted.seconds - plant.control_timestep))


def _broken_off(run: Run, names: Sequence[str], least: float) -> Iterator[str]:
    """Say which recordings are shorter than at least asked, in [s]."""
    for name in names:
        lasted = read_recording(run.path(f"{name}.parquet")).duration
        if lasted < least - _ROUNDING:
            yield (
                f"{name} breaks off after {lasted:.3g} s: the task ended, or the machine "
                "left its limits"
            )


def _done(run: Run, study: Study, names: Sequence[str]) -> int:
    """Return how many recordings are there already, made of the same files by the same packages."""
    now = {"files": fingerprints(study, recorded=False), "versions": versions()}
    if not (run.has(_MADE_OF) and run.read_json(_MADE_OF) == now):
        for name in names:
            run.path(f"{name}.parquet").unlink(missing_ok=True)
        run.write_json(_MADE_OF, now)
    return next((k for k, n in enumerate(names) if not run.has(f"{n}.parquet")), len(names))

"""Learning: the outer loop, from a study to a policy that works on the real machine.

    record → identify on all recordings → choose β → learn on the model at β → stop or go on

The policy of each iteration is what the next trajectory is recorded with.
"""

import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from bo_sysid.belief.stopping import StopReason
from bo_sysid.errors import RunError, StudyError, UserError
from bo_sysid.execution import OnProgress, limit_threads, silent
from bo_sysid.learn.floor import lacks_physics
from bo_sysid.learn.hand_over import cautions, how_to_run, write_for_machine
from bo_sysid.learn.identified import is_long
from bo_sysid.learn.iterate import ProgressReporter, iterate
from bo_sysid.learn.iteration import Iteration, reread
from bo_sysid.learn.machine_source import MachineSource
from bo_sysid.learn.plant_source import PlantSource
from bo_sysid.learn.scene import Scene
from bo_sysid.learn.source import Source
from bo_sysid.plants.build import foreign_task
from bo_sysid.plants.python_task import PythonTask
from bo_sysid.policy.store import LearnedPolicy
from bo_sysid.runs import Run
from bo_sysid.study import Study
from bo_sysid.study.inputs import changed, fingerprints

INPUTS = "inputs.json"
_UNTRIED = (
    "No policy of this run has acted on the machine: what it does there is foretold by the model "
    "alone. Record it there; `learn: {stop: timeout}` asks for such recordings, and goes on from "
    "them."
)
_INFORMATIVE = 2.0  # times the noise in Δ that the worst candidate leaves, where Δ is informative


@dataclass(frozen=True)
class Learning:
    """What the outer loop came to.

    Attributes:
        name: of the study.
        policy: the last policy; None where none was learned yet.
        chosen: the parameter values that it was learned on.
        iterations: one row an iteration: trajectories, evaluated (rows of B so far), evaluations
            (how often Δ was computed in it: of rows of before on all recordings again, of new ones,
            and before a repair), entropy, deviation, training_steps (control steps simulated to
            learn its policy, without those taken over), episodes, model_return and plant_return
            over so many with their standard errors.
        trajectories: one row a real trajectory: number, name, steps, seconds, reward, fault.
        given_seconds: length of each recording that the study names, where a machine has no plant.
        reason: why the loop ended; empty where it waits.
        waiting: what a person has to record before it goes on; empty where it ended.
        notes: diagnoses, and what was done otherwise than the study may suggest.
    """

    name: str
    policy: LearnedPolicy | None
    chosen: dict[str, float]
    iterations: pd.DataFrame
    trajectories: pd.DataFrame
    given_seconds: tuple[float, ...]
    reason: str
    waiting: str
    notes: tuple[str, ...]


def learn(
    study: Study, run: Run | None = None, *, progress: OnProgress = silent, strict: bool = False
) -> Learning:
    """Learn a policy with few real trajectories.

    Args:
        study: names the task, the model, what is uncertain, and the plant; without a plant the
            machine is a person's, and the loop waits for recordings.
        run: folder that keeps every phase; an interrupted run, resumed, has the result that it
            would have had. By default a temporary one, where the study has a plant.
        progress: called after every phase.
        strict: refuse messy recordings of a person's machine.

    Raises:
        UserError: the study, its model, its task or a recording is wrong, or a person's machine
            has no run folder to take the policy from and put its recording into.
    """
    import torch  # noqa: F401 - before threads are limited, or its own would not be

    if run is not None:
        # simulations have threads of their own; those of linear algebra would change roundings,
        # and with them the result of a resumed run
        with limit_threads(1):
            return _learned(study, run, progress, strict)
    if study.plant is None:
        raise UserError(
            "learning on a machine of your own needs a run folder, for its policies and "
            "recordings: learn(study, run)"
        )
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place) / "run"
        with Run.open(folder, study.resolved(relative_to=folder), "learn") as own:
            return learn(study, own, progress=progress, strict=strict)


def _learned(study: Study, run: Run, progress: OnProgress, strict: bool) -> Learning:
    scene = Scene.of(study)
    _require_unchanged(study, run)
    source = PlantSource(scene, run) if study.plant else MachineSource(scene, run, strict)
    report = ProgressReporter(progress, study.learn.trajectories)
    done: list[Iteration] = []
    while not done or not done[-1].verdict.stop:
        before = done[-1] if done else None
        number = len(done) + 1
        now = before.scene if before else scene
        waiting = source.take(number, before.policy if before else None, now)
        if waiting is not None:
            return _write_results(study, scene, source, done, run, waiting.message)
        done.append(reread(now, before, run) or iterate(now, source, before, run, report))
    return _write_results(study, scene, source, done, run)


def _require_unchanged(study: Study, run: Run) -> None:
    """Refuse to resume a run under another model or other files that it needs.

    The first recordings of a person's machine are checked by their source.

    Raises:
        RunError: the message names what changed.
    """
    run.require_same_packages()
    now = fingerprints(study, recorded=False)
    what = changed(run.read_json(INPUTS), now) if run.has(INPUTS) else ""
    if what:
        raise RunError(
            f"{run.folder}: {what} changed since this run began; use another --out, or remove the "
            "folder"
        )
    run.write_json(INPUTS, now)


def _write_results(
    study: Study,
    scene: Scene,
    source: Source,
    done: list[Iteration],
    run: Run,
    waiting: str = "",
) -> Learning:
    """Write what was found so far, and return it."""
    last = done[-1]
    result = Learning(
        study.name,
        last.policy,
        last.figures["chosen"],
        _table(done),
        source.trajectories,
        tuple(r.duration for r in source.given),
        "" if waiting else last.verdict.sentence,
        waiting,
        _notes(scene, done, source),
    )
    last.policy.save(run.path("policy.npz"))
    about = write_for_machine(last.scene, last.policy, run, "policy")
    run.write_frame("trajectories.parquet", result.trajectories)
    run.write_frame("iterations.parquet", result.iterations)
    run.write_frame("training.parquet", _log(done, run))
    to_run = [] if waiting or study.plant else _to_run(run, about, len(source.trajectories))
    run.write_json("learning.json", {**_summary(result, done), "to_run": to_run})
    return result


def _to_run(run: Run, about: Mapping[str, Any], given: int) -> list[str]:
    """Return how the last policy is run on a person's machine.

    Args:
        run: holds the policy.
        about: what the policy takes and gives.
        given: how many trajectories of policies were recorded.
    """
    untried = [] if given else [_UNTRIED]
    file = f"The policy for the machine is {run.path('policy.pt')}."
    return [f"{file} {how_to_run(about)}", *cautions(about), *untried]


def _table(done: list[Iteration]) -> pd.DataFrame:
    rows = []
    for i in done:
        f = i.figures
        rows.append(
            {
                "iteration": i.number,
                "trajectories": f["trajectories"],
                "evaluated": f["evaluated"],
                "evaluations": f["evaluations"],
                "entropy": f["entropy"],
                "deviation": f["floor"]["deviation"],
                "floor": i.found.floor.expected,
                "training_steps": f["training_steps"],
                "episodes": f["model_return"].get("samples", np.inf),
                "model_return": f["model_return"]["mean"],
                "model_error": f["model_return"]["error"],
                "plant_return": f["plant_return"]["mean"] if f["plant_return"] else None,
                "plant_error": f["plant_return"]["error"] if f["plant_return"] else None,
                "diagnosed": f["diagnosis"] is not None,
            }
        )
    return pd.DataFrame(rows)


def _log(done: list[Iteration], run: Run) -> pd.DataFrame:
    """Return the log of TRPO of all iterations, one row a batch.

    A training that began with the checkpoint of another has its batches in its own log as well:
    they belong to the iteration that simulated them.
    """
    parts: list[pd.DataFrame] = []
    for i in done:
        log = run.read_frame(f"iterations/{i.number:02d}/training/iterations.parquet")
        begun = log["steps"].iloc[-1] - i.figures["training_steps"]
        log.insert(0, "learned", i.number)
        parts.append(log[log["steps"] > begun])
    return pd.concat([part for part in parts if len(part)], ignore_index=True)


def _notes(scene: Scene, done: list[Iteration], source: Source) -> tuple[str, ...]:
    notes = [s for i in done if i.figures["diagnosis"] for s in i.figures["diagnosis"]]
    relative = [p.name for p in done[-1].scene.parameters if p.apply != "set"]
    if relative and any(r.study for r in done[-1].repairs):
        notes.append(f"values of {', '.join(relative)} are relative to the repaired model")
    notes += doubts(done[-1])
    if isinstance(scene.task, PythonTask):
        notes.append(scene.task.notice)
    elif foreign := foreign_task(scene.study, scene.model):
        notes.append(foreign)
    if not scene.study.plant:
        notes += [n for r in source.recordings(scene.study) for n in r.notes]
    elif _recorded(scene.study):
        notes.append("recordings.train: not read, since the study has a plant, which makes its own")
    if scene.study.search.refine:
        notes.append("search.refine zooms in identify; learn keeps to the stated B")
    faults = [fault for fault in source.trajectories["fault"] if fault]
    notes += [f"{fault}; what was recorded until then is used" for fault in faults]
    horizon = scene.study.deviation.horizon  # a loop goes on only where a recording is as long
    notes += [
        f"{r.name}: too short for a window of {horizon} instants (deviation.horizon), not compared"
        for r in source.recordings(scene.study)
        if not is_long(r, horizon)
    ]
    return tuple(dict.fromkeys(notes))


def _recorded(study: Study) -> bool:
    """Whether training recordings of a study are there."""
    try:
        return bool(study.train_files)
    except StudyError:  # none matches
        return False


def doubts(last: Iteration) -> list[str]:
    """Return why the last policy may not be the machine's: what B and the model do not hold."""
    floor, sentences = last.found.floor, [last.found.moved] if last.found.moved else []
    for p in last.scene.parameters:
        name, value, ends = p.name, last.figures["chosen"][p.name], (p.low, p.high)
        if p.ordered and np.isclose(value, ends, rtol=1e-9, atol=0.0).any():
            sentences.append(f"{name} = {value:.4g} is an end of B; widen it if it may lie beyond")
    most = float(last.found.deviation.max())
    if most < _INFORMATIVE * floor.noise:
        deviation = last.scene.study.deviation
        sentences.append(
            f"the worst of the candidates that were tried leaves {most / floor.noise:.1f} times "
            f"what the sensors' noise alone makes: over {deviation.horizon} recorded "
            f"instant{'' if deviation.horizon == 1 else 's'} (deviation.horizon) parameters change "
            "little; "
            "a longer horizon"
            + ("" if deviation.starts == "fitted" else ", or starts: fitted,")
            + " tells them better apart"
        )
    if last.found.reason is StopReason.BUDGET and floor.is_above:
        sentences.append(
            f"{floor.ratio:.1f} times what noise and the spacing of B leave is left, and the "
            "search used up search.budget: with more it finds a better candidate, or that none "
            "explains the recordings; what the model lacks is looked for then"
        )
    if lacks_physics(floor, last.found.reason):
        diagnoses = last.scene.study.learn.diagnose != "never"
        hint = "" if diagnoses else "; learn: {diagnose: auto} looks for what it lacks"
        sentences.append(
            f"no candidate explains the recordings: {floor.ratio:.1f} times what noise and the "
            f"spacing of B leave is left{hint}"
        )
    return sentences


def _summary(result: Learning, done: list[Iteration]) -> dict[str, Any]:
    """Return the content of `learning.json`."""
    return {
        "name": result.name,
        "status": "waiting" if result.waiting else "finished",
        "stopped": result.reason,
        "waiting": result.waiting,
        "trajectories": len(result.trajectories),
        "seconds_recorded": float(result.trajectories["seconds"].sum()),
        "given": len(result.given_seconds),
        "given_seconds": float(sum(result.given_seconds)),
        "chosen": result.chosen,
        "policy": "policy.npz",
        "commands": "policy.pt",
        "iterations": [i.figures for i in done],
        "notes": list(result.notes),
    }

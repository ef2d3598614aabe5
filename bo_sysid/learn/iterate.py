"""One iteration of the outer loop, phase by phase; every phase leaves a file and is not repeated.

A run that is killed goes through its iterations again: what is there is read, the first phase that
is not there is computed. Every phase follows from the files before it and the study's seed, so that
the result is the one of a run that was never killed.
"""

from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from jaxtyping import Int

from bo_sysid.arrays import Probabilities
from bo_sysid.errors import RecordingError
from bo_sysid.execution import OnProgress, Progress, threads
from bo_sysid.learn.choose import CHOOSE
from bo_sysid.learn.floor import lacks_physics
from bo_sysid.learn.hand_over import beyond_limits, command_range, machine_names
from bo_sysid.learn.identified import Identified, identified
from bo_sysid.learn.iteration import Iteration, repaired_scene, stored_repair
from bo_sysid.learn.repair import MOST, Repair, repaired
from bo_sysid.learn.scene import Scene
from bo_sysid.learn.source import Source
from bo_sysid.learn.stops import STOP_RULES, Verdict, distances, near_enough, value_guided
from bo_sysid.learn.values import Values, values
from bo_sysid.policy.store import LearnedPolicy
from bo_sysid.policy.trainer import TrainingIteration
from bo_sysid.runs import Run, finite

PHASES = 4  # of an iteration, for its progress
_CONVERGED = 0.95  # probability of the chosen candidate from which on the belief has converged


@dataclass(frozen=True)
class ProgressReporter:
    """Reports the progress of the loop, four phases an iteration."""

    on_progress: OnProgress
    of: int

    def __call__(self, number: int, phase: int, message: str) -> None:
        """Report that a phase of an iteration is done."""
        step = min(PHASES * (number - 1) + phase, PHASES * self.of)
        self.on_progress(Progress(step, PHASES * self.of, f"iteration {number}: {message}"))


@dataclass(frozen=True)
class _Step:
    """What every phase of one iteration needs beside the scene, which a repair may change.

    Attributes:
        source: of real trajectories, which has recorded one more.
        before: the iteration before; None in the first.
        run: folder of the loop.
        report: called after every phase.
    """

    source: Source
    before: Iteration | None
    run: Run
    report: ProgressReporter

    @property
    def number(self) -> int:
        """Number of the iteration, from 1 on."""
        return self.before.number + 1 if self.before else 1

    @property
    def folder(self) -> str:
        """Folder of the iteration, within that of the loop."""
        return f"iterations/{self.number:02d}"

    @property
    def repairs(self) -> tuple[Repair, ...]:
        """The repairs of the iterations before."""
        return self.before.repairs if self.before else ()

    def done(self, phase: int, message: str) -> None:
        """Report that a phase is done."""
        self.report(self.number, phase, message)


def iterate(
    scene: Scene, source: Source, before: Iteration | None, run: Run, report: ProgressReporter
) -> Iteration:
    """Identify on all recordings, choose a candidate, learn a policy on it, and judge.

    Args:
        scene: of the study, or the repaired one.
        source: has recorded one trajectory more.
        before: the iteration before; None in the first.
        run: folder of the loop.
        report: called after every phase.
    """
    step = _Step(source, before, run, report)
    count = len(source.trajectories)
    step.done(1, f"{count} real trajector{'y' if count == 1 else 'ies'}")
    known = before.found.rows if before else np.zeros(0, int)
    found = _identified(scene, step, known, step.folder)
    evaluations = len(found.rows)  # those of before were evaluated again
    step.done(2, f"least deviation {found.floor.deviation:.4g}")
    repair, repairs = _repaired(scene, step, found), step.repairs
    if repair is not None:
        repairs += (repair,)
        if repair.study is not None:
            scene = repaired_scene(scene, run, repair)
            none = np.zeros(0, int)  # the repaired model has other candidates
            found = _identified(scene, step, none, f"{step.folder}/repaired")
            evaluations += len(found.rows)
    row = _chosen(scene, found, step.number)
    policy = _learned(scene, step, found, row)
    step.done(3, "policy learned")
    verdict = _judged(scene, step, found, row, policy)
    figures = _figures(scene, step, found, row, policy, verdict, repair)
    figures["evaluations"] = evaluations
    result = Iteration(step.number, scene, found, row, policy, verdict, repairs, figures)
    run.write_json(f"{step.folder}/iteration.json", figures)
    step.done(4, verdict.sentence)
    return result


def _identified(scene: Scene, step: _Step, known: Int[np.ndarray, " k"], folder: str) -> Identified:
    """Return the belief after all trajectories, as a folder has it or after a search.

    Args:
        scene: gives the candidates.
        step: the iteration.
        known: rows that begin the search.
        folder: where the belief is kept.
    """
    stored = Identified.read(step.run, folder)
    if stored is not None:
        return stored
    learn, value_stop, source = scene.study.learn, None, step.source
    if STOP_RULES[learn.stop].guided and step.before is not None:
        valued = partial(value_candidates, scene, step.before.policy)

        def value_stop(probabilities: Probabilities) -> Verdict:
            return value_guided(probabilities, learn.epsilon, learn.eta, valued)

    try:
        found = identified(scene, source.recordings(scene.study), known, value_stop, source.noise)
    except RecordingError as error:
        faults = [fault for fault in source.trajectories["fault"] if fault]
        if not faults:
            raise
        raise RecordingError("; ".join([str(error), *faults])) from None
    found.write(step.run, folder, scene.candidates)
    return found


def _repaired(scene: Scene, step: _Step, found: Identified) -> Repair | None:
    """Diagnose, where no candidate will do and no diagnosis was in vain before."""
    stored = stored_repair(step.run, step.folder)
    if stored is not None:
        return stored
    hopeless = len(step.repairs) >= MOST or any(r.study is None for r in step.repairs)
    if scene.study.learn.diagnose == "never" or hopeless:
        return None
    if not lacks_physics(found.floor, found.reason):
        return None
    ratio = found.floor.ratio
    step.done(2, f"no candidate explains the recordings ({ratio:.1f} x noise): diagnosis")

    def diagnosing(progress: Progress) -> None:
        if not progress.passing:
            step.done(2, f"diagnosis: {progress.message}")

    repair = repaired(scene, step.run, step.source.training, step.number, diagnosing)
    content = {"study": repair.study, "sentences": list(repair.sentences)}
    step.run.write_json(f"{step.folder}/repair.json", content)
    return repair


def _chosen(scene: Scene, found: Identified, number: int) -> int:
    rng = np.random.default_rng((scene.seed, number, 4))
    return CHOOSE[scene.study.learn.choose](found.probabilities, found.mean, rng)


def _learned(scene: Scene, step: _Step, found: Identified, row: int) -> LearnedPolicy:
    """Learn a policy by TRPO on the model at the chosen candidate, or over P_boot.

    A fresh policy begins with the networks and the draws of every other one: they differ by their
    models alone, and none inherits what a wrong model taught it. A warm one resumes from the
    previous checkpoint, under the new model.
    """
    place = step.run.path(f"{step.folder}/policy.npz")
    if place.is_file():
        return LearnedPolicy.load(place)

    from bo_sysid.learn.training import Beginning, train_on  # needs torch

    point = scene.candidates.points[row]
    probabilities = found.bootstrap if scene.study.learn.models == "bootstrap" else None

    def watch(batch: TrainingIteration) -> None:
        step.done(2, f"TRPO {batch.steps} steps, return {batch.batch_return:.4g}")

    environment = scene.training(point, probabilities, threads())
    start, before = Beginning(), step.before
    same = before is not None and before.scene is scene  # no repair in between
    if before and same and scene.study.policy.start == "warm":
        start = Beginning(before.number, go_on=True)
    elif before and same and probabilities is None and before.row == row:
        start = Beginning(before.number)  # the same training: its result is taken over
    steps = _steps(scene, step, found, row)
    policy = train_on(scene, environment, step.run, step.number, start, steps, watch)
    about = {**policy.about, "iteration": step.number, "beta": _named(scene, row)}
    about["beyond_limits"] = beyond_limits(scene, policy, point)
    about["commands"] = dict(zip(("low", "high"), command_range(scene), strict=True))
    about["machine"] = machine_names(scene)
    policy = replace(policy, about=about)
    policy.save(place)
    return policy


def value_candidates(
    scene: Scene, policy: LearnedPolicy, rows: Int[np.ndarray, " K"], times: int
) -> Values:
    """Return the returns of a policy on candidates.

    Args:
        scene: the candidates and the task.
        policy: what acts.
        rows: of the candidates.
        times: episodes on each, from the same starts.
    """
    models = [scene.compiled(scene.candidates.points[row]) for row in rows]
    act = policy.acting(*command_range(scene))  # it may be of before a repair
    return values(scene, models, act, threads=threads(), times=times)


def _judged(
    scene: Scene, step: _Step, found: Identified, row: int, policy: LearnedPolicy
) -> Verdict:
    """Return whether the loop ends: by its rule, or because more trajectories are of no use."""
    learn = scene.study.learn
    all_spent = f"All {learn.trajectories} trajectories of learn.trajectories are spent."
    if not STOP_RULES[learn.stop].near:
        if _budget_exhausted(scene, step.source):
            return Verdict(True, all_spent, budget_exhausted=True)
        return Verdict(False, "The loop goes on until its trajectories are spent.")
    valued = partial(value_candidates, scene, policy)
    verdict = near_enough(scene.candidates, row, found.best, learn.epsilon, learn.r, valued)
    if not verdict.stop and _repeats(found, row, policy, step.before):
        text = (
            "The trajectory of this very policy left the belief where it was: another one "
            "would tell no more."
        )
        return Verdict(True, f"{verdict.sentence} {text}", verdict.figures)
    if _budget_exhausted(scene, step.source) and not verdict.stop:
        return Verdict(
            True, f"{all_spent} {verdict.sentence}", verdict.figures, budget_exhausted=True
        )
    return verdict


def _repeats(found: Identified, row: int, policy: LearnedPolicy, before: Iteration | None) -> bool:
    """Return whether the next trajectory would repeat the last one, under a converged belief."""
    if before is None or found.probabilities[row] < _CONVERGED:
        return False
    same = before.row == row and before.found.probabilities[row] >= _CONVERGED
    return bool(same and np.array_equal(before.policy.theta, policy.theta))


def _budget_exhausted(scene: Scene, source: Source) -> bool:
    return len(source.trajectories) >= scene.study.learn.trajectories


def _steps(scene: Scene, step: _Step, found: Identified, row: int) -> int:
    """Return how long to learn: a policy that cannot be the last may be a draft."""
    policy, learn = scene.study.policy, scene.study.learn
    near = distances(scene.candidates, row)[found.best] <= learn.epsilon + 1e-12
    if (
        policy.draft is None
        or _budget_exhausted(scene, step.source)
        or (near and STOP_RULES[learn.stop].near)
    ):
        return policy.steps
    return policy.draft


def _named(scene: Scene, row: int) -> dict[str, float]:
    names = [p.name for p in scene.parameters]
    return dict(zip(names, scene.candidates.points[row].tolist(), strict=True))


def _figures(
    scene: Scene,
    step: _Step,
    found: Identified,
    row: int,
    policy: LearnedPolicy,
    verdict: Verdict,
    repair: Repair | None,
) -> dict[str, Any]:
    value = value_candidates(scene, policy, np.array([row]), 1).value(0)
    plant = step.source.evaluate(policy)
    return {
        "trajectories": len(step.source.trajectories),
        "study": scene.study.name,
        "row": row,
        "chosen": _named(scene, row),
        "most_probable": _named(scene, found.best),
        "probability": float(found.probabilities[row]),
        **found.figures(),
        "intervals": {
            p.name: ends
            for p, ends in zip(scene.parameters, found.interval.T.tolist(), strict=True)
        },
        "diagnosis": None if repair is None else list(repair.sentences),
        "training_steps": policy.about["training_steps"],
        "model_return": finite(value._asdict()),
        "plant_return": None if plant is None else finite(plant._asdict()),
        "stop": verdict.stop,
        "spent": verdict.budget_exhausted,
        "verdict": verdict.sentence,
        "conditions": finite(verdict.figures),
    }

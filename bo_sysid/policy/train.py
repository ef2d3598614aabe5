"""The training loop: iterations, their log, and checkpoints that survive a kill."""

import dataclasses
import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd

from bo_sysid.errors import RunError, StudyError
from bo_sysid.plants.environment import Environment
from bo_sysid.policy.settings import TrpoSettings
from bo_sysid.policy.store import LearnedPolicy, read_arrays, write_arrays
from bo_sysid.policy.trainer import Trainer, TrainingIteration
from bo_sysid.runs import atomic, plain

CHECKPOINT, LOG, POLICY = "checkpoint.npz", "iterations.parquet", "policy.npz"
_FORMAT = 2  # of checkpoints

Watch = Callable[[TrainingIteration], None]


@dataclass(frozen=True)
class Training:
    """A finished training run.

    Attributes:
        policy: what was learned.
        log: one row an iteration, columns as in `TrainingIteration`.
    """

    policy: LearnedPolicy
    log: pd.DataFrame


def train(
    environment: Environment,
    settings: TrpoSettings | None = None,
    *,
    steps: int,
    seed: int = 0,
    threads: int = 1,
    folder: Path | None = None,
    every: int = 10,
    about: Mapping[str, Any] | None = None,
    watch: Watch | None = None,
) -> Training:
    """Learn a policy.

    Args:
        environment: where to learn; it begins new episodes.
        settings: of the algorithm.
        steps: control steps in all, rounded up to whole batches.
        seed: of networks, actions and shuffles; the environment has its own.
        threads: of the update; results do not depend on it.
        folder: where checkpoints, log and policy are written. With a checkpoint there, training
            resumes from it and ends as if it had never been interrupted. Models are not
            compared: what distinguishes them belongs into `about`.
        every: iterations between checkpoints.
        about: what the policy is learned on, stored with it; a checkpoint with another is
            refused.
        watch: called with each iteration's log.

    Raises:
        StudyError: a setting is wrong.
        RunError: the checkpoint is damaged or belongs to another training.
    """
    if steps < 1 or every < 1:
        raise StudyError(f"policy: steps {steps} and every {every} must be at least 1")
    trainer = Trainer(environment, settings, seed=seed, threads=threads)
    own = dict(about or {})
    log = _resume(trainer, folder, own) if folder else []
    while trainer.steps < steps:
        row = trainer.iterate()
        log.append(row)
        if watch:
            watch(row)
        if folder and (trainer.iterations % every == 0 or trainer.steps >= steps):
            _checkpoint(trainer, folder, log, own)
    learned = LearnedPolicy(trainer.policy, trainer.theta.copy(), trainer.normaliser(), own)
    if folder:
        learned.save(folder / POLICY)
    return Training(learned, _frame(log))


def _identity(trainer: Trainer, about: Mapping[str, Any]) -> dict[str, Any]:
    """Return what must be equal for a training to be resumed, as its checkpoint has it in JSON."""
    environment = trainer.environment
    identity = {
        "format": _FORMAT,
        "settings": dataclasses.asdict(trainer.settings),
        "seed": trainer.seed,
        "environments": environment.n,
        "observations": environment.observation_size,
        "actions": environment.action_size,
        "about": dict(about),
    }
    return dict(json.loads(json.dumps(plain(identity))))


def _checkpoint(
    trainer: Trainer, folder: Path, log: list[TrainingIteration], about: Mapping[str, Any]
) -> None:
    frame = _frame(log)
    with atomic(folder / LOG) as path:
        frame.to_parquet(path)
    columns = {f"log.{name}": frame[name].to_numpy() for name in TrainingIteration._fields}
    arrays = {**trainer.get_state(), **columns}
    write_arrays(folder / CHECKPOINT, arrays, _identity(trainer, about))


def _resume(trainer: Trainer, folder: Path, about: Mapping[str, Any]) -> list[TrainingIteration]:
    """Put the trainer where its checkpoint is, if there is one; return the log so far."""
    path = folder / CHECKPOINT
    if not path.is_file():
        return []
    arrays, header = read_arrays(path)
    own = _identity(trainer, about)
    different = [key for key in own if header.get(key) != own[key]]
    if different:
        raise RunError(
            f"{path}: belongs to a training with other {', '.join(different)}; choose another "
            "folder, or remove it"
        )
    columns = {name: arrays.pop(f"log.{name}").tolist() for name in TrainingIteration._fields}
    trainer.set_state(arrays)
    return [TrainingIteration(*row) for row in zip(*columns.values(), strict=True)]


def _frame(log: list[TrainingIteration]) -> pd.DataFrame:
    return pd.DataFrame(log, columns=list(TrainingIteration._fields))

"""Real trajectories of a person's machine: a policy file out, a recording in."""

import hashlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from bo_sysid.errors import RecordingError, RunError, StudyError
from bo_sysid.learn.hand_over import hand_over
from bo_sysid.learn.identified import is_long
from bo_sysid.learn.returned import (
    require_commands_within,
    require_new,
    unread,
    with_lost_commands,
)
from bo_sysid.learn.scene import Scene
from bo_sysid.learn.source import Waiting
from bo_sysid.learn.values import Estimate
from bo_sysid.policy.store import LearnedPolicy
from bo_sysid.recording import READERS, Recording
from bo_sysid.recording.writers import write_recording
from bo_sysid.runs import Run
from bo_sysid.study import Study
from bo_sysid.study.inputs import corrected, read_files, read_train

_USED = "used_recordings.json"
"""Digests of the recordings of policies that a run has used, by the iteration that used them."""
_WHOLE = 0.95  # share of an episode that a recording of it should have


class MachineSource:
    """A person's machine: a policy file out, a recording in.

    The first iteration uses the recordings that the study names. Every later one needs the
    recording of the policy that was learned before, in ``recordings/trajectory-<number>`` of the
    run folder, in any format that is read.

    Args:
        scene: its study names the first recordings.
        run: folder of policies and recordings.
        strict: refuse messy recordings.

    Raises:
        RunError: the first recordings changed since the run began.
        UserError: there are none, or they cannot be read.
    """

    def __init__(self, scene: Scene, run: Run, strict: bool = False) -> None:
        self._scene, self._run, self._strict = scene, run, strict
        self._first = _first_recordings(scene, strict)
        self._files: list[Path] = []
        self._further: list[Recording] = []  # those of policies, as recorded on the machine
        digest = _digest(corrected(scene.study, self._first))
        if run.has("first_recordings.json"):
            if run.read_json("first_recordings.json")["sha256"] != digest:
                raise RunError(
                    f"{run.folder}: the recordings that the study names changed since this run "
                    "began; use another --out, or put further ones where the run asks for them"
                )
        else:
            names = [r.name for r in self._first]
            run.write_json("first_recordings.json", {"names": names, "sha256": digest})
        self._copies = self._copied() if scene.study.recordings.dataset else []

    def take(self, number: int, policy: LearnedPolicy | None, scene: Scene) -> Waiting | None:
        """Find the recording of iteration `number`, or write the policy and say what to record.

        Raises:
            RecordingError: the recording is wrong, cannot be one of the policy, or there are two;
                the run waits for a better one.
            RunError: it is another one than the run used before, or gone.
        """
        if policy is None:
            return None
        stem = f"recordings/trajectory-{number - 1:02d}"
        there = [self._run.path(stem + ending) for ending in READERS]
        found = [path for path in there if path.is_file()]
        if not found:
            self._require_never_there(number, stem)
            waiting = hand_over(scene, self._run, policy, number - 1, stem)
            lines = [waiting, unread(self._run.path(stem))]
            return Waiting("\n".join(line for line in lines if line))
        if len(found) > 1:
            both = " and ".join(path.name for path in found)
            raise RecordingError(f"{self._run.path(stem)}: {both} are there; only one may be")
        read = read_files(self._scene.study, found, self._strict)
        self._require_fitting(number, read, found[0])
        self._require_used(number, found[0], _digest(read))
        step = self._scene.task.control_timestep
        self._files.append(found[0])
        self._further += [with_lost_commands(r, step) for r in read]
        return None

    def _require_never_there(self, number: int, stem: str) -> None:
        """Refuse to wait once more for a recording that an iteration was begun with."""
        if self._run.path(f"iterations/{number:02d}").is_dir():
            raise RunError(
                f"{self._run.path(stem)}.parquet (or .csv, …): this run has used it and it is "
                "gone; put it back, or use another --out"
            )

    def _require_fitting(self, number: int, read: Sequence[Recording], file: Path) -> None:
        """Refuse what cannot be a recording of the policy before."""
        handed = f"policies/policy-{number - 1:02d}.json"
        about = self._run.read_json(handed) if self._run.has(handed) else None
        horizon = self._scene.study.deviation.horizon
        for recording in read:
            if not is_long(recording, horizon):
                raise RecordingError(
                    f"{file}: {recording.duration:.3g} s are too short for a window of {horizon} "
                    "instants (deviation.horizon), and so tell nothing; put the recording of a "
                    "whole episode there"
                )
            require_new(recording, (*self._first, *self._further), file)
            if about is not None:
                require_commands_within(recording, about, file)

    def _require_used(self, number: int, file: Path, digest: str) -> None:
        """Refuse another recording than the one with which an iteration was begun."""
        used = self._run.read_json(_USED) if self._run.has(_USED) else {}
        begun = self._run.path(f"iterations/{number:02d}").is_dir()
        if begun and used.get(str(number), digest) != digest:
            raise RunError(
                f"{file}: changed since this run used it; put back what was there, or use "
                "another --out"
            )
        self._run.write_json(_USED, {**used, str(number): digest})

    def recordings(self, study: Study) -> tuple[Recording, ...]:
        """The first recordings and those of policies, as a study's model is to see them."""
        return corrected(study, (*self._first, *self._further))

    def _copied(self) -> list[str]:
        """A dataset's recordings as files of the run folder: no key names a dataset and files."""
        names = [f"recordings/first-{k + 1:02d}.parquet" for k in range(len(self._first))]
        for name, recording in zip(names, self._first, strict=True):
            if not self._run.has(name):  # the same: their digest was compared
                write_recording(recording, self._run.path(name))
        return names

    @property
    def training(self) -> Mapping[str, Any]:
        """The study's own key, with the recordings of policies added."""
        section = self._scene.study.resolved(relative_to=self._run.folder)["recordings"]
        own = [str(f.relative_to(self._run.folder)) for f in self._files]
        if section.pop("dataset", None) is not None:
            section["train"] = self._copies
        return {**section, "train": [*section["train"], *own]}

    @property
    def noise(self) -> Mapping[str, float]:
        """σ of the sensors as the study states it."""
        return self._scene.study.recordings.noise

    @property
    def trajectories(self) -> pd.DataFrame:
        """One row a recording of a policy; its reward is not known here."""
        step = self._scene.task.control_timestep
        rows = [
            {
                "number": k + 1,
                "name": r.name,
                "steps": round(r.duration / step),
                "seconds": r.duration,
                "reward": np.nan,
                "fault": self._silence(r),
            }
            for k, r in enumerate(self._further)
        ]
        return pd.DataFrame(rows, columns=["number", "name", "steps", "seconds", "reward", "fault"])

    def _silence(self, recording: Recording) -> str:
        seconds, whole = recording.duration, self._scene.task.time_limit
        if not np.isfinite(whole) or seconds > _WHOLE * whole:
            return ""
        return f"{recording.name} ends after {seconds:.3g} of {whole:g} s"

    @property
    def given(self) -> tuple[Recording, ...]:
        """The recordings that the study names."""
        return tuple(self._first)

    def evaluate(self, policy: LearnedPolicy) -> Estimate | None:
        """Return None: only the machine itself knows."""
        return None


def _first_recordings(scene: Scene, strict: bool) -> tuple[Recording, ...]:
    try:
        return read_train(scene.study, strict=strict)
    except StudyError as error:
        raise StudyError(
            f"{error}. Learning for a machine begins with a recording of it (bo-sysid excite makes "
            "a safe trajectory to record); a simulated one is described under the key plant"
        ) from None


def _digest(recordings: tuple[Recording, ...]) -> str:
    digest = hashlib.sha256()
    for r in recordings:
        for name, channel in r.channels.items():
            digest.update(name.encode())
            digest.update(channel.time.tobytes())
            digest.update(channel.values.tobytes())
    return digest.hexdigest()

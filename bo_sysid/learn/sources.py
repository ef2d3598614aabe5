"""Where real trajectories come from: a simulated plant, or a person's machine."""

import hashlib
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np
import pandas as pd

from bo_sysid.errors import RecordingError, RunError, StudyError
from bo_sysid.learn.hand_over import hand_over
from bo_sysid.learn.scene import Scene
from bo_sysid.learn.values import VALUE_SEED, Estimate
from bo_sysid.plants.build import build_plant
from bo_sysid.plants.excitation import smooth_random
from bo_sysid.plants.measuring import KINDS
from bo_sysid.plants.plant import Act, PlantError, Trajectory
from bo_sysid.policy.store import LearnedPolicy
from bo_sysid.recording import READERS, Recording, read_recording
from bo_sysid.recording.writers import write_recording
from bo_sysid.runs import Run
from bo_sysid.study import Study
from bo_sysid.study.inputs import corrected, read_files, read_train

_USED = "used_recordings.json"
"""Digests of the recordings of policies that a run has used, by the iteration that began so."""
_WHOLE = 0.95  # share of an episode that a recording of it should have
_LONGEST = 20.0  # [s] of the first excitation, where a task has no end


class Waiting(NamedTuple):
    """A trajectory that a person has to record.

    Attributes:
        message: what to record, and where to put it.
    """

    message: str


@runtime_checkable
class Source(Protocol):
    """Where real trajectories come from."""

    def take(self, number: int, policy: LearnedPolicy | None, scene: Scene) -> Waiting | None:
        """Have the recordings of iteration `number`, under the policy of the one before.

        Args:
            number: of the iteration, from 1 on.
            policy: None in the first.
            scene: in which the policy was learned: after a repair its commands have another range.
        """
        ...

    def recordings(self, study: Study) -> tuple[Recording, ...]:
        """All recordings so far, as the model of a study is to see them."""
        ...

    @property
    def training(self) -> Mapping[str, Any]:
        """The study's key `recordings` for what is there, paths relative to the run folder."""
        ...

    @property
    def noise(self) -> Mapping[str, float]:
        """σ of the sensors by kind or channel, as far as it is known."""
        ...

    @property
    def trajectories(self) -> pd.DataFrame:
        """One row a counted trajectory: number, name, steps, seconds, reward, fault."""
        ...

    def evaluate(self, policy: LearnedPolicy) -> Estimate | None:
        """Return the policy's return on the machine, which is no trajectory; None if unknown."""
        ...


def open_source(scene: Scene, run: Run, *, strict: bool = False) -> Source:
    """Return the plant of a study where it has one, else the person's machine."""
    return PlantSource(scene, run) if scene.study.plant else MachineSource(scene, run, strict)


class PlantSource:
    """A simulated plant; the first trajectory is an excitation, the others are policies'.

    An excitation moves every actuator over its range and has something to tell about every
    parameter; an untrained policy hardly moves at all. Recordings that the study names are not
    used: only what the plant has counted is.

    Args:
        scene: its study describes the plant.
        run: folder of the recordings.
    """

    def __init__(self, scene: Scene, run: Run) -> None:
        self._scene, self._run = scene, run
        self._plant = build_plant(scene.study, budget=scene.study.learn.trajectories)
        told = run.read_json("trajectories.json") if run.has("trajectories.json") else []
        self._plant.resume([Trajectory(**entry) for entry in told])

    def take(self, number: int, policy: LearnedPolicy | None, scene: Scene) -> Waiting | None:
        """Roll out one trajectory; one that breaks off is kept as far as it went.

        Raises:
            PlantError: it broke off at once.
        """
        if number <= len(self._plant.trajectories):
            return None
        settings = self._scene.study.plant
        warmstart = settings is not None and settings.record.warmstart
        source = self._excitation() if policy is None else self._acting(policy)
        try:
            recording = self._plant.record(source, warmstart=warmstart)
        except PlantError as error:
            if error.recording is None:
                raise
            recording = error.recording
        write_recording(recording, self._run.path(_file(number)))
        self._run.write_json("trajectories.json", [asdict(t) for t in self._plant.trajectories])
        return None

    def _acting(self, policy: LearnedPolicy) -> Act:
        return policy.acting(*self._plant.command_range(policy.policy.actions))

    def _excitation(self) -> np.ndarray:
        scene = self._scene
        compiled = scene.model.compile(scene.limits)
        duration = min(scene.task.time_limit, _LONGEST)
        return smooth_random(compiled, duration, self._plant.control_timestep, seed=scene.seed)

    def recordings(self, study: Study) -> tuple[Recording, ...]:
        """What was recorded, read back from the run folder, as a study's model is to see it."""
        count = len(self._plant.trajectories)
        read = [read_recording(self._run.path(_file(k + 1))) for k in range(count)]
        return corrected(study, read)

    @property
    def training(self) -> Mapping[str, Any]:
        """The recordings in the run folder, in the package's own convention."""
        names = [_file(k + 1) for k in range(len(self._plant.trajectories))]
        return {"train": names, "noise": {k: x for k, x in self.noise.items() if x > 0}}

    @property
    def noise(self) -> Mapping[str, float]:
        """What the study says of the plant's sensors; those it says nothing of are exact."""
        study = self._scene.study
        told = study.plant.noise if study.plant is not None else {}
        return {**dict.fromkeys(KINDS, 0.0), **told, **study.recordings.noise}

    @property
    def trajectories(self) -> pd.DataFrame:
        """One row a counted trajectory."""
        rows = [asdict(t) for t in self._plant.trajectories]
        frame = pd.DataFrame(rows, columns=["name", "steps", "reward", "fault"])
        frame.insert(0, "number", np.arange(1, len(frame) + 1))
        frame.insert(3, "seconds", frame["steps"] * self._plant.control_timestep)
        return frame

    def evaluate(self, policy: LearnedPolicy) -> Estimate | None:
        """Return the policy's return over episodes that are counted apart.

        They start like those by which the policy is valued on models, so that the two compare.
        """
        scene = self._scene
        episodes, seed = scene.study.learn.episodes, scene.seed + VALUE_SEED
        return Estimate.of(self._plant.evaluate(self._acting(policy), episodes, seed=seed))


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

    def take(self, number: int, policy: LearnedPolicy | None, scene: Scene) -> Waiting | None:
        """Find the recording of iteration `number`, or write the policy and say what to record.

        Raises:
            RecordingError: the recording is wrong, or there are two; the run waits for a better
                one.
            RunError: it is another one than the run used before.
        """
        if policy is None:
            return None
        stem = f"recordings/trajectory-{number - 1:02d}"
        there = [self._run.path(stem + ending) for ending in READERS]
        found = [path for path in there if path.is_file()]
        if not found:
            return Waiting(hand_over(scene, self._run, policy, number - 1, stem))
        if len(found) > 1:
            both = " and ".join(path.name for path in found)
            raise RecordingError(f"{self._run.path(stem)}: {both} are there; only one may be")
        read = read_files(self._scene.study, found, self._strict)
        self._require_used(number, found[0], _digest(read))
        self._files.append(found[0])
        return None

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

    @property
    def _further(self) -> tuple[Recording, ...]:
        """Those of policies, as the machine told them."""
        return read_files(self._scene.study, self._files, self._strict)

    @property
    def training(self) -> Mapping[str, Any]:
        """The study's own key, with the recordings of policies added.

        No key names a dataset and files: those of a dataset are written into the run folder.
        """
        told = self._scene.study.resolved(relative_to=self._run.folder)["recordings"]
        own = [str(f.relative_to(self._run.folder)) for f in self._files]
        if told.pop("dataset", None) is not None:
            told["train"] = []
            for k, recording in enumerate(self._first):
                file = f"recordings/first-{k + 1:02d}.parquet"
                write_recording(recording, self._run.path(file))
                told["train"].append(file)
        return {**told, "train": [*told["train"], *own]}

    @property
    def noise(self) -> Mapping[str, float]:
        """What the study says."""
        return self._scene.study.recordings.noise

    @property
    def trajectories(self) -> pd.DataFrame:
        """One row a recording of a policy; its reward is not known here."""
        step = self._scene.task.control_timestep
        rows = [
            {
                "number": k + 1,
                "name": r.name,
                "steps": round((r.span[1] - r.span[0]) / step),
                "seconds": r.span[1] - r.span[0],
                "reward": np.nan,
                "fault": self._silence(r),
            }
            for k, r in enumerate(self._further)
        ]
        return pd.DataFrame(rows, columns=["number", "name", "steps", "seconds", "reward", "fault"])

    def _silence(self, recording: Recording) -> str:
        seconds, whole = recording.span[1] - recording.span[0], self._scene.task.time_limit
        if not np.isfinite(whole) or seconds > _WHOLE * whole:
            return ""
        return f"{recording.name} ends after {seconds:.3g} of {whole:g} s"

    def evaluate(self, policy: LearnedPolicy) -> Estimate | None:
        """Return None: only the machine itself knows."""
        return None


def _file(number: int) -> str:
    return f"trajectories/{number:02d}.parquet"


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

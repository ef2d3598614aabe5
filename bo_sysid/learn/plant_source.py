"""Real trajectories of a simulated plant."""

from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

import numpy as np
import pandas as pd

from bo_sysid.learn.scene import Scene
from bo_sysid.learn.source import Waiting
from bo_sysid.learn.values import VALUE_SEED, Estimate
from bo_sysid.plants.build import build_plant, driven_within
from bo_sysid.plants.excitation import smooth_random
from bo_sysid.plants.measuring import KINDS
from bo_sysid.plants.plant import Act, PlantError, Trajectory
from bo_sysid.policy.store import LearnedPolicy
from bo_sysid.recording import Recording, read_recording
from bo_sysid.recording.writers import write_recording
from bo_sysid.runs import Run
from bo_sysid.study import Study
from bo_sysid.study.inputs import corrected

_LONGEST = 20.0  # [s] of the first excitation, where a task has no end


class PlantSource:
    """A simulated plant; the first trajectory is an excitation, the others are policies'.

    An excitation moves every actuator over its range and is informative about every
    parameter; an untrained policy hardly moves at all. Recordings that the study names are not
    used: only what the plant has counted is.

    Args:
        scene: its study describes the plant.
        run: folder of the recordings.
    """

    def __init__(self, scene: Scene, run: Run) -> None:
        self._scene, self._run = scene, run
        self._plant = build_plant(scene.study, budget=scene.study.learn.trajectories)
        stored = run.read_json("trajectories.json") if run.has("trajectories.json") else []
        self._plant.resume([Trajectory(**entry) for entry in stored])

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
        return policy.acting(*self._plant.command_range)

    def _excitation(self) -> np.ndarray:
        scene = self._scene
        compiled = scene.model.compile(scene.limits)
        duration = min(scene.task.time_limit, _LONGEST)
        step, within = self._plant.control_timestep, driven_within(self._plant)
        return smooth_random(compiled, duration, step, seed=scene.seed, within=within)

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
        """σ of the plant's sensors as the study states it, 0 for those that it leaves out."""
        study = self._scene.study
        stated = study.plant.noise if study.plant is not None else {}
        return {**dict.fromkeys(KINDS, 0.0), **stated, **study.recordings.noise}

    @property
    def trajectories(self) -> pd.DataFrame:
        """One row a counted trajectory."""
        rows = [asdict(t) for t in self._plant.trajectories]
        frame = pd.DataFrame(rows, columns=["name", "steps", "reward", "fault"])
        frame.insert(0, "number", np.arange(1, len(frame) + 1))
        frame.insert(3, "seconds", frame["steps"] * self._plant.control_timestep)
        return frame

    @property
    def given(self) -> tuple[Recording, ...]:
        """None: what a simulated plant did first is counted."""
        return ()

    def evaluate(self, policy: LearnedPolicy) -> Estimate | None:
        """Return the policy's return over episodes that do not count as trajectories.

        They start like those by which the policy is valued on models, so that the two compare.
        """
        scene = self._scene
        episodes, seed = scene.study.learn.episodes, scene.seed + VALUE_SEED
        return Estimate.of(self._plant.evaluate(self._acting(policy), episodes, seed=seed))


def _file(number: int) -> str:
    return f"trajectories/{number:02d}.parquet"

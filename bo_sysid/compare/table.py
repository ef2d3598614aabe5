"""Δ on all of B, computed once for each seed of a problem; searches look it up."""

import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from bo_sysid.arrays import Points
from bo_sysid.compare.arms import remade
from bo_sysid.deviation import Evaluation
from bo_sysid.identify.problem import Problem, make_problem
from bo_sysid.parameters import Parameter
from bo_sysid.plants.build import build_plant, record
from bo_sysid.plants.limits import limit_edits
from bo_sysid.runs import atomic
from bo_sysid.simulation import Prediction, Simulator, State, Windows
from bo_sysid.study import Study
from bo_sysid.study.inputs import load_model


@dataclass(frozen=True)
class Table:
    """Δ of every candidate on the recordings of one seed.

    Attributes:
        evaluation: of all of B; contributions are kept in single precision.
        weight: `b` share of windows in each block of the recordings.
        session: `b` recording of each block; None where there are too few to draw from.
        steps: engine steps that one evaluation of Δ simulates, on average.
        seconds: that one evaluation takes, on average.
    """

    evaluation: Evaluation
    weight: Float[np.ndarray, " b"]
    session: Int[np.ndarray, " b"] | None
    steps: float
    seconds: float

    def row(self, row: int) -> Evaluation:
        """Return Δ of one candidate."""
        all_of = self.evaluation
        return Evaluation(
            all_of.deviation[[row]],
            all_of.contributions[[row]].astype(float),
            all_of.diverged[[row]],
        )

    def write(self, path: Path) -> None:
        """Write it as NPZ."""
        session = np.zeros(0, int) if self.session is None else self.session
        with atomic(path) as temporary:
            np.savez_compressed(
                temporary,
                deviation=self.evaluation.deviation,
                contributions=self.evaluation.contributions.astype(np.float32),
                diverged=self.evaluation.diverged,
                weight=self.weight,
                session=session,
                cost=np.array([self.steps, self.seconds]),
            )

    @classmethod
    def read(cls, path: Path) -> "Table":
        """Read what was written."""
        with np.load(path, allow_pickle=False) as file:
            session = file["session"]
            return cls(
                Evaluation(file["deviation"], file["contributions"], file["diverged"]),
                file["weight"],
                session if len(session) else None,
                *file["cost"].tolist(),
            )


@dataclass
class Counted:
    """A simulator that counts the engine steps that it simulates.

    Attributes:
        simulator: predicts.
        steps: counted so far.
    """

    simulator: Simulator
    steps: int = 0

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """The simulator's."""
        return self.simulator.parameters

    def predictions(
        self, points: Points, windows: Windows, starts: Sequence[State] | None = None
    ) -> Iterator[Prediction]:
        """Yield the simulator's predictions."""
        self.steps += len(points) * len(windows) * windows.steps
        return self.simulator.predictions(points, windows, starts)

    @property
    def following(self) -> Int[np.ndarray, " k"]:
        """Those of the simulator that is counted."""
        return self.simulator.following

    def moved(self, start: State, tangent: Float[np.ndarray, "W n"]) -> State:
        """Delegate to the simulator that is counted."""
        return self.simulator.moved(start, tangent)


@dataclass(frozen=True)
class TableJob:
    """What a process needs to compute a table.

    Attributes:
        study: resolved, of one seed.
        folder: that its paths are relative to.
        seed: of the recordings.
    """

    study: Mapping[str, Any]
    folder: str
    seed: int


def tabulate(job: TableJob) -> Table:
    """Return Δ on all of B."""
    problem, counter = recorded(remade(job.study, job.folder), job.seed)
    began = time.perf_counter()
    points = problem.candidates.points
    found = problem.deviation(points)
    seconds = time.perf_counter() - began
    blocks = problem.deviation.blocks
    return Table(
        Evaluation(found.deviation, found.contributions.astype(np.float32), found.diverged),
        blocks.weight,
        blocks.session,
        counter.steps / len(points),
        seconds / len(points),
    )


def recorded(study: Study, seed: int) -> tuple[Problem, Counted]:
    """Return the problem of a study, and what counts the steps of its deviation.

    Args:
        study: with a plant it is recorded anew; without one its recordings are read.
        seed: of the plant's starts, noise and excitation.
    """
    recordings = None
    if study.plant is not None:
        model, settings = load_model(study), study.plant.record
        recordings = record(
            build_plant(study, seed=seed),
            model,
            settings.train,
            duration=settings.seconds,
            excitation=settings.excitation,
            seed=seed,
            warmstart=settings.warmstart,
            limits=limit_edits(study, model),
        )
    problem = make_problem(study, recordings, threads=1)
    _ = problem.deviation.blocks  # they are simulated once for all: no arm pays for it
    counter = Counted(problem.deviation.simulator)
    problem.deviation.simulator = counter
    return problem, counter

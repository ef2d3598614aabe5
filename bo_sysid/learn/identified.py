"""The inner loop within the outer one: what all recordings so far say about β."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import pandas as pd
from jaxtyping import Float, Int
from scipy.special import entr

from bo_sysid.arrays import Point, Points, Probabilities
from bo_sysid.belief.bootstrap import cell_interval, credible_interval
from bo_sysid.belief.stopping import StopReason, StopRule
from bo_sysid.deviation import Deviation
from bo_sysid.execution import threads
from bo_sysid.identify import doubts
from bo_sysid.identify.problem import Problem, make_problem
from bo_sysid.identify.search import History, Rules, SearchOutcome, search
from bo_sysid.learn.floor import Floor, floor_of, noise_by_channel
from bo_sysid.learn.scene import Scene
from bo_sysid.learn.stops import Verdict
from bo_sysid.parameters import CandidateSet
from bo_sysid.recording import Recording
from bo_sysid.runs import Run, finite

_BETWEEN = 5  # evaluations between two looks at the values, where these end the search

ValueStop = Callable[[Probabilities], Verdict]
"""Returns whether what P leaves open matters no longer for the policy."""


@dataclass(frozen=True)
class Identified:
    """What all recordings so far say.

    Attributes:
        rows: `n` evaluated rows of B, in order.
        deviation: `n`, Δ of each on all recordings.
        entropy: `n` entropies of P; NaN for rows that earlier iterations had picked, but the last.
        probabilities: `N` P(β).
        bootstrap: `N` P_boot(β).
        mean: `N` mean of g(Δ(β)), the power of Δ that the surrogate models (`belief.warp`).
        fresh: how many of the rows are new.
        reason: why the search ended.
        floor: under Δ.
        interval: `2 x d`, between which P_boot has 95 % of each parameter.
        moved: what the noise of measured starts does to the parameters, in words; "" if nothing.
        guided: figures behind the end of a search that was ended by values, else empty.
    """

    rows: Int[np.ndarray, " n"]
    deviation: Float[np.ndarray, " n"]
    entropy: Float[np.ndarray, " n"]
    probabilities: Probabilities
    bootstrap: Probabilities
    mean: Float[np.ndarray, " N"]
    fresh: int
    reason: StopReason
    floor: Floor
    interval: Float[np.ndarray, "2 d"]
    moved: str = ""
    guided: Mapping[str, Any] = field(default_factory=dict)

    @property
    def best(self) -> int:
        """The row with the largest probability."""
        return int(self.probabilities.argmax())

    def figures(self) -> dict[str, Any]:
        """Return its entry in `learning.json`."""
        return {
            "evaluated": len(self.rows),
            "new": self.fresh,
            "entropy": float(entr(self.probabilities).sum()),
            "entropy_bootstrap": float(entr(self.bootstrap).sum()),
            "search_stopped": self.reason.value,
            "search_values": finite(dict(self.guided)),
            "interval": self.interval.tolist(),
            "moved": self.moved,
            "floor": {
                "deviation": self.floor.deviation,
                "noise": self.floor.noise,
                "resolution": self.floor.resolution,
                "unsure": self.floor.unsure,
            },
        }

    def write(self, run: Run, folder: str, candidates: CandidateSet) -> None:
        """Write it; the last file makes it complete."""
        points = candidates.frame()
        evaluations = points.iloc[self.rows].reset_index(drop=True)
        evaluations.insert(0, "row", self.rows)
        run.write_frame(
            f"{folder}/evaluations.parquet",
            evaluations.assign(deviation=self.deviation, entropy=self.entropy),
        )
        run.write_frame(
            f"{folder}/belief.parquet",
            points.assign(P=self.probabilities, P_boot=self.bootstrap, mean=self.mean),
        )
        run.write_json(f"{folder}/identified.json", self.figures())

    @classmethod
    def read(cls, run: Run, folder: str) -> "Identified | None":
        """Return what was written; None where it is not complete."""
        if not run.has(f"{folder}/identified.json"):
            return None
        figures = run.read_json(f"{folder}/identified.json")
        evaluations = run.read_frame(f"{folder}/evaluations.parquet")
        belief = run.read_frame(f"{folder}/belief.parquet")
        interval = figures.get("interval")
        if interval is None:  # an earlier version left it out
            points = belief.drop(columns=["P", "P_boot", "mean"]).to_numpy(float)
            interval = credible_interval(points, belief["P_boot"].to_numpy(float))
        return cls(
            evaluations["row"].to_numpy(int),
            evaluations["deviation"].to_numpy(float),
            evaluations["entropy"].to_numpy(float),
            belief["P"].to_numpy(float),
            belief["P_boot"].to_numpy(float),
            belief["mean"].to_numpy(float),
            figures["new"],
            StopReason(figures["search_stopped"]),
            Floor(**figures["floor"]),
            np.array(interval),
            figures.get("moved", ""),
            figures["search_values"],
        )


def identified(
    scene: Scene,
    recordings: Sequence[Recording],
    known: Int[np.ndarray, " k"],
    value_stop: ValueStop | None = None,
    noise: Mapping[str, float] | None = None,
) -> Identified:
    """Search for the arg-min of Δ on all recordings, from what earlier iterations had evaluated.

    Δ of every candidate that was ever evaluated is computed again: recordings have been added, and
    a value on some of them says nothing about a value on all. Then at most `search.budget`
    candidates are added.

    Args:
        scene: gives model and B.
        recordings: all so far; those too short for a window are left out, unless all are.
        known: rows of B that were evaluated before.
        value_stop: ends the search in place of the entropy.
        noise: of the machine's sensors, see `floor_of`.
    """
    long = long_enough(recordings, scene.study.deviation.horizon)
    problem = make_problem(scene.study, long, threads=threads())
    deviation, points = problem.deviation, scene.candidates.points
    history = evaluated_again(deviation, points, known)
    outcome, guided = _searched(scene, deviation, history, value_stop)
    rows, found = outcome.history.rows, outcome.history.evaluation
    best = int(found.deviation.argmin())
    blocks = deviation.blocks
    bootstrap = outcome.bootstrap(points, blocks.weight, blocks.session, scene.seed)
    candidates = scene.candidates
    cells = np.broadcast_to(candidates.cell, points.shape)
    interval = cell_interval(points, cells, bootstrap, candidates.bounds)
    return Identified(
        rows,
        found.deviation,
        outcome.history.entropy,
        outcome.belief.probabilities,
        bootstrap,
        outcome.surrogate.moments(points)[0],
        len(rows) - len(known),
        outcome.reason,
        floor_of(problem, points[rows[best]], float(found.deviation[best]), scene.seed, noise),
        interval,
        _moved(problem, points[rows[best]], interval, noise or {}),
        guided,
    )


def _moved(
    problem: Problem,
    best: Point,
    interval: Float[np.ndarray, "2 d"],
    noise: Mapping[str, float],
) -> str:
    """Return what the noise of measured starts does to the parameters, in words."""
    if problem.deviation.fitted_starts:
        return ""
    other = problem.with_fitted_starts(best, noise_by_channel(problem, noise), *interval)
    table = pd.DataFrame({"low95": interval[0], "high95": interval[1]})
    table["name"] = [p.name for p in problem.parameters]
    table["unit"] = [p.unit for p in problem.parameters]
    return doubts.moved(table, other)


def long_enough(recordings: Sequence[Recording], horizon: int) -> tuple[Recording, ...]:
    """Return the recordings that hold a window of `horizon` instants; all where none does."""
    return tuple(r for r in recordings if is_long(r, horizon)) or tuple(recordings)


def is_long(recording: Recording, horizon: int) -> bool:
    """Whether a recording holds a window of `horizon` instants."""
    positions = recording.of_kind("qpos").values()
    return max((len(c.time) for c in positions), default=0) > horizon


def evaluated_again(deviation: Deviation, points: Points, rows: Int[np.ndarray, " k"]) -> History:
    """Return the history of rows whose Δ is computed on the recordings of `deviation`."""
    if not len(rows):
        return History.empty(len(deviation.blocks.weight))
    return History(np.asarray(rows, int), deviation(points[rows]), np.full(len(rows), np.nan))


def _searched(
    scene: Scene, deviation: Deviation, history: History, value_stop: ValueStop | None
) -> tuple[SearchOutcome, Mapping[str, Any]]:
    candidates, search_of = scene.candidates, scene.study.search
    budget = len(history) + search_of.budget

    def run(history: History, rule: StopRule) -> SearchOutcome:
        rules = Rules(search_of.acquisition, rule, scene.seed)
        return search(candidates, lambda row: deviation(candidates.points[[row]]), rules, history)

    if value_stop is None:
        rule = StopRule(budget, search_of.stop.entropy, search_of.stop.last)
        return run(history, rule), {}
    enough = len(history) + 2 * len(candidates.parameters) + 2  # the initial design
    while True:
        outcome = run(history, StopRule(min(enough, budget), entropy=None))
        history = outcome.history
        verdict = value_stop(outcome.belief.probabilities)
        converged = outcome.reason is StopReason.CONVERGED
        if verdict.stop and not converged:
            return replace(outcome, reason=StopReason.VALUES), verdict.figures
        if converged or len(history) >= budget:
            return outcome, verdict.figures
        enough = len(history) + _BETWEEN

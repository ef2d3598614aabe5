"""One search of an arm: the inner loop on the recordings of a seed, and what it saw on its way."""

import hashlib
import time
from collections import OrderedDict
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from bo_sysid.acquisition.registry import acquisition
from bo_sysid.arrays import Points
from bo_sysid.belief.argmin import ArgminBelief
from bo_sysid.belief.bootstrap import credible_interval
from bo_sysid.belief.joint import TIED
from bo_sysid.belief.stopping import StopRule, entropy_converged
from bo_sysid.belief.surrogate import Surrogate
from bo_sysid.compare.arms import Arm, remade
from bo_sysid.compare.table import Table, recorded
from bo_sysid.deviation import Evaluation
from bo_sysid.deviation.measure import Blocks
from bo_sysid.identify.search import History, Rules, SearchOutcome, search, update_belief
from bo_sysid.parameters import CandidateSet
from bo_sysid.study import Study
from bo_sysid.study.inputs import load_model
from bo_sysid.study.overview import candidate_set

BLIND = ("full-grid", "random", "sobol")
"""Acquisitions that do not look at the belief; it is computed at every fifth evaluation alone."""
EVERY = 5
_KEPT = 160  # beliefs that a process caches: arms with the same picks share them


@dataclass(frozen=True)
class SearchJob:
    """What a process needs for one search.

    Attributes:
        study: resolved, of one seed.
        folder: that its paths are relative to.
        arm: how to search.
        seed: of the search.
        data: seed of the recordings.
        table: Δ on all of B; None where B is too large.
    """

    study: Mapping[str, Any]
    folder: str
    arm: Arm
    seed: int
    data: int
    table: Table | None


def run_search(job: SearchJob) -> dict[str, Any]:
    """Search until the budget is used or all probability is on evaluated candidates.

    Returns:
        One value an evaluation: row, deviation, steps and seconds so far, entropy, max_p, and
        right (whether the row of the largest P is an arg-min of Δ on B); these three None where
        the belief was not computed or Δ is not known on B. The belief is first computed when the
        initial design ends, also for blind acquisitions. And at the end: stopped; settled, after
        how many evaluations the study's rule on the entropy would have stopped, had it been applied
        whenever the belief was computed; lowest and median Δ on B; truth, low95 and high95 of each
        parameter.
    """
    study = remade(job.study, job.folder)
    acquisition(job.arm.acquisition)  # imports what it needs, which is no time of the search
    scene = _scene(job, study)
    budget = study.search.budget
    watch = _Watch(scene, budget, blind=job.arm.acquisition in BLIND)
    rules = Rules(job.arm.acquisition, StopRule(budget, entropy=None), job.seed)
    outcome = search(
        scene.candidates,
        watch.evaluate,
        rules,
        History.empty(len(scene.blocks.weight)),
        belief_update=watch.update_belief,
    )
    deviation = None if job.table is None else job.table.evaluation.deviation
    lowest = None if deviation is None else float(deviation.min())
    least = None if deviation is None else deviation - lowest <= TIED * deviation.std()
    seen = watch.beliefs(len(outcome.history))
    return {
        "row": outcome.history.rows.tolist(),
        "deviation": outcome.history.evaluation.deviation.tolist(),
        "entropy": [s and s.entropy for s in seen],
        "max_p": [s and s.max_p for s in seen],
        "right": [None if s is None or least is None else bool(least[s.best]) for s in seen],
        "steps": [steps for steps, _ in watch.costs],
        "seconds": [seconds for _, seconds in watch.costs],
        "stopped": outcome.reason.value,
        "settled": _entropy_convergence(watch, study, outcome.history, rules),
        "lowest": lowest,
        "median": None if deviation is None else float(np.median(deviation)),
        **_intervals(scene, outcome, study, job.seed),
    }


class _Scene(NamedTuple):
    """What a search searches.

    Attributes:
        candidates: the set B.
        evaluate: returns Δ of a row.
        blocks: of the recordings.
        cost: returns engine steps and seconds of all evaluations so far, from their number and
            the seconds that they took here.
    """

    candidates: CandidateSet
    evaluate: Callable[[int], Evaluation]
    blocks: Blocks
    cost: Callable[[int, float], tuple[float, float]]


def _scene(job: SearchJob, study: Study) -> _Scene:
    table = job.table
    if table is None:
        problem, counter = recorded(study, job.data)
        points, counter.steps = problem.candidates.points, 0
        return _Scene(
            problem.candidates,
            lambda row: problem.deviation(points[[row]]),
            problem.deviation.blocks,
            lambda _, seconds: (counter.steps, seconds),
        )
    blocks = Blocks(np.zeros(0, int), table.weight, table.session)
    return _Scene(
        candidate_set(study, study.parameter_set(load_model(study))),
        table.row,
        blocks,
        lambda count, _: (count * table.steps, count * table.seconds),
    )


class _BeliefSummary(NamedTuple):
    """A belief in three numbers."""

    entropy: float
    max_p: float
    best: int


class _Watch:
    """Evaluates and updates the belief for a search, and records results and costs of both.

    Args:
        scene: what is searched.
        budget: of the search.
        blind: whether the acquisition does not look at the belief.
    """

    def __init__(self, scene: _Scene, budget: int, *, blind: bool) -> None:
        self._scene, self._budget, self._blind = scene, budget, blind
        self._simulation_time = self._decision_time = 0.0  # seconds
        self._belief_ready_at: float | None = None
        self._surrogate: Surrogate | None = None
        self.summaries: dict[int, _BeliefSummary] = {}
        self.costs: list[tuple[float, float]] = []  # engine steps and seconds so far

    def evaluate(self, row: int) -> Evaluation:
        """Return Δ of a row; the time since the belief was that of the acquisition."""
        began = time.perf_counter()
        if self._belief_ready_at is not None:
            self._decision_time += began - self._belief_ready_at
            self._belief_ready_at = None
        found = self._scene.evaluate(row)
        self._simulation_time += time.perf_counter() - began
        steps, seconds = self._scene.cost(len(self.costs) + 1, self._simulation_time)
        self.costs.append((steps, seconds + self._decision_time))
        return found

    def update_belief(
        self, candidates: CandidateSet, history: History, rules: Rules
    ) -> tuple[Surrogate, ArgminBelief]:
        """Return surrogate and belief; for a blind acquisition mostly the surrogate of before."""
        count = len(history)
        whole = count == len(candidates)  # there is nothing left to pick blindly
        skipped = self._blind and count % EVERY and count < self._budget and not whole
        if skipped and self._surrogate is not None:
            self._belief_ready_at = time.perf_counter()
            return self._surrogate, _unknown(len(candidates))
        surrogate, belief, seconds = _cached_belief(candidates, history, rules)
        if not self._blind:  # an acquisition that ignores the belief does not wait for it
            self._decision_time += seconds
        self._surrogate = surrogate
        self.summaries[count] = _BeliefSummary(
            belief.entropy, float(belief.probabilities.max()), belief.best
        )
        self._belief_ready_at = time.perf_counter()
        return surrogate, belief

    def entropy(self, history: History, rules: Rules) -> float:
        """Return the entropy after a history, also where it was not computed before."""
        seen = self.summaries.get(len(history))
        if seen is None:
            return _cached_belief(self._scene.candidates, history, rules)[1].entropy
        return seen.entropy

    def beliefs(self, count: int) -> list[_BeliefSummary | None]:
        """Return what was seen after each of so many evaluations."""
        return [self.summaries.get(n) for n in range(1, count + 1)]


def _unknown(size: int) -> ArgminBelief:
    return ArgminBelief(np.full(size, 1.0 / size), "none", 1.0)


_beliefs: OrderedDict[bytes, tuple[Surrogate, ArgminBelief, float]] = OrderedDict()


def _cached_belief(
    candidates: CandidateSet, history: History, rules: Rules
) -> tuple[Surrogate, ArgminBelief, float]:
    """Return the belief, cached, and the seconds that it takes.

    It follows from B, the history and the seed, not from the acquisition: arms with the same
    picks so far share one belief, which is computed once in a process.
    """
    parts = (candidates.points, history.rows, history.evaluation.deviation, np.array(rules.seed))
    key = b"|".join(_digest(p) for p in parts)
    if key not in _beliefs:
        began = time.perf_counter()
        found = update_belief(candidates, history, rules)
        _beliefs[key] = (*found, time.perf_counter() - began)
        if len(_beliefs) > _KEPT:
            _beliefs.popitem(last=False)
    _beliefs.move_to_end(key)
    return _beliefs[key]


def _digest(values: Points | np.ndarray) -> bytes:
    return hashlib.sha256(np.ascontiguousarray(values).tobytes()).digest()


def _entropy_convergence(watch: _Watch, study: Study, history: History, rules: Rules) -> int | None:
    """Return after how many evaluations the entropy had converged; None where it never had.

    For a blind acquisition the rule is applied where the belief was computed; the entropies
    between, which the rule needs as well, are computed where the known ones do not vary.
    """
    rule = study.search.stop
    counts = sorted(watch.summaries)
    for count in counts:
        if count - rule.last < counts[0]:
            continue
        window = range(count - rule.last, count + 1)
        known = [watch.summaries[n].entropy for n in window if n in watch.summaries]
        if entropy_converged(known, rule.entropy, len(known) - 1):
            every = [watch.entropy(_first(history, n), rules) for n in window]
            if entropy_converged(every, rule.entropy, rule.last):
                return count
    return None


def _first(history: History, count: int) -> History:
    """Return a history as it was after so many evaluations."""
    evaluation = history.evaluation
    return History(
        history.rows[:count],
        Evaluation(
            evaluation.deviation[:count],
            evaluation.contributions[:count],
            evaluation.diverged[:count],
        ),
        history.entropy[:count],
    )


def _intervals(scene: _Scene, outcome: SearchOutcome, study: Study, seed: int) -> dict[str, Any]:
    """Return the plant's parameters, and the 95 % intervals that P_boot gives for them."""
    candidates, blocks = scene.candidates, scene.blocks
    bootstrap = outcome.bootstrap(candidates.points, blocks.weight, blocks.session, seed)
    cell = candidates.cell / 2
    low, high = credible_interval(candidates.points, bootstrap, 0.95)
    plant = study.plant.parameters if study.plant else {}
    return {
        "parameters": [p.name for p in candidates.parameters],
        "truth": [plant.get(p.name) for p in candidates.parameters],
        "low95": (low - cell).tolist(),
        "high95": (high + cell).tolist(),
    }

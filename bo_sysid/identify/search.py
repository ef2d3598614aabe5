"""The search for the arg-min of Δ over the discrete set B: ask, simulate, tell.

Nothing here knows of models or recordings: Δ comes from a function of a row. Every step follows
from the history alone, so that an interrupted search, resumed, has the same result.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import cKDTree
from scipy.stats import qmc

from bo_sysid.acquisition import SelectionContext, build_acquisition
from bo_sysid.acquisition.rows import pick
from bo_sysid.arrays import Points, Probabilities
from bo_sysid.belief.argmin import ArgminBelief, argmin_probability
from bo_sysid.belief.bootstrap import bootstrap_argmin
from bo_sysid.belief.stopping import StopReason, StopRule
from bo_sysid.belief.surrogate import Surrogate, fit_surrogate
from bo_sysid.deviation import Evaluation
from bo_sysid.parameters import CandidateSet

Evaluate = Callable[[int], Evaluation]
"""Returns Δ of one row of B."""

UpdateBelief = Callable[[CandidateSet, "History", "Rules"], tuple[Surrogate, ArgminBelief]]
"""Returns surrogate and belief after a history."""


@dataclass(frozen=True)
class History:
    """What was evaluated, in order.

    Attributes:
        rows: `n` rows of B.
        evaluation: their deviations.
        entropy: `n` entropies of P in nats after each evaluation; NaN during the initial design.
    """

    rows: Int[np.ndarray, " n"]
    evaluation: Evaluation
    entropy: Float[np.ndarray, " n"]

    @classmethod
    def empty(cls, blocks: int) -> "History":
        """Return a history without evaluations."""
        none = np.zeros(0)
        return cls(np.zeros(0, int), Evaluation(none, np.zeros((0, blocks)), none), none)

    def __len__(self) -> int:
        return len(self.rows)

    def with_evaluation(self, row: int, evaluation: Evaluation) -> "History":
        """Return the history with one more evaluation, whose entropy is not known yet."""
        old = self.evaluation
        joined = Evaluation(
            np.append(old.deviation, evaluation.deviation),
            np.concatenate([old.contributions, evaluation.contributions]),
            np.append(old.diverged, evaluation.diverged),
        )
        return History(np.append(self.rows, row), joined, np.append(self.entropy, np.nan))

    def with_entropy(self, entropy: float) -> "History":
        """Return the history with the entropy after its last evaluation."""
        return History(self.rows, self.evaluation, np.append(self.entropy[:-1], entropy))


@dataclass(frozen=True)
class Rules:
    """How to search.

    Attributes:
        acquisition: name of the rule that picks the next candidate.
        stop: when to stop.
        seed: of everything drawn at random.
    """

    acquisition: str
    stop: StopRule
    seed: int = 0


@dataclass(frozen=True)
class SearchOutcome:
    """Where a search ended.

    Attributes:
        history: every evaluation.
        surrogate: of a power of Δ, after the last one.
        belief: P over B, after the last one.
        reason: why the search stopped.
    """

    history: History
    surrogate: Surrogate
    belief: ArgminBelief
    reason: StopReason

    def bootstrap(
        self,
        points: Points,
        weights: Float[np.ndarray, " blocks"],
        groups: Int[np.ndarray, " blocks"] | None,
        seed: int,
    ) -> Probabilities:
        """Return P_boot of each candidate, see `bootstrap_argmin`.

        Args:
            points: `N x d`, the set B.
            weights: of each block of the recordings in Δ.
            groups: session of each block; None where all are of one session.
            seed: of bootstraps and samples.
        """
        found = self.history
        contributions = found.evaluation.contributions
        return bootstrap_argmin(
            self.surrogate, points, found.rows, contributions, weights, groups=groups, seed=seed
        ).probabilities


def search(
    candidates: CandidateSet,
    evaluate: Evaluate,
    rules: Rules,
    history: History,
    on_step: Callable[[History], None] = lambda _: None,
    belief_update: UpdateBelief | None = None,
) -> SearchOutcome:
    """Search the candidate with the smallest Δ.

    Args:
        candidates: the set B.
        evaluate: returns Δ of a row.
        rules: how to search.
        history: what was evaluated before; the search resumes from it.
        on_step: called with the history so far after every evaluation, again once its entropy is
            known.
        belief_update: fits surrogate and belief; `update_belief` by default.
    """
    updated = belief_update or update_belief
    design = initial_rows(candidates, rules)
    room = max(rules.stop.budget - len(history), 0)
    for row in np.sort(design[~np.isin(design, history.rows)][:room]).tolist():
        history = history.with_evaluation(row, evaluate(row))
        on_step(history)
    while True:
        surrogate, belief = updated(candidates, history, rules)
        if np.isnan(history.entropy[-1]):
            history = history.with_entropy(belief.entropy)
            on_step(history)
        entropies = history.entropy[np.isfinite(history.entropy)]
        reason = rules.stop(entropies.tolist(), belief, history.rows)
        if reason is not None:
            return SearchOutcome(history, surrogate, belief, reason)
        row = select_next(candidates, history, surrogate, belief, rules)
        history = history.with_evaluation(row, evaluate(row))
        on_step(history)  # before the next belief is made: an evaluation may have taken long


def initial_rows(candidates: CandidateSet, rules: Rules) -> Int[np.ndarray, " n"]:
    """Return the rows of the initial design: 2 d + 2 candidates that fill the box.

    They are those nearest to a scrambled Sobol sequence, scaled to the bounds.
    """
    low, high = candidates.bounds
    wanted = min(2 * len(low) + 2, rules.stop.budget, len(candidates))
    tree = cKDTree((candidates.points - low) / (high - low))
    sobol = qmc.Sobol(len(low), rng=np.random.default_rng(rules.seed))
    near = np.asarray(tree.query(sobol.random_base2(int(np.ceil(np.log2(8 * wanted)))))[1])
    rows = near[np.sort(np.unique(near, return_index=True)[1])][:wanted]
    spare = np.setdiff1d(np.arange(len(candidates)), rows)  # a small B: the points may repeat
    return np.concatenate([rows, spare])[:wanted]


def update_belief(
    candidates: CandidateSet, history: History, rules: Rules
) -> tuple[Surrogate, ArgminBelief]:
    """Fit the surrogate of Δ to a history; return it and the belief about the arg-min."""
    seed = rules.seed * 100_003 + len(history)
    surrogate = fit_surrogate(
        candidates.points[history.rows],
        history.evaluation.deviation,
        candidates.bounds,
        categories=candidates.categories,
        seed=seed,
    )
    return surrogate, argmin_probability(surrogate, candidates.points, seed=seed)


def select_next(
    candidates: CandidateSet,
    history: History,
    surrogate: Surrogate,
    belief: ArgminBelief,
    rules: Rules,
) -> int:
    """Return the row to evaluate next; never one that was evaluated before."""
    context = SelectionContext(surrogate, belief, candidates.points, history.rows, rules.seed)
    return pick(build_acquisition(rules.acquisition, context), candidates.points, history.rows)

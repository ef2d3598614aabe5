"""When the search over B stops, as functions of its history."""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum

import numpy as np

from bo_sysid.arrays import Rows
from bo_sysid.belief.argmin import ArgminBelief


class StopReason(Enum):
    """Why a search stopped, with what it means; the value is written into the run."""

    ENTROPY = "entropy"
    BUDGET = "budget"
    CONVERGED = "converged"
    VALUES = "values"

    @property
    def sentence(self) -> str:
        """What happened and what to do about it."""
        return {
            StopReason.ENTROPY: "The entropy of the belief did not change any more; a lower "
            "stop.entropy or a larger stop.last, in another run folder, goes further.",
            StopReason.BUDGET: "The budget of evaluations was reached; "
            "a larger search.budget, in another run folder, goes further.",
            StopReason.CONVERGED: "All probability is on candidates that were evaluated.",
            StopReason.VALUES: "What the belief leaves open does not matter for the policy.",
        }[self]


@dataclass(frozen=True)
class StopRule:
    """The three conditions under which the search ends.

    Attributes:
        budget: number of evaluations, the initial ones included.
        entropy: threshold in nats; None switches the entropy condition off.
        last: number of picks over which the entropy is watched.
    """

    budget: int = 60
    entropy: float | None = 0.01
    last: int = 5

    def __post_init__(self) -> None:
        if self.budget < 1 or self.last < 1:
            raise ValueError(f"budget {self.budget} and last {self.last} must be at least 1")
        if self.entropy is not None and self.entropy < 0:
            raise ValueError(f"entropy {self.entropy} must not be negative")

    def __call__(
        self, entropies: Sequence[float], belief: ArgminBelief, evaluated: Rows
    ) -> StopReason | None:
        """Return the reason to stop, or None to go on.

        Args:
            entropies: of the belief after the initial evaluations and after each pick since.
            belief: the present one.
            evaluated: rows that have been evaluated.
        """
        if has_converged(belief, evaluated):
            return StopReason.CONVERGED
        if len(evaluated) >= self.budget:
            return StopReason.BUDGET
        if self.entropy is not None and entropy_converged(entropies, self.entropy, self.last):
            return StopReason.ENTROPY
        return None


def has_converged(belief: ArgminBelief, evaluated: Rows) -> bool:
    """Return whether all probability is on candidates that were evaluated."""
    unseen = np.ones(len(belief.probabilities), dtype=bool)
    unseen[np.asarray(evaluated, dtype=np.intp)] = False
    return not belief.probabilities[unseen].any()


def entropy_converged(entropies: Sequence[float], threshold: float, last: int) -> bool:
    """Return whether the entropy stayed within `threshold` nats over the last `last` picks.

    A rising entropy counts as well (a second valley was found), so the spread of the window is
    watched, not only its fall.
    """
    if len(entropies) <= last:
        return False
    window = np.asarray(entropies[-last - 1 :])
    return bool(window.max() - window.min() < threshold)

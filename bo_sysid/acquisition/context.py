"""What an acquisition may look at."""

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from bo_sysid.arrays import Points, Rows
from bo_sysid.belief.argmin import ArgminBelief, argmin_probability, evaluated_rows
from bo_sysid.belief.joint import posterior_moments
from bo_sysid.belief.surrogate import Surrogate

if TYPE_CHECKING:
    from torch import Tensor


@dataclass(frozen=True)
class SelectionContext:
    """The state of the search when the next candidate is chosen.

    Attributes:
        surrogate: of Δ, given all evaluations so far.
        belief: P over the candidates.
        candidates: `N x d`, the set B.
        evaluated: rows of B that were evaluated.
        seed: of whatever the acquisition draws; the same for the whole search.
    """

    surrogate: Surrogate
    belief: ArgminBelief
    candidates: Points
    evaluated: Rows
    seed: int = 0

    def __post_init__(self) -> None:
        if len(self.belief.probabilities) != len(self.candidates):
            raise ValueError(
                f"belief over {len(self.belief.probabilities)} candidates does not belong to a "
                f"set of {len(self.candidates)}"
            )

    @cached_property
    def choices(self) -> "Tensor":
        """The candidates as a float64 tensor `N x d`."""
        import torch

        return torch.tensor(self.candidates, dtype=torch.float64)

    def moments(self) -> tuple[Float[np.ndarray, "M N"], Float[np.ndarray, "M N"]]:
        """Return mean and standard deviation of the warped Δ, `M x N` each.

        A row for each member of the ensemble, a column for each candidate.
        """
        surrogate = self.surrogate
        x = surrogate.unit(self.candidates)
        known, known_values = evaluated_rows(surrogate, self.candidates)
        found = [
            posterior_moments(member, x, surrogate.standardised, known, known_values)
            for member in surrogate.members
        ]
        mean = surrogate.shift + surrogate.scale * np.array([m.mean for m in found])
        return mean, surrogate.scale * np.sqrt([m.variance for m in found])

    def after(self, rows: Rows, seed: int) -> "SelectionContext":
        """Return the context as it may be once pending rows have been evaluated.

        Their Δ is drawn from the joint posterior (a fantasy), the surrogate is conditioned on
        it and the belief computed again.

        Args:
            rows: `k` rows of B, none of them evaluated.
            seed: of the fantasy: its number among several.
        """
        points = self.candidates[rows]
        rng = np.random.default_rng((self.seed, seed, len(self.evaluated)))
        member = self.surrogate.members[
            rng.choice(len(self.surrogate.members), p=self.surrogate.weights)
        ]
        draw = member.draw(self.surrogate.unit(points), self.surrogate.standardised, rng)
        values = self.surrogate.shift + self.surrogate.scale * draw
        surrogate = self.surrogate.conditioned(points, values)
        belief = argmin_probability(surrogate, self.candidates, seed=self.seed)
        evaluated = np.append(self.evaluated, rows)
        return SelectionContext(surrogate, belief, self.candidates, evaluated, self.seed)

    def generator(self) -> np.random.Generator:
        """Return the random generator of this step of the search."""
        return np.random.default_rng((self.seed, len(self.evaluated)))

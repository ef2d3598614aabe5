"""What an acquisition may look at."""

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from bo_sysid.arrays import Points, Rows
from bo_sysid.belief.argmin import ArgminBelief
from bo_sysid.belief.surrogate import Surrogate

if TYPE_CHECKING:
    from torch import Tensor


@dataclass(frozen=True)
class SelectionContext:
    """The state of the search when the next candidate is chosen.

    Attributes:
        surrogate: of log Δ, given all evaluations so far.
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

    def generator(self) -> np.random.Generator:
        """Return the random generator of this step of the search."""
        return np.random.default_rng((self.seed, len(self.evaluated)))

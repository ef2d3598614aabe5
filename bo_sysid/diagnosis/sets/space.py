"""The vector of all that is fitted of a set, with its bounds."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from bo_sysid.diagnosis.windows.hypothesis import Candidate, Hypothesis, beside, slices_of
from bo_sysid.diagnosis.windows.problem import Problem
from bo_sysid.diagnosis.windows.timestep import SHARE_BOUNDS


@dataclass(frozen=True)
class Space:
    """The vector that is fitted: magnitudes of members, parameters, share of the finer step.

    Attributes:
        members: the effects.
        nuisances: the study's parameters that are fitted beside them.
        numerics: whether the share of a finer time step is among what is fitted.
        low: least values.
        high: largest values.
        probe: changes that move the predictions measurably.
    """

    members: tuple[Candidate, ...]
    nuisances: tuple[Candidate, ...]
    numerics: bool
    low: Float[np.ndarray, " p"]
    high: Float[np.ndarray, " p"]
    probe: Float[np.ndarray, " p"]

    @classmethod
    def of(cls, problem: Problem, members: Sequence[Candidate]) -> "Space":
        """Return the space in which a set is fitted to some windows."""
        nuisances = beside(problem.nuisances, members)
        held = (*members, *nuisances)
        numerics = problem.correction is not None
        extra = ([SHARE_BOUNDS[0]], [SHARE_BOUNDS[1]], [1.0]) if numerics else ([], [], [])
        low, high, probe = (
            np.concatenate([*(getattr(c, name) for c in held), np.array(tail, float)])
            for name, tail in zip(("low", "high", "probe"), extra, strict=True)
        )
        return cls(tuple(members), nuisances, numerics, low, high, probe)

    def vector(self, x: Sequence[np.ndarray], guess: Hypothesis) -> Float[np.ndarray, " p"]:
        """Return the vector of magnitudes, and of the parameters and the share of a guess."""
        tail = np.array([guess.numerics] if self.numerics else [], float)
        known = dict(zip(guess.nuisances, guess.nuisance_x, strict=True))
        nuisance = (known.get(c, np.zeros(c.size)) for c in self.nuisances)
        return np.asarray(np.clip(np.concatenate([*x, *nuisance, tail]), self.low, self.high))

    def hypothesis(self, theta: Float[np.ndarray, " p"]) -> Hypothesis:
        """Return what a vector says."""
        held = (*self.members, *self.nuisances)
        parts = tuple(theta[own] for own in slices_of(held))
        k = len(self.members)
        numerics = float(theta[-1]) if self.numerics else 0.0
        return Hypothesis(self.members, parts[:k], self.nuisances, parts[k:], numerics)

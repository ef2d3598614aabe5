"""The choice between sets of effects, searched as one discrete set B.

B is the union over the carried sets of a grid of magnitudes about their fits. Its arg-min is
searched with the surrogate of `identify` and the entropy of the arg-min; which set it belongs to on
other recordings, P_boot(set), stands beside the posterior, which is computed in another way from
the same fits: where the two disagree, that is said.
"""

from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from jaxtyping import Float, Int

from bo_sysid.belief.stopping import StopRule
from bo_sysid.deviation import Evaluation
from bo_sysid.deviation.measure import SESSIONS
from bo_sysid.diagnosis.sets.decide import Decision
from bo_sysid.diagnosis.sets.fit import Fit
from bo_sysid.diagnosis.windows.candidate import slices_of
from bo_sysid.diagnosis.windows.hypothesis import Hypothesis
from bo_sysid.diagnosis.windows.problem import Problem
from bo_sysid.diagnosis.windows.projection import project
from bo_sysid.identify.search import History, Rules, search
from bo_sysid.parameters import CandidateSet, Parameter

_SETS = 6  # carried sets at most
_STEPS = (-1.0, 0.0, 1.0)  # of the grid, in standard deviations about the fit
_RELATIVE = 0.005  # of a magnitude, beside its standard deviation
_FULL = 3  # magnitudes of a set up to which its grid is full; others vary one at a time
_SAME = 0.02  # of what they leave, at least of a sigma: difference of sets that are one
_SURE = 0.5  # P_boot above which another set than the answer is worth a sentence
_WINDOWS = 24
_BUDGET = 30
_ACQUISITION = "argmin-entropy"


@dataclass(frozen=True)
class ArgminSets:
    """Which set the arg-min belongs to.

    Attributes:
        sets: the carried sets, most probable first.
        bootstrap: P_boot of each.
    """

    sets: tuple[Fit, ...]
    bootstrap: Float[np.ndarray, " s"]

    @property
    def best(self) -> Fit:
        """The set with the largest P_boot."""
        return self.sets[int(np.argmax(self.bootstrap))]

    def disagrees(self, answer: Fit) -> bool:
        """Whether the arg-min lies, more often than not, in another set than the answer."""
        return bool(self.sets) and self.best is not answer and float(self.bootstrap.max()) > _SURE

    def of(self, fit: Fit) -> float | None:
        """Return P_boot of a set, None where it was not carried."""
        found = (float(p) for f, p in zip(self.sets, self.bootstrap, strict=True) if f is fit)
        return next(found, None)


def argmin_sets(problem: Problem, Q: Float[np.ndarray, "W R k"], decision: Decision) -> ArgminSets:
    """Search the arg-min over the carried sets and their magnitudes.

    Args:
        problem: the training windows.
        Q: basis of the response to their starts.
        decision: the sets that were fitted on them.
    """
    sets = decision.fits[:_SETS]
    if len(sets) < 2:
        return ArgminSets(sets, np.ones(len(sets)))
    keep = problem.windows.evenly(_WINDOWS)
    part = problem.rows(keep)
    blocks = int(part.block.max()) + 1
    if blocks < 2:  # other recordings cannot be drawn from it
        return ArgminSets((), np.zeros(0))
    candidates, owner = _candidates(sets)

    def evaluate(row: int) -> Evaluation:
        fit = sets[owner[row]]
        hypothesis = _at(fit, candidates.points[row, 1 : 1 + fit.width])
        y = project(Q[keep], part.residual(hypothesis, fit.start.rows(keep)))
        return _by_block(part, y, _optimism(fit) / problem.dof)

    rules = Rules(
        _ACQUISITION, StopRule(budget=min(_BUDGET, len(candidates)), entropy=0.02, last=4)
    )
    outcome = search(candidates, evaluate, rules, History.empty(blocks))
    weights = np.bincount(part.block).astype(float)
    bootstrap = outcome.bootstrap(candidates.points, weights, _recordings(part), rules.seed)
    share = np.bincount(owner, weights=bootstrap, minlength=len(sets))
    return ArgminSets(sets, _shared(sets, Q, problem.dof, share))


def _recordings(problem: Problem) -> Int[np.ndarray, " b"] | None:
    """Return the recording of each block, None where there are too few recordings to draw from."""
    recording = problem.windows.recording
    if len(np.unique(recording)) < SESSIONS:
        return None
    first = np.unique(problem.block, return_index=True)[1]
    return np.asarray(recording[first], int)


def _shared(
    sets: tuple[Fit, ...], Q: Float[np.ndarray, "W R k"], dof: int, share: np.ndarray
) -> Float[np.ndarray, " s"]:
    """Return the probabilities with sets that predict the same sharing theirs."""
    left = np.stack([project(Q, f.residual).ravel() for f in sets])
    apart = np.sqrt(((left[:, None] - left[None]) ** 2).sum(axis=-1) / dof)
    rms = np.array([f.rms for f in sets])
    same = (apart < _SAME * np.maximum(1.0, np.minimum(rms[:, None], rms))).astype(float)
    return np.asarray(same @ share / same.sum(axis=1))


def _candidates(sets: tuple[Fit, ...]) -> tuple[CandidateSet, np.ndarray]:
    """Return B, with the set as a category and magnitudes in deviations, and each row's set."""
    most = max(f.width for f in sets)
    rows, owner = [], []
    for number, fit in enumerate(sets):
        for z in _grid(fit.width):
            rows.append([number, *z, *(0.0,) * (most - len(z))])
            owner.append(number)
    names = [f"magnitude {k}" for k in range(most)]
    category = Parameter("set", ("set",), 0, len(sets) - 1, steps=len(sets), ordered=False)
    magnitudes = (Parameter(n, (n,), _STEPS[0], _STEPS[-1], steps=len(_STEPS)) for n in names)
    return CandidateSet((category, *magnitudes), np.array(rows, float)), np.array(owner)


def _grid(width: int) -> list[tuple[float, ...]]:
    if width <= _FULL:
        return list(product(_STEPS, repeat=width))
    around = [tuple(np.eye(width)[k] * s) for k in range(width) for s in _STEPS if s]
    return [(0.0,) * width, *around]


def _at(fit: Fit, steps: Float[np.ndarray, " k"]) -> Hypothesis:
    """Return the hypothesis of a fit with its magnitudes so many deviations away, within bounds."""
    x = []
    for c, value, own in zip(fit.members, fit.x, slices_of(fit.members), strict=True):
        variance = np.diag(fit.covariance)[own] + (_RELATIVE * value) ** 2
        x.append(np.clip(value + np.sqrt(variance) * steps[own], c.low, c.high))
    return replace(fit.hypothesis, x=tuple(x))


def _optimism(fit: Fit) -> float:
    """Return by how much more a set leaves of blocks that it is not fitted to.

    Not less than 0: a set that leaves less of those was not fitted to its end.
    """
    return max(float((fit.cv - fit.cost).sum()), 0.0)


def _by_block(problem: Problem, y: Float[np.ndarray, "W R"], optimism: float) -> Evaluation:
    """Return the mean square of what is left of each block in sigma², cross-validated.

    To what the magnitudes leave is added the optimism of having been fitted to the same blocks:
    squares left out minus squares fitted.
    """
    weights = np.bincount(problem.block)
    squares = np.bincount(problem.block, weights=(y**2).sum(axis=1)) / weights
    contributions = squares * len(y) / problem.dof + optimism
    total = float(contributions @ weights / weights.sum())
    return Evaluation(np.array([total]), contributions[None], np.zeros(1))

"""Decide between the sets that were fitted, on the training recordings alone."""

import operator
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import sqrt

import numpy as np
from jaxtyping import Float

from bo_sysid.diagnosis.sets.fit import Fit
from bo_sysid.diagnosis.sets.rules import (
    LOOSE,
    SetPrior,
    admissible,
    clean,
    criterion,
    inflation,
    required_size,
)
from bo_sysid.diagnosis.windows.problem import ROUGH
from bo_sysid.diagnosis.windows.projection import project

BAND = 4.6
"""Difference of log posterior within which sets are equivalent: 1 in 100."""

# [sigma] rms difference below which two sets predict the same; where they leave far more than the
# sensors' noise, a share of what they leave
_SAME = 0.05
_CHANCE = 0.5  # share of what is left unexplained, below which a difference may be chance
_TRIFLE = 0.1  # share of what a richer effect holds, that is its own: below, it says nothing more
_NEARLY = 0.5  # of the size that a member must have, for a set that may stand for the best
_AFTER = 1e-9  # difference of log posterior that orders equals
_ROUNDS = 3
_MOST_EQUIVALENT = 11


@dataclass(frozen=True)
class Decision:
    """The posterior over the admissible sets.

    Attributes:
        best: the set that is answered.
        nominal: the fit of nothing.
        fits: the admissible sets, most probable first.
        probability: of each.
        equivalents: sets that the recordings do not tell from the best.
    """

    best: Fit
    nominal: Fit
    fits: tuple[Fit, ...]
    probability: Float[np.ndarray, " f"]
    equivalents: tuple[Fit, ...]


def decide(
    fits: Sequence[Fit],
    nominal: Fit,
    prior: SetPrior,
    Q: Float[np.ndarray, "W R k"],
    dof: int,
    equal: Callable[[Fit, Fit], bool] = operator.is_,
) -> Decision:
    """Return the posterior over sets.

    Posterior ∝ exp(-½ ΣD/κ)·prior with D the difference of the blocks' cross-validated squares
    to the best set; κ grows with the variance of D between blocks where that is larger than the
    one of two nearly true models.

    Args:
        fits: of all sets.
        nominal: the fit of nothing.
        prior: of sets.
        Q: what starts make up for.
        dof: degrees of freedom of the residuals.
        equal: whether two sets are the same, whatever they leave.
    """
    compared = _Compared(fits, nominal, prior, inflation(fits), Q, dof, equal)
    ranking = _rank_admitted(compared)
    leader = ranking.leader
    best, as_probable = _answer(compared, leader, ranking.fits)
    for fit in reversed(as_probable):
        ranking = ranking.with_tie(fit)
    ranking = ranking.ordered()
    equivalents = _equivalents(compared, ranking, best, (leader, *as_probable))
    return Decision(best, nominal, tuple(ranking.fits), ranking.probability, equivalents)


@dataclass(frozen=True)
class _Compared:
    """The sets between which is decided, and the measures by which they are compared."""

    fits: Sequence[Fit]
    nominal: Fit
    prior: SetPrior
    kappa: float
    Q: Float[np.ndarray, "W R k"]
    dof: int
    equal: Callable[[Fit, Fit], bool]

    @property
    def finite(self) -> list[Fit]:
        """The fits whose cross-validated squares are finite."""
        return [f for f in self.fits if np.isfinite(f.cv.sum())]

    def cost(self, fit: Fit) -> float:
        """Return the deviance by which fits are ranked, lower is better."""
        return criterion(fit, self.kappa, self.prior)

    def rms_difference(self, one: Fit, two: Fit) -> float:
        """Return the rms difference of two fits' predictions in sigma."""
        difference = project(self.Q, one.residual - two.residual)
        return float(np.sqrt((difference**2).sum() / self.dof))

    def nearly_admissible(self, fit: Fit) -> bool:
        """Whether every member has at least half of the size that a name needs."""
        return min(fit.unique, default=0.0) > _NEARLY * required_size(fit, self.nominal)


def _rank_admitted(compared: _Compared) -> "_Ranking":
    """Return the sets that may be answered, with their posteriors.

    Only sets whose every member is needed are admitted, and those that stand for the best of them
    as well as it does itself.
    """
    finite, cost = compared.finite, compared.cost
    admitted = [f for f in finite if admissible(f, compared.nominal, compared.fits)]
    leader = min(admitted, key=cost)
    stand_ins = [
        f
        for f in finite
        if compared.nearly_admissible(f)
        and f not in admitted
        and _stands_for(compared, f, leader)
        and not _refines(compared, f, leader)
    ]
    candidates = _best_of_each_set([*admitted, *stand_ins], cost)
    leader, score = _scored(candidates, leader, compared.kappa, compared.prior)
    score = _equalise_indistinguishable(compared, candidates, score, leader)
    return _Ranking(candidates, _prefer_simpler_equivalent(compared, candidates, score))


def _answer(compared: _Compared, leader: Fit, ranked: Sequence[Fit]) -> tuple[Fit, Sequence[Fit]]:
    """Return the set that is answered, and those outside the ranking that are as probable.

    Args:
        compared: all sets.
        leader: the most probable of the ranked ones.
        ranked: the sets that may be answered by `_rank_admitted`.
    """
    cost = compared.cost
    rejected = [f for f in compared.finite if f not in ranked]
    # Where the leader leaves something that one effect more explains, too small a part of what the
    # nominal model leaves for a name, both are as probable, and the one that explains it is
    # answered.
    completing = _best_of_each_set([f for f in rejected if _completes(compared, f, leader)], cost)
    if completing:
        return completing[0], [f for f in completing if cost(f) - cost(completing[0]) < BAND]
    # Where recordings that are nearly explained ask for a richer effect in the place of one of the
    # leader, but with less than a name needs, that is answered, the plain one being as probable.
    richer = sorted([f for f in rejected if _refines(compared, f, leader)], key=cost)
    nearly = [f for f in richer if compared.nearly_admissible(f)]
    if nearly:
        return nearly[0], nearly[:1]
    # Where a member of the richer set falls short of half that size, the plain set is answered,
    # and the richer one is listed as equally probable if it says something else.
    return leader, [f for f in richer if _refinement_matters(f)][:1]


def _equivalents(
    compared: _Compared, ranking: "_Ranking", best: Fit, as_probable: Sequence[Fit]
) -> tuple[Fit, ...]:
    """Return the first sets of an ordered ranking that the recordings do not tell from the best.

    Args:
        compared: all sets.
        ranking: most probable first.
        best: the set that is answered.
        as_probable: sets that are equivalents whatever they predict.
    """
    top = ranking.score[0]
    first = list(zip(ranking.fits, ranking.score, strict=True))[: _MOST_EQUIVALENT + 1]
    return tuple(
        f
        for f, score in first
        if f is not best
        and (f in as_probable or _is_equivalent(compared, f, best, float(top - score)))
    )


@dataclass(frozen=True)
class _Ranking:
    """Sets and the logarithms of their posteriors, up to a constant."""

    fits: list[Fit]
    score: Float[np.ndarray, " f"]

    @property
    def leader(self) -> Fit:
        return self.fits[int(np.argmax(self.score))]

    @property
    def probability(self) -> Float[np.ndarray, " f"]:
        weight = np.exp(self.score - self.score.max())
        return np.asarray(weight / weight.sum())

    def with_tie(self, fit: Fit) -> "_Ranking":
        """Return the same with a set that is as probable as the leader, before it."""
        return _Ranking([fit, *self.fits], np.concatenate([[self.score.max()], self.score]))

    def ordered(self) -> "_Ranking":
        """Return the same, most probable first."""
        order = np.argsort(-self.score, kind="stable")
        return _Ranking([self.fits[i] for i in order], self.score[order])


def _stands_for(compared: _Compared, fit: Fit, best: Fit) -> bool:
    """Whether a fit stands for the best one: the same predictions, or one member exchanged."""
    if len(fit.members) != len(best.members):
        return False
    shared = len(fit.names & best.names)
    exchanged = len(best.members) > 1 and shared == len(best.members) - 1
    worse = compared.cost(fit) - compared.cost(best)
    return bool(best.members) and (
        (exchanged and worse < BAND) or compared.rms_difference(fit, best) < _SAME
    )


def _refines(compared: _Compared, fit: Fit, best: Fit) -> bool:
    """Whether a fit is the best one with an effect that holds one of its own, and explains more.

    Only close to the recordings: far from them what a richer effect explains may be anything.
    """
    cost = compared.cost
    own, keys = {c.key for c in best.members}, {c.key for c in fit.members}
    plainer = {(c.effect.nested, c.site.name) for c in fit.members if c.key not in own}
    instead = bool(plainer) and plainer == own - keys
    return instead and fit.rms <= LOOSE and cost(fit) < cost(best) - BAND


def _completes(compared: _Compared, fit: Fit, best: Fit) -> bool:
    """Whether a fit is the best one with one effect more, and leaves noise where that leaves more.

    Its members must be needed but for one thing: one may be a small part of what the nominal model
    leaves, as the shape of a large effect that is a little off would be.
    """
    cost = compared.cost
    more = best.names < fit.names and fit.size == best.size + 1
    explains = more and clean(fit) and not clean(best) and cost(fit) < cost(best) - BAND
    # what it leaves itself, for the nominal model
    return explains and admissible(fit, fit, compared.fits)


def _refinement_matters(fit: Fit) -> bool:
    """Whether what a richer effect has of its own is more than a trifle of what it holds.

    That is a tenth, in units of the magnitudes: what the time step does to friction is less.
    """
    scaled = [(np.abs(x / c.probe), c) for c, x in zip(fit.members, fit.x, strict=True)]
    return any(c.effect.nested and x[0] > _TRIFLE * x[1:].max() for x, c in scaled)


def _best_of_each_set(fits: Sequence[Fit], cost: Callable[[Fit], float]) -> list[Fit]:
    """Return the best of the fits that name the same effects at the same sites."""
    found: dict[frozenset[tuple[str, str]], Fit] = {}
    for f in sorted(fits, key=cost):
        found.setdefault(frozenset(c.key for c in f.members), f)
    return list(found.values())


def _scored(
    fits: Sequence[Fit], best: Fit, kappa: float, prior: SetPrior
) -> tuple[Fit, Float[np.ndarray, " f"]]:
    """Return the leader and the log posterior of each fit against it.

    The leader is compared with itself, or after some rounds with the one before it.
    """
    for _ in range(_ROUNDS):
        score = np.array([_log_posterior(f, best, kappa, prior) for f in fits])
        leader = fits[int(np.argmax(score))]
        if leader is best:
            break
        best = leader
    return best, score


def _log_posterior(fit: Fit, best: Fit, kappa: float, prior: SetPrior) -> float:
    D = fit.cv - best.cv
    spread = float(D.var(ddof=1)) * len(D) if len(D) > 1 else 0.0
    usual = 4 * kappa * max(abs(float(D.sum())), 1.0)  # of two models near the truth
    widening = max(1.0, kappa * float(np.sqrt(max(spread / usual, 1.0))))
    return -0.5 * float(D.sum()) / widening + prior.log(fit)


def _equalise_indistinguishable(
    compared: _Compared, fits: Sequence[Fit], score: Float[np.ndarray, " f"], best: Fit
) -> Float[np.ndarray, " f"]:
    """Return the scores where sets of one size that predict nearly the same differ by their prior.

    Nearly is little beside what all of them leave, E = √(rms² - 1): that is no noise but the
    model's step or other small physics, and sets whose predictions are d apart may differ in N
    samples by up to 2 N d E for no better reason than how it happens to lie.
    """
    prior = compared.prior
    near = max(_SAME * sqrt(best.excess), min(_CHANCE * sqrt(best.excess), _SAME))
    level = score[[f is best for f in fits].index(True)] - prior.log(best)
    same = [
        len(f.members) == len(best.members)
        and (compared.rms_difference(f, best) < near or compared.equal(f, best))
        for f in fits
    ]
    return np.where(same, [level + prior.log(f) for f in fits], score)


def _prefer_simpler_equivalent(
    compared: _Compared, fits: Sequence[Fit], score: Float[np.ndarray, " f"]
) -> Float[np.ndarray, " f"]:
    """Return the scores where a group has no more than what does the same with fewer magnitudes.

    All thrusts that are too small by one share are a mass that is too large, or a low battery: that
    their magnitudes agree would be chance, or have one cause. The plainer set has the group's score
    then, so that neither falls behind a third one for it. Nor has a load somewhere about its body
    more than one number that does the same: another motion may tell what its place is made up for.
    """
    out = score.copy()
    for k, fit in enumerate(fits):
        moved = any(c.moved for c in fit.members)
        if not (any(fit.groups) or moved) or fit.rms > ROUGH:
            continue
        simpler = [
            i
            for i, f in enumerate(fits)
            if f.size == fit.size
            and f.width < fit.width
            and compared.rms_difference(f, fit) < _SAME
        ]
        best = max(simpler, key=lambda i: out[i], default=None)
        if best is not None and out[best] <= out[k]:
            out[best] = out[k]
            out[k] -= _AFTER
    return out


def _is_equivalent(compared: _Compared, fit: Fit, best: Fit, gap: float) -> bool:
    """Whether recordings do not tell a fit from the best one: by probability, or by predictions.

    None is a set that only adds to the best one. `gap` is their difference of log posterior.
    """
    if not fit.members or best.names <= fit.names:
        return False
    near = _SAME * (best.rms if best.rms > ROUGH else 1.0)
    fewer = len(fit.members) <= len(best.members)
    return gap < BAND or (compared.rms_difference(fit, best) < near and fewer)

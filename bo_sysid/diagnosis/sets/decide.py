"""Decide between the sets that were fitted, on the training recordings alone."""

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
    required,
)
from bo_sysid.diagnosis.windows.problem import ROUGH
from bo_sysid.diagnosis.windows.projection import project

_BAND = 4.6  # difference of log posterior within which sets are equivalent: 1 in 100
_SAME = 0.05  # [sigma] difference of predictions within which sets are equivalent; a share where
# what they leave is far above the sensors' noise
# of what is left unexplained: predictions closer than that may be told apart by chance
_CHANCE = 0.5
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
    fits: Sequence[Fit], nominal: Fit, prior: SetPrior, Q: Float[np.ndarray, "W R k"], dof: int
) -> Decision:
    """Return the posterior over sets.

    Posterior ∝ exp(-½ ΣD/κ)·prior with D the difference of the blocks' cross-validated squares
    to the best set; κ grows with the variance of D between blocks where that is larger than the
    one of two nearly true models. Only sets whose every member is needed are admitted, and those
    that stand for the best of them as well as it does itself. Where recordings that are nearly
    explained ask for a richer effect in the place of one of the best, but with less than a name
    needs, that is answered, the plain one being as probable. Where it is less than half of that the
    plain one is answered, and a richer one that says something else is as probable. Where the best
    leaves something that one effect more explains, too small a part of what the nominal model
    leaves for a name, both are as probable, and the one that explains it is answered.
    """
    able = [f for f in fits if np.isfinite(f.cv.sum())]
    kappa = inflation(fits)

    def cost(fit: Fit) -> float:
        return criterion(fit, kappa, prior)

    admitted = [f for f in able if admissible(f, nominal, fits)]
    nearly = [f for f in able if min(f.unique, default=0.0) > _NEARLY * required(f, nominal)]
    leader = min(admitted, key=cost)
    alike = [
        f
        for f in nearly
        if f not in admitted
        and _is_like(f, leader, Q, dof, cost(f) - cost(leader))
        and not _is_richer(f, leader, cost)
    ]
    held = _one_of_each([*admitted, *alike], cost)
    leader, score = _scored(held, leader, kappa, prior)
    score = _levelled(held, score, leader, prior, Q, dof)
    ranking = _Ranking(held, _no_likelier(held, score, Q, dof))
    plain = ranking.leader
    others = [f for f in able if f not in held]
    richer = [f for f in others if _is_richer(f, plain, cost)]
    asked = [f for f in richer if f in nearly]
    fuller = _one_of_each([f for f in others if _completes(f, plain, fits, cost)], cost)
    beside = [f for f in fuller if cost(f) - cost(fuller[0]) < _BAND]
    beside = beside or sorted(asked or [f for f in richer if _says_more(f)], key=cost)[:1]
    best = beside[0] if fuller or asked else plain
    for fit in reversed(beside):
        ranking = ranking.with_level(fit)
    ranking = ranking.ordered()
    first = ranking.score[0]
    near = [
        f
        for f, own in list(zip(ranking.fits, ranking.score, strict=True))[: _MOST_EQUIVALENT + 1]
        if f is not best
        and (f in (plain, *beside) or _equivalent(f, best, float(first - own), Q, dof))
    ]
    return Decision(best, nominal, tuple(ranking.fits), ranking.probability, tuple(near))


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

    def with_level(self, fit: Fit) -> "_Ranking":
        """Return the same with a set that is as probable as the leader, before it."""
        return _Ranking([fit, *self.fits], np.concatenate([[self.score.max()], self.score]))

    def ordered(self) -> "_Ranking":
        """Return the same, most probable first."""
        order = np.argsort(-self.score, kind="stable")
        return _Ranking([self.fits[i] for i in order], self.score[order])


def _is_like(fit: Fit, best: Fit, Q: Float[np.ndarray, "W R k"], dof: int, worse: float) -> bool:
    """Whether a fit stands for the best one: the same predictions, or one member exchanged."""
    if len(fit.members) != len(best.members):
        return False
    shared = len(fit.names & best.names)
    exchanged = len(best.members) > 1 and shared == len(best.members) - 1
    return bool(best.members) and (
        (exchanged and worse < _BAND) or _apart(fit, best, Q, dof) < _SAME
    )


def _is_richer(fit: Fit, best: Fit, cost: Callable[[Fit], float]) -> bool:
    """Whether a fit is the best one with an effect that holds one of its own, and explains more.

    Only close to the recordings: far from them what a richer effect explains may be anything.
    """
    own, held = {c.key for c in best.members}, {c.key for c in fit.members}
    plainer = {(c.effect.nested, c.site.name) for c in fit.members if c.key not in own}
    instead = bool(plainer) and plainer == own - held
    return instead and fit.rms <= LOOSE and cost(fit) < cost(best) - _BAND


def _completes(fit: Fit, best: Fit, fits: Sequence[Fit], cost: Callable[[Fit], float]) -> bool:
    """Whether a fit is the best one with one effect more, and leaves noise where that leaves more.

    Its members must be needed but for one thing: one may be a small part of what the nominal model
    leaves, as the shape of a large effect that is a little off would be.
    """
    more = best.names < fit.names and fit.size == best.size + 1
    explains = more and clean(fit) and not clean(best) and cost(fit) < cost(best) - _BAND
    return explains and admissible(fit, fit, fits)  # what it leaves itself, for the nominal model


def _says_more(fit: Fit) -> bool:
    """Whether what a richer effect has of its own is more than a trifle of what it holds.

    That is a tenth, in units of the magnitudes: what the time step does to friction is less.
    """
    held = [(np.abs(x / c.probe), c) for c, x in zip(fit.members, fit.x, strict=True)]
    return any(c.effect.nested and x[0] > _TRIFLE * x[1:].max() for x, c in held)


def _one_of_each(fits: Sequence[Fit], cost: Callable[[Fit], float]) -> list[Fit]:
    """Return the best of the fits that name the same effects at the same sites."""
    found: dict[frozenset[tuple[str, str]], Fit] = {}
    for f in sorted(fits, key=cost):
        found.setdefault(frozenset(c.key for c in f.members), f)
    return list(found.values())


def _scored(
    held: Sequence[Fit], best: Fit, kappa: float, prior: SetPrior
) -> tuple[Fit, Float[np.ndarray, " f"]]:
    """Return the leader and the log posterior of each fit against it.

    The leader is compared with itself, or after some rounds with the one before it.
    """
    for _ in range(_ROUNDS):
        score = np.array([_log_posterior(f, best, kappa, prior) for f in held])
        leader = held[int(np.argmax(score))]
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


def _levelled(
    fits: Sequence[Fit],
    score: Float[np.ndarray, " f"],
    best: Fit,
    prior: SetPrior,
    Q: Float[np.ndarray, "W R k"],
    dof: int,
) -> Float[np.ndarray, " f"]:
    """Return the scores where sets of one size that predict nearly the same differ by their prior.

    Nearly is little beside what all of them leave, E = √(rms² - 1): that is no noise but the
    model's step or other small physics, and sets whose predictions are d apart may differ in N
    samples by up to 2 N d E for no better reason than how it happens to lie.
    """
    apart = max(_SAME * sqrt(best.excess), min(_CHANCE * sqrt(best.excess), _SAME))
    level = score[[f is best for f in fits].index(True)] - prior.log(best)
    same = [len(f.members) == len(best.members) and _apart(f, best, Q, dof) < apart for f in fits]
    return np.where(same, [level + prior.log(f) for f in fits], score)


def _no_likelier(
    fits: Sequence[Fit], score: Float[np.ndarray, " f"], Q: Float[np.ndarray, "W R k"], dof: int
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
        plain = [
            i
            for i, f in enumerate(fits)
            if f.size == fit.size and f.width < fit.width and _apart(f, fit, Q, dof) < _SAME
        ]
        best = max(plain, key=lambda i: out[i], default=None)
        if best is not None and out[best] <= out[k]:
            out[best] = out[k]
            out[k] -= _AFTER
    return out


def _apart(one: Fit, two: Fit, Q: Float[np.ndarray, "W R k"], dof: int) -> float:
    """Return the rms difference of two fits' predictions in sigma."""
    difference = project(Q, one.residual - two.residual)
    return float(np.sqrt((difference**2).sum() / dof))


def _equivalent(fit: Fit, best: Fit, gap: float, Q: Float[np.ndarray, "W R k"], dof: int) -> bool:
    if not fit.members or best.names <= fit.names:
        return False
    near = _SAME * (best.rms if best.rms > ROUGH else 1.0)
    fewer = len(fit.members) <= len(best.members)
    return gap < _BAND or (_apart(fit, best, Q, dof) < near and fewer)

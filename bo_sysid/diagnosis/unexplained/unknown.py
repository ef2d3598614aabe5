"""What no named effect explains: found by predictability, answered by a learned force law.

A magnet near one angle hides as cogging and a spring with a few per cent left over: the size of a
residual says little. What says something is whether a flexible law at a joint predicts, in blocks
that it was not fitted to, what the answer leaves. Such a law is never given a physical name.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from bo_sysid.diagnosis.sets.decide import Decision
from bo_sysid.diagnosis.sets.fit import Fit
from bo_sysid.diagnosis.sets.rules import MARGIN
from bo_sysid.diagnosis.unexplained.law import law_columns, lengths, scales, terms_of
from bo_sysid.diagnosis.unexplained.left_out import LeftOut
from bo_sysid.diagnosis.windows.candidate import slices_of
from bo_sysid.diagnosis.windows.linear import Linear, linearise
from bo_sysid.diagnosis.windows.problem import ROUGH, Problem
from bo_sysid.diagnosis.windows.projection import project
from bo_sysid.diagnosis.windows.windowing import meets_impacts
from bo_sysid.effects.learned import Feature, features

WORTH = 0.015
"""rms² - 1 below which nothing is asked."""

_GAIN = 0.02  # of the squared residual per degree of freedom that a law must predict
_RELATIVE = 0.002  # the same, of what the nominal model left unexplained
_LOOSE, _LOOSE_SHARE = 0.35, 0.08  # rms and share unexplained that are flagged without a law
_LOOSE_IN_CONTACT = 1.5  # the same rms in contact, where 1.05 was left of nothing missing
_BETWEEN_IMPACTS = 0.1  # of what is left, that a law must predict in contact
_STANDS_OUT = 1.25  # times what a law at any other joint predicts there
_RIDGE = 1e-6  # on names beside a law where both are compared: names keep what both could explain
_ALSO = 0.2  # share of what a law leaves, that a further dependence must predict of it
_AT_LEAST = 0.02  # the same, as a share of what there was to predict
# of what is left, that one joint's law must predict; share of its gain that rivals reach
_MOST, _NEAR = 0.75, 0.5
# times the squares without names, by which slopes may be wrong and still be believed
_FORETOLD = 2.0
_WINDOWS = 40
_DRAWS = 39  # of signs: chance exceeds the largest gain of them once in forty


@dataclass(frozen=True)
class Clue:
    """How well a law at one joint predicts what is left.

    Attributes:
        joint: name of the joint.
        depends_on: what the law depends on.
        gain: cross-validated gain of squared residual per degree of freedom.
        tells: whether it explains enough to say where something acts, and on what that depends.
    """

    joint: str
    depends_on: tuple[str, ...]
    gain: float
    tells: bool = True


@dataclass(frozen=True)
class Unknown:
    """What stays unexplained.

    Attributes:
        flagged: whether it is more than noise.
        share: of the nominal model's excess.
        clues: laws at one joint that predict some of it: the one that predicts most, and others
            that may be better, where that one leaves much.
    """

    flagged: bool
    share: float
    clues: tuple[Clue, ...] = ()

    @property
    def law(self) -> Clue | None:
        """The law that stands for it, where one predicts some of it."""
        return self.clues[0] if self.flagged and self.clues else None


def examine(problem: Problem, decision: Decision) -> Unknown:
    """Look for a law in what the decision leaves unexplained."""
    best, nominal = decision.best, decision.nominal
    share = best.excess / max(nominal.excess, 1e-9) if nominal.excess > 0 else 0.0
    share = min(share, 1.0)
    if best.excess < WORTH:
        return Unknown(False, share)
    problem, best = _some(problem, best)
    linear = linearise(problem, best.hypothesis, best.start)
    found, chance = _clues(linear, best)
    clues = sorted(found, key=lambda c: -c.gain)
    most = clues[0].gain if clues else 0.0
    need = max(_GAIN, _RELATIVE * nominal.excess)
    if meets_impacts(problem):  # impacts leave something whatever the model
        elsewhere = max((c.gain for c in clues if c.joint != clues[0].joint), default=0.0)
        loose = np.sqrt(best.excess) > _LOOSE_IN_CONTACT
        need = max(need, _BETWEEN_IMPACTS * best.excess, _STANDS_OUT * elsewhere)
    else:
        loose = np.sqrt(best.excess) > _LOOSE and share > _LOOSE_SHARE
    laws = _laws(linear, best, clues) if most > max(_GAIN, chance) else ()
    return Unknown(bool(loose or most > max(need, chance)), share, laws)


def slopes_reach(problem: Problem, fit: Fit, nominal: Fit) -> bool:
    """Whether the linear model about a fit reaches to the model without its names.

    Near the recordings it does. Far from them it does where it foretells the squares that the
    nominal model leaves, with the study's parameters free: that of an arm whose friction grows with
    its load foretold 425 where 2 281 are left.
    """
    if fit.rms <= ROUGH or not fit.members:
        return True
    problem, fit = _some(problem, fit)
    linear = linearise(problem, fit.hypothesis, fit.start)
    S, y = project(linear.Q, fit.jacobian.astype(float)), project(linear.Q, fit.residual)
    of_members = sum(x.size for x in fit.x)
    without = (y + S[..., :of_members] @ np.concatenate(fit.x)).reshape(-1)
    free = S[..., of_members:].reshape(len(without), -1)
    left = without - free @ np.linalg.lstsq(free, without)[0]
    foretold = (left**2).sum() / (nominal.excess * problem.dof)
    return bool(1 / _FORETOLD < foretold < _FORETOLD)


def needed_with_law(problem: Problem, fit: Fit, law: Clue) -> tuple[bool, ...]:
    """Return which members of a fit are still needed once a law acts at a joint.

    A flexible law can say within the recordings what almost any name says. What a name says that
    holds beyond them is what it predicts in blocks that neither was fitted to: the gain of the law
    with the name over the law without it. It must exceed what both together leave there, and the
    least size of an effect, squared.
    """
    problem, fit = _some(problem, fit)
    linear = linearise(problem, fit.hypothesis, fit.start)
    terms = terms_of(problem.machine, law.joint, law.depends_on)
    A, S = _columns(linear, fit, law.joint, terms), project(linear.Q, fit.jacobian.astype(float))
    y = project(linear.Q, fit.residual)
    of_law, named = list(range(len(terms))), list(range(len(terms), A.shape[-1]))
    explained = LeftOut.of(A, y, problem.block).gain(of_law, named)[0] / problem.dof
    need = max(MARGIN**2, fit.excess - explained)
    kept = []
    for x, at in zip(fit.x, slices_of(fit.members), strict=True):
        own = named[at]
        before = y + S[..., at] @ x  # what is left without the member
        rest = [k for k in named if k not in own]
        held = LeftOut.of(A, before, problem.block)
        gain = held.gain(of_law, [*own, *rest], _RIDGE)[0] - held.gain(of_law, rest, _RIDGE)[0]
        kept.append(bool(gain / problem.dof >= need))
    return tuple(kept)


def _clues(linear: Linear, best: Fit) -> tuple[list[Clue], float]:
    """Return what laws of one dependence each predict, and the most that one does by chance.

    Noise in recorded commands and random disturbances leave much that no law predicts, and of many
    laws one seems to.
    """
    found, by_chance, dof = [], np.zeros(_DRAWS), linear.problem.dof
    for joint in linear.problem.machine.names("joint"):
        held, own, named = _regression(linear, best, joint, _DRAWS)
        for dependence, columns in own.items():
            gain, of_draws = held.against_chance(columns, named)
            found.append(Clue(joint, (dependence,), gain / dof))
            by_chance = np.maximum(by_chance, of_draws / dof)
    return found, float(by_chance.max())


def _laws(linear: Linear, best: Fit, clues: Sequence[Clue]) -> tuple[Clue, ...]:
    """Return the law that predicts most, and rivals where what it leaves may be the linear model's.

    A prediction that runs away from the recording says little of what acts there.
    """
    first = _widened(linear, best, clues[0])
    if first.gain > _MOST * best.excess:
        return (first,)
    near = [c for c in clues if c.joint == first.joint and c.gain > _NEAR * clues[0].gain]
    return (first, *(c for c in near if c.depends_on != first.depends_on))


def _widened(linear: Linear, best: Fit, clue: Clue) -> Clue:
    """Return a law that depends on all that it needs, one after the other."""
    held, own, named = _regression(linear, best, clue.joint)
    while True:
        tried = []
        for dependence in (d for d in own if d not in clue.depends_on):
            depends_on = (*clue.depends_on, dependence)
            gain = held.gain([k for d in depends_on for k in own[d]], named)[0]
            tried.append(Clue(clue.joint, depends_on, gain / linear.problem.dof))
        wider = max(tried, key=lambda c: c.gain, default=clue)
        left = best.excess - clue.gain
        if wider.gain - clue.gain <= max(_GAIN, _ALSO * left, _AT_LEAST * best.excess):
            return replace(clue, depends_on=tuple(sorted(clue.depends_on)))
        clue = wider


def _regression(
    linear: Linear, best: Fit, joint: str, draws: int = 0
) -> tuple[LeftOut, dict[str, list[int]], list[int]]:
    """Return the regression on all laws at a joint, and the columns of each and of the names."""
    terms = features(joint, linear.problem.machine)
    A = _columns(linear, best, joint, terms)
    own: dict[str, list[int]] = {}
    for k, t in enumerate(terms):
        own.setdefault(t.depends_on, []).append(k)
    held = LeftOut.of(A, project(linear.Q, best.residual), linear.problem.block, draws)
    return held, own, list(range(len(terms), A.shape[-1]))


def _columns(
    linear: Linear, fit: Fit, joint: str, terms: Sequence[Feature]
) -> Float[np.ndarray, "W R k"]:
    """Return the scaled responses to each term of a law, then to the magnitudes of a fit."""
    L, S = law_columns(linear, joint, terms), project(linear.Q, fit.jacobian.astype(float))
    return np.concatenate([L / scales(L, terms), S / lengths(S)], axis=-1)


def _some(problem: Problem, fit: Fit) -> tuple[Problem, Fit]:
    """Return a problem of at most `_WINDOWS` windows, evenly chosen, and the fit on them."""
    if len(problem.windows) <= _WINDOWS:
        return problem, fit
    keep = problem.windows.evenly(_WINDOWS)
    return problem.rows(keep), replace(
        fit,
        start=fit.start.rows(keep),
        residual=fit.residual[keep],
        jacobian=fit.jacobian[keep],
    )

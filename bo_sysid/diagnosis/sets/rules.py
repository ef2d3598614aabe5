"""The rules by which sets of effects are compared, on the training recordings alone.

Constants were fixed on development cases; see the benchmark of the diagnosis.
"""

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from math import comb, log, sqrt

import numpy as np

from bo_sysid.diagnosis.sets.fit import Fit, Names
from bo_sysid.diagnosis.windows.candidate import Candidate, slices_of
from bo_sysid.diagnosis.windows.problem import ROUGH

MARGIN = 0.2  # [sigma] least unique size of an effect
SHARE = 1.0  # unique size relative to what stays unexplained
PART = 0.02  # unique size relative to what the nominal model leaves unexplained
_UNKNOWN = 2.0  # times what the best fit leaves: no more than that counts as unexplained
_MOST_PART = 1.0  # [sigma] PART asks for no more: far off, many large effects leave it together
# [sigma] linear size of a member below which it is saturated: more of it would do no more
FLAT = 0.01
_NOTHING = 1e-3  # of the magnitude by which a member is probed: less than that is no magnitude
_THERE = 4.0  # standard deviations from which a small member of a group is there
LOOSE = 1.3  # [sigma] of a fit from which linear sizes are not trusted
CLEAN = 0.03  # rms² - 1 below which nothing is left to look for
_NOISE = 0.97  # rms² of a set that leaves no more than noise
_BELOW = 0.25  # share that counts of what is explained below the noise
_LOST = 0.05  # of the nominal model's excess: a set far off that leaves more explains little


@dataclass(frozen=True)
class SetPrior:
    """Weight of a set before the recordings are seen; not normalised.

    ½ for nothing. A set with g of the G groups and s of the S effects at sites has

        ⅛ Π πᵢ / (C(G, g) C(S, s)),

    an eighth for each pair (g, s), shared by the sets of that pair, with πᵢ the relative prior of
    each member's effect (`Effect.prior`, 1 for most). s is what `Fit.size` counts beside groups: a
    refinement counts as two. The nine pairs of up to three names weigh 1⅝ together with nothing,
    and more if more are allowed; only ratios of weights are used.

    Attributes:
        singles: number S of effects at sites.
        groups: number G of groups.
    """

    singles: int
    groups: int

    def log(self, fit: Fit) -> float:
        """Return the logarithm of the weight of a fit's set."""
        if not fit.members:
            return log(0.5)
        grouped = len({g for g in fit.groups if g is not None})
        alone = fit.size - grouped
        rare = sum(log(c.effect.prior) for c in fit.members)
        ways = comb(max(self.groups, 1), min(grouped, max(self.groups, 1))) if grouped else 1
        return (
            log(0.125)
            + rare
            - log(ways)
            - log(comb(max(self.singles, 1), min(alone, self.singles)))
        )


def inflation(fits: Iterable[Fit]) -> float:
    """Return the variance that even the best fit leaves, at least that of the sensors."""
    return max(1.0, min(f.rms for f in fits) ** 2)


def criterion(fit: Fit, kappa: float, prior: SetPrior) -> float:
    """Return the deviance by which fits are ranked, lower is better."""
    return float(fit.cv.sum()) / kappa - 2 * (prior.log(fit) - log(0.5))


def required_size(fit: Fit, nominal: Fit) -> float:
    """Return the unique size in sigma that every member of a fit must reach by itself."""
    return max(MARGIN, SHARE * _left(fit, ()), _part(nominal))


def _left(fit: Fit, fits: Iterable[Fit]) -> float:
    """Return what stays unexplained, in sigma: by a fit, or by twice what any fit leaves.

    What others explain is no unknown: without that bound every member that is left out raises the
    bar for the next, and of a set that explains the recordings nothing remains. Joints that were
    added explain nothing where much is left: they follow whatever is missing.
    """
    rigid = (f for f in fits if f.rms <= LOOSE or not any(c.effect.hidden for c in f.members))
    least = min((f.excess for f in rigid), default=fit.excess)
    return min(sqrt(fit.excess), _UNKNOWN * sqrt(least))


def _part(nominal: Fit) -> float:
    return min(PART * sqrt(nominal.excess), _MOST_PART)


def sizes(fit: Fit, fits: Iterable[Fit]) -> tuple[float, ...]:
    """Return the unique size of each member, in sigma.

    With u the linear one (`Fit.unique`), rms₀ the least that a fit without the member leaves, and
    d = √(rms₀² - rms²), where of what lies below the noise, rms² < .97, a quarter counts: in
    contact samples weigh little, and sets leave less than the sensors say.

    - near the recordings: min(u, d), since where contact bends the response a column is large in
      windows that no magnitude brings any closer
    - far from them (rms above 1.3): d, since no linearisation reaches from a set to the same set
      without a member; rms₀ is that of fits with all the rest
    - saturated, a large magnitude whose slope is nothing since more of it would change nothing: d
      in the same way
    - there or not, with no slope in between: d
    - no magnitude: min(u, d) with u then nothing, however far the fit is

    u stands for d where no fit without the member was made.
    """
    others, found = tuple(fits), []
    for member, x, unique, linear in zip(
        fit.members, fit.x, fit.unique, fit.linear_rms, strict=True
    ):
        probe = np.abs(member.probe)
        x = member.total(x)
        there = bool((np.abs(x) > _NOTHING * probe).any())
        full = linear <= FLAT and bool((np.abs(x) > probe).any())
        far = there and (fit.rms > LOOSE or full or member.effect.discrete)
        left = min((f.rms for f in others if _without(f, fit, member, far)), default=None)
        lost = unique if left is None else sqrt(_gained(left**2, fit.rms**2))
        found.append(lost if far else min(unique, lost))
    return tuple(found)


def _gained(left: float, now: float) -> float:
    """Return what of rms² is explained, less where that is below the noise already."""
    below = max(min(left, _NOISE) - now, 0.0)
    return max(left - max(now, _NOISE), 0.0) + _BELOW * below


def _without(other: Fit, fit: Fit, member: Candidate, all_else: bool) -> bool:
    """Whether `other` has nothing but what `fit` has beside a member, whatever the shapes.

    It may have the simpler effect that the member holds. With `all_else` it must have all the rest.
    """
    held, simpler = {c.key for c in other.members}, (member.effect.nested, member.site.name)
    rest = {c.key for c in fit.members} - {member.key}
    return held - {simpler} == rest - {simpler} if all_else else held <= {*rest, simpler}


def weak(fit: Fit, nominal: Fit, fits: Iterable[Fit]) -> list[int]:
    """Return the members that are smaller than what stays unexplained, or a part of the nominal's.

    The threshold set by the nominal's rest is compared with the larger of a member's unique size
    and what leaving it out costs.
    A group is one hypothesis: each of its n members needs 1/√n of both thresholds, and a size of
    `MARGIN` all the same. Where at least two of them, and half, reach that, the others stay as long
    as the recordings show that they are there: what all joints have is not small by chance.
    """
    others = tuple(fits)
    found, cost, part = sizes(fit, others), leave_one_out_costs(fit, others), _part(nominal)
    left, count = _left(fit, others), Counter(fit.groups)
    alone = [1.0 if g is None else sqrt(1.0 / count[g]) for g in fit.groups]
    large = [
        u >= max(MARGIN, SHARE * left * a) and max(u, c) >= part * a
        for u, c, a in zip(found, cost, alone, strict=True)
    ]
    held = Counter(g for g, ok in zip(fit.groups, large, strict=True) if ok)
    standing = {g for g, n in count.items() if g is not None and held[g] >= max(2.0, 0.5 * n)}
    excused = [fit.rms <= ROUGH and g in standing for g in fit.groups]
    sure = significance(fit)
    return [k for k, ok in enumerate(large) if not ok and not (excused[k] and sure[k] > _THERE)]


def required_members(fit: Fit, nominal: Fit, fits: Iterable[Fit]) -> Names:
    """Return effects and sites of the members that are not `weak`."""
    small = weak(fit, nominal, fits)
    return frozenset(c.key for k, c in enumerate(fit.members) if k not in small)


def leave_one_out_costs(fit: Fit, fits: Iterable[Fit]) -> tuple[float, ...]:
    """Return what leaving out each member costs in sigma, 0 where no set without it was fitted.

    A small part of what the nominal model leaves may be no more than the shape of a large effect
    that is a little off: there this is little as well. Beside a long delay or a wide gap the slope
    of a mass is little, and yet without it nothing comes near.
    """
    others, found = tuple(fits), []
    for member in fit.members:
        left = min((f.rms for f in others if _without(f, fit, member, True)), default=0.0)
        found.append(sqrt(max(left**2 - fit.rms**2, 0.0)))
    return tuple(found)


def significance(fit: Fit) -> list[float]:
    """Return for each member how many standard deviations its magnitudes are from nothing."""
    found = []
    for x, own in zip(fit.x, slices_of(fit.members), strict=True):
        inverse = np.linalg.pinv(fit.covariance[own, own], hermitian=True)
        found.append(sqrt(max(float(x @ inverse @ x), 0.0)))
    return found


def admissible(fit: Fit, nominal: Fit, fits: Iterable[Fit] = ()) -> bool:
    """Whether every member is needed."""
    return not weak(fit, nominal, fits)


def clean(fit: Fit) -> bool:
    """Whether a fit leaves nothing to look for."""
    return fit.excess < CLEAN


def explains_little(fit: Fit, nominal: Fit) -> bool:
    """Whether a fit is far from the recordings and explains little of what they have.

    Where that is the leading set, no names are the explanation, and finer differences between sets
    decide nothing.
    """
    return fit.rms > ROUGH and fit.excess > _LOST * nominal.excess


def follows_anything(fit: Fit) -> bool:
    """Whether a fit has a joint that it added, and is far from the recordings.

    Such a joint begins in each window where that fits best: soft or loose enough, it follows
    whatever else is missing, and what it explains of that says nothing.
    """
    return fit.rms > ROUGH and any(c.effect.hidden for c in fit.members)


def ranked(fits: Iterable[Fit], prior: SetPrior) -> list[Fit]:
    """Return fits by the criterion, best first."""
    held = list(fits)
    kappa = inflation(held)
    return sorted(held, key=lambda f: criterion(f, kappa, prior))

"""A known effect that is too small for a name, where something is left that a law predicts."""

from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from bo_sysid.diagnosis.answer.sentences import unit_words
from bo_sysid.diagnosis.search.locate import Located
from bo_sysid.diagnosis.sets.decide import BAND, Decision
from bo_sysid.diagnosis.sets.fit import Fit
from bo_sysid.diagnosis.sets.rules import MARGIN, criterion, inflation
from bo_sysid.diagnosis.unexplained.unknown import WORTH, examine


def with_trifle(located: Located) -> Located:
    """Return the decision with one effect more, where that explains what a law would.

    What is left, rms² - 1, may be less than the square of the least size that is named, and yet
    predicted by a law of unknown physics. Where one effect more explains all of it, it is answered,
    as a hint: physics that nobody knows is no better explanation.
    """
    decision, search = located.decision, located.search
    found = trifles(decision.best, search.fits.values())
    if not found or not examine(located.prepared.problem, decision).flagged:
        return located
    known = {f.key for f in found}
    kappa = inflation(search.fits.values())

    def cost(fit: Fit) -> float:
        return criterion(fit, kappa, search.prior)

    fits = [*sorted(found, key=cost), *(f for f in decision.fits if f.key not in known)]
    D = np.array([cost(f) for f in fits])
    weight = np.exp(-0.5 * (D - D.min()))
    made = Decision(
        fits[0], decision.nominal, tuple(fits), weight / weight.sum(), tuple(fits[1 : len(found)])
    )
    return replace(located, decision=made)


def trifles(best: Fit, fits: Iterable[Fit]) -> list[Fit]:
    """Return the sets of the best one and one effect more that leave noise, where that is little.

    The first is the one that predicts most; those that predict about as much follow.

    Args:
        best: what is answered.
        fits: of all sets that were tried.
    """
    if not WORTH < best.excess < MARGIN**2:
        return []
    more = [
        f for f in fits if best.names < f.names and f.size == best.size + 1 and f.excess < WORTH
    ]
    order = sorted(more, key=lambda f: float(f.cv.sum()))
    return [f for f in order if (f.cv - order[0].cv).sum() < 2 * BAND]


def trifle_sentence(best: Fit) -> str:
    """Return in words that an answer has a member that is too small for a name, and what tells."""
    which = unit_words([best.members[int(np.argmin(best.unique))]])
    size = f"{min(best.unique):.2g} of {MARGIN:g} sensor sigmas"
    return (
        f"{which[:1].upper()}{which[1:]} does less than what is named ({size}), but what is left "
        "without it is no noise: motion that shows more of it would tell."
    )

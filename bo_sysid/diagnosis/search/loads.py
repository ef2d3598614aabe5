"""Loads at a place that the model does not say: a mass and three coordinates, fitted together.

Elsewhere than where the model would hold it, a load looks like a mass, a shifted centre and an
inertia of its body at once, or like springs and weak motors where only three names are allowed.
"""

from collections.abc import Iterator

import numpy as np

from bo_sysid.diagnosis.search.search import Search
from bo_sysid.diagnosis.sets.fit import Fit, set_key
from bo_sysid.diagnosis.sets.groups import subset
from bo_sysid.diagnosis.sets.refit import Effort
from bo_sysid.diagnosis.sets.rules import clean
from bo_sysid.diagnosis.sets.shapes import reshaped
from bo_sysid.diagnosis.windows.hypothesis import Candidate
from bo_sysid.diagnosis.windows.linear import linearise

_INERTIAL = ("payload", "link_mass", "com_shift", "link_inertia", "gravity_compensation")
_AFRESH, _GAINED = 4, 0.999  # times a place is fitted, each of which must leave less than that
_USUAL = 0.98  # times what a load at its usual place leaves, above which it stays there


def place_loads(search: Search, base: Fit) -> None:
    """Fit a set with a load, wherever it lies, in the place of what is said of its body's mass.

    Of a set that leaves nothing only where it says two things of one body, which may be one.
    """
    for rest, load in _loads(search, base):
        if len(base.members) - len(rest) > 1 or not clean(search.best):
            _place(search, base, rest, load)


def _loads(search: Search, base: Fit) -> Iterator[tuple[list[int], Candidate]]:
    """Return what remains of a set and the load beside it, for each body of which it says that."""
    for body in dict.fromkeys(c.site for c in base.members if c.effect.id in _INERTIAL):
        own = [k for k, c in enumerate(base.members) if c.site == body and c.effect.id in _INERTIAL]
        load = next((c for c in search.candidates if c.site == body and c.extent.places), None)
        if load is not None and not any(base.members[k].moved for k in own):
            yield [k for k in range(len(base.members)) if k not in own], load.usual


def _place(search: Search, base: Fit, rest: list[int], load: Candidate) -> None:
    """Fit the place of a load beside what remains of a set; its usual one is kept where it does."""
    members, x = subset(base, rest)
    usual = search.fit((*members, search.known(load)), (*x, load.probe), guess=base.hypothesis)
    fits = [_begun(search, base, rest, load, place) for place in load.extent.places]
    fit, effort = min(fits, key=lambda f: f.rms), Effort(rival=search.least)
    for _ in range(_AFRESH):
        there = linearise(search.prepared.problem, fit.hypothesis, fit.start)
        before, fit = fit, reshaped(there, fit, effort)
        if fit.rms > _GAINED * before.rms:
            break
    if fit.rms < _USUAL * usual.rms:
        search.listed(fit)


def _begun(
    search: Search, base: Fit, rest: list[int], load: Candidate, place: tuple[float, ...]
) -> Fit:
    """Return the fit with a load at a place, which is only on the way to another."""
    members, x = subset(base, rest)
    held = (*members, load.with_shapes(np.array(place)))
    made = search.refit(held, (*x, load.probe), start=base.start, guess=base.hypothesis)
    del search.fits[set_key(held)]
    return made

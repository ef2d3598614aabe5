"""Loads at a place that the model does not say: a mass and three coordinates, fitted together.

Elsewhere than where the model would hold it, a load looks like a mass, a shifted centre and an
inertia of its body at once, or like springs and weak motors where only three names are allowed.
"""

from collections.abc import Iterator

import numpy as np

from bo_sysid.diagnosis.search.search import Search
from bo_sysid.diagnosis.sets.fit import Fit, set_key
from bo_sysid.diagnosis.sets.groups import all_but, subset
from bo_sysid.diagnosis.sets.refit import Effort
from bo_sysid.diagnosis.sets.rules import clean
from bo_sysid.diagnosis.windows.candidate import Candidate

_INERTIAL = ("payload", "link_mass", "com_shift", "link_inertia", "gravity_compensation")
_AFRESH, _NEARER = 4, 0.999  # times a place is fitted anew; each must leave less than this share
_USUAL = 0.99  # times what a load at its usual place leaves, above which it stays there


def place_loads(search: Search, base: Fit, nearest: Fit | None = None) -> None:
    """Fit a set with a load, wherever it lies, in the place of what is said of its body's mass.

    Where nothing is left only if it says two things of one body, which may be one.

    Args:
        search: tries it.
        base: the set.
        nearest: by what it leaves; the nearest of the search by default.
    """
    done = clean(nearest or search.best)
    for rest, load in _loads(search, base):
        if len(base.members) - len(rest) > 1 or not done:
            _place(search, base, rest, load)


def _loads(search: Search, base: Fit) -> Iterator[tuple[list[int], Candidate]]:
    """Return what remains of a set and the load beside it, for each body of which it says that."""
    for body in dict.fromkeys(c.site for c in base.members if c.effect.id in _INERTIAL):
        own = [k for k, c in enumerate(base.members) if c.site == body and c.effect.id in _INERTIAL]
        load = next((c for c in search.candidates if c.site == body and c.extent.place), None)
        if load is not None and not any(base.members[k].moved for k in own):
            yield all_but(base, own), load


def _place(search: Search, base: Fit, rest: list[int], load: Candidate) -> None:
    """Fit a load and its place beside what remains of a set, as long as that comes nearer.

    However much nearer others are. It stays at its usual place if that does.
    """
    members, x = subset(base, rest)
    free, effort = load.free, Effort()
    held = (*members, free)
    if set_key(held) in search.placed:
        return
    search.placed.add(set_key(held))
    known = set_key((*members, load)) in search.fits
    usual = search.fit((*members, load), (*x, load.probe), guess=base.hypothesis)
    usual = _settled(search, usual, effort)
    keys = [c.key for c in usual.members]  # in the order in which it was fitted first
    # the slope to a place is nothing without a mass
    mass = np.maximum(usual.x[keys.index(load.key)], load.probe)
    begun = (*x, np.concatenate([mass, free.point[len(mass) :]]))
    made = search.refit(held, begun, start=base.start, guess=base.hypothesis, effort=effort)
    made = _settled(search, made, effort)
    if made.rms < _USUAL * usual.rms:
        search.listed(made)
        if not known:  # it was on the way
            del search.fits[usual.key]
    else:
        del search.fits[made.key]


def _settled(search: Search, made: Fit, effort: Effort) -> Fit:
    """Fit a set anew as long as that comes nearer."""
    for _ in range(_AFRESH):
        left, guess = made.rms, made.hypothesis
        made = search.refit(made.members, made.x, start=made.start, guess=guess, effort=effort)
        if made.rms > _NEARER * left:
            break
    return made

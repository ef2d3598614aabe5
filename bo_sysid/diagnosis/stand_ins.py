"""Friction that is a parameter of the study, as a member of a set: it may hold, or bend.

MuJoCo's `frictionloss` creeps under a load and does not bend before it slips. What a parameter
leaves where a machine's friction does is not linear in its level, and no screening proposes it.
"""

import numpy as np

from bo_sysid.diagnosis.fit import Fit, set_key, size_of
from bo_sysid.diagnosis.groups import grouped_labels
from bo_sysid.diagnosis.hypothesis import Candidate
from bo_sysid.diagnosis.rules import clean
from bo_sysid.diagnosis.search import Search
from bo_sysid.diagnosis.subsets import clashes

_THERE = 0.1  # of the level by which friction is probed, that a parameter must add to the model's


def stand_in(search: Search, base: Fit) -> None:
    """Fit a set with members in the place of its parameters that are friction.

    All of them at once, with each shape of friction that there is; then, where that is not all,
    each parameter by itself with the shape that leaves least.
    """
    present = _present(search, base)
    if not present:
        return
    together = [c for own in present for c in own]
    count = min(len(c.extent.variants) for c in together) + 1
    made = [_fitted(search, base, together, k) for k in range(count)]
    left = [np.inf if f is None else f.rms for f in made]
    if len(present) > 1 and not clean(search.best):
        for own in present:
            _fitted(search, base, own, int(np.argmin(left)))


def _present(search: Search, base: Fit) -> list[list[Candidate]]:
    """Return for each parameter that adds friction to the model what may stand in its place.

    One that leaves the model's own friction as it is has no member that differs from nothing.
    """
    dry = {c.site.name: c for c in search.candidates if c.rubbing and not c.effect.nested}
    taken = {c.site.name for c in base.members if c.rubbing}
    found = []
    for p, x in zip(base.hypothesis.nuisances, base.hypothesis.nuisance_x, strict=True):
        able = p.rubs and all(j in dry and j not in taken for j in p.rubs)
        if able:
            own = [dry[j].straight for j in p.rubs]
            if any(x[0] > _THERE * c.probe[0] for c in own):
                found.append(own)
    return found


def _fitted(search: Search, base: Fit, own: list[Candidate], shape: int) -> Fit | None:
    """Fit a set with more members, all of the same shape; None where there is no room."""
    shapes = [[c.shapes, *c.extent.variants][shape] for c in own]
    held = [c.with_shapes(np.array(s, float)) for c, s in zip(own, shapes, strict=True)]
    members = [*base.members, *(search.known(c) for c in held)]
    labels = grouped_labels(members, search.candidates)
    if clashes(members) or size_of(members, labels) > search.most:
        return None
    if (key := set_key(members)) in search.fits:
        return search.fits[key]
    x = (*base.x, *(np.zeros(c.size) for c in held))  # and what the parameters have
    return search.fit(members, x, start=base.start, guess=base.hypothesis, again=True)

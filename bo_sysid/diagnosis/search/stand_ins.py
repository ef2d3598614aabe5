"""Friction that the model or a parameter of the study has, as a member of a set: it may preslide.

MuJoCo's `frictionloss` creeps under a load and does not give way before it slips. What is left
where a machine's friction does is not linear in its level, and no screening proposes it.
"""

from dataclasses import replace

import numpy as np

from bo_sysid.diagnosis.search.search import Search
from bo_sysid.diagnosis.sets.fit import Fit, set_key, size_of
from bo_sysid.diagnosis.sets.groups import grouped_labels
from bo_sysid.diagnosis.sets.rules import clean
from bo_sysid.diagnosis.sets.subsets import clashes
from bo_sysid.diagnosis.windows.candidate import Candidate

_THERE = 0.1  # of the level by which friction is probed, that friction of a model must have
_BEGUN = (
    1e-2  # of that level, by which a member begins to change it: without a change none preslides
)


def stand_in(search: Search, base: Fit) -> None:
    """Fit a set with members in the place of the friction that the model has beside it.

    All of them at once, with each shape of friction that there is; then, where that is not all,
    each joint's, or each parameter's, by itself with the shape that leaves least.
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
    """Return what may stand in the place of friction: joints of one parameter together."""
    h = base.hypothesis
    model, _ = search.prepared.problem.compiled(replace(h, members=(), x=()))
    dry = {c.site.name: c for c in search.candidates if c.is_dry_friction and not c.effect.nested}
    taken = {c.site.name for c in base.members if c.is_dry_friction}

    def rubs(joint: str) -> bool:
        return bool(model.joint(joint).frictionloss[0] > _THERE * dry[joint].probe[0])

    tied = [p.friction_joints for p in h.nuisances if p.friction_joints]
    alone = [(joint,) for joint in dry if not any(joint in joints for joints in tied)]
    able = [
        joints for joints in (*tied, *alone) if all(j in dry and j not in taken for j in joints)
    ]
    return [
        [dry[j].without_presliding for j in joints] for joints in able if any(map(rubs, joints))
    ]


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
    x = (*base.x, *(_BEGUN * c.probe for c in held))  # and what the parameters have
    return search.refit(members, x, start=base.start, guess=base.hypothesis)

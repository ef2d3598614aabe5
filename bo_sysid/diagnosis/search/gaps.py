"""Joints that an effect adds to a model, gaps and springs: no linear estimate leads to them."""

from collections.abc import Sequence
from dataclasses import replace
from operator import itemgetter

import numpy as np

from bo_sysid.diagnosis.search.search import Search
from bo_sysid.diagnosis.sets.fit import Fit, set_key
from bo_sysid.diagnosis.sets.groups import subset
from bo_sysid.diagnosis.sets.meshing import joints_at
from bo_sysid.diagnosis.sets.subsets import clashes
from bo_sysid.diagnosis.windows.candidate import Candidate
from bo_sysid.diagnosis.windows.settling import first_start, settle

# joints on which a gap is tried, most promising first; magnitudes each fit begins from
_TRIED, _BEGUN = 2, 3

_Point = tuple[float, Candidate, np.ndarray]
"""What is left, in sigma²; a candidate; its magnitudes."""


def add_joints(search: Search, leader: Fit) -> None:
    """Fit sets with each joint that an effect adds, from what its grid points leave.

    A linear estimate says little of a gap: what moves in it is not there in the nominal model. Each
    is tried alone, beside the leader and in the place of what the leader adds.
    """
    rigid = [k for k, c in enumerate(leader.members) if not c.effect.hidden]
    bases = dict.fromkeys((search.nominal, search.fit(*subset(leader, rigid)), leader))
    for base in (b for b in bases if b.size < search.most):
        _add_best_joints(search, base, search.candidates)


def replace_by_backlash(search: Search, leader: Fit, joints: Sequence[str]) -> None:
    """Fit a joint that is added in the place of all that a set has at each of some joints.

    Where a motor that is late explains all, none is tried otherwise.
    """
    machine = search.prepared.problem.machine
    for name in joints:
        elsewhere = [
            k for k, c in enumerate(leader.members) if name not in joints_at(c.site, machine)
        ]
        base = search.fit(*subset(leader, elsewhere))
        _add_best_joints(search, base, [c for c in search.candidates if c.site.name == name])


def _add_best_joints(search: Search, base: Fit, candidates: Sequence[Candidate]) -> None:
    """Fit a set with each of the joints that leave least beside it."""
    for points in _rank_added_joints(search, base, candidates)[:_TRIED]:
        for _, c, x in points[:_BEGUN]:
            search.refit(
                (*base.members, c), (*base.x, x), start=base.start, guess=base.hypothesis,
                across=True,
            )  # fmt: skip


def soften(search: Search, leader: Fit) -> None:
    """Fit a set whose joint moves in a gap from soft ends; no small step leads there from hard."""
    for k, c in enumerate(leader.members):
        others = c.points[1:] if c.effect.hidden else []
        for ends in dict.fromkeys(tuple(point[1:]) for point in others):
            x = (*leader.x[:k], np.array([leader.x[k][0], *ends]), *leader.x[k + 1 :])
            search.refit(
                leader.members, x, start=leader.start, guess=leader.hypothesis,
                across=True,
            )  # fmt: skip


def _rank_added_joints(
    search: Search, base: Fit, candidates: Sequence[Candidate]
) -> list[list[_Point]]:
    """Return for each joint that may be added its points by what they leave; the best joint first.

    Every other window is simulated.
    """
    some = np.arange(len(search.prepared.start)) % 2 == 0
    frame = search.frame.rows(some)
    added = [c for c in candidates if c.effect.hidden and not clashes([*base.members, c])]
    points = {(set_key([c]), tuple(x)): (c, x) for c in added for x in c.points}
    left: dict[tuple[str, str], list[_Point]] = {}
    for c, x in points.values():  # points of a grid have the same further starts
        h = replace(base.hypothesis, members=(*base.members, c), x=(*base.x, x))
        start, r = first_start(frame.problem, h, base.start.rows(some))
        r = settle(frame.problem, frame, h, start, 1, r=r)[1]
        left.setdefault(c.key, []).append((float((r**2).sum()), c, x))
    ordered = [sorted(points, key=itemgetter(0)) for points in left.values()]
    return sorted(ordered, key=lambda points: points[0][0])

"""One round of the search: what could be added to a set, exchanged, left out or shaped anew.

Sets are proposed by linear algebra (`subsets`) on what every candidate would do at a fit
(`screen`), and fitted through the simulator.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from bo_sysid.diagnosis.search.loads import place_loads
from bo_sysid.diagnosis.search.search import Search
from bo_sysid.diagnosis.search.variants import reshape, simplify
from bo_sysid.diagnosis.sets import subsets
from bo_sysid.diagnosis.sets.fit import Fit, set_key
from bo_sysid.diagnosis.sets.groups import all_but, alone, subset, units_of, with_group
from bo_sysid.diagnosis.sets.refit import FINAL, Effort
from bo_sysid.diagnosis.sets.rules import CLEAN, MARGIN, SHARE, clean
from bo_sysid.diagnosis.sets.screen import Screen
from bo_sysid.diagnosis.sets.subsets import Scored
from bo_sysid.diagnosis.windows.candidate import Candidate, slices_of
from bo_sysid.diagnosis.windows.problem import ROUGH
from bo_sysid.diagnosis.windows.projection import project

_TOP = {1: 5, 2: 5, 3: 3}  # sets of each size that are fitted in the first round
_TOP_GROUPED = {1: 3, 2: 3, 3: 3}
_ALIKE = 30.0  # [sigma²] of linear gain within which another effect may be equivalent
_NEARLY = 1e-3  # of the gain, what a linear estimate of it may be off
_ROUGHLY = 0.01  # the same where the fit is far from the recordings
_FEWER = 0.9  # of a member's gain, from which one with fewer magnitudes is tried for it
_SUBSTITUTES = 5  # single effects that are fitted in the place of one
_GROUP_SUBSTITUTES = 2  # sets that are fitted in the place of a large group, groups in that of one
_PAIR = 2  # members of a group up to which each is exchanged by itself
_NEARER = 0.97  # of what a fit left, to go on from it linearised at itself


def round_at(search: Search, base: Fit) -> None:
    """Linearise at a fit and try what could be added to it, exchanged or left out."""
    simplify(search, base)
    if not clean(base):
        reshape(search, base)
    place_loads(search, base)
    _refine(search, base)
    screen = search.screened(base)
    if not base.members:
        _first(search, screen)
        return
    if not clean(base):  # with the response to the start at this fit
        again = search.refit(
            base.members, base.x, start=base.start, guess=base.hypothesis,
        )  # fmt: skip
        if again.rms < _NEARER * base.rms:
            return round_at(search, again)
    _add(search, screen, base)
    for unit in units_of(base):
        _exchange(search, screen, base, unit)
        _drop(search, base, unit)


def _there_or_not(search: Search) -> None:
    """Fit signs and swaps of channels: those that simulations say leave least, as no slope does."""
    problem, nominal = search.prepared.problem, search.nominal.hypothesis

    def left(c: Candidate) -> float:
        read = replace(nominal, members=(c,), x=(c.probe,))
        return float((problem.residual(read, problem.smoothed(read)) ** 2).sum())

    for c in sorted((c for c in search.candidates if c.effect.discrete), key=left)[: _TOP[1]]:
        search.fit((c,), (c.probe,))


def extend(search: Search, base: Fit) -> None:
    """Linearise at a fit and try what could be added to it."""
    _add(search, search.screened(base), base)


def _first(search: Search, screen: Screen) -> None:
    if search.nominal.rms > ROUGH:
        _there_or_not(search)
    found = subsets.search(screen.gram((), {}), search.most, subsets.groups(search.candidates))
    _run(search, alone(found.get(1, [])), _TOP[1], None)
    if not clean(search.best):
        reshape(search, search.best)
        place_loads(search, search.best)
    for size in (1, 2, 3):
        if search.least**2 - 1 <= CLEAN:
            return
        sets = found.get(size, [])
        _run(search, with_group(sets), _TOP_GROUPED[size], None)
        if size > 1:
            _run(search, alone(sets), _TOP[size], None)


def _add(search: Search, screen: Screen, base: Fit) -> None:
    room = search.most - base.size
    if room <= 0:
        return
    fixed = [search.candidates.index(c) for c in base.members]
    now = dict(zip(fixed, base.x, strict=True))
    units = subsets.groups(search.candidates) if not clean(base) else ()
    found = subsets.search(screen.gram(fixed, now), room, units, deepest=2, paired=60)
    need = max(0.7 * MARGIN, 0.5 * SHARE * np.sqrt(base.excess))
    _run(search, alone(found[1]), 3, base, need=need)
    _run(search, with_group(found[1]), 2, base, need=need)
    if room > 1 and not clean(base):
        _run(search, alone(found.get(2, [])), 2, base, need=need)


def _exchange(search: Search, screen: Screen, base: Fit, unit: tuple[int, ...]) -> None:
    """Try others in the place of one unit of a fit."""
    rest = all_but(base, unit)
    members, x = subset(base, rest)
    fixed = [search.candidates.index(c) for c in members]
    now = dict(zip(fixed, x, strict=True))
    without = screen.without([base.members[k] for k in unit], [base.x[k] for k in unit])
    many = len(units_of(base)) < 3 and not clean(base)
    units = subsets.groups(search.candidates) if not clean(base) else ()
    room = search.most - base.size + base.members[unit[0]].effect.weight
    deepest = 2 if many else 1
    found = subsets.search(without.gram(fixed, now), room, units, deepest=deepest, paired=60)
    _run(search, alone(found[1]), 2 if clean(base) else 3, base, rest)
    _run(search, with_group(found[1]), 1, base, rest)
    if many:
        _run(search, alone(found.get(2, [])), 1, base, rest)


def substitute(search: Search, base: Fit) -> None:
    """Fit what could stand in the place of a member and explain as much; of a large group as one.

    A group may stand in the place of one effect: all thrusts that are too small, of a mass that is
    too large. In contact also what was fitted before and leaves more than the set: it may have
    come from starts on the far side of an impact.
    """
    screen, touching = search.screened(base), search.prepared.problem.machine.impacts
    effort = replace(FINAL, rival=base.rms)
    parts = [p for u in units_of(base) for p in ([u] if len(u) > _PAIR else [(k,) for k in u])]
    for part in parts:
        rest = all_but(base, part)
        for left in _left_without(search, screen, base, part):
            for sets in _as_good(search, left, base, part):
                kinds = [(sets, _GROUP_SUBSTITUTES)]
                if len(part) == 1:
                    kinds = [(alone(sets), _SUBSTITUTES), (with_group(sets), _GROUP_SUBSTITUTES)]
                for some, most in kinds:
                    _run(search, some, most, base, rest, effort=effort, anew=touching)


def _left_without(search: Search, screen: Screen, base: Fit, part: tuple[int, ...]) -> list[Screen]:
    """Return the screens of what a part of a fit explains: by slopes, and as it is simulated.

    By slopes the part that was fitted explains all of it, and another one what its own slope does,
    which may be less than it can: that of a delay is taken at 2 ms, and at 20 ms. A late encoder
    was not tried for a late command, .5 % below it by slopes and 32 σ² above it once fitted. Where
    geoms touch, what a simulation without the part leaves is far from any slope.
    """
    problem = search.prepared.problem
    by_slopes = screen.without(*subset(base, part))
    if problem.machine.impacts:
        return [by_slopes]
    members, x = subset(base, all_but(base, part))
    left = problem.residual(replace(base.hypothesis, members=members, x=x), base.start)
    return [by_slopes, screen.explaining(project(search.frame.Q, left))]


def _as_good(
    search: Search, without: Screen, base: Fit, part: tuple[int, ...]
) -> tuple[list[Scored], list[Scored]]:
    """Return what explains as much as a part of a set, by slopes, and what does with less.

    That is as much but for a little, or with fewer magnitudes nearly as much.

    Args:
        search: whose candidates are looked through.
        without: the screen of what the part explains.
        base: the set.
        part: places of its members.
    """
    out = [base.members[k] for k in part]
    members, x = subset(base, all_but(base, part))
    fixed = [search.candidates.index(c) for c in members]
    grouped = subsets.groups(search.candidates)
    if len(part) == 1:  # a group of the same effect explains more, and needs it
        grouped = tuple(u for u in grouped if u.group != out[0].effect.id)
    table = without.gram(fixed, dict(zip(fixed, x, strict=True)))
    room = search.most - base.size + max(c.effect.weight for c in out)
    found = subsets.search(table, room, grouped, deepest=1)[1]

    def size(s: Scored) -> int:
        return sum(search.candidates[i].size for i in s.members)

    def itself(s: Scored) -> bool:
        held = [search.candidates[i] for i in s.members]
        if len(out) == 1:
            return held[0] is out[0]
        return {c.key for c in held} == {c.key for c in out}  # whatever the shapes

    own = max((s.gain for s in found if itself(s)), default=0.0)
    near = _ALIKE * max(1.0, base.rms**2)
    rough = _ROUGHLY if base.rms > ROUGH else _NEARLY
    equally_good = [s for s in found if s.gain > own - max(near, rough * own)]
    most = sum(c.size for c in out)
    return equally_good, [s for s in found if s.gain > _FEWER * own and size(s) < most]


def _drop(search: Search, base: Fit, unit: tuple[int, ...]) -> None:
    sets = [unit] if len(unit) == 1 else [unit, *((k,) for k in unit)]
    for out in sets:
        search.refit(*subset(base, all_but(base, out)), start=base.start)


def _run(
    search: Search,
    scored: Sequence[Scored],
    top: int,
    base: Fit | None,
    kept: Sequence[int] | None = None,
    need: float = 0.0,
    effort: Effort | None = None,
    anew: bool = False,
) -> None:
    """Fit the best of the scored sets, on top of the kept members of a fit.

    With `anew` also those that were fitted before, and leave more than that fit.
    """
    seen: set[frozenset[tuple[str, str]]] = set()
    dof = search.prepared.problem.dof
    held: tuple[Sequence[Candidate], Sequence[np.ndarray]] = ((), ())
    if base is not None:
        held = subset(base, range(len(base.members)) if kept is None else kept)
    for s in scored:
        members = [search.candidates[i] for i in s.members]
        key = frozenset(c.key for c in members)
        if key in seen:
            continue
        seen.add(key)
        if len(seen) > top or np.sqrt(max(s.gain, 0.0) / dof) < need:
            return
        if subsets.clashes([*held[0], *members]):
            continue
        x = [s.x[own] for own in slices_of(members)]
        whole = (*held[0], *members)
        known = search.fits.get(set_key(whole))
        again = anew and known is not None and base is not None and known.rms > base.rms
        fit = search.refit if again else search.fit
        fit(
            whole,
            (*held[1], *x),
            start=base.start if base is not None else None,
            guess=base.hypothesis if base is not None else None,
            effort=effort,
        )


def _refine(search: Search, base: Fit) -> None:
    """Add finer shapes of the members of a fit to the candidates."""
    present = {set_key([c]) for c in search.candidates}
    for c in (c for c in base.members if c.extent.grid or not c.may_preslide):
        turns = search.prepared.problem.machine.joint_of(c.site.kind, c.site.name)
        whole = turns is not None and turns.hinge and c.effect.vector > 1
        if whole and clean(base):
            continue  # periods in a turn are whole numbers
        for factor in c.extent.refine:
            shapes = factor * c.shapes
            if c.may_preslide:
                shapes[-1] = c.shapes[-1]
            made = c.with_shapes(shapes)
            if set_key([made]) not in present:
                search.candidates.append(made)

"""What is done with a search: go on to its end, carry sets to longer windows, leave out."""

from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np

from bo_sysid.diagnosis.search.gaps import add_joints, soften
from bo_sysid.diagnosis.search.rounds import extend, round_at
from bo_sysid.diagnosis.search.search import Search
from bo_sysid.diagnosis.search.variants import simplify
from bo_sysid.diagnosis.sets.fit import Fit, set_key
from bo_sysid.diagnosis.sets.groups import all_but, subset
from bo_sysid.diagnosis.sets.refit import FINAL
from bo_sysid.diagnosis.sets.rules import (
    LOOSE,
    MARGIN,
    admissible,
    clean,
    explains_little,
    ranked,
    required_members,
    required_size,
    sizes,
    weak,
)
from bo_sysid.diagnosis.windows.problem import ROUGH
from bo_sysid.diagnosis.windows.windowing import Prepared

_ELIMINATIONS = 14  # members left out in turn, at most
_NEARER = 0.97  # far from the recordings a round goes on only if it leaves less than this share
# a member is needed if without it this many times as much is left, wherever windows start
_NEEDED = 1.5
_CARRIED = 4  # sets, the best ones, with which a search on other windows begins


def explore(search: Search, rounds: int = 5) -> Fit:
    """Return the leading set after rounds that end where it no longer changes.

    They end as well where a leader that explains little came no nearer in a round (`_stuck`).
    """
    near = search.best.members and search.best.rms < LOOSE
    if not (search.begun or near):
        round_at(search, search.nominal)
    leader = _followed(search, rounds)
    if leader.members and leader.rms > LOOSE:
        extend_first(search, leader)
        leader = search.best if search.best.key == leader.key else _followed(search, rounds)
    problem = search.prepared.problem
    if not (clean(leader) or problem.machine.impacts):
        if leader.rms < ROUGH and problem.loose(leader.hypothesis):
            soften(search, leader)
        else:
            add_joints(search, leader)
        if search.best.key != leader.key:
            leader = _followed(search, rounds)
    return leader


def _followed(search: Search, rounds: int) -> Fit:
    leader = search.best
    for _ in range(rounds):
        if not leader.members:
            break
        round_at(search, leader)
        before, leader = leader, search.best
        if leader.key == before.key or _stuck(search, before) or _as_before(search, before):
            break
    return leader


def extend_first(search: Search, leader: Fit) -> None:
    """Extend the best single effect that a leader lacks, as long as that comes nearer.

    Exchanges, one effect at a time, do not lead from a set to one with other values of the study's
    parameters: what a lighter pendulum and less current do, a heavier arm does at the current of
    the model, and neither a heavier arm nor that current fits beside the rest of the first.
    """
    taken = {c.key for c in leader.members}
    grown = [f for f in search.fits.values() if f.size == 1 and f.members[0].key not in taken]
    base: Fit | None = None
    while grown and (best := ranked(grown, search.prior)[0]) is not base:
        base, before = best, set(search.fits)
        extend(search, base)
        grown = [base, *(f for key, f in search.fits.items() if key not in before)]


def _stuck(search: Search, before: Fit) -> bool:
    """Whether a round has found no more than another set that explains as little."""
    best = search.best
    return explains_little(best, search.nominal) and best.rms > _NEARER * before.rms


def _as_before(search: Search, before: Fit) -> bool:
    """Whether a round near the recordings changed no more than members that are too small.

    What they do together is less than what one effect must do to be told.
    """
    best = search.best
    if before.rms > LOOSE or before.rms**2 - best.rms**2 > MARGIN**2:
        return False
    fits = search.fits.values()
    return required_members(best, search.nominal, fits) == required_members(
        before, search.nominal, fits
    )


def carried(search: Search, prepared: Prepared) -> Search:
    """Begin on other windows with the best sets found so far."""
    guess = search.best.hypothesis
    new = Search.on(prepared, search.candidates, search.most, guess, search.doing)
    for f in ranked(search.fits.values(), search.prior)[:_CARRIED]:
        if f.members:
            new.fit(f.members, f.x, guess=f.hypothesis, across=True)
    return new


def without_weakest(search: Search) -> None:
    """Fit the sets without their weakest member, or with the simpler effect in its place.

    And without all that are next to nothing, at once: there may be more of them than turns.
    """
    done: set[object] = set()
    for _ in range(4):
        before = len(search.fits)
        for f in ranked(search.fits.values(), search.prior)[:4]:
            if not f.members or f.key in done:
                continue
            done.add(f.key)
            simplify(search, f)
            weakest = int(np.argmin(f.unique))
            if f.unique[weakest] < max(2 * MARGIN, 0.5, 0.03 * max(f.unique)):
                trifles = tuple(k for k, size in enumerate(f.unique) if size < MARGIN)
                for out in dict.fromkeys(((weakest,), trifles or (weakest,))):
                    left = subset(f, all_but(f, out))
                    search.refit(*left, start=f.start, guess=f.hypothesis)
        if len(search.fits) == before:
            return


def has_friction(fit: Fit, *, presliding: bool = False) -> bool:
    """Whether a fit has friction that may preslide; with `presliding`, one that does."""
    if presliding:
        return any(c.preslides for c in fit.members)
    h = fit.hypothesis
    fitted = zip(h.nuisances, h.nuisance_x, strict=True)
    return any(c.may_preslide for c in fit.members) or any(
        p.friction_joints and x[0] > 0 for p, x in fitted
    )


def leading(search: Search) -> Fit:
    """Return the best of the fits whose every member is needed."""
    fits = list(search.fits.values())
    order = ranked(fits, search.prior)
    return next(f for f in order if admissible(f, search.nominal, fits))


def eliminate(search: Search) -> None:
    """Leave out what is too small until the leading set is admissible.

    Where contact bends the response, that is known of a set only once it was fitted without each
    of its members, from its own magnitudes, from its starts and anew from the smoother's: a smaller
    set that stayed on the far side of an impact makes anything that leads across look needed. So
    are members fitted that stay for what leaving them out costs alone.
    """
    touching = search.prepared.problem.machine.impacts
    done: set[tuple[object, object]] = set()
    for _ in range(_ELIMINATIONS):
        for f in ranked(search.fits.values(), search.prior):
            before, nearer = len(search.fits), False
            small = weak(f, search.nominal, search.fits.values())
            if small:
                simplify(search, f, replace(FINAL, rival=f.rms))
                fit_some(search, f, _without_weak(search, f, small))
            else:
                out = range(len(f.members)) if touching else _by_cost(search, f)
                nearer = _fitted_without(search, f, out, done)
                if f.rms > LOOSE and not touching:
                    _fit_parts(search, f)
            if nearer or len(search.fits) > before:
                break
            if not small:
                return
        else:
            return


def _by_cost(search: Search, f: Fit) -> list[int]:
    """Return the members that stay for what leaving them out costs alone."""
    found, need = sizes(f, search.fits.values()), required_size(f, search.nominal)
    return [k for k, u in enumerate(found) if u < need and f.groups[k] is None]


def _fitted_without(
    search: Search, f: Fit, out: Iterable[int], done: set[tuple[object, object]]
) -> bool:
    """Fit a set without each of some members from where it is; whether that came nearer."""
    nearer, problem = False, search.prepared.problem
    for k in out:
        members, x = subset(f, all_but(f, (k,)))
        key = set_key(members)
        if (f.key, key) in done:
            continue
        done.add((f.key, key))
        known = search.fits.get(key)
        for start in (f.start, problem.smoothed(f.hypothesis)):
            made = search.refit(members, x, start=start, guess=f.hypothesis, effort=FINAL)
            if made.rms > _NEEDED * f.rms:
                break
        nearer |= known is None or made.rss < known.rss
    return nearer


def _fit_parts(search: Search, f: Fit) -> None:
    """Fit a set without each of its members that is in no group, where that was not done yet."""
    for k, group in enumerate(f.groups):
        if group is None:
            fit_some(search, f, all_but(f, (k,)))


def fit_some(search: Search, f: Fit, keep: Sequence[int]) -> None:
    """Fit a part of a set; where that leaves less than the set, fit the set from there as well.

    A part that stays far behind is given up early: what was left out is needed.
    """
    members, x = subset(f, keep)
    if set_key(members) in search.fits:
        return
    effort = replace(FINAL, rival=f.rms)
    made = search.fit(members, x, start=f.start, guess=f.hypothesis, effort=effort)
    if made.rss < f.rss:
        search.refit(f.members, f.x, start=f.start, guess=f.hypothesis, effort=FINAL)


def _without_weak(search: Search, f: Fit, small: Sequence[int]) -> list[int]:
    """Leave out the weakest member, or all weak members of the weakest group at once.

    Only one group: without what a second one does, nothing says how much the first is needed.
    """
    size = np.square(sizes(f, search.fits.values()))
    units: dict[object, list[int]] = {}
    for k in small:
        units.setdefault(f.groups[k] or k, []).append(k)
    out = min(units.values(), key=lambda unit: float(size[unit].sum()))
    return all_but(f, out)

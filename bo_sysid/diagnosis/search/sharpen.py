"""The shapes of the leading set, such as a period, searched between the points of their grids."""

import numpy as np
from scipy.optimize import minimize_scalar

from bo_sysid.diagnosis.search.search import Search
from bo_sysid.diagnosis.search.variants import enrich, vary
from bo_sysid.diagnosis.sets import subsets
from bo_sysid.diagnosis.sets.fit import Fit, set_key
from bo_sysid.diagnosis.sets.groups import all_but, subset
from bo_sysid.diagnosis.sets.screen import Screen
from bo_sysid.diagnosis.sets.shapes import UNIFORM, Place, profile, ranges, reshaped_members
from bo_sysid.diagnosis.windows.candidate import Candidate
from bo_sysid.diagnosis.windows.linear import linearise

_SHARPENINGS, _SHARP = 12, 0.003  # fits of a period; share of its range that is told apart
_SMOOTH = (
    0.05  # the same share of the range of a presliding or a speed, fitted again on all windows
)
_APART = 0.5  # of what a stroke tells apart, between periods that are tried again
_UNDETERMINED = 0.75  # of what was unsure of a shape beforehand, that leaves nothing to fit it by


def sharpened(search: Search) -> None:
    """Fit the shapes of effects that repeat with position, or preslide, between points of a grid.

    Of the leading set, and of that set without each of its other members: beside a period that is
    a little off a second effect looks needed.
    """
    if not any(search.best.groups):
        vary(search, search.best)  # what is left may be little and decide a forecast all the same
    enrich(search, search.best)
    done: set[tuple[str, str]] = set()
    while left := [c for c in search.best.members if c.key not in done]:
        done.add(left[0].key)
        _sharpened_at(search, search.best, left[0].key)


def repeated_anew(search: Search) -> None:
    """Look for the periods of the leading set again, over all that they may be.

    Windows that visit few positions leave a period open, and one that fits some of them need not
    fit the others: a force that repeats along a slide was dropped for that.
    """
    for c in search.best.members:
        if c in search.best.members and _repeats(c):
            _repeated_anew(search, search.best, c)


def _repeats(c: Candidate) -> bool:
    several = bool(c.extent.refine) and len(c.extent.grid) > 1
    return several and c.effect.vector > 1 and len(c.shapes) == 1


def _repeated_anew(search: Search, leader: Fit, c: Candidate) -> None:
    """Fit a set with the period at which one member explains most, by slopes, and around it."""
    problem, k = search.prepared.problem, leader.members.index(c)
    joint = problem.machine.joint_of(c.site.kind, c.site.name)
    assert joint is not None  # noqa: S101 - what repeats with position is at a joint
    rest = subset(leader, all_but(leader, (k,)))
    base = search.fit(*rest, start=leader.start, guess=leader.hypothesis)
    apart = _APART * 2 * np.pi / joint.span
    first, most = min(grid[-1] for grid in c.extent.grid), float(c.extent.high[-1])
    tried = [c.with_shapes(np.array([p])) for p in np.arange(first, most, apart)]
    screen = Screen.at(
        base, linearise(problem, base.hypothesis, base.start), [*base.members, *tried]
    )
    fixed = range(len(base.members))
    table = screen.gram(fixed, dict(zip(fixed, base.x, strict=True)))
    scored = subsets.search(table, c.effect.weight, (), deepest=1)[1]
    if not scored:
        return
    best = max(scored, key=lambda s: s.gain)
    found = screen.candidates[best.members[0]]
    if abs(found.shapes[0] - c.shapes[0]) < apart:
        return
    made = search.refit(
        (*base.members, search.known(found)), (*base.x, best.x),
        start=base.start, guess=base.hypothesis,
    )  # fmt: skip
    at = _place(made, found.key)
    _sharpen(search, made, (at, 0), ranges(made.members[at], problem.machine)[0])


def _place(fit: Fit, key: tuple[str, str]) -> int:
    """Return which member of a fit, whose order may be that of an earlier one, has a key."""
    return next(i for i, c in enumerate(fit.members) if c.key == key)


def _sharpened_at(search: Search, leader: Fit, key: tuple[str, str]) -> None:
    """Fit the shapes of one member of a set, and of the set without each of its others."""
    count, machine = len(leader.members), search.prepared.problem.machine
    alone = [i for i in range(count) if leader.members[i].key != key and leader.groups[i] is None]
    for out in (None, *alone):
        members, x = subset(leader, [i for i in range(count) if i != out])
        fit = search.fit(members, x, start=leader.start, guess=leader.hypothesis)
        for shape, bounds in ranges(fit.members[_place(fit, key)], machine).items():
            fit = _sharpen(search, fit, (_place(fit, key), shape), bounds)


def _sharpen(search: Search, fit: Fit, at: Place, bounds: tuple[float, float]) -> Fit:
    """Minimise the residual over one shape of a member; the best fit is kept.

    A shape that the recordings do not tell (the speed of friction that does not fall) stays.
    """
    profiled = profile(search.prepared.problem, search.frame.Q, fit, {at: bounds})
    if profiled.covariance[0, 0] > _UNDETERMINED * (bounds[1] - bounds[0]) ** 2 / UNIFORM:
        return fit
    best, sharp = fit, _SMOOTH if fit.members[at[0]].may_preslide else _SHARP
    key, shape = fit.members[at[0]].key, at[1]

    def rss(value: float) -> float:
        nonlocal best
        members = reshaped_members(best, {(_place(best, key), shape): value})
        known = set_key(members) in search.fits
        made = search.refit(members, best.x, start=best.start, guess=best.hypothesis)
        if not known:  # a value on the way to the best one
            del search.fits[made.key]
        best = min(best, made, key=lambda f: f.rss)
        return made.rss

    minimize_scalar(
        rss, bounds=bounds, method="bounded",
        options={"maxiter": _SHARPENINGS, "xatol": 0.5 * sharp * (bounds[1] - bounds[0])},
    )  # fmt: skip
    if best is not fit:
        search.listed(best)
    return best

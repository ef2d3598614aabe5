"""Variants of a set: other shapes of its friction, richer and simpler effects at the same sites."""

import numpy as np

from bo_sysid.diagnosis.search.search import Search
from bo_sysid.diagnosis.search.stand_ins import stand_in
from bo_sysid.diagnosis.sets.fit import Fit, set_key
from bo_sysid.diagnosis.sets.groups import all_but, grouped_labels, subset, units_of
from bo_sysid.diagnosis.sets.refit import Effort, refit_at
from bo_sysid.diagnosis.sets.rules import clean
from bo_sysid.diagnosis.sets.shapes import reshaped
from bo_sysid.diagnosis.sets.subsets import clashes
from bo_sysid.diagnosis.windows.candidate import Candidate
from bo_sysid.diagnosis.windows.linear import linearise

_CONSTANT, _DIFFERENCE = "constant_force", "asymmetric_friction"
_PROMISING = 1.5  # times the least that is left, up to which presliding is fitted


def reshape(search: Search, base: Fit) -> None:
    """Fit a set with other shapes of its friction; the nearest with presliding between grid points.

    A grid is coarse: what a presliding leaves that is half as large again looks like a compliance,
    and every joint has one of its own.
    """
    vary(search, base)
    enrich(search, base)
    stand_in(search, base)
    turn_about(search, base)
    for f in _nearest_presliding(search):
        if clean(search.best):
            return
        effort = Effort(rival=search.least)
        there = linearise(search.prepared.problem, f.hypothesis, f.start)
        begun = refit_at(there, f, effort=effort)
        search.listed(reshaped(there, begun, effort, friction_alone=True))


def creep(search: Search, base: Fit) -> None:
    """Fit a set with friction that creeps, linearised at itself.

    Where friction holds a joint a start does nothing, and where it creeps it does.
    """
    vary(search, base, straight=True)
    best = search.best
    if best.key != base.key:
        there = linearise(search.prepared.problem, best.hypothesis, best.start)
        search.listed(refit_at(there, best, effort=Effort(rival=search.least)))


def _nearest_presliding(search: Search) -> list[Fit]:
    """Return the nearest set with presliding, after the nearest with fewer magnitudes.

    Only where they preslide as points of a grid say, and were not fitted between them before.
    """
    presliding = [f for f in search.fits.values() if any(c.preslides for c in f.members)]
    near = sorted((f for f in presliding if f.rms < _PROMISING * search.least), key=lambda f: f.rms)
    count = [f.width for f in near]
    fewer = [f for f, n in zip(near, count, strict=True) if n < count[0]]
    return [f for f in (*fewer[:1], *near[:1]) if any(map(_on_grid, f.members))]


def _on_grid(c: Candidate) -> bool:
    return c.preslides and any(c.shapes[-1] == v[-1] for v in c.extent.variants)


def vary(search: Search, base: Fit, *, straight: bool = False) -> None:
    """Fit a set with other shapes of its effects, all sites alike; with `straight` no presliding.

    Without the joints that were added where such effects are: what bristles do before they slip
    looks like a compliance, and beside one there is little left for them.
    """
    with_friction = {c.site.name for c in base.members if c.may_preslide}
    keep = [
        k
        for k, c in enumerate(base.members)
        if not (c.effect.hidden and c.site.name in with_friction)
    ]
    if len(keep) < len(base.members):
        base = search.fit(*subset(base, keep), guess=base.hypothesis)
    for effect in dict.fromkeys(c.effect for c in base.members if c.may_preslide):
        own = [c for c in base.members if c.effect is effect]
        # the site with the fewest shapes, one without presliding yet, ends the list for all
        for shapes in zip(*(_other_shapes(c, straight) for c in own), strict=False):
            changed = {c: c.with_shapes(s) for c, s in zip(own, shapes, strict=True)}
            members = [changed.get(c, c) for c in base.members]
            if set_key(members) not in search.fits:
                known = [search.known(c) for c in members]
                search.refit(
                    known, base.x, start=base.start, guess=base.hypothesis,
                )  # fmt: skip


def enrich(search: Search, base: Fit) -> None:
    """Fit a set with each effect that holds a simpler one, in its place, with the same presliding.

    What a friction would do is far from linear at one of another size, so that no linear estimate
    proposes it. One without presliding never comes near, where that of the set does. Where a member
    is such an effect itself, with its other shapes: from one of them none may lead to another.
    """
    for k, c in ((unit[0], base.members[unit[0]]) for unit in units_of(base) if len(unit) == 1):
        for d in _richer(search, c):
            shapes = np.array([*d.shapes[:-1], c.shapes[-1]]) if c.preslides else d.shapes
            members = (*base.members[:k], d.with_shapes(shapes), *base.members[k + 1 :])
            if clashes(members) or set_key(members) in search.fits:
                continue
            known = [search.known(m) for m in members]
            own = base.x[k] if d.key == c.key else np.concatenate([[0.0], base.x[k]])
            x = (*base.x[:k], own, *base.x[k + 1 :])
            search.refit(known, x, start=base.start, guess=base.hypothesis)


def turn_about(search: Search, base: Fit, effort: Effort | None = None) -> None:
    """Fit a set with friction that differs between directions in the place of a constant force.

    While a joint moves the two do the same. Where it rests, friction beside a force may hold that
    as if there were none; each of the two alone is far from it, so that no exchange of one effect
    leads there.
    """
    found = {d.site.name: d for d in search.candidates if d.effect.id == _DIFFERENCE}
    for k, c in enumerate(base.members):
        if c.effect.id != _CONSTANT or c.site.name not in found:
            continue
        # -x/2 in motion is the force, see `asymmetric_friction`
        difference, x = found[c.site.name], -2.0 * base.x[k]
        held = [
            i
            for i, m in enumerate(base.members)
            if m.is_dry_friction and m.site.name == c.site.name
        ]
        for out in dict.fromkeys(((k, *held), (k,))):
            members, own = subset(base, all_but(base, out))
            members = (*members, difference)
            # one name for another, though rarer; a group counts as one
            labels = grouped_labels(members, search.candidates)
            count = len({label or i for i, label in enumerate(labels)})
            if count <= search.most and not clashes(members):
                search.fit(
                    members, (*own, x), start=base.start, guess=base.hypothesis, effort=effort
                )


def _richer(search: Search, c: Candidate) -> list[Candidate]:
    """Return the points of the grids of effects that hold another one, or are that themselves."""
    listed = [d for d in search.candidates if tuple(d.point) in d.extent.grid and not d.secant]
    holding = [d for d in listed if (d.effect.nested, d.site.name) == c.key]
    return holding or [
        d for d in listed if d.key == c.key and d.effect.nested and d.size < len(d.point)
    ]


def _other_shapes(c: Candidate, straight: bool) -> list[np.ndarray]:
    given = np.array(c.extent.variants, float)
    finer = [c.shapes[-1] * f for f in c.extent.refine if c.preslides]
    found = [
        *np.where(np.isnan(given), c.shapes, given),
        *(np.array([*c.shapes[:-1], s]) for s in finer),
    ]
    return [s for s in found if not s[-1]] if straight else found


def simplify(search: Search, fit: Fit, effort: Effort | None = None) -> None:
    """Fit a set with the simpler effect for each that contains one, with the same presliding.

    Where that has none also with its other shapes: friction that creeps is no less simple
    than friction that holds, and beside one that rises by nothing it was never tried.
    """
    for k, c in enumerate(fit.members):
        for plain in _plainer(search, c) if fit.unique[k] < 1.0 or effort else ():
            members = (*fit.members[:k], plain, *fit.members[k + 1 :])
            x = (*fit.x[:k], fit.x[k][1:], *fit.x[k + 1 :])
            if not clashes(members):
                search.fit(members, x, start=fit.start, guess=fit.hypothesis, effort=effort)


def _plainer(search: Search, c: Candidate) -> list[Candidate]:
    wanted = (c.effect.nested, c.site.name)
    plain = next((d for d in search.candidates if d.key == wanted and not d.secant), None)
    if plain is None:
        return []
    if c.preslides:
        return [search.known(plain.with_shapes(np.array([*plain.shapes[:-1], c.shapes[-1]])))]
    straight = [np.array(v) for v in plain.extent.variants if not v[-1]]
    return [plain, *(search.known(plain.with_shapes(v)) for v in straight)]

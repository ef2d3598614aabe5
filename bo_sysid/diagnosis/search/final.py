"""The final fits, on all windows: the leading sets, and what could stand in their place."""

from collections.abc import Sequence
from dataclasses import replace

from bo_sysid.diagnosis.search.blocks import simulate_blocks
from bo_sysid.diagnosis.search.ground import slide
from bo_sysid.diagnosis.search.held_friction import drop_unsupported_presliding, vary_presliding
from bo_sysid.diagnosis.search.lateness import late_elsewhere, lead_of
from bo_sysid.diagnosis.search.loads import place_loads
from bo_sysid.diagnosis.search.moves import eliminate, leading
from bo_sysid.diagnosis.search.polish import fitted_at_itself, polished, stepped_finer
from bo_sysid.diagnosis.search.rounds import substitute
from bo_sysid.diagnosis.search.search import Search
from bo_sysid.diagnosis.search.sharpen import repeated_anew
from bo_sysid.diagnosis.search.variants import turn_about
from bo_sysid.diagnosis.search.window_lengths import windows_of
from bo_sysid.diagnosis.sets.decide import BAND
from bo_sysid.diagnosis.sets.fit import Fit, Names, set_key
from bo_sysid.diagnosis.sets.refit import FINAL, Effort
from bo_sysid.diagnosis.sets.rules import (
    LOOSE,
    MARGIN,
    admissible,
    clean,
    explains_little,
    ranked,
    required_members,
)
from bo_sysid.diagnosis.sets.shapes import ranges
from bo_sysid.diagnosis.windows.candidate import Candidate
from bo_sysid.diagnosis.windows.evidence import Evidence
from bo_sysid.diagnosis.windows.windowing import prepare

_FINALISTS = 5
_FAR = 2.0  # times what the leader leaves, above which a set is far from it
# [sigma] a set without a part of the leader is fitted again unless that part costs more
_NEEDED = 0.5
_COMPARED = 3  # leading sets at most that are compared with others
_AS_GOOD = 1.02  # times what the leader leaves: simpler sets within that are as good
_UNDECIDED = 1.005  # the same, of rivals that may only not be fitted to their end
# times what the leader leaves, within which rivals are polished as well; how many of them
_NEAR, _RIVALS = 1.05, 2


def final_fits(evidence: Evidence, search: Search, horizon: int, step: float) -> Search:
    """Fit the leading sets again, on all windows, with the correction taken at the leader."""
    order = _without_trifles(search)
    chosen = finalists(order, search.nominal)
    evidence = replace(evidence, lead=lead_of(chosen))
    problem = windows_of(evidence, horizon, step, everything=True)
    leader, prepared = order[0], prepare(problem, order[0].hypothesis)
    once = explains_little(order[0], search.nominal)
    leader, prepared = polished(problem, leader, prepared, search.doing, once=once)
    leader, prepared = stepped_finer(evidence, leader, prepared, horizon, search.doing)
    final = Search.on(prepared, search.candidates, search.most, leader.hypothesis, search.doing)
    for f in chosen:
        if f.members:
            fitted_on_all(final, leader if f is order[0] else f, far=f.rms > _FAR * order[0].rms)
    vary_presliding(final)
    if not (clean(final.best) or explains_little(final.best, final.nominal)):
        repeated_anew(final)
    drop_unsupported_presliding(final)
    return final


def fitted_on_all(final: Search, fit: Fit, far: bool = False) -> None:
    """Fit a set on all windows; to the end only where it may lead there."""
    last = replace(FINAL, rival=final.least)
    for effort in (Effort(), last) if far else (last,):
        made = final.refit(fit.members, fit.x, guess=fit.hypothesis, effort=effort)
        if made.rms > _FAR * final.least:
            break
    final.listed(made)


def compare(final: Search, first: Fit) -> None:
    """Fit what could stand in the place of each member of the leading set, and fewer of them.

    Whatever comes to lead by that is compared with others in its turn: of a set that was not,
    nothing says what else the recordings admit.

    Args:
        final: the fits on all windows.
        first: what led before; it was fitted with its own shapes.
    """
    eliminate(final)
    done: set[object] = set()
    finished = {first.effects}
    for _ in range(_COMPARED):
        simulate_blocks(final)
        leader = leading(final)
        if not leader.members or leader.key in done:
            return
        done.add(leader.key)
        if explains_little(leader, final.nominal):
            return
        substitute(final, leader)
        turn_about(final, leader, FINAL)
        place_loads(final, leader, leader)
        slide(final, leader)
        _fit_with_leader_shapes(final, leader)
        refit_from_nearer(final, leader)
        _polish(final, leader, finished)
        eliminate(final)


def _fit_with_leader_shapes(final: Search, leader: Fit) -> None:
    """Fit the sets that differ from the leader in one member with the shapes of the others.

    Beside friction that preslides otherwise a set looks worse than it is.
    """
    for f in [f for f in final.fits.values() if f.rms < _AS_GOOD * leader.rms]:
        if f.exchanges_one(leader) and set_key(_as_in(leader, f)) not in final.fits:
            _with_leader_shapes(final, f, leader)


def _with_leader_shapes(final: Search, fit: Fit, leader: Fit) -> Fit:
    """Return a set with the shapes of what it shares with the leader, or as it is: what is nearer.

    A load beside friction that holds left 1.19 σ, and three gains beside one that creeps 0.99, so
    that the load was no explanation; beside one that creeps it leaves as much.
    """
    members = _as_in(leader, fit)
    if set_key(members) == fit.key:
        return fit
    made = final.refit(members, fit.x, start=fit.start, guess=fit.hypothesis, effort=FINAL)
    return min(made, fit, key=lambda f: f.rss)


def _as_in(leader: Fit, fit: Fit) -> list[Candidate]:
    """Return the members of a set, with the leader's shapes where it has them."""
    own = {c.key: c for c in leader.members}
    return [own.get(c.key, c) for c in fit.members]


def refit_from_nearer(final: Search, leader: Fit) -> None:
    """Fit a leader that is far off from a set that differs in one member and is nearer.

    Where both do the same, what they share may lie where only that one came to: a drag left 201 σ
    and the back-EMF of its motor 203, and so they were told apart.
    """
    own = {c.key: (c, x) for c, x in zip(leader.members, leader.x, strict=True)}
    near = [f for f in final.fits.values() if f.rss < leader.rss and f.exchanges_one(leader)]
    if leader.rms <= LOOSE or not near:
        return
    best = min(near, key=lambda f: f.rss)
    (instead,) = own.keys() - {c.key for c in best.members}
    pairs = [
        (c, x) if c.key in own else own[instead] for c, x in zip(best.members, best.x, strict=True)
    ]
    members, x = zip(*pairs, strict=True)
    final.refit(members, x, start=best.start, guess=best.hypothesis, effort=FINAL)


def _polish(final: Search, leader: Fit, finished: set[Names]) -> None:
    """Fit the leader and the nearest rivals with their own shapes, linearised at themselves.

    What a start can do at one motion is not what it can do at another, and an effect with fewer
    magnitudes than another may only be linear less far.

    Args:
        final: the fits on all windows.
        leader: the leading one.
        finished: effects and sites of the sets that were fitted so before; grows.
    """
    problem = final.prepared.problem
    late, rivals, smaller = (
        [f for f in found if f.effects not in finished]
        for found in (
            late_elsewhere(final.fits.values(), leader),
            _rivals(final, leader),
            _smaller(final, leader),
        )
    )
    for f in (leader, *late[:1], *rivals[:_RIVALS], *smaller[:1]):
        if f.effects in finished or (f is leader and not _shaped(final, f)):
            continue
        finished.add(f.effects)
        f = _with_leader_shapes(final, f, leader)
        made = fitted_at_itself(problem, f)
        if made.rss < f.rss:
            final.listed(made)


def _rivals(final: Search, leader: Fit) -> list[Fit]:
    """Return the nearest sets with other effects, each with the best of its shapes.

    One that leaves so little more may only not be fitted to its end, and is as probable then.
    """
    count, found = leader.width, dict[Names, Fit]()
    for f in ranked(final.fits.values(), final.prior):
        fewer = f.width < count and f.rms < _FAR * leader.rms
        shaped = f.names != leader.names and _shaped(final, f) and f.rms < _NEAR * leader.rms
        close = f.rms < _UNDECIDED * leader.rms and f.rss - leader.rss > 2 * BAND
        if f.size == leader.size and (fewer or shaped or close) and not f.names < leader.names:
            found.setdefault(f.effects, f)
    return list(found.values())


def _smaller(final: Search, leader: Fit) -> list[Fit]:
    """Return the nearest smaller sets that are as good.

    What they leave more may be that their shapes were fitted beside others, as the period of a
    cogging was, and one effect more would stand for it.
    """
    order = ranked(final.fits.values(), final.prior)
    return [
        f
        for f in order
        if f.members
        and f.size < leader.size
        and f.rms < _AS_GOOD * leader.rms
        and _shaped(final, f)
    ]


def _shaped(final: Search, fit: Fit) -> bool:
    return any(ranges(c, final.prepared.problem.machine) for c in fit.members)


def _without_trifles(search: Search) -> list[Fit]:
    """Return the fits, best first, but those of sets that add only trifles to an admissible one.

    On all windows trifles cost a fit each, and a share of the leader's residual by which is told
    whether the time step is fine enough.
    """
    fits, nominal = ranked(search.fits.values(), search.prior), search.nominal
    able = {f.effects: f for f in reversed(fits) if f.members and admissible(f, nominal)}

    def trifling(f: Fit) -> bool:
        core = required_members(f, nominal, fits)
        rest = able.get(core) if core != f.effects else None
        return rest is not None and rest.excess - f.excess < MARGIN**2

    return [f for f in fits if not trifling(f)]


def _lacks(fit: Fit, leader: Fit) -> bool:
    """Whether a set is a part of one that leaves little, and what it lacks is clearly needed."""
    part = fit.names < leader.names and leader.rms < LOOSE
    return part and fit.excess > leader.excess + _NEEDED**2


def finalists(order: Sequence[Fit], nominal: Fit) -> list[Fit]:
    """Return the leading sets, and the best that are admissible or groups.

    Of sets that differ in shapes alone only the first, since they are fitted again. Parts of a
    leader that leaves little are no rivals, where they leave clearly more. Of those that
    leave many times as much as the leader only the best that is admissible, which may be what all
    windows admit, and the best that shares no name, to compare with. Where names are no explanation
    only the leader, and the best that is admissible.
    """
    first = dict[Names, Fit]()
    for f in order:
        first.setdefault(f.effects, f)
    order = list(first.values())
    able = [f for f in order if f.members and not any(f.groups) and admissible(f, nominal)]
    grouped = [f for f in order if any(f.groups)]
    if explains_little(order[0], nominal):
        return list(dict.fromkeys((order[0], *able[:1])))
    held = (*order[:_FINALISTS], *able[:3], *grouped[:1])
    near = [f for f in held if f.rms < _FAR * order[0].rms and not _lacks(f, order[0])]
    others = [f for f in order if f.members and not f.names & order[0].names]
    return list(dict.fromkeys((*near, *able[:1], *others[:1])))

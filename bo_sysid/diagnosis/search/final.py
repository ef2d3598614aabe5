"""The final fits, on all windows: the leading sets, and what could stand in their place."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from bo_sysid.diagnosis.search.blocks import simulate_blocks
from bo_sysid.diagnosis.search.moves import eliminate, rubbing
from bo_sysid.diagnosis.search.rounds import substitute
from bo_sysid.diagnosis.search.search import Search
from bo_sysid.diagnosis.search.variants import vary
from bo_sysid.diagnosis.search.window_lengths import windows_of
from bo_sysid.diagnosis.sets.fit import Fit, Names, set_key
from bo_sysid.diagnosis.sets.refit import FINAL, Effort, refit
from bo_sysid.diagnosis.sets.rules import LOOSE, admissible, clean, lost, ranked
from bo_sysid.diagnosis.sets.shapes import ranges, reshaped, with_shapes_unsure
from bo_sysid.diagnosis.windows.estimated_starts import first_starts
from bo_sysid.diagnosis.windows.evidence import Evidence
from bo_sysid.diagnosis.windows.linear import Linear
from bo_sysid.diagnosis.windows.problem import ROUGH, Problem
from bo_sysid.diagnosis.windows.windowing import Prepared, prepare, settled
from bo_sysid.mjcf.touching import can_touch

_FINALISTS = 5
_FAR = 2.0  # times what the leader leaves
_NEEDED = 0.5  # [sigma] that leaving out a part costs, from which it need not be fitted again
_COMPARED = 3  # leading sets at most that are compared with others
_POLISH = 6  # times at most that the leader is linearised anew on all windows
_TOLD = 2.0  # standard deviations from which a bend, or what is left, is told from none
_AS_GOOD = 1.02  # times what a set leaves, that may be left without
_UNTOLD = 1.005  # the same, of friction that holds where it creeps in the set
_NEAR, _RIVALS = 1.05, 2  # times what a set leaves, within which others are polished; how many
_SETTLED = 0.3  # standard deviations: magnitudes that moved less stay where they are
_SETTLED_SHAPE = 0.03  # the same as a share of a shape
_GAINED = 0.995  # of what the time before left, that linearising anew must come below
_CURVED = 0.5  # [sigma] of the correction, from which more than a share of it may be left
_HALVINGS = 2  # of the time step at most, for that
_STRAIGHTER = 0.7  # of what is unexplained, that half the step may leave to be worth its time


def final_fits(evidence: Evidence, search: Search, horizon: int, step: float) -> Search:
    """Fit the leading sets again, on all windows, with the correction taken at the leader."""
    order = ranked(search.fits.values(), search.prior)
    chosen = _finalists(order, search.nominal)
    problem = windows_of(evidence, horizon, step, everything=True)
    leader, prepared = order[0], prepare(problem, order[0].hypothesis)
    times = 1 if lost(order[0], search.nominal) else _POLISH
    leader, prepared = _polished(problem, leader, prepared, most=times)
    if leader.rms < ROUGH and not can_touch(evidence.machine.model):
        leader, prepared = _stepped_finer(evidence, leader, prepared, horizon)
    final = Search.on(prepared, search.candidates, search.most, leader.hypothesis, search.doing)
    for f in chosen:
        if f.members:
            _fitted_on_all(final, leader if f is order[0] else f, far=f.rms > _FAR * order[0].rms)
    _bent_anew(final)
    _straightened(final)
    return final


def _fitted_on_all(final: Search, fit: Fit, far: bool) -> None:
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
    polished = {_effects(first)}
    for _ in range(_COMPARED):
        simulate_blocks(final)
        leader = _leader(final)
        if not leader.members or leader.key in done:
            return
        done.add(leader.key)
        if lost(leader, final.nominal):
            return
        substitute(final, leader)
        _shaped_alike(final, leader)
        _from_nearer(final, leader)
        _polish(final, leader, polished)
        eliminate(final)


def let_hold(final: Search) -> None:
    """Let friction of the leading set hold a load where recordings do not tell that it creeps.

    Machines' friction holds; that of MuJoCo's default settings creeps.
    """
    leader = _leader(final)
    if not any(c.creeps for c in leader.members):
        return
    known = [final.known(c.usual) if c.creeps else c for c in leader.members]
    held = final.fit(known, leader.x, start=leader.start, guess=leader.hypothesis, effort=FINAL)
    if held.rms < _UNTOLD * leader.rms:
        for f in [f for f in final.fits.values() if _effects(f) == _effects(leader)]:
            if any(c.creeps for c in f.members):
                del final.fits[f.key]


def _shaped_alike(final: Search, leader: Fit) -> None:
    """Fit the sets that differ from the leader in one member with the shapes of the others.

    Beside friction that bends otherwise a set looks worse than it is.
    """
    own = {c.key: c for c in leader.members}
    near = [f for f in final.fits.values() if f.rms < _AS_GOOD * leader.rms]
    for f in near:
        members = [own.get(c.key, c) for c in f.members]
        if _exchanged(f, leader) and set_key(members) not in final.fits:
            final.refit(members, f.x, start=f.start, guess=f.hypothesis, effort=FINAL)


def _from_nearer(final: Search, leader: Fit) -> None:
    """Fit a leader that is far off from a set that differs in one member and is nearer.

    Where both do the same, what they share may lie where only that one came to: a drag left 201 σ
    and the back-EMF of its motor 203, and so they were told apart.
    """
    own = {c.key: (c, x) for c, x in zip(leader.members, leader.x, strict=True)}
    near = [f for f in final.fits.values() if f.rss < leader.rss and _exchanged(f, leader)]
    if leader.rms <= LOOSE or not near:
        return
    best = min(near, key=lambda f: f.rss)
    (instead,) = own.keys() - {c.key for c in best.members}
    pairs = [
        (c, x) if c.key in own else own[instead] for c, x in zip(best.members, best.x, strict=True)
    ]
    members, x = zip(*pairs, strict=True)
    final.refit(members, x, start=best.start, guess=best.hypothesis, effort=FINAL)


def _exchanged(fit: Fit, leader: Fit) -> bool:
    """Whether a set differs from the leader in one member."""
    shared = len(_effects(fit) & _effects(leader))
    return len(fit.members) == len(leader.members) == shared + 1


def _polish(final: Search, leader: Fit, polished: set[Names]) -> None:
    """Fit the leader and the nearest rivals with their own shapes, linearised at themselves.

    What a start can do at one motion is not what it can do at another, and an effect with fewer
    magnitudes than another may only be linear less far.

    Args:
        final: the fits on all windows.
        leader: the leading one.
        polished: effects and sites of the sets that were fitted so before; grows.
    """
    problem = final.prepared.problem
    rivals = [f for f in _rivals(final, leader) if _effects(f) not in polished]
    for f in (leader, *rivals[:_RIVALS]):
        if _effects(f) in polished or (f is leader and not _shaped(final, f)):
            continue
        polished.add(_effects(f))
        made = _fitted_at_itself(problem, f)
        if made.rss < f.rss:
            final.listed(made)


def _rivals(final: Search, leader: Fit) -> list[Fit]:
    """Return the nearest sets with other effects, each with the best of its shapes."""
    count, found = sum(c.size for c in leader.members), dict[Names, Fit]()
    for f in ranked(final.fits.values(), final.prior):
        fewer = sum(c.size for c in f.members) < count and f.rms < _FAR * leader.rms
        shaped = f.names != leader.names and _shaped(final, f) and f.rms < _NEAR * leader.rms
        if f.size == leader.size and (fewer or shaped) and not f.names < leader.names:
            found.setdefault(_effects(f), f)
    return list(found.values())


def _shaped(final: Search, fit: Fit) -> bool:
    return any(ranges(c, final.prepared.problem.machine) for c in fit.members)


def _effects(fit: Fit) -> Names:
    """Return effects and sites as they are, whatever an effect contains (`Fit.names`)."""
    return frozenset(c.key for c in fit.members)


def _bent_anew(final: Search) -> None:
    """Vary the bends of friction on all windows: in some of them alone joints may be stuck."""
    leader, smooth = final.best, not can_touch(final.prepared.problem.machine.model)
    decided = clean(leader) or lost(leader, final.nominal)
    if smooth and rubbing(leader) and not decided:
        vary(final, leader)


def _straightened(final: Search) -> None:
    """Leave out bends of the leading set that the recordings do not tell from none."""
    leader = final.best
    if not rubbing(leader, bent=True):
        return
    spread = with_shapes_unsure(final.prepared.problem, final.frame.Q, leader).spread
    untold = {
        c.key
        for c, s in zip(leader.members, spread, strict=True)
        if c.bent and c.shapes[-1] < _TOLD * s[-1]
    }
    if not untold:
        return
    members = [c.straight if c.key in untold else c for c in leader.members]
    known = [final.known(c) for c in members]
    straight = final.refit(known, leader.x, guess=leader.hypothesis, effort=FINAL)
    if straight.rms > _AS_GOOD * leader.rms:
        return
    for f in list(final.fits.values()):
        if _effects(f) == _effects(leader) and any(c.bent and c.key in untold for c in f.members):
            del final.fits[f.key]


def _polished(
    problem: Problem, leader: Fit, prepared: Prepared, *, most: int
) -> tuple[Fit, Prepared]:
    """Fit the leader on all windows, prepared anew until its magnitudes stay where they are.

    Or until that gains nothing: a bend that windows tell little of may wander on for ever.
    """
    for k in range(min(most, _times(leader, problem))):
        before, leader = leader, _refitted(prepared.linear, leader)
        same = len(leader.start) == len(problem.windows)
        prepared = prepare(problem, leader.hypothesis, leader.start if same else None)
        idle = k > 0 and leader.rms > _GAINED * before.rms
        if idle or _distance(before, leader) < _SETTLED:
            break
    return leader, prepared


def _stepped_finer(
    evidence: Evidence, leader: Fit, prepared: Prepared, horizon: int
) -> tuple[Fit, Prepared]:
    """Halve the time step while that explains much of what the leader leaves.

    What a step does is corrected by one share of what a finer one changes, which is right to first
    order alone. Where effects are thousands of sigma large the rest is felt: an arm whose friction,
    damping and rotors were missing kept .4 σ, and its forecasts twice their noise.
    """
    by_noise = _TOLD * np.sqrt(2.0 / prepared.problem.dof)  # rms² of n numbers varies by √(2/n)
    for _ in range(_HALVINGS):
        if leader.excess < by_noise or prepared.correction_rms < _CURVED:
            break
        step = prepared.problem.windows.timestep / 2
        problem = windows_of(evidence, horizon, step, everything=True)
        finer = prepare(problem, leader.hypothesis)
        made, finer = _polished(problem, leader, finer, most=_POLISH)
        if made.excess > _STRAIGHTER * leader.excess:
            break
        leader, prepared = made, finer
    return leader, prepared


def _fitted_at_itself(problem: Problem, fit: Fit) -> Fit:
    """Fit a set as the leader was, on the windows and with the weights that all are compared by."""
    for _ in range(_times(fit, problem)):
        first = first_starts(problem, fit.hypothesis)
        linear = settled(problem, fit.hypothesis, [*first, fit.start])
        before, fit = fit, _refitted(linear, fit)
        if _distance(before, fit) < _SETTLED:
            break
    return fit


def _times(fit: Fit, problem: Problem) -> int:
    """Return how often a set is linearised anew.

    Once in contact: how much each window says is found anew with every linear model there.
    """
    most = 1 if can_touch(problem.machine.model) else _POLISH
    return most if fit.members else 0


def _refitted(linear: Linear, fit: Fit) -> Fit:
    """Return a fit with magnitudes and shapes fitted to the end in a linear model's space."""
    made = refit(
        linear, fit.members, fit.x, groups=fit.groups, start=linear.start, guess=fit.hypothesis,
        effort=FINAL,
    )  # fmt: skip
    return reshaped(linear, made)


def _distance(before: Fit, after: Fit) -> float:
    """Return how far the magnitudes of two fits of a set lie apart, in standard deviations.

    Infinitely far where its shapes still move.
    """
    moved = [
        np.abs(b.shapes - a.shapes) > _SETTLED_SHAPE * np.abs(a.shapes)
        for b, a in zip(before.members, after.members, strict=True)
    ]
    if np.concatenate(moved).any():
        return np.inf
    change = np.concatenate(after.x) - np.concatenate(before.x)
    own = slice(0, len(change))
    inverse = np.linalg.pinv(after.covariance[own, own], hermitian=True)
    return float(np.sqrt(max(change @ inverse @ change, 0.0)))


def _lacks(fit: Fit, leader: Fit) -> bool:
    """Whether a set is a part of one that leaves little, and what it lacks is clearly needed."""
    part = fit.names < leader.names and leader.rms < LOOSE
    return part and fit.excess > leader.excess + _NEEDED**2


def _leader(search: Search) -> Fit:
    """Return the best of the fits whose every member is needed."""
    fits = list(search.fits.values())
    order = ranked(fits, search.prior)
    return next(f for f in order if admissible(f, search.nominal, fits))


def _finalists(order: Sequence[Fit], nominal: Fit) -> list[Fit]:
    """Return the leading sets, and the best that are admissible or groups.

    Of sets that differ in shapes alone only the first, since they are fitted again. Parts of a
    leader that leaves little are no rivals, where they leave clearly more. Of those that
    leave many times as much as the leader only the best that is admissible, which may be what all
    windows admit, and the best that shares no name, to compare with. Where names are no explanation
    only the leader, and the best that is admissible.
    """
    first = dict[Names, Fit]()
    for f in order:
        first.setdefault(_effects(f), f)
    order = list(first.values())
    able = [f for f in order if f.members and not any(f.groups) and admissible(f, nominal)]
    grouped = [f for f in order if any(f.groups)]
    if lost(order[0], nominal):
        return list(dict.fromkeys((order[0], *able[:1])))
    held = (*order[:_FINALISTS], *able[:3], *grouped[:1])
    near = [f for f in held if f.rms < _FAR * order[0].rms and not _lacks(f, order[0])]
    others = [f for f in order if f.members and not f.names & order[0].names]
    return list(dict.fromkeys((*near, *able[:1], *others[:1])))

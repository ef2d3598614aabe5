"""From recordings to the decision: windows that grow, the search, the final fits on all windows."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from bo_sysid.diagnosis.decide import Decision, decide
from bo_sysid.diagnosis.evidence import Evidence
from bo_sysid.diagnosis.fit import Fit
from bo_sysid.diagnosis.hypothesis import Hypothesis
from bo_sysid.diagnosis.linear import linearise, project
from bo_sysid.diagnosis.moves import (
    carried,
    eliminate,
    explore,
    rubbing,
    stripped,
)
from bo_sysid.diagnosis.problem import Problem, pose
from bo_sysid.diagnosis.refit import FINAL, refit
from bo_sysid.diagnosis.rounds import substitute, vary
from bo_sysid.diagnosis.rules import ROUGH, admissible, clean, ranked
from bo_sysid.diagnosis.search import Search
from bo_sysid.diagnosis.shapes import reshaped, sharpened
from bo_sysid.diagnosis.windowing import Prepared, nothing, prepare
from bo_sysid.mjcf.touching import can_touch

_TRACTABLE = 12.0  # [sigma] of the nominal residual for which linear screening serves
_SHORTEST = 1 / 6  # of the full horizon
_UNSTABLE = 2.0  # growth λT of disturbances in a window, as a logarithm
_LESS = 3  # times shorter at most: what acts slowly is not seen in less
_OFTEN = 0.9  # quantile of λ over the recordings
_LEAST = 6  # instants in the shortest window
_GROWTH, _ALMOST = 2.2, 2.6  # of the windows; times their length that are full ones at once
_LONG_STEP = 2.0  # [sigma] of the correction above which the simulation steps at half
_HALVINGS = 3
_SOFTER = 10.0  # times the softness of a gap's ends on the grid, to begin with once more
_GAP_DIVISION = 4  # of the time step where a joint moves in a gap
_BRISTLES_DIVISION = 2  # the same, where friction bends before it slips
_WINDOWS = 24  # in the search
_MOST = 10  # times that number at most in the final fits
_MOST_IN_CONTACT = 4  # the same, where each is fitted by itself and takes its time
_FINALISTS = 5
_FAR = 2.0  # times what the leader leaves
_POLISH = 6  # times at most that the leader is linearised anew on all windows
_SETTLED = 0.3  # standard deviations: magnitudes that moved less stay where they are
_CARRIED = 4


@dataclass(frozen=True)
class Located:
    """The decision, with the windows on which it was made.

    Attributes:
        decision: the posterior over sets.
        prepared: all training windows.
        search: the finished search, for what is asked of it later.
        tried: number of sets fitted through the simulator.
    """

    decision: Decision
    prepared: Prepared
    search: Search
    tried: int


def locate(evidence: Evidence, tell: Callable[[str], None] = lambda text: None) -> Located:
    """Find the set of effects that explains the training recordings."""
    horizon = max(round(evidence.window / evidence.machine.sampling), _LEAST)
    step = evidence.machine.model.opt.timestep
    horizon = _stable(evidence, horizon, step)
    prepared, length = _tractable(evidence, horizon, step)
    for _ in range(_HALVINGS if length == horizon else 0):
        if prepared.correction_rms <= _LONG_STEP:
            break
        step = step / 2
        prepared = prepare(_problem(evidence, horizon, step))
    search = Search.on(prepared, list(evidence.candidates), evidence.most, None)
    tell(f"windows of {length} instants: {search.nominal.rms:.2f} sigma with the nominal model")
    search, step = _explored(evidence, search, length, step)
    while length < horizon:
        step = _step_for(search, search.best, step)
        search, length = _lengthened(evidence, search, length, horizon, step)
        search, step = _explored(evidence, search, length, step, rounds=3)
        tell(f"windows of {length} instants: {_said(search.best)}")
    sharpened(search)
    stripped(search)
    tell(f"final fits: {_said(search.best)}")
    final = _final(evidence, search, horizon, _step_for(search, search.best, step))
    eliminate(final)
    leader = _leader(final)
    if leader.members:
        substitute(final, leader)
        eliminate(final)
    fits, dof = list(final.fits.values()), final.prepared.problem.dof
    decision = decide(fits, final.nominal, final.prior, final.frame.Q, dof)
    return Located(decision, final.prepared, final, len(search.fits) + len(final.fits))


def _explored(
    evidence: Evidence, search: Search, length: int, step: float, rounds: int = 5
) -> tuple[Search, float]:
    """Explore; once more with a finer step where friction leaves what may be its bend."""
    leader = explore(search, rounds)
    finer = _step_for(search, leader, step)
    if finer < step and _bends(leader) and not clean(leader):
        prepared = prepare(_problem(evidence, length, finer), leader.hypothesis)
        search, step = carried(search, prepared, _CARRIED), finer
        explore(search, rounds)
    return search, step


def _step_for(search: Search, leader: Fit, step: float) -> float:
    """Return the time step for a leader whose joints meet ends of gaps between two long steps.

    No share of a finer step's difference corrects that: when it arrives bends what follows. Nor
    does a long step tell bristles that bend from those that do not.
    """
    problem, division = search.prepared.problem, 1
    if problem.loose(leader.hypothesis):
        division = _GAP_DIVISION
    elif _bends(leader) and not can_touch(problem.machine.model):
        division = _BRISTLES_DIVISION
    return min(step, float(problem.machine.model.opt.timestep) / division)


def _bends(leader: Fit) -> bool:
    """Whether friction of a fit bends, or little is left, which may be its bend."""
    return leader.rms < ROUGH and rubbing(leader, bent=clean(leader))


def _stable(evidence: Evidence, horizon: int, step: float) -> int:
    """Shorten the windows until little disturbances do not grow to many times their size in them.

    λ = max log|eig A|/h of one step of the linear model of the mechanics is the rate at which the
    motion leaves a recorded one; where λ ≥ 15/s (a short pendulum upright), 0.3 s multiply what the
    model lacks by a hundred, and a fit follows those moments alone.
    """
    problem = _problem(evidence, max(int(horizon * _SHORTEST), _LEAST), step)
    linear = linearise(problem, nothing(problem), problem.windows.start)
    mechanics = slice(0, 2 * evidence.machine.model.nv)
    growth = np.abs(np.linalg.eigvals(linear.A[..., mechanics, mechanics])).max(axis=-1)
    rates = np.log(np.maximum(growth, 1e-12)) / (linear.macro * problem.windows.timestep)
    rate = float(np.quantile(rates, _OFTEN))
    most = _UNSTABLE / rate if rate > 0 else np.inf
    return int(max(min(horizon, most / evidence.machine.sampling), horizon / _LESS, _LEAST))


def _tractable(evidence: Evidence, horizon: int, step: float) -> tuple[Prepared, int]:
    """Shorten the windows until the nominal residual is small enough for linear screening."""
    least = max(int(horizon * _SHORTEST), _LEAST)
    length = horizon
    while True:
        prepared = prepare(_problem(evidence, length, step))
        problem = prepared.problem
        r = problem.residual(nothing(problem), prepared.start)
        rms = float(np.sqrt((project(prepared.linear.Q, r) ** 2).sum() / problem.dof))
        if rms < _TRACTABLE or length <= least:
            return prepared, length
        factor = max(min((_TRACTABLE / rms) ** 0.4, 0.75), 0.4)
        length = max(int(length * factor), least)


def _lengthened(
    evidence: Evidence, search: Search, length: int, horizon: int, step: float
) -> tuple[Search, int]:
    """Carry the best sets to longer windows: at once to full ones where the leader holds there."""
    leader = search.best
    longer = horizon if length * _ALMOST > horizon else int(length * _GROWTH)
    for tried in (horizon, longer) if clean(leader) else (longer,):
        prepared = prepare(_problem(evidence, tried, step), leader.hypothesis)
        made = carried(search, prepared, _CARRIED)
        if made.best.rms < ROUGH:
            break
    return made, tried


def _problem(evidence: Evidence, horizon: int, step: float, everything: bool = False) -> Problem:
    whole = sum(r.span[1] - r.span[0] for r in evidence.recordings) / evidence.machine.sampling
    count = max(int(whole / horizon), 1)
    stride = max(round(count / _WINDOWS), 1)
    if everything:
        most = _MOST_IN_CONTACT if can_touch(evidence.machine.model) else _MOST
        stride = -(-count // (most * _WINDOWS))
    return pose(
        evidence.model,
        evidence.machine,
        evidence.recordings,
        evidence.sigma,
        evidence.nuisances,
        horizon=horizon,
        stride=stride,
        timestep=step,
        engine=evidence.engine,
        laws=evidence.laws,
    )


def _final(evidence: Evidence, search: Search, horizon: int, step: float) -> Search:
    """Fit the leading sets again, on all windows, with the correction taken at the leader."""
    order = ranked(search.fits.values(), search.prior)
    chosen = _finalists(order, search.nominal)
    problem = _problem(evidence, horizon, step, everything=True)
    leader, prepared = _polished(problem, order[0])
    if problem.loose(leader.hypothesis):
        other = _polished(problem, _restarted(order[0]))
        leader, prepared = min((leader, prepared), other, key=lambda made: made[0].rms)
    final = Search.on(prepared, search.candidates, search.most, leader.hypothesis)
    for f in chosen:
        if f.members:
            begin = leader if f is order[0] else f
            final.listed(_again(final, begin, begin.hypothesis))
    _bent_anew(final)
    return final


def _bent_anew(final: Search) -> None:
    """Vary the bends of friction on all windows: in some of them alone joints may be stuck."""
    leader = final.best
    if (
        rubbing(leader)
        and not clean(leader)
        and not can_touch(final.prepared.problem.machine.model)
    ):
        vary(final, leader)


def _polished(problem: Problem, leader: Fit) -> tuple[Fit, Prepared]:
    """Fit the leader on all windows, linearised anew until its magnitudes stay where they are.

    In contact they do not: how much each window says is found anew with every linear model.
    """
    prepared = prepare(problem, leader.hypothesis)
    most = 1 if can_touch(problem.machine.model) else _POLISH
    for _ in range(most if leader.members else 0):
        before = leader
        leader = refit(
            prepared.linear, leader.members, leader.x, groups=leader.groups,
            start=prepared.start, guess=leader.hypothesis, effort=FINAL,
        )  # fmt: skip
        leader = reshaped(prepared.linear, leader)
        same = len(leader.start) == len(problem.windows)
        prepared = prepare(problem, leader.hypothesis, leader.start if same else None)
        if _distance(before, leader) < _SETTLED:
            break
    return leader, prepared


def _distance(before: Fit, after: Fit) -> float:
    """Return how far the magnitudes of two fits of a set lie apart, in standard deviations."""
    if before.key != after.key:  # its shapes were fitted
        return np.inf
    change = np.concatenate(after.x) - np.concatenate(before.x)
    own = slice(0, len(change))
    inverse = np.linalg.pinv(after.covariance[own, own], hermitian=True)
    return float(np.sqrt(max(change @ inverse @ change, 0.0)))


def _restarted(fit: Fit) -> Fit:
    """Return a fit whose gaps have softer ends.

    From a wide gap with hard ends no small step leads to a narrower one with soft ends.
    """
    x = tuple(
        np.concatenate([v[:1], [_SOFTER * c.point[1]], v[2:]]) if c.effect.hidden else v
        for c, v in zip(fit.members, fit.x, strict=True)
    )
    return replace(fit, hypothesis=replace(fit.hypothesis, x=x))


def _again(search: Search, fit: Fit, guess: Hypothesis) -> Fit:
    return search.fit(fit.members, fit.x, guess=guess, again=True, effort=FINAL)


def _leader(search: Search) -> Fit:
    """Return the best of the fits whose every member is needed."""
    fits = list(search.fits.values())
    order = ranked(fits, search.prior)
    return next(f for f in order if admissible(f, search.nominal, fits))


def _finalists(order: Sequence[Fit], nominal: Fit) -> list[Fit]:
    """Return the leading sets, and the best that are admissible or groups.

    Of those that leave many times as much as the leader only the best that is admissible, which
    may be what all windows admit, and the best that shares no name, to compare with.
    """
    able = [f for f in order if f.members and not any(f.groups) and admissible(f, nominal)]
    grouped = [f for f in order if any(f.groups)]
    held = (*order[:_FINALISTS], *able[:3], *grouped[:1])
    near = [f for f in held if f.rms < _FAR * order[0].rms]
    names = [{(c.effect.nested or c.effect.id, c.site.name) for c in f.members} for f in order]
    others = [f for f, n in zip(order, names, strict=True) if n and not n & names[0]]
    return list(dict.fromkeys((*near, *able[:1], *others[:1])))


def _said(fit: Fit) -> str:
    names = ", ".join(str(c) for c in fit.members) or "nothing missing"
    return f"{names} ({fit.rms:.3f} sigma)"

"""Fit the magnitudes of a set of effects through the simulator.

Gauss-Newton in the space from which changes of start are projected out, with Broyden's update
between exact Jacobians, a line search, bounds by clipping, and starts that follow with the stale
response to the start, accepted window by window.
"""

from collections.abc import Sequence
from dataclasses import astuple, dataclass, replace

import numpy as np
from jaxtyping import Float

from bo_sysid.diagnosis.sets.fit import Fit, assess
from bo_sysid.diagnosis.sets.gauss_newton import LeastSquares, broyden
from bo_sysid.diagnosis.windows.candidate import Candidate, free_parameters, slices_of
from bo_sysid.diagnosis.windows.estimated_starts import caught_up
from bo_sysid.diagnosis.windows.fitted_starts import held_joints
from bo_sysid.diagnosis.windows.hypothesis import Hypothesis
from bo_sysid.diagnosis.windows.linear import Linear
from bo_sysid.diagnosis.windows.problem import ROUGH, Problem
from bo_sysid.diagnosis.windows.projection import project
from bo_sysid.diagnosis.windows.settling import better_of, first_start, moved_along, settle
from bo_sysid.diagnosis.windows.timestep import SHARE_BOUNDS
from bo_sysid.simulation import State

_STEPS = (1.0, 0.35)  # shares of a step that are tried; less of one gains nothing to speak of
_RIDGE = 1e-5  # on unit columns: what a parameter does as well stays with it, to its bound
_DAMPED = 0.03  # ridge on unit columns where the plain step leads nowhere
_FAR_WORTH = 5e-3  # of the squared residual, that a step must gain far from the recordings
_NEAR_WORTH = 1e-3  # the same near them; nothing in final fits
# rms² above which no Jacobian is computed anew, of a fit whose step leads nowhere
_TOO_FAR = 1e4
# times the rivals' rms², and what is added: above, from the second step on, no Jacobian is
# computed anew, ...
_NO_RIVAL, _NO_RIVAL_MARGIN = 2, 3
# ... and above that a step must gain a share of the squared residual
_BEHIND, _BEHIND_MARGIN, _BEHIND_WORTH = 3, 1, 0.25
_CUT = 1e9
_NOTHING = 1e-3  # variances of the squared residual: where a step promises less, only starts move
_WORTH, _HOPELESS = 0.02, 1.5  # gain to go on for; times the best rms of others to give up at


@dataclass(frozen=True)
class Effort:
    """How hard to fit.

    Attributes:
        iterations: most Gauss-Newton steps.
        gain: stop where a step gains less of the squared residual than this many variances.
        final: go on to full precision.
        rival: best rms of other fits; a fit far above gives up early.
        resting: where `final`, whether joints that friction may hold are tried at rest.
    """

    iterations: int = 8
    gain: float = 2.0
    final: bool = False
    rival: float = np.inf
    resting: bool = True


FINAL = Effort(iterations=5, gain=1.0, final=True)
"""On all windows, for sets between which is decided."""


@dataclass(frozen=True)
class _Space:
    """The vector that is fitted: magnitudes of members, parameters, share of the finer step."""

    members: tuple[Candidate, ...]
    nuisances: tuple[Candidate, ...]
    numerics: bool
    low: Float[np.ndarray, " p"]
    high: Float[np.ndarray, " p"]
    probe: Float[np.ndarray, " p"]

    @classmethod
    def of(cls, problem: Problem, members: Sequence[Candidate]) -> "_Space":
        nuisances = free_parameters(problem.nuisances, members)
        held = (*members, *nuisances)
        numerics = problem.correction is not None
        extra = ([SHARE_BOUNDS[0]], [SHARE_BOUNDS[1]], [1.0]) if numerics else ([], [], [])
        low, high, probe = (
            np.concatenate([*(getattr(c, name) for c in held), np.array(tail, float)])
            for name, tail in zip(("low", "high", "probe"), extra, strict=True)
        )
        return cls(tuple(members), nuisances, numerics, low, high, probe)

    def vector(self, x: Sequence[np.ndarray], guess: Hypothesis) -> Float[np.ndarray, " p"]:
        tail = np.array([guess.numerics] if self.numerics else [], float)
        known = dict(zip(guess.nuisances, guess.nuisance_x, strict=True))
        nuisance = (known.get(c, np.zeros(c.size)) for c in self.nuisances)
        return np.asarray(np.clip(np.concatenate([*x, *nuisance, tail]), self.low, self.high))

    def hypothesis(self, theta: Float[np.ndarray, " p"]) -> Hypothesis:
        held = (*self.members, *self.nuisances)
        parts = tuple(theta[own] for own in slices_of(held))
        k = len(self.members)
        numerics = float(theta[-1]) if self.numerics else 0.0
        return Hypothesis(self.members, parts[:k], self.nuisances, parts[k:], numerics)


def refit(
    frame: Linear,
    members: Sequence[Candidate],
    x: Sequence[Float[np.ndarray, " _"]],
    *,
    groups: tuple[str | None, ...] | None = None,
    start: State | None = None,
    guess: Hypothesis | None = None,
    columns: Float[np.ndarray, "W R p"] | None = None,
    effort: Effort | None = None,
) -> Fit:
    """Fit a set of effects.

    Args:
        frame: the linear model whose response to the start is used.
        members: the effects.
        x: first magnitudes of each.
        groups: as in `Fit`.
        start: first starts, by default the frame's.
        guess: gives first values of the nuisances.
        columns: a first Jacobian in the order of `Fit.jacobian`; simulated where left out.
        effort: how hard to fit.
    """
    problem, effort = frame.problem, effort or Effort()
    space, guess = _Space.of(problem, members), guess or frame.hypothesis
    theta = space.vector(_with_parameters(problem, space, x, guess), guess)
    begin = start or frame.start
    made_from = (
        problem.identity, frame.hypothesis.identity, frame.Q, frame.start_gain,
        space.hypothesis(theta).identity, tuple(begin.arrays.items()), columns, astuple(effort),
    )  # fmt: skip

    def fitted() -> dict[str, np.ndarray]:
        point, S = _fitted(frame, space, theta, begin, columns, effort)
        return {"theta": point.theta, "residual": point.r, "jacobian": S, **point.start.arrays}

    found = problem.kept.arrays(made_from, fitted)
    labels = groups if groups is not None else (None,) * len(members)
    hypothesis, start = space.hypothesis(found["theta"]), State.of(found)
    return assess(problem, frame.Q, hypothesis, labels, start, found["residual"], found["jacobian"])


def refit_at(
    frame: Linear, fit: Fit, *, start: State | None = None, effort: Effort | None = None
) -> Fit:
    """Fit a set on from where it is, with another linear model.

    Args:
        frame: as in `refit`.
        fit: the set.
        start: first starts, by default the fit's.
        effort: how hard to fit.
    """
    return refit(
        frame, fit.members, fit.x, groups=fit.groups, start=start or fit.start,
        guess=fit.hypothesis, effort=effort,
    )  # fmt: skip


def _fitted(
    frame: Linear,
    space: _Space,
    theta: Float[np.ndarray, " p"],
    start: State,
    columns: Float[np.ndarray, "W R p"] | None,
    effort: Effort,
) -> tuple["_Point", np.ndarray]:
    """Return what a fit comes to from magnitudes and starts, and its Jacobian."""
    problem = frame.problem
    first, r = first_start(problem, space.hypothesis(theta), start)
    begin, r = settle(problem, frame, space.hypothesis(theta), first, 2, r=r)
    point = _Point(theta, begin, r, project(frame.Q, r))
    S = np.zeros((*r.shape, 0)) if columns is None else columns.astype(float)
    if len(theta):
        point, S = _descend(frame, space, point, S if columns is not None else None, effort)
    point = _with_starts_moved(frame, space, point)
    at = space.hypothesis(point.theta)
    resting = effort.final and effort.resting and held_joints(problem, at)
    if problem.machine.impacts or resting:
        point, S = _caught_up(frame, space, point, S, effort)
    return point, S


def _with_parameters(
    problem: Problem, space: _Space, x: Sequence[Float[np.ndarray, " _"]], guess: Hypothesis
) -> list[Float[np.ndarray, " _"]]:
    """Return first magnitudes in which members have the friction of parameters that give way."""
    out = [p for p in guess.nuisances if p not in space.nuisances]
    if not out:
        return list(x)
    model, _ = problem.compiled(replace(guess, members=(), x=()))
    begun, held = [v.copy() for v in x], {joint for p in out for joint in p.friction_joints}
    for c, v in zip(space.members, begun, strict=True):
        if c.is_dry_friction and c.site.name in held:
            own = problem.machine.model.joint(c.site.name).frictionloss[0]
            # an effect that contains a simpler one has its magnitudes last
            v[1 if c.effect.nested else 0] += model.joint(c.site.name).frictionloss[0] - own
    return begun


@dataclass(frozen=True)
class _Point:
    theta: Float[np.ndarray, " p"]
    start: State
    r: Float[np.ndarray, "W R"]
    y: Float[np.ndarray, "W R"]

    @property
    def rss(self) -> float:
        return float((self.r**2).sum())


def _with_starts_moved(frame: Linear, space: _Space, point: _Point) -> _Point:
    """Return a point with its starts moved once more along the response to them."""
    hypothesis = space.hypothesis(point.theta)
    start, r, _ = moved_along(frame.problem, frame, hypothesis, point.start, point.r, point.r)
    return _Point(point.theta, start, r, project(frame.Q, r))


def _caught_up(
    frame: Linear, space: _Space, point: _Point, J: np.ndarray, effort: Effort
) -> tuple[_Point, np.ndarray]:
    """Return a point whose windows were fitted on each by itself, and magnitudes with them.

    Once only far from the recordings, where windows that are fitted once more gain little.
    """
    near = point.rss / frame.problem.dof < ROUGH**2
    for go_on in (True, False) if effort.final and near else (True,):
        if np.sqrt(point.rss / frame.problem.dof) > _HOPELESS * max(effort.rival, 1.0):
            break
        hypothesis = space.hypothesis(point.theta)
        start, r = caught_up(frame.problem, hypothesis, point.start)
        gain = point.rss - float((r**2).sum())
        point = _Point(point.theta, start, r, project(frame.Q, r))
        if not go_on or gain < _WORTH * point.rss or not len(point.theta):
            break
        point, J = _descend(frame, space, point, None, effort)
    return point, J


def _descend(
    frame: Linear, space: _Space, point: _Point, S: np.ndarray | None, effort: Effort
) -> tuple[_Point, np.ndarray]:
    dof = frame.problem.dof
    exact = S is None
    J = _jacobian(frame, space, point) if S is None else np.clip(np.nan_to_num(S), -_CUT, _CUT)
    for iteration in range(effort.iterations):
        SP = project(frame.Q, J)
        local = LeastSquares(SP, point.y, point.theta, space.low, space.high, space.probe)
        idle = local.promised(local.step(_RIDGE)) < _NOTHING * max(point.rss / dof, 1.0)
        tried: _Point | None = None
        if idle and (exact or iteration):
            tried = _with_starts_moved(frame, space, point)
        else:
            tried = _stepped(frame, space, point, J, local, exact=exact)
        if tried is None:
            if exact or _gives_up(point.rss / dof, effort, iteration):
                break
            J, exact = _jacobian(frame, space, point), True
            continue
        gain, moved = point.rss - tried.rss, tried.theta - point.theta
        if moved.any():
            J = broyden(SP, moved, project(frame.Q, point.r - tried.r))
        exact, point = exact and not moved.any(), tried
        if _should_stop(gain, point.rss, dof, effort, iteration):
            break
    return point, J


def _gives_up(variance: float, effort: Effort, iteration: int) -> bool:
    """Whether a fit is not worth an exact Jacobian once a step leads nowhere.

    Args:
        variance: its rms², in sigma².
        effort: how hard to fit.
        iteration: number of the step, from 0.
    """
    no_rival = variance > _NO_RIVAL * effort.rival**2 + _NO_RIVAL_MARGIN and iteration >= 1
    return no_rival or variance > _TOO_FAR


def _should_stop(gain: float, rss: float, dof: int, effort: Effort, iteration: int) -> bool:
    """Whether a step gained too little to go on, or little for a fit that is far behind others.

    Args:
        gain: of the squared residual.
        rss: the squared residual after the step.
        dof: degrees of freedom.
        effort: how hard to fit.
        iteration: number of the step, from 0.
    """
    variance = rss / dof
    share = _FAR_WORTH if variance > ROUGH**2 else 0.0 if effort.final else _NEAR_WORTH
    if gain < effort.gain * max(variance, 1.0) + share * rss:
        return True
    behind = variance > _BEHIND * effort.rival**2 + _BEHIND_MARGIN and gain < _BEHIND_WORTH * rss
    return iteration >= 1 and behind


def _stepped(
    frame: Linear, space: _Space, point: _Point, J: np.ndarray, local: LeastSquares, *, exact: bool
) -> _Point | None:
    """Return the point after a step, damped where the plain one of an exact Jacobian leads nowhere.

    None where nothing leads to less.
    """
    for ridge, variance in (
        (_RIDGE, 0.0), (_DAMPED, 0.0), (_RIDGE, point.rss / frame.problem.dof),
    ):  # fmt: skip
        tried = _line_search(frame, space, point, J, local.step(ridge, variance))
        if tried is not None or not exact:
            return tried
    return None


def _jacobian(frame: Linear, space: _Space, point: _Point) -> Float[np.ndarray, "W R p"]:
    columns = []
    for k, (value, probe) in enumerate(zip(point.theta, np.abs(space.probe), strict=True)):
        h = max(0.1 * probe if abs(value) < probe else 0.02 * abs(value), 0.05 * probe)
        if value + h > space.high[k]:
            h = -h
        theta = point.theta.copy()
        theta[k] += h
        moved = frame.problem.residual(space.hypothesis(theta), point.start)
        columns.append((point.r - moved) / h)
    return np.asarray(np.clip(np.stack(columns, axis=-1), -_CUT, _CUT))


def _line_search(
    frame: Linear, space: _Space, point: _Point, J: np.ndarray, step: np.ndarray
) -> _Point | None:
    """Return the first point along a step that leaves less, None where none does.

    Starts move along; where that does not help on the whole, window by window: a joint that sticks
    does not follow its start.
    """
    problem = frame.problem
    for share in _STEPS:
        theta = np.clip(point.theta + share * step, space.low, space.high)
        hypothesis = space.hypothesis(theta)
        left = point.r - J @ (theta - point.theta)
        change = np.einsum("wki,wi->wk", frame.start_gain, left) * share
        start = problem.moved(point.start, change)
        r = problem.residual(hypothesis, start)
        if (r**2).sum() >= point.rss:
            stay = problem.residual(hypothesis, point.start)
            start, r, _ = better_of(point.start, stay, start, r)
            start, r, _ = moved_along(problem, frame, hypothesis, start, r, r)
        if (r**2).sum() < point.rss:
            return _Point(theta, start, r, project(frame.Q, r))
    return None

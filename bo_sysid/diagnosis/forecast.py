"""How well hypotheses predict recordings that were set aside.

`forecast`: the start of every window is estimated, with the model that is judged, from samples
before the window only. `fit`: the start is fitted inside the window, which flatters every model.
`free_run`: a long forecast in the channel's own unit.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float

from bo_sysid.diagnosis.coordinates import Coordinates
from bo_sysid.diagnosis.hypothesis import Hypothesis
from bo_sysid.diagnosis.linear import linearise
from bo_sysid.diagnosis.problem import Problem, finer_step, pose
from bo_sysid.effects import Machine
from bo_sysid.mjcf import Model
from bo_sysid.recording import Recording
from bo_sysid.simulation import Controller, Engine, ForceLaw, State

PAST = 0.2  # [s] before a window from which its start is estimated
AHEAD = 0.08  # [s] forecast for the headline
LONGER = 0.3  # [s] forecast beside it
_ROUNDS = 5
_SHARES = (1.0, 0.3, 0.06)
_SETTLED = 0.05  # [sigma²] gain that a step promises below which a start stays
_POSITION, _SPEED = 30.0, 0.3  # prior of a start: in sigma, and in the joint's typical speed
_TRAVEL = 1e-3  # of the joint's travel, beside the sigmas: real sensors are finer than models
_ADDED = 0.1  # of the joint's travel: prior of a joint that the hypothesis added
_LEAST = 1e-12  # of that prior
_DIVERGING = 1e9  # response to the start above which a window's simulation diverges
_STUCK = 0.02  # of the joint's typical speed, below which it may be at rest


@dataclass(frozen=True)
class Errors:
    """Errors of one hypothesis over the same windows.

    Attributes:
        ahead: root mean square of recorded minus forecast, in sigma.
        floor: what sensor noise alone makes of it.
        channel: the same by channel, in its unit.
        residual: recorded minus predicted after the past, in sigma.
    """

    ahead: float
    floor: float
    channel: Mapping[str, float]
    residual: Float[np.ndarray, "W F c"]


def forecast_problem(
    model: Model,
    machine: Machine,
    recordings: Sequence[Recording],
    sigma: Mapping[str, float],
    *,
    past: float,
    ahead: float,
    timestep: float,
    engine: Engine,
    laws: Sequence[Controller | ForceLaw] = (),
) -> tuple[Problem, int]:
    """Cut recordings into windows of past and future; return them and the instants of the past."""
    before = max(round(past / machine.sampling), 3)
    after = max(round(ahead / machine.sampling), 1)
    problem = pose(
        model,
        machine,
        recordings,
        dict(sigma),
        (),
        horizon=before + after,
        timestep=timestep,
        engine=engine,
        laws=laws,
    )
    return problem, before


def forecast(problem: Problem, past: int, hypothesis: Hypothesis) -> Errors:
    """Return the errors of forecasts from the past alone.

    The start is the least-squares one over the past, with a wide prior about a smoother's
    estimate; where a joint may have been at rest, a start at rest is tried as well, since with dry
    friction no small change of the start leads from one to the other.
    """
    finer = finer_step(hypothesis.numerics)
    plain = _plain(problem, hypothesis)
    channels = len(problem.windows.channels)
    known = np.zeros((problem.windows.observed.shape[1], channels), bool)
    known[:past] = True
    start, best = _estimated(problem, plain, problem.windows.start, known.ravel(), finer)
    at_rest = _at_rest(problem, start)
    if at_rest is not None:
        other, cost = _estimated(problem, plain, at_rest, known.ravel(), finer)
        start = start.picked(cost < best, other)
    r = problem.residual(plain, start, finer).reshape(len(start), -1, channels)[:, past:]
    good = np.abs(r).max(axis=(1, 2)) < 1e6
    return Errors(
        float(np.sqrt(np.mean(r**2))),
        _floor(problem, plain, start, known.ravel(), good),
        _by_channel(problem, r, past),
        r,
    )


def fitted(problem: Problem, hypothesis: Hypothesis) -> Errors:
    """Return the errors with starts fitted inside the windows, over √((n - p)/n)."""
    finer = finer_step(hypothesis.numerics)
    plain = _plain(problem, hypothesis)
    everything = np.ones(problem.count, bool)
    start, _ = _estimated(problem, plain, problem.windows.start, everything, finer)
    r = problem.residual(plain, start, finer)
    n, p = problem.count, 2 * problem.machine.model.nv
    spare = np.sqrt(max(n - p, 1) / n)
    shaped = r.reshape(len(r), -1, len(problem.windows.channels))
    channel = {k: v / spare for k, v in _by_channel(problem, shaped, 0).items()}
    return Errors(float(np.sqrt(np.mean(r**2))) / spare, 1.0, channel, shaped)


def _plain(problem: Problem, hypothesis: Hypothesis) -> Hypothesis:
    return replace(hypothesis, numerics=0.0)


def _estimated(
    problem: Problem,
    hypothesis: Hypothesis,
    start: State,
    known: Bool[np.ndarray, " R"],
    finer: int,
) -> tuple[State, Float[np.ndarray, " W"]]:
    """Fit the starts to the known observations, window by window; return them and their cost."""
    model = problem.machine.model
    r = problem.residual(hypothesis, start, finer)[:, known]
    cost = (r**2).sum(axis=1)
    for other in problem.starts(hypothesis, start, moving=True):
        rn = problem.residual(hypothesis, other, finer)[:, known]
        better = (rn**2).sum(axis=1) < cost
        start, r = start.picked(better, other), np.where(better[:, None], rn, r)
        cost = (r**2).sum(axis=1)
    anchor = start
    spread, away, gain = np.zeros(0), np.zeros((len(start), 0)), None
    for k in range(_ROUNDS):
        if k in (0, 2, 4):
            linear = linearise(problem, hypothesis, start)
            spread = _prior(problem, linear.points.coordinates)
            away = away if k else np.zeros((len(start), len(spread)))
            J = linear.J[:, known]
            J = np.where((np.abs(J) < _DIVERGING).all(axis=(1, 2), keepdims=True), J, 0.0)
            N = np.einsum("wri,wrj->wij", J, J) + np.diag(1 / spread**2)
            gain = np.linalg.pinv(N, rcond=1e-15, hermitian=True)
        assert gain is not None  # noqa: S101
        g = np.einsum("wri,wr->wi", J, r) - away / spread**2
        step = np.einsum("wij,wj->wi", gain, g)
        done = np.einsum("wi,wi->w", g, step) < _SETTLED
        if done.all():
            break
        moved_any = False
        for share in _SHARES:
            try_away = np.where(done[:, None], away, away + share * step)
            moved = anchor.moved(model, try_away)
            rn = problem.residual(hypothesis, moved, finer)[:, known]
            new = (rn**2).sum(axis=1) + ((try_away / spread) ** 2).sum(axis=1)
            better = ~done & (new < cost)
            pick = better[:, None]
            away, r = np.where(pick, try_away, away), np.where(pick, rn, r)
            start, cost = start.picked(better, moved), np.where(better, new, cost)
            done, moved_any = done | better, moved_any or bool(better.any())
            if done.all():
                break
        if not moved_any:
            break
    return start, cost


def _prior(problem: Problem, coordinates: Coordinates) -> Float[np.ndarray, " n"]:
    """Return how far the start may lie from a smoother's estimate, position then velocity.

    What a hypothesis added may lie as far from where it rests, and no further than it can go.
    """
    nv = problem.machine.model.nv
    position, speed = np.full(nv, 1e3), np.full(nv, 1e3)
    layout, windows = problem.layout, problem.windows
    travel = np.zeros(nv)
    for joint in problem.machine.joints.values():
        speed[joint.dof], travel[joint.dof] = _SPEED * joint.speed, _TRAVEL * joint.travel
    scale = 1 / np.maximum(problem.weight.reshape(-1, len(windows.channels)).max(axis=0), 1e-300)
    for k, name in enumerate(windows.channels):
        if name in layout.qpos:
            dof = int(layout.velocity[layout.qpos[name]])
            if dof >= 0:
                position[dof] = _POSITION * scale[k] + travel[dof]
    own = [s.qvel for s in coordinates.second]
    most = np.array([s.most for s in coordinates.second])
    places = np.minimum(travel[own] / _TRAVEL * _ADDED, np.maximum(most, _LEAST))
    return np.concatenate([position, speed, places, speed[own]])


def _at_rest(problem: Problem, start: State) -> State | None:
    """Return starts in which joints that hardly move are at rest, None where all move."""
    qvel = start.qvel.copy()
    for joint in problem.machine.joints.values():
        slow = np.abs(qvel[:, joint.dof]) < _STUCK * joint.speed
        qvel[slow, joint.dof] = 0.0
    return None if (qvel == start.qvel).all() else replace(start, qvel=qvel)


def _floor(
    problem: Problem,
    hypothesis: Hypothesis,
    start: State,
    known: Bool[np.ndarray, " R"],
    good: Bool[np.ndarray, " W"],
) -> float:
    """Return the forecast error of sensor noise alone: √(1 + tr(Jₐ Cov Jₐᵀ)/n)."""
    linear = linearise(problem, hypothesis, start)
    J, spread = linear.J, _prior(problem, linear.points.coordinates)
    J = J[good & (np.abs(J) < _DIVERGING).all(axis=(1, 2))]
    if not len(J):
        return 1.0
    past, ahead = J[:, known], J[:, ~known]
    # what noise leaves of the start: ahead·(past'past + prior)⁻¹·ahead', by least squares
    prior = np.broadcast_to(np.diag(1 / spread), (len(J), *[J.shape[-1]] * 2))
    R = np.linalg.qr(np.concatenate([past, prior], axis=1), mode="r")
    noise = ahead @ np.linalg.pinv(R, rcond=1e-12)
    return float(np.sqrt(1.0 + np.mean((noise**2).sum(axis=(1, 2)) / ahead.shape[1])))


def _by_channel(problem: Problem, r: Float[np.ndarray, "W H c"], first: int) -> dict[str, float]:
    weight = problem.weight[:, first:]
    out = {}
    for k, name in enumerate(problem.windows.channels):
        seen = weight[..., k] > 0
        if seen.any():
            out[name] = float(np.sqrt(np.mean((r[..., k][seen] / weight[..., k][seen]) ** 2)))
    return out

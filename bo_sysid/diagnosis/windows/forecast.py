"""How well hypotheses predict recordings that were set aside.

`forecast`: the start of every window is estimated, with the model that is judged, from samples
before the window only. `fit`: the start is fitted inside the window, which flatters every model.
`free_run`: a long forecast in the channel's own unit.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from bo_sysid.diagnosis.windows.cutting import cut_problem
from bo_sysid.diagnosis.windows.estimated_starts import estimated
from bo_sysid.diagnosis.windows.fitted_starts import DIVERGING, held_joints, prior
from bo_sysid.diagnosis.windows.hypothesis import Hypothesis
from bo_sysid.diagnosis.windows.input_noise import shaken
from bo_sysid.diagnosis.windows.linear import linearise
from bo_sysid.diagnosis.windows.problem import Problem
from bo_sysid.diagnosis.windows.timestep import finer_step
from bo_sysid.effects import Machine
from bo_sysid.mjcf import Model
from bo_sysid.recording import Recording
from bo_sysid.recording.alignment import instants_each, instants_in
from bo_sysid.simulation import Controller, Engine, ForceLaw, State

PAST = 0.2  # [s] before a window from which its start is estimated
AHEAD = 0.08  # [s] forecast for the headline
LONGER = 0.3  # [s] forecast beside it
_DIVERGED = 1e6  # [sigma] of a window that says nothing of the floor


@dataclass(frozen=True)
class Errors:
    """Errors of one hypothesis over the same windows.

    Attributes:
        ahead: root mean square of recorded minus forecast over what was recorded, in sigma.
        channel: the same by channel, in its unit.
        residual: recorded minus predicted after the past, in sigma, quaternions with the sign that
            they were recorded with.
        start: that was estimated for each window.
    """

    ahead: float
    channel: Mapping[str, float]
    residual: Float[np.ndarray, "W F c"]
    start: State


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
    input_noise: Mapping[str, float] | None = None,
) -> tuple[Problem, int]:
    """Cut recordings into windows of past and future; return them and the instants of the past.

    Lengths in [s] are counted at the rate of these recordings, which may not be that of others. One
    of another rate has windows that last as long: what it has no instants for is not observed.
    """
    compared = {*model.qpos_channels, *sigma}
    usual = instants_in(past, recordings, compared)
    before, after = (
        [max(n, least) for n in instants_each(count, past / usual, recordings, compared)]
        for count, least in ((usual, 3), (instants_in(ahead, recordings, compared), 1))
    )
    problem = cut_problem(
        model,
        machine,
        recordings,
        dict(sigma),
        (),
        horizon=[b + a for b, a in zip(before, after, strict=True)],
        timestep=timestep,
        engine=engine,
        laws=laws,
        input_noise=input_noise,
    )
    return _with_one_past(problem, before, after), max(before)


def _with_one_past(problem: Problem, before: Sequence[int], after: Sequence[int]) -> Problem:
    """Return windows in which every future begins at one instant, after the longest past.

    Args:
        problem: windows of past and future.
        before: instants of the past of each recording.
        after: those of its future.
    """
    past, future = np.arange(max(before)), np.arange(max(after))
    if len({*before}) == len({*after}) == 1:
        return problem
    order = [
        np.concatenate([np.minimum(past, b - 1), b + np.minimum(future, a - 1)])
        for b, a in zip(before, after, strict=True)
    ]
    seen = [np.concatenate([past < b, future < a]) for b, a in zip(before, after, strict=True)]
    windows = problem.windows
    at, observed = (np.array(each)[windows.recording] for each in (order, seen))
    weight = problem.weight[np.arange(len(windows))[:, None], at] * observed[..., None]
    return replace(problem, windows=windows.arranged(at, observed), weight=weight)


def forecast(problem: Problem, past: int, hypothesis: Hypothesis) -> Errors:
    """Return the errors of forecasts from the past alone.

    The start is the least-squares one over the past, with a wide prior about a smoother's
    estimate; joints that may have been at rest are tried at rest as well.
    """
    finer = finer_step(hypothesis.numerics)
    plain = _plain(hypothesis)
    channels = len(problem.windows.channels)
    start = estimated(problem.beginning(past), plain, finer, resting=True)
    r = problem.as_recorded(plain, start, finer).reshape(len(start), -1, channels)[:, past:]
    ahead = np.sqrt((r**2).sum() / max((problem.weight[:, past:] > 0).sum(), 1))
    return Errors(float(ahead), _by_channel(problem, r, past), r, start)


def noise_floor(problem: Problem, past: int, hypothesis: Hypothesis, errors: Errors) -> float:
    """Return the forecast error that noise alone makes, in sigma of the sensors.

    By the response to the start, √(1 + tr(Jₐ Cov Jₐᵀ)/n). In contact, and where friction may hold
    a joint, no slope holds over a window, and noise of the inputs has another covariance: there
    what the hypothesis predicts from its starts is seen through new noise, and forecast.
    """
    drawn = problem.machine.impacts or problem.input_noise or held_joints(problem, hypothesis)
    if drawn:
        return forecast(_redrawn(problem, hypothesis, errors.start), past, hypothesis).ahead
    return _floor(problem, past, _plain(hypothesis), errors)


def fitted(problem: Problem, hypothesis: Hypothesis) -> Errors:
    """Return the errors with starts fitted inside the windows, over √((n - p)/n)."""
    finer = finer_step(hypothesis.numerics)
    plain = _plain(hypothesis)
    start = estimated(problem, plain, finer, resting=True)
    r = problem.as_recorded(plain, start, finer)
    seen = int((problem.weight > 0).sum())
    n, p = seen / len(r), problem.start_size
    spare = np.sqrt(max(n - p, 1) / n)
    shaped = r.reshape(len(r), -1, len(problem.windows.channels))
    channel = {k: v / spare for k, v in _by_channel(problem, shaped, 0).items()}
    return Errors(float(np.sqrt((r**2).sum() / seen)) / spare, channel, shaped, start)


def fitted_floor(problem: Problem, hypothesis: Hypothesis, errors: Errors) -> float:
    """Return what `fitted` leaves of noise alone, in sigma of the sensors."""
    if not problem.input_noise:
        return 1.0
    return fitted(_redrawn(problem, hypothesis, errors.start), hypothesis).ahead


def _plain(hypothesis: Hypothesis) -> Hypothesis:
    return replace(hypothesis, numerics=0.0)


def _redrawn(problem: Problem, hypothesis: Hypothesis, start: State) -> Problem:
    """Return the windows as a hypothesis predicts them, seen through noise."""
    plain, seen = _plain(hypothesis), problem.weight > 0
    r = problem.as_recorded(plain, start, finer_step(hypothesis.numerics)).reshape(seen.shape)
    rng = np.random.default_rng(0)
    noise = rng.standard_normal(seen.shape)
    if problem.input_noise:
        moved = shaken(linearise(problem, plain, start), problem.input_noise, rng)
        noise += moved.reshape(seen.shape)
    change = np.divide(noise - r, problem.weight, out=np.zeros_like(r), where=seen)
    windows = problem.windows
    return replace(problem, windows=replace(windows, observed=windows.observed + change))


def _floor(problem: Problem, past: int, plain: Hypothesis, errors: Errors) -> float:
    """Return √(1 + tr(Jₐ Cov Jₐᵀ)/n) over n observed values ahead, in sigma.

    Cov = (JₚᵀJₚ + S⁻²)⁻¹ is that of the start, with Jₚ and Jₐ the responses of past and future to
    it and S its prior. With QR = [Jₚ; S⁻¹] it is R⁻¹R⁻ᵀ, and the trace the squares of Jₐ R⁻¹.
    """
    good = np.abs(errors.residual).max(axis=(1, 2)) < _DIVERGED
    linear = linearise(problem, plain, errors.start)
    J, spread = linear.J, prior(problem, linear.points.coordinates)
    good &= (np.abs(J) < DIVERGING).all(axis=(1, 2))
    J, seen = J[good], (problem.weight[good, past:] > 0).sum()
    if not seen:
        return 1.0
    known, ahead = np.split(J, [past * len(problem.windows.channels)], axis=1)
    about = np.broadcast_to(np.diag(1 / spread), (len(J), *[J.shape[-1]] * 2))
    R = np.linalg.qr(np.concatenate([known, about], axis=1), mode="r")
    noise = ahead @ np.linalg.pinv(R, rcond=1e-12)
    return float(np.sqrt(1.0 + (noise**2).sum() / seen))


def _by_channel(problem: Problem, r: Float[np.ndarray, "W H c"], first: int) -> dict[str, float]:
    weight = problem.weight[:, first:]
    out = {}
    for k, name in enumerate(problem.windows.channels):
        seen = weight[..., k] > 0
        if seen.any():
            out[name] = float(np.sqrt(np.mean((r[..., k][seen] / weight[..., k][seen]) ** 2)))
    return out

"""Whether any candidate explains the recordings: the floor under Δ against what it should be.

Were the machine one of the model's family, the least Δ over B would be that of the sensors' noise
and of B's resolution:

- noise: the best candidate's predictions from starts that are moved by the sensors' noise, plus
  that noise, against its own predictions; where starts are fitted, those predictions with that
  noise as if they had been recorded;
- resolution: the truth may lie half a step of B off the best candidate, in every parameter that
  has an order: it is one of the categories of the others.

Both are measured through the simulator, in the units of Δ. A floor clearly above their root sum of
squares, under a belief that has converged, means that no β will do: physics is missing.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from bo_sysid.arrays import Point
from bo_sysid.belief.stopping import StopReason
from bo_sysid.deviation.starts import fit_starts
from bo_sysid.identify.problem import Problem
from bo_sysid.mjcf.joints import FREE, SCALAR
from bo_sysid.recording import sensor_noise, stated_for
from bo_sysid.simulation import Prediction

_SURE = 2.0  # standard errors
ABOVE = 1.15  # times the expected floor; where nothing lacked the ratio was .95 to 1.05


@dataclass(frozen=True)
class Floor:
    """The least Δ over B, and what it would be if the model lacked nothing.

    Attributes:
        deviation: the least Δ that was found.
        noise: Δ that the sensors' noise alone makes.
        resolution: Δ that the spacing of B alone makes.
        unsure: standard error of `ratio` by the chance of the noise, which few windows hold.
    """

    deviation: float
    noise: float
    resolution: float
    unsure: float = 0.0

    @property
    def expected(self) -> float:
        """The floor of a model that lacks nothing."""
        return float(np.hypot(self.noise, self.resolution))

    @property
    def ratio(self) -> float:
        """The floor in units of the expected one."""
        return self.deviation / max(self.expected, np.finfo(float).tiny)

    @property
    def is_above(self) -> bool:
        """Whether more is left than a model would leave that lacks nothing."""
        return self.ratio > ABOVE + _SURE * self.unsure


def lacks_physics(floor: Floor, reason: StopReason) -> bool:
    """Return whether no candidate will do: a converged belief over a floor that is too high.

    Args:
        floor: under Δ, on all recordings.
        reason: why the search ended; one that ran out of budget, or that was ended by values, may
            still find better.
    """
    unfinished = reason in (StopReason.BUDGET, StopReason.VALUES)
    return not unfinished and floor.is_above


def floor_of(
    problem: Problem,
    best: Point,
    deviation: float,
    seed: int = 0,
    known: Mapping[str, float] | None = None,
) -> Floor:
    """Return the floor under Δ and its two expected parts.

    Args:
        problem: on all recordings.
        best: the evaluated candidate with the least Δ.
        deviation: its Δ.
        seed: of the noise.
        known: σ by kind or channel, where the machine's sensors are known; the study's come first.
    """
    sigma = noise_by_channel(problem, known or {})
    norms = _noise_part(problem, best, sigma, seed)
    noise = _mean(norms)
    # of two draws of the noise, that of the recordings and this one
    spread = np.sqrt(2 / len(norms)) * norms.std(ddof=1) if len(norms) > 1 else noise
    unsure = float(spread / noise) if noise else 0.0
    return Floor(deviation, noise, _resolution_part(problem, best), unsure)


def noise_by_channel(problem: Problem, known: Mapping[str, float]) -> dict[str, float]:
    """Return σ of every observed channel: the study's, else what is known, else estimated.

    The estimate takes motion that is too fast for differences of the highest order for noise, see
    `sensor_noise`: there, where no noise is stated, the floor is expected too high, and
    missing physics may hide beneath it.
    """
    given = {**known, **problem.study.recordings.noise}
    found = [sensor_noise(r) for r in problem.recordings]
    sigma = {}
    for name in problem.deviation.windows.channels:
        stated = stated_for(name, given, None)
        estimated = float(np.median([f[name] for f in found if name in f] or [0.0]))
        sigma[name] = estimated if stated is None else float(stated)
    return sigma


def _noise_part(
    problem: Problem, best: Point, sigma: dict[str, float], seed: int
) -> Float[np.ndarray, " W"]:
    """Return Δ of each window by noise alone."""
    deviation, windows = problem.deviation, problem.deviation.windows
    rng = np.random.default_rng((seed, 3))
    if deviation.fitted_starts:
        seen = np.array([sigma[name] for name in windows.channels])
        noise = seen * rng.standard_normal(windows.observed.shape)
        return _were_recorded(problem, best, deviation.prediction(best).values + noise)
    scale = _start_noise(problem, sigma)
    moved = deviation.simulator.moved(
        windows.start, scale * rng.standard_normal((len(windows), len(scale)))
    )
    clean, shaken = deviation.simulator.predictions(
        np.stack([best, best]), windows, [windows.start, moved]
    )
    seen = np.array([sigma[name] for name in windows.channels])
    noise = seen * rng.standard_normal(windows.observed.shape)
    return _deviation_between(problem, clean, shaken, noise)


def _resolution_part(problem: Problem, best: Point) -> float:
    """Return the sum over parameters of half a step's Δ, the worst that B can leave."""
    (low, high), step = problem.candidates.bounds, problem.candidates.cell
    points = [best]
    for k in np.flatnonzero(step):
        up, down = high[k] - best[k], best[k] - low[k]
        move = step[k] if step[k] <= up + 1e-12 else -step[k]
        if step[k] > max(up, down) + 1e-12:  # few candidates stand for more than half of the range
            move = up if up > down else -down
        points.append(best + move * np.eye(len(best))[k])
    if problem.deviation.fitted_starts:
        recorded = problem.deviation.prediction(best).values
        return sum((0.5 * _mean(_were_recorded(problem, p, recorded)) for p in points[1:]), 0.0)
    own, *others = problem.deviation.simulator.predictions(
        np.array(points), problem.deviation.windows
    )
    return sum((0.5 * _mean(_deviation_between(problem, own, o)) for o in others), 0.0)


def _deviation_between(
    problem: Problem,
    a: Prediction,
    b: Prediction,
    noise: Float[np.ndarray, "W H c"] | float = 0.0,
) -> Float[np.ndarray, " K"]:
    """Return Δ between two predictions, with noise, in each window in which none diverged."""
    recorded = np.isfinite(problem.deviation.windows.observed)
    difference = np.where(recorded, b.values - a.values + noise, 0.0)
    return _norms(problem, difference[~(a.diverged | b.diverged)])


def _were_recorded(
    problem: Problem, point: Point, values: Float[np.ndarray, "W H c"]
) -> Float[np.ndarray, " K"]:
    """Return Δ of a candidate in each window, starts fitted, if others had been recorded."""
    d = problem.deviation
    observed = np.where(np.isfinite(d.windows.observed), values, np.nan)
    windows = fit_starts(
        d.simulator, point, replace(d.windows, observed=observed), 1.0 / d.whitening.scale
    )
    predicted = next(iter(d.simulator.predictions(point[None], windows)))
    return _norms(problem, windows.residual(predicted.values)[~predicted.diverged])


def _norms(problem: Problem, difference: Float[np.ndarray, "K H c"]) -> Float[np.ndarray, " K"]:
    weighted = np.nan_to_num(difference / problem.deviation.whitening.scale)
    horizon = max(weighted.shape[1], 1)
    return np.asarray(np.sqrt(np.einsum("whc,whc->w", weighted, weighted) / horizon))


def _mean(norms: Float[np.ndarray, " K"]) -> float:
    return float(norms.mean()) if len(norms) else 0.0


def _start_noise(problem: Problem, sigma: dict[str, float]) -> Float[np.ndarray, " n"]:
    """Return σ of the starts, `2 nv`.

    A turn of an orientation is twice the change of its quaternion, dq = q (0, dθ) / 2. A velocity
    that was not recorded is worth what a difference of two positions is.
    """
    model, compiled = problem.model, problem.model.compile()
    read = np.array([sigma.get(name, 0.0) for name in model.qpos_channels])
    place = np.zeros(compiled.nv)
    for j in range(compiled.njnt):
        q, v = int(compiled.jnt_qposadr[j]), int(compiled.jnt_dofadr[j])
        kind = int(compiled.jnt_type[j])
        if kind in SCALAR:
            place[v] = read[q]
            continue
        if kind == FREE:
            place[v : v + 3] = read[q : q + 3]
            q, v = q + 3, v + 3
        place[v : v + 3] = 2.0 * read[q : q + 4].mean()
    spacing = [np.median(np.diff(c.time)) for r in problem.recordings
               for c in r.of_kind("qpos").values()]  # fmt: skip
    difference = place / (np.sqrt(2) * float(np.median(spacing)))
    names = zip(model.qvel_channels, difference, strict=True)
    return np.concatenate([place, [sigma.get(name, d) for name, d in names]])

"""The search for informative controls of one machine.

The cost of a trajectory is the logarithm of the widest predicted interval, in units of the
parameters' ranges (the worst parameter decides, as in E- and A-optimal designs; a high norm stands
for the largest, so that the second widest count too), plus a penalty for limits that any of several
drawn parameter vectors exceeds. Searching starts at the best of many random spectra.
"""

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from jaxtyping import Float

from bo_sysid.excite.evolution import minimise
from bo_sysid.excite.judge import largest
from bo_sysid.excite.splines import Splines
from bo_sysid.excite.trial import Trial

_ROWS: tuple[int, ...] = (0, 1, 2)  # of these, the first to keep them while searching
_TONES = 0.5  # of the budget; splines have the rest
_ROUNDS = ((0.6, 0.3, 0.93), (0.4, 0.15, 0.98))  # of that; deviation at first; share of limits
_LEAST = 1e-9  # unit of corrections of controls that stand still
_CORRECTIONS = ((0.5, 0.15, 0.93), (0.5, 0.05, 0.98))  # the same, of splines
_ADDED = 4  # machines that the next round heeds, too
_NORM = 12  # of the intervals: stands for the largest
_PENALTY = 20.0
_SHARE, _HALVINGS = 0.25, 6  # of the budget for random spectra; simulations each
_SPECTRA = 4  # at least
LEAST = _SPECTRA * (_HALVINGS + 1)
"""Trajectories that are tried in any case: of the random spectra."""
_SPREAD, _SLOPE = 1.2, 3.0  # of random spectra: deviation of log amplitudes; most that they fall
_OFFSPRING = 24  # of a generation
_FLOOR, _SHIFT = 0.02, 0.3  # of the units, for tones that are hardly there; of frequencies


@dataclass(frozen=True)
class _How:
    """How a plan is searched for: on what, with what energy, seed, generation and report."""

    trial: Trial
    energy: float
    seed: int
    offspring: int
    report: Callable[[int, float], None] | None


def design(
    trial: Trial,
    budget: int,
    seed: int,
    *,
    energy: float = np.inf,
    report: Callable[[int, float], None] | None = None,
) -> Float[np.ndarray, "R nu"]:
    """Return the most informative controls that were found, within all limits.

    Tones first, then splines that correct them.

    Args:
        trial: of the machine.
        budget: number of trajectories that are tried, in whole generations, `LEAST` or more.
        seed: of the search.
        energy: most that the controls may have.
        report: told the number of trajectories tried and the lowest cost.
    """
    first = int(_TONES * budget)
    how = _How(trial, energy, seed, min(_OFFSPRING, max(budget // 8, 4)), report)
    x, width, tried = _start(how, first)
    x, rows = _refined(how, trial.series.controls, x, width, _ROUNDS, (tried, first), _ROWS)
    splines = Splines.on(trial.series, trial.series.controls(x[None])[0])
    width = np.full(splines.size, np.sqrt((splines.base**2).mean(axis=0)).max() + _LEAST)
    c, _ = _refined(
        how, splines.controls, np.zeros(splines.size), width, _CORRECTIONS, (first, budget), rows
    )
    return trial.safe(splines.unit(c[None])[0])


def _cost(
    how: _How, controls: Float[np.ndarray, "K R nu"], margin: float, rows: tuple[int, ...]
) -> Float[np.ndarray, " K"]:
    """Return the logarithm of the widest interval, with penalties for limits and energy."""
    found = how.trial.judge(rows)(controls, margin)
    over = found.over + np.maximum(how.trial.energy(controls) / how.energy - 1.0, 0.0)
    log_error = np.log((found.sigma**_NORM).sum(axis=1)) / _NORM
    return np.asarray(_PENALTY * over + np.where(over > 1.0, 0.0, log_error))


def _refined(
    how: _How,
    form: Callable[[Float[np.ndarray, "K p"]], Float[np.ndarray, "K R nu"]],
    x: Float[np.ndarray, " p"],
    width: Float[np.ndarray, " p"],
    rounds: Sequence[tuple[float, float, float]],
    tried: tuple[int, int],
    rows: tuple[int, ...],
) -> tuple[Float[np.ndarray, " p"], tuple[int, ...]]:
    """Return better coefficients and the rows of machines that were heeded at the end.

    Args:
        how: is searched.
        form: from coefficients to controls.
        x: coefficients at first.
        width: their units.
        rounds: share of the budget, deviation at first, share of the limits.
        tried: number of trajectories before and after.
        rows: of machines that keep the limits at first.
    """
    done = tried[0]
    for share, sigma, margin in rounds:
        count = int(share * (tried[1] - tried[0]))

        def cost(z: np.ndarray, margin: float = margin, rows: tuple[int, ...] = rows) -> np.ndarray:
            return _cost(how, form(z * width), margin, rows)

        z, _ = minimise(
            cost, x / width, sigma, count, how.seed, offspring=how.offspring,
            report=how.report and partial(_later, how.report, done),
        )  # fmt: skip
        x, done = z * width, done + count
        rows = _heeded(how.trial, form(x[None])[0], rows)
    return x, rows


def _heeded(
    trial: Trial, controls: Float[np.ndarray, "R nu"], rows: tuple[int, ...]
) -> tuple[int, ...]:
    """Return rows of machines, with those that exceed the limits most."""
    over = trial.violations(controls, trial.machines, 1.0)
    worst = [int(k) for k in np.argsort(-over)[:_ADDED] if over[k] > 0]
    return tuple(sorted({*rows, *worst}))


def _start(how: _How, budget: int) -> tuple[Float[np.ndarray, " p"], Float[np.ndarray, " p"], int]:
    """Return the best of random spectra, the units of its coefficients, and what was tried."""
    rng, trial = np.random.default_rng(how.seed), how.trial
    s = trial.series
    count = max(int(_SHARE * budget / _HALVINGS), _SPECTRA)
    tones, nu = len(s.frequencies), len(s.half)
    fall = rng.uniform(0, _SLOPE, (count, 1, 1)) * np.linspace(0, 1, tones)
    size = np.exp(_SPREAD * rng.standard_normal((count, nu, tones)) - fall)
    size /= size.max(axis=(1, 2), keepdims=True)
    unit = np.tile(size, 2).reshape(count, -1)
    shift = _SHIFT * rng.standard_normal((count, tones))
    shape = unit * rng.standard_normal(unit.shape)

    def coefficients(k: np.ndarray) -> np.ndarray:
        return np.concatenate([k[:, None] * shape, shift], axis=1)

    done = itertools.count(count, count)

    def over(k: np.ndarray) -> np.ndarray:
        controls = s.controls(coefficients(k))
        if how.report is not None:
            how.report(next(done), np.inf)
        exceeded = trial.judge(_ROWS)(controls, _ROUNDS[0][2], information=False).over
        return np.asarray(np.maximum(exceeded, trial.energy(controls) - how.energy))

    amplitude = largest(over, np.ones(count), _HALVINGS)
    x = coefficients(amplitude)
    best = int(np.argmin(_cost(how, s.controls(x), _ROUNDS[0][2], _ROWS)))
    width = np.full(s.size, _SHIFT)
    width[: s.waves] = amplitude[best] * (unit[best] + _FLOOR)
    return x[best], width, (_HALVINGS + 1) * count


def _later(report: Callable[[int, float], None], before: int, done: int, cost: float) -> None:
    report(before + done, cost)

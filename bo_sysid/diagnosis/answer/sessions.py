"""Magnitudes by recording: where sessions of one machine disagree, the interval must say so."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd
from jaxtyping import Bool, Float
from scipy.linalg import hadamard
from scipy.stats import chi2, norm
from scipy.stats import t as student

from bo_sysid.diagnosis.answer.quantities import quantities
from bo_sysid.diagnosis.sets.fit import Fit
from bo_sysid.diagnosis.sets.refit import Effort, refit
from bo_sysid.diagnosis.windows.linear import linearise
from bo_sysid.diagnosis.windows.problem import Problem
from bo_sysid.effects import Machine

_LEAST = 4  # windows that a recording must have to be fitted alone
_STRETCHES = 4  # of recordings in contact
_AWAY = 0.2  # of a magnitude, where the fit of a stretch begins
_AS_NEAR = 1.2  # times the squares that the whole fit leaves of a stretch
_CHANCE = 0.95  # of recordings that agree, which differ by less
_UPPER = 0.975  # quantile at which an interval of 95 % ends
_EFFORT = Effort(iterations=4, gain=1.0, final=True)


@dataclass(frozen=True)
class Sessions:
    """The magnitudes of a fit, recording by recording.

    Attributes:
        table: columns recording, effect, site, value, low, high, unit; one row each, as findings
            have them.
        covariance: `p x p` of the joint magnitudes, with the spread between recordings.
        stated: the same for intervals, which allow for how few recordings tell that spread.
    """

    table: pd.DataFrame
    covariance: Float[np.ndarray, "p p"]
    stated: Float[np.ndarray, "p p"]


def by_recording(problem: Problem, fit: Fit) -> Sessions:
    """Fit every recording alone and widen the covariance where they disagree.

    The between-recording variance of a magnitude's mean over n recordings, s²/n, is added where
    it exceeds what the fits' own variances predict. n recordings tell s² with n - 1 degrees of
    freedom: where it is more than chance, intervals take it times (t / z)², the quantiles of 97.5 %
    of Student's distribution and of the normal one.
    """
    numbers = np.unique(problem.windows.recording)
    counts = {i: int((problem.windows.recording == i).sum()) for i in numbers}
    used = [i for i in numbers if counts[i] >= _LEAST]
    if len(used) < 2 or not fit.members:
        return Sessions(_table([]), fit.covariance, fit.covariance)
    alone = [_alone(problem, fit, problem.windows.recording == i) for i in used]
    rows = [
        row
        for i, f in zip(used, alone, strict=True)
        for row in _rows(problem.recordings[i].name, f, problem.machine)
    ]
    more, stated = between(*_magnitudes(alone))
    return Sessions(_table(rows), _with_more(fit, more), _with_more(fit, stated))


def by_stretch(problem: Problem, fit: Fit) -> Float[np.ndarray, "p p"]:
    """Return the covariance of a fit, widened by what stretches of the recordings end at.

    In contact slopes say little of how sure a magnitude is: impacts bend what they tell, and leave
    many magnitudes from which no small step leads on. Each stretch therefore begins a share above
    or below what was found, in another combination for every magnitude. Those that come as near to
    their recordings as the whole fit does say where else it might have ended.
    """
    count = len(problem.windows)
    if count < _STRETCHES * _LEAST or not fit.members:
        return fit.covariance
    number = np.arange(count) * _STRETCHES // count
    signs = hadamard(_STRETCHES)[1:]  # rows: magnitudes, columns: stretches
    near = []
    for i in range(_STRETCHES):
        rows = number == i
        away = [1.0 + _AWAY * signs[k % len(signs), i] for k in range(len(fit.members))]
        alone = _alone(problem, fit, rows, [a * v for a, v in zip(away, fit.x, strict=True)])
        if (alone.residual**2).sum() < _AS_NEAR * (fit.residual[rows] ** 2).sum():
            near.append(alone)
    if not near:
        return fit.covariance
    x, own = _magnitudes([fit, *near])
    return _with_more(fit, np.maximum(np.var(x, axis=0, ddof=1) - own, 0.0))


def between(
    x: Float[np.ndarray, "n m"], own: Float[np.ndarray, " m"]
) -> tuple[Float[np.ndarray, " m"], Float[np.ndarray, " m"]]:
    """Return how much less sure the mean of n recordings is than they say by themselves.

    Args:
        x: magnitudes, recording by recording.
        own: mean variance of each.

    Returns:
        The variance of the mean beyond `own`, and the same as intervals take it.
    """
    free = len(x) - 1
    spread = x.var(axis=0, ddof=1)
    more = np.maximum(spread - own, 0.0) / len(x)
    chance = free * spread <= chi2.ppf(_CHANCE, free) * own
    few = (student.ppf(_UPPER, free) / norm.ppf(_UPPER)) ** 2
    return more, np.where(chance, more, few * more)


def _magnitudes(fits: Sequence[Fit]) -> tuple[Float[np.ndarray, "n m"], Float[np.ndarray, " m"]]:
    """Return the magnitudes of fits, and the mean of their variances."""
    x = np.array([np.concatenate(f.x) for f in fits])
    return x, np.mean([np.diag(f.covariance)[: x.shape[1]] for f in fits], axis=0)


def _with_more(fit: Fit, variance: Float[np.ndarray, " m"]) -> Float[np.ndarray, "p p"]:
    """Return the covariance of a fit with more variance of its magnitudes."""
    covariance, own = fit.covariance.copy(), np.arange(len(variance))
    covariance[own, own] += variance
    return covariance


def _alone(
    problem: Problem, fit: Fit, rows: Bool[np.ndarray, " W"], x: Sequence[np.ndarray] | None = None
) -> Fit:
    part, start = problem.rows(rows), fit.start.rows(rows)
    return refit(
        linearise(part, fit.hypothesis, start),
        fit.members,
        fit.x if x is None else x,
        groups=fit.groups,
        start=start,
        guess=fit.hypothesis,
        effort=_EFFORT,
    )


def _rows(recording: str, fit: Fit, machine: Machine) -> list[dict[str, object]]:
    return [
        {
            "recording": recording,
            "effect": c.effect.id,
            "site": c.site.name,
            "value": q.value,
            "low": q.interval[0],
            "high": q.interval[1],
            "unit": q.unit,
        }
        for c, q in zip(fit.members, quantities(fit, machine), strict=True)
    ]


def _table(rows: list[dict[str, object]]) -> pd.DataFrame:
    columns = ["recording", "effect", "site", "value", "low", "high", "unit"]
    return pd.DataFrame(rows, columns=columns)

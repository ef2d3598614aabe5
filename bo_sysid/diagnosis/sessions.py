"""Magnitudes by recording: where sessions of one machine disagree, the interval must say so."""

from dataclasses import dataclass, replace

import numpy as np
import pandas as pd
from jaxtyping import Float

from bo_sysid.diagnosis.fit import Fit
from bo_sysid.diagnosis.linear import linearise
from bo_sysid.diagnosis.problem import Problem
from bo_sysid.diagnosis.refit import Effort, refit

_LEAST = 4  # windows that a recording must have to be fitted alone
_EFFORT = Effort(iterations=4, gain=1.0, final=True)


@dataclass(frozen=True)
class Sessions:
    """The magnitudes of a fit, recording by recording.

    Attributes:
        table: columns recording, effect, site, value, deviation; one row each.
        covariance: `p x p` of the joint magnitudes, with the spread between recordings.
    """

    table: pd.DataFrame
    covariance: Float[np.ndarray, "p p"]


def by_recording(problem: Problem, fit: Fit) -> Sessions:
    """Fit every recording alone and widen the covariance where they disagree.

    The between-recording variance of a magnitude's mean over n recordings, s²/n, is added where
    it exceeds what the fits' own variances predict.
    """
    numbers = np.unique(problem.windows.recording)
    counts = {i: int((problem.windows.recording == i).sum()) for i in numbers}
    used = [i for i in numbers if counts[i] >= _LEAST]
    if len(used) < 2 or not fit.members:
        return Sessions(_table([]), fit.covariance)
    size = sum(c.size for c in fit.members)
    rows, values, variances = [], [], []
    for i in used:
        alone = _alone(problem, fit, problem.windows.recording == i)
        values.append(np.concatenate(alone.x))
        variances.append(np.diag(alone.covariance)[:size])
        rows += _rows(problem.recordings[i].name, alone)
    spread = np.var(values, axis=0, ddof=1)
    between = np.maximum(spread - np.mean(variances, axis=0), 0.0) / len(used)
    covariance = fit.covariance.copy()
    covariance[np.arange(size), np.arange(size)] += between
    return Sessions(_table(rows), covariance)


def _alone(problem: Problem, fit: Fit, rows: Float[np.ndarray, " W"] | np.ndarray) -> Fit:
    part, start = problem.rows(rows), fit.start.rows(rows)
    linear = linearise(part, fit.hypothesis, start)
    return refit(
        replace(linear, problem=part),
        fit.members,
        fit.x,
        groups=fit.groups,
        start=start,
        guess=fit.hypothesis,
        effort=_EFFORT,
    )


def _rows(recording: str, fit: Fit) -> list[dict[str, object]]:
    deviation = np.sqrt(np.diag(fit.covariance))
    first, rows = 0, []
    for c, x in zip(fit.members, fit.x, strict=True):
        rows.append(
            {
                "recording": recording,
                "effect": c.effect.id,
                "site": c.site.name,
                "value": c.effect.value(c.full(x)),
                "deviation": float(deviation[first]),
            }
        )
        first += c.size
    return rows


def _table(rows: list[dict[str, object]]) -> pd.DataFrame:
    return pd.DataFrame(rows, columns=["recording", "effect", "site", "value", "deviation"])

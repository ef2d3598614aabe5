"""What an identification found."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pandas as pd
from scipy.special import entr

from bo_sysid.arrays import Point, Probabilities
from bo_sysid.belief.stopping import StopReason
from bo_sysid.identify import doubts
from bo_sysid.identify.problem import FittedStarts
from bo_sysid.parameters import CandidateSet
from bo_sysid.runs import finite

_KNOWN = 1e-9  # share of the range: what spreads less has one value, but for rounding
_SURE = 0.95  # P of a candidate, from which a search that used up its budget was sure of it


@dataclass(frozen=True)
class Identification:
    """The parameters that fit, and how sure one can be.

    Attributes:
        name: of the study.
        best: `d` parameter values with the smallest Δ among those evaluated.
        parameters: one row a parameter: name, unit, nominal, value, low95, high95 (from P_boot),
            at_bound.
        candidates: the discrete set B; with `search.refine` every set that was searched, as one.
        probabilities: `N` P(β): where the minimum of Δ on these recordings lies.
        bootstrap: `N` P_boot(β): what these recordings say about the machine.
        evaluations: one row an evaluation: level, row, parameters, deviation, diverged, entropy.
        errors: root mean square prediction errors: recordings (train, holdout), kind
            (prediction, fit, forecast), channel, unit, nominal, identified, in that unit, over
            windows in which neither diverges; nominal_diverged, identified_diverged, the shares of
            windows in which each does.
        traces: recorded, nominal and identified over time, for the first recording set aside.
        reason: why the search stopped.
        notes: what was done to the data.
        noise: standard deviation of each recorded position's noise, by channel.
        spread: the scale of each channel that is compared in units of its recorded spread.
        fitted_starts: what would fit best with fitted starts; None where it is not known.
        nominal_deviation: Δ of the model as it is; NaN where it is not known.
    """

    name: str
    best: Point
    parameters: pd.DataFrame
    candidates: CandidateSet
    probabilities: Probabilities
    bootstrap: Probabilities
    evaluations: pd.DataFrame
    errors: pd.DataFrame
    traces: pd.DataFrame
    reason: str
    notes: tuple[str, ...]
    noise: Mapping[str, float] = field(default_factory=dict)
    spread: Mapping[str, float] = field(default_factory=dict)
    fitted_starts: FittedStarts | None = None
    nominal_deviation: float = float("nan")

    @property
    def belief(self) -> pd.DataFrame:
        """One row a candidate: its parameters, P and P_boot."""
        return self.candidates.frame().assign(P=self.probabilities, P_boot=self.bootstrap)

    @property
    def identifiability(self) -> pd.DataFrame:
        """What P_boot says about each parameter, and which other one could take its place.

        Columns: name; of_range, the share of the range of B that the 95 % interval takes; tied_to,
        the parameter with the largest correlation ρ over P_boot, and that ρ (empty, 0 for none).
        """
        names = [str(n) for n in self.parameters["name"]]
        points, likely = self.candidates.points, self.bootstrap > 0
        width = (self.parameters["high95"] - self.parameters["low95"]).to_numpy(float)
        of_range = width / np.ptp(self.candidates.bounds, axis=0)
        covariance = np.atleast_2d(
            np.cov(points[likely].T, aweights=self.bootstrap[likely], bias=True)
        )
        sigma = np.sqrt(np.diag(covariance))
        known = sigma < _KNOWN * np.ptp(self.candidates.bounds, axis=0)
        sigma[known] = np.inf  # tied to nothing
        rho = covariance / np.outer(sigma, sigma)
        np.fill_diagonal(rho, 0.0)
        tied = np.abs(rho).argmax(axis=1)
        found = rho[np.arange(len(names)), tied]
        return pd.DataFrame(
            {
                "name": names,
                "of_range": np.minimum(of_range, 1.0),
                "tied_to": [names[k] if r else "" for k, r in zip(tied, found, strict=True)],
                "correlation": found,
            }
        )

    @property
    def refined(self) -> bool:
        """Whether the search zoomed in on its best candidates."""
        levels = self.evaluations.get("level", pd.Series(dtype=int))
        return bool(levels.max() > levels.min())

    @property
    def unsure(self) -> tuple[str, ...]:
        """What these recordings do not tell about the parameters, in words.

        Begins with how far they are from being explained, where they are not.
        """
        rows, table = self.identifiability, self.parameters
        trained = self.errors
        if not trained.empty:
            trained = trained[trained["recordings"] == "train"]
        deviation = float(self.evaluations["deviation"].min()) if len(self.evaluations) else np.nan
        ended = self.reason != StopReason.BUDGET.sentence or self.probabilities.max() > _SURE
        here = (self.candidates.points == self.best).all(axis=1)
        found = (
            doubts.worse(trained, table, deviation, self.nominal_deviation, refined=self.refined),
            doubts.moved(table, self.fitted_starts, refined=self.refined),
            doubts.unexplained(trained, self.noise),
            *(doubts.wide(rows) if ended else doubts.cut_short(rows)),
            *doubts.tied(rows),
            doubts.hidden(rows, self.spread, self.noise),
            doubts.at_ends(table, self.candidates),
            doubts.outside(
                table, self.candidates, self.best, float(self.probabilities[here].sum())
            ),
        )
        return tuple(words for words in found if words)

    def summary(self) -> dict[str, Any]:
        """Return the result as plain values, for JSON."""
        return {
            "name": self.name,
            "parameters": self.parameters.to_dict(orient="records"),
            "deviation": float(self.evaluations["deviation"].min()),
            "evaluations": len(self.evaluations),
            "candidates": len(self.candidates),
            "entropy": float(entr(self.probabilities).sum()),
            "entropy_bootstrap": float(entr(self.bootstrap).sum()),
            "stopped": self.reason,
            "identifiability": self.identifiability.to_dict(orient="records"),
            "unsure": list(self.unsure),
            "errors": finite(self.errors.to_dict(orient="records")),
            "notes": list(self.notes),
        }

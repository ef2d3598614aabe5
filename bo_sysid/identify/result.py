"""What an identification found."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
from jaxtyping import Float

from bo_sysid.arrays import Point, Probabilities
from bo_sysid.parameters import CandidateSet


@dataclass(frozen=True)
class Identification:
    """The parameters that fit, and how sure one can be.

    Attributes:
        name: of the study.
        best: `d` parameter values with the smallest Δ among those evaluated.
        parameters: one row a parameter: name, unit, nominal, value, low95, high95 (from P_boot),
            at_bound.
        candidates: the discrete set B at the end of the search.
        probabilities: `N` P(β): where the minimum of Δ on these recordings lies.
        bootstrap: `N` P_boot(β): what these recordings say about the machine.
        evaluations: one row an evaluation: level, row, parameters, deviation, diverged, entropy.
        errors: root mean square prediction errors: recordings (train, holdout), kind (one-step,
            fit, forecast), channel, nominal, identified, in the channel's unit.
        traces: recorded, nominal and identified over time, for the first recording set aside.
        reason: why the search stopped.
        notes: what was done to the data.
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

    @property
    def belief(self) -> pd.DataFrame:
        """One row a candidate: its parameters, P and P_boot."""
        return self.candidates.frame().assign(P=self.probabilities, P_boot=self.bootstrap)

    def summary(self) -> dict[str, Any]:
        """Return the result as plain values, for JSON."""
        return {
            "name": self.name,
            "parameters": self.parameters.to_dict(orient="records"),
            "deviation": float(self.evaluations["deviation"].min()),
            "evaluations": len(self.evaluations),
            "candidates": len(self.candidates),
            "entropy": entropy(self.probabilities),
            "entropy_bootstrap": entropy(self.bootstrap),
            "stopped": self.reason,
            "errors": self.errors.to_dict(orient="records"),
            "notes": list(self.notes),
        }


def entropy(p: Float[np.ndarray, " N"]) -> float:
    """Return -Σ p log p in nats."""
    positive = p[p > 0]
    return float(-(positive * np.log(positive)).sum())

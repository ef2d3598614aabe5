"""What an identification found."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pandas as pd
from scipy.special import entr

from bo_sysid.arrays import Point, Probabilities
from bo_sysid.identify.errors import is_worse
from bo_sysid.parameters import CandidateSet
from bo_sysid.runs import finite

_LITTLE = 0.5  # share of the range from which an interval says little
_KNOWN = 1e-9  # share of the range: what spreads less has one value, but for rounding
_EXPLAINED = 3.0  # standard deviations of the noise, beyond which recordings are not explained
_LIKELY = 0.5  # P of the best candidate that was tried, from which it is no stopgap
_UNLIKE = 100.0  # ratio of two channels' spreads over noise, above which one hides the other
_TIED = 0.8  # correlation from which two parameters stand for each other


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
    def unsure(self) -> tuple[str, ...]:
        """What these recordings do not tell about the parameters, in words.

        Begins with how far they are from being explained, where they are not.
        """
        rows = self.identifiability.to_dict(orient="records")
        sentences = [
            f"These recordings say little about {r['name']}: its interval takes "
            f"{float(r['of_range']):.0%} of the range that was searched."
            for r in rows
            if float(r["of_range"]) > _LITTLE
        ]
        pairs = {
            frozenset((str(r["name"]), str(r["tied_to"]))): float(r["correlation"])
            for r in rows
            if abs(float(r["correlation"])) > _TIED
        }
        for pair, rho in pairs.items():
            one, other = sorted(pair)
            how = "together" if rho > 0 else "against each other"
            sentences.append(
                f"{one} and {other} move {how} over P_boot (ρ = {rho:.2f}): the recordings tell a "
                "combination of the two better than either."
            )
        hidden = self._hidden if any(r["of_range"] > _LITTLE for r in rows) else ()
        return (
            *self._worse, *self._unexplained, *sentences, *hidden, *self._cut, *self._outside
        )  # fmt: skip

    @property
    def _worse(self) -> tuple[str, ...]:
        """Whether the model as it is fits the training recordings better than every candidate."""
        if self.errors.empty:
            return ()
        trained = self.errors[self.errors["recordings"] == "train"]
        if not is_worse(trained):
            return ()
        known = trained[["channel", "unit", "nominal", "identified"]].dropna()
        ratio = known["identified"] / known["nominal"]
        worst = known.to_dict(orient="records")[int(ratio.to_numpy().argmax())]
        return (
            "The model as it is fits the training recordings better than every candidate that was "
            f"tried ({worst['channel']}: {worst['nominal']:.3g} {worst['unit']}, and "
            f"{worst['identified']:.3g} with the best of them): use none of these values. "
            "Candidates are too far apart; `search: {refine: true}` zooms in on the best ones, and "
            "narrower bounds help.",
        )

    @property
    def _hidden(self) -> tuple[str, ...]:
        """Which channel counts for little, since its spread is far more of its noise than others'.

        Such as a wheel that turns many times, beside a joint that swings.
        """
        ratio = {n: s / self.noise[n] for n, s in self.spread.items() if self.noise.get(n)}
        if not ratio or max(ratio.values()) < _UNLIKE * min(ratio.values()):
            return ()
        least = max(ratio, key=ratio.__getitem__)
        whiten = ", ".join(f"{n}: {self.noise[n]:.2g}" for n in ratio)
        return (
            f"Channels are compared in units of their recorded spread, in which {least} counts for "
            "little: it varies by far more of its noise than others do. In units of noise, "
            f"`deviation: {{whiten: {{{whiten}}}}}`, it may tell more.",
        )

    @property
    def _cut(self) -> tuple[str, ...]:
        """Which short intervals end where the search does, of values that are on no bound.

        But for an end at zero: less than no friction is none.
        """
        bounds, count = self.candidates.bounds, len(self.parameters)
        free = ~np.asarray(self.parameters.get("at_bound", np.zeros(count)), bool)
        free[list(self.candidates.categories)] = False
        low, high = (self.parameters[c].to_numpy(float) for c in ("low95", "high95"))
        short = high - low <= _LITTLE * np.ptp(bounds, axis=0)
        ends = ((low <= bounds[0]) & (bounds[0] != 0)) | ((high >= bounds[1]) & (bounds[1] != 0))
        names = self.parameters["name"][free & short & ends].astype(str)
        if not len(names):
            return ()
        verb = "interval ends" if len(names) == 1 else "intervals end"
        return (
            f"{', '.join(names)}: the {verb} where the search does, and the truth may lie beyond.",
        )

    @property
    def _outside(self) -> tuple[str, ...]:
        """Which values lie outside their intervals, where P expects others to be better."""
        here = (self.candidates.points == self.best).all(axis=1)
        if self.probabilities[here].sum() > _LIKELY:
            return ()
        slack = _KNOWN * np.ptp(self.candidates.bounds, axis=0)
        low, high = (self.parameters[c].to_numpy(float) for c in ("low95", "high95"))
        outside = (self.best < low - slack) | (self.best > high + slack)
        names = self.parameters["name"][outside].astype(str)
        if not len(names):
            return ()
        return (
            f"{', '.join(names)}: the value, that of the best candidate that was tried, lies "
            "outside the interval, where better ones are expected; a larger search.budget, in "
            "another run folder, tries them.",
        )

    @property
    def _unexplained(self) -> tuple[str, ...]:
        """What is left of the training recordings from fitted starts, where that is far from noise.

        Measured starts make predictions as noisy as they are: their errors are no sign.
        """
        if not self.noise or self.errors.empty:
            return ()
        fits = self.errors[(self.errors["recordings"] == "train") & (self.errors["kind"] == "fit")]
        left = {
            str(channel): float(error) / self.noise[str(channel)]
            for channel, error in zip(fits["channel"], fits["identified"], strict=True)
            if self.noise.get(str(channel)) and np.isfinite(error)
        }
        worst = max(left, key=left.__getitem__, default="")
        if not worst or not left[worst] > _EXPLAINED:
            return ()
        return (
            f"The identified model misses {worst} of the training recordings by "
            f"{left[worst]:,.0f} standard deviations of its noise. Nothing that was tried explains "
            "them, so do not trust the intervals: more evaluations or candidates may find what "
            "fits, and diagnose what the model lacks.",
        )

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

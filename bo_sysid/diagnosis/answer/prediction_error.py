"""How well hypotheses forecast the training recordings; in contact, magnitudes that do it best.

A start that is fitted inside a window takes over what an impact tells, and windows in which the
start or the step decides have next to no weight: what is left there are broad valleys. A forecast
from the past alone keeps what impacts tell; the prediction-error method [1] takes the magnitudes
that leave least of it.

[1] L. Ljung, "System Identification: Theory for the User", 2nd ed., Prentice Hall, 1999, chapter 7.
"""

from dataclasses import replace
from weakref import WeakKeyDictionary

import numpy as np
from jaxtyping import Float
from scipy.optimize import minimize

from bo_sysid.diagnosis.windows.candidate import slices_of
from bo_sysid.diagnosis.windows.evidence import Evidence
from bo_sysid.diagnosis.windows.forecast import AHEAD, PAST, forecast, forecast_problem
from bo_sysid.diagnosis.windows.hypothesis import Hypothesis
from bo_sysid.diagnosis.windows.timestep import shares
from bo_sysid.diagnosis.windows.windowing import meets_impacts

_WINDOWS, _MORE_WINDOWS = 24, 120  # of the training recordings in contact, elsewhere
_FLOOR = 1e-2  # [sigma²] of a window that leaves nothing
_LITTLE = 0.05  # share by which a coarser time step may leave more
_SWEEPS, _EVALUATIONS = 2, 16  # of step and magnitudes in turn; forecasts of all windows in each
_REACH = 0.25  # of a magnitude
_REACH_OF_PARAMETERS = 0.05  # of a parameter's range
_GAIN = 0.99  # of what was left, to move magnitudes at all


class PredictionError:
    """What forecasts of the training recordings leave.

    Args:
        evidence: the recordings and the nominal model.
        timestep: of the simulation in [s], which hypotheses divide.
    """

    def __init__(self, evidence: Evidence, timestep: float) -> None:
        problem, self._past = forecast_problem(
            evidence.model, evidence.machine, evidence.recordings, evidence.sigma, past=PAST,
            ahead=AHEAD, timestep=timestep, engine=evidence.engine, laws=evidence.laws,
        )  # fmt: skip
        self._touching = meets_impacts(problem)
        count = _WINDOWS if self._touching else _MORE_WINDOWS
        self._problem = problem.rows(problem.windows.evenly(count))
        self._kept = evidence.kept
        self._cached: WeakKeyDictionary[Hypothesis, float] = WeakKeyDictionary()  # asked for again

    def __call__(self, hypothesis: Hypothesis) -> float:
        """Return what forecasts leave, in sigma; one that took long is found again after a kill."""
        if hypothesis not in self._cached:
            made_from = ("forecasts", self._problem.identity, hypothesis.identity)
            found = self._kept.arrays(made_from, lambda: {"left": np.array(self._left(hypothesis))})
            self._cached[hypothesis] = float(found["left"])
        return self._cached[hypothesis]

    def _left(self, hypothesis: Hypothesis) -> float:
        """Return the rms of a forecast over all windows, in contact its geometric mean, in sigma.

        Geometric, since a few windows end on the other side of an impact whatever is supposed, and
        would decide an arithmetic one. Elsewhere windows in which a machine rests would decide the
        geometric one: that of an arm whose friction grows with its load leaves less there if it
        has too much friction everywhere, and twice as much on the whole.
        """
        squares = (forecast(self._problem, self._past, hypothesis).residual ** 2).sum(axis=(1, 2))
        seen = (self._problem.weight[:, self._past :] > 0).sum(axis=(1, 2))
        if not self._touching:
            return float(np.sqrt(squares.sum() / max(seen.sum(), 1)))
        squares /= np.maximum(seen, 1)
        return float(np.exp(0.5 * np.log(squares + _FLOOR).mean()))

    def stepped(self, hypothesis: Hypothesis) -> Hypothesis:
        """Return a hypothesis at the coarsest time step that forecasts nearly as well as any."""
        made = [replace(hypothesis, numerics=numerics) for numerics in shares()]
        left = [self(h) for h in made]
        near = (1 + _LITTLE) * min(left)
        return next(h for h, r in zip(made, left, strict=True) if r <= near)

    def fitted(self, hypothesis: Hypothesis) -> Hypothesis:
        """Return a hypothesis with time step and magnitudes that forecast best nearby."""
        hypothesis = self.stepped(hypothesis)
        for _ in range(_SWEEPS if hypothesis.members else 0):
            moved = self.stepped(self._moved(hypothesis))
            same, hypothesis = moved.numerics == hypothesis.numerics, moved
            if same:
                break
        return hypothesis

    def _moved(self, hypothesis: Hypothesis) -> Hypothesis:
        """Return a hypothesis with the magnitudes that Powell's method ends at."""
        count, before = sum(x.size for _, x in hypothesis.terms), self(hypothesis)

        def left(u: Float[np.ndarray, " m"]) -> float:
            return self(_displaced(hypothesis, u))

        found = minimize(
            left, np.zeros(count), method="Powell", bounds=[(-1.0, 1.0)] * count,
            options={"maxfev": _EVALUATIONS, "xtol": 0.02, "ftol": 0.01},
        )  # fmt: skip
        return _displaced(hypothesis, found.x) if found.fun < _GAIN * before else hypothesis


def _displaced(hypothesis: Hypothesis, u: Float[np.ndarray, " m"]) -> Hypothesis:
    """Return a hypothesis whose magnitudes lie a share of their reach away, in -1 to 1 each."""
    held = (*hypothesis.nuisances, *hypothesis.members)
    parts = [u[own] for own in slices_of(held)]
    moved = []
    for k, ((c, x), part) in enumerate(zip(hypothesis.terms, parts, strict=True)):
        parameter = k < len(hypothesis.nuisances)
        reach = _REACH_OF_PARAMETERS * (c.high - c.low) if parameter else _REACH * np.abs(x)
        moved.append(np.clip(x + part * reach, c.low, c.high))
    count = len(hypothesis.nuisances)
    return replace(hypothesis, nuisance_x=tuple(moved[:count]), x=tuple(moved[count:]))

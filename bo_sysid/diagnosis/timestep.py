"""By how much the time step of the model is divided.

To first order in the step h a simulation differs from a continuous machine by an amount in
proportion to h: a plant that steps n times finer shows the share (1 - 1/n)/(1 - 1/FINER) of the
correction, which is what a step FINER times smaller changes.
"""

from dataclasses import replace

import numpy as np

from bo_sysid.diagnosis.hypothesis import Hypothesis
from bo_sysid.simulation.windows import Windows

SHARE_BOUNDS = (-0.5, 2.0)  # of the correction: where the share that is shown may lie
FINER = 4  # the discretisation is judged against a time step this many times smaller
_DIVISIONS = (1, 2, 4, 8, 16)
_SHARES = {n: (1 - 1 / n) / (1 - 1 / FINER) for n in _DIVISIONS}  # of the correction


def refined(windows: Windows, finer: int) -> Windows:
    """Return the same windows for a time step `finer` times smaller."""
    at = (windows.step + windows.fraction) * finer
    step = np.floor(at + 1e-9).astype(int)
    fraction = at - step
    fraction[np.abs(fraction) < 1e-9] = 0.0
    return replace(
        windows,
        ctrl=np.repeat(windows.ctrl, finer, axis=1),
        signals={n: np.repeat(s, finer, axis=1) for n, s in windows.signals.items()},
        step=step,
        fraction=fraction,
        timestep=windows.timestep / finer,
    )


def finer_step(numerics: float) -> int:
    """Return the division of the time step whose predictions the recordings show."""
    return min(_DIVISIONS, key=lambda n: abs(_SHARES[n] - numerics))


def coarsened(hypothesis: Hypothesis, tolerance: float) -> Hypothesis:
    """Return a hypothesis with the share of the correction that a coarser time step shows.

    Args:
        hypothesis: with the share that was fitted.
        tolerance: by how much its share may differ.
    """
    within = (n for n in _DIVISIONS if abs(_SHARES[n] - hypothesis.numerics) <= tolerance)
    division = next(within, finer_step(hypothesis.numerics))
    return replace(hypothesis, numerics=_SHARES[division])


def shares() -> tuple[float, ...]:
    """Return the shares of the correction that time steps up to the finer one show."""
    return tuple(_SHARES[n] for n in _DIVISIONS if n <= FINER)

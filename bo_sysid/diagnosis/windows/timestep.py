"""By how much the time step of the model is divided.

To first order in the step h a simulation differs from a continuous machine by an amount in
proportion to h: a plant that steps n times finer shows the share (1 - 1/n)/(1 - 1/FINER) of the
correction, which is what a step FINER times smaller changes.
"""

from dataclasses import replace

import numpy as np

from bo_sysid.diagnosis.windows.hypothesis import Hypothesis
from bo_sysid.simulation.windows import Windows

SHARE_BOUNDS = (-0.5, 2.0)  # of the correction: where the share that is shown may lie
FINER = 4  # the discretisation is judged against a time step this many times smaller
_DIVISIONS, _FINEST = (1, 2, 4, 8), 16  # the finest only where the error of the others is felt
_CONTINUOUS = 1 / (1 - 1 / FINER)  # share of the correction that a continuous machine shows
_LITTLE = 0.05  # of what a hypothesis leaves: a time-step error that counts as none
_FELT = 0.3  # the same, from which forecasts are worse by a twentieth


def refined(windows: Windows, finer: int) -> Windows:
    """Return the same windows for a time step `finer` times smaller."""
    at = (windows.step + windows.fraction) * finer
    step = np.floor(at + 1e-9).astype(int)
    fraction = at - step
    fraction[np.abs(fraction) < 1e-9] = 0.0
    start, past = windows.start, windows.start.past
    return replace(
        windows,
        start=start if past is None else replace(start, past=np.repeat(past, finer, axis=1)),
        ctrl=np.repeat(windows.ctrl, finer, axis=1),
        signals={n: np.repeat(s, finer, axis=1) for n, s in windows.signals.items()},
        step=step,
        fraction=fraction,
        timestep=windows.timestep / finer,
    )


def share_of(division: int) -> float:
    """Return the share of the correction that a time step `division` times smaller shows."""
    return (1 - 1 / division) / (1 - 1 / FINER)


def finer_step(numerics: float) -> int:
    """Return the division of the time step whose predictions the recordings show."""
    return min((*_DIVISIONS, _FINEST), key=lambda n: abs(share_of(n) - numerics))


def coarsened(hypothesis: Hypothesis, change: float, *, finest: bool = True) -> Hypothesis:
    """Return a hypothesis with the share of the correction that a coarser time step shows.

    Args:
        hypothesis: with the share that was fitted.
        change: what a step `FINER` times smaller changes, over what the hypothesis leaves.
        finest: whether the finest division is one, where the error of the others is felt.
    """
    shown = min(hypothesis.numerics, _CONTINUOUS)  # what is beyond no time step explains
    error = {n: abs(share_of(n) - shown) * change for n in (*_DIVISIONS, _FINEST)}
    nearest = min(_DIVISIONS, key=error.__getitem__)
    if finest and error[nearest] > max(_FELT, error[_FINEST]):
        nearest = _FINEST
    division = next((n for n in _DIVISIONS if error[n] <= _LITTLE), nearest)
    return replace(hypothesis, numerics=share_of(division))


def shares() -> tuple[float, ...]:
    """Return the shares of the correction that time steps up to the finer one show."""
    return tuple(share_of(n) for n in _DIVISIONS if n <= FINER)

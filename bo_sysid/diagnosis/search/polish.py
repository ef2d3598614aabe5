"""Fits to their end: linearised anew until magnitudes stay, at a step that is fine enough."""

from collections.abc import Callable

import numpy as np

from bo_sysid.diagnosis.search.window_lengths import windows_of
from bo_sysid.diagnosis.sets.fit import Fit
from bo_sysid.diagnosis.sets.refit import FINAL, refit_at
from bo_sysid.diagnosis.sets.shapes import reshaped
from bo_sysid.diagnosis.windows.estimated_starts import first_starts
from bo_sysid.diagnosis.windows.evidence import Evidence
from bo_sysid.diagnosis.windows.linear import Linear
from bo_sysid.diagnosis.windows.problem import ROUGH, Problem
from bo_sysid.diagnosis.windows.windowing import Prepared, linearise_at_best_starts, prepare

CURVED = 0.5
"""Size in [sigma] of the time-step correction from which a share of it may not be enough."""

_MOST = 6  # times at most that a set is linearised anew on all windows
_SETTLED = 0.3  # standard deviations: magnitudes that moved less stay where they are
_SETTLED_SHAPE = 0.03  # the same as a share of a shape
# linearising anew goes on only while less than this share of the rms before is left
_GAINED = 0.995
_HALVINGS = 3  # of the time step at most, for that
_BEYOND_NOISE = 2.0  # standard deviations of rms², from which something is left
_STRAIGHTER = 0.7  # half the step is kept if it leaves less than this share of what was unexplained


def polished(
    problem: Problem,
    leader: Fit,
    prepared: Prepared,
    doing: Callable[[str], None],
    *,
    once: bool = False,
) -> tuple[Fit, Prepared]:
    """Fit the leader on all windows, prepared anew until its magnitudes stay where they are.

    Or until that gains nothing: a bend that windows tell little of may wander on for ever.

    Args:
        problem: the windows.
        leader: a set that was fitted on some of them, or on others.
        prepared: the windows with starts fitted to the leader.
        doing: told what is fitted, before it is; one time may take minutes.
        once: whether one time is enough, since the leader is no explanation.
    """
    times = min(_times(leader, problem), 1 if once else _MOST)
    for k in range(times):
        doing(
            f"the leading set on all {len(problem.windows)} windows, {leader.rms:.3f} sigma so far "
            f"(time {k + 1}, at most {times})"
        )
        before, leader = leader, _refitted(prepared.linear, leader)
        same = len(leader.start) == len(problem.windows)
        prepared = prepare(problem, leader.hypothesis, leader.start if same else None)
        idle = k > 0 and leader.rms > _GAINED * before.rms
        if idle or _distance(before, leader) < _SETTLED:
            break
    return leader, prepared


def stepped_finer(
    evidence: Evidence,
    leader: Fit,
    prepared: Prepared,
    horizon: int,
    doing: Callable[[str], None],
) -> tuple[Fit, Prepared]:
    """Halve the time step while that explains much of what the leader leaves.

    What a step does is corrected by one share of what a finer one changes, which is right to first
    order alone. Where effects are thousands of sigma large the rest is felt: an arm whose friction,
    damping and rotors were missing kept .4 σ, and its forecasts twice their noise. In contact no
    step is fine enough for a share to hold, and what is far off is so for other reasons.

    Args:
        evidence: what is diagnosed.
        leader: a set that was fitted to the end.
        prepared: all windows, with starts fitted to it.
        horizon: their length in instants.
        doing: told what is fitted, before it is.
    """
    if not leader.members or leader.rms > ROUGH or evidence.machine.impacts:
        return leader, prepared
    varies = np.sqrt(2.0 / prepared.problem.dof)  # rms² of n numbers, by noise alone
    for _ in range(_HALVINGS):
        if leader.excess < _BEYOND_NOISE * varies or prepared.correction_rms < CURVED:
            break
        step = prepared.problem.windows.timestep / 2
        problem = windows_of(evidence, horizon, step, everything=True)
        finer = prepare(problem, leader.hypothesis)
        made, finer = polished(problem, leader, finer, doing)
        if made.excess > _STRAIGHTER * leader.excess:
            break
        leader, prepared = made, finer
    return leader, prepared


def fitted_at_itself(problem: Problem, fit: Fit) -> Fit:
    """Fit a set as the leader was, on the windows and with the weights that all are compared by."""
    for _ in range(_times(fit, problem)):
        first = first_starts(problem, fit.hypothesis)
        linear = linearise_at_best_starts(problem, fit.hypothesis, [*first, fit.start])
        before, fit = fit, _refitted(linear, fit)
        if _distance(before, fit) < _SETTLED:
            break
    return fit


def _times(fit: Fit, problem: Problem) -> int:
    """Return how often a set is linearised anew.

    Once in contact: how much each window says is found anew with every linear model there.
    """
    most = 1 if problem.machine.impacts else _MOST
    return most if fit.members else 0


def _refitted(linear: Linear, fit: Fit) -> Fit:
    """Return a fit with magnitudes and shapes fitted to the end in a linear model's space."""
    return reshaped(linear, refit_at(linear, fit, start=linear.start, effort=FINAL))


def _distance(before: Fit, after: Fit) -> float:
    """Return how far the magnitudes of two fits of a set lie apart, in standard deviations.

    Infinitely far where its shapes still move.
    """
    moved = [
        np.abs(b.shapes - a.shapes) > _SETTLED_SHAPE * np.abs(a.shapes)
        for b, a in zip(before.members, after.members, strict=True)
    ]
    if np.concatenate(moved).any():
        return np.inf
    change = np.concatenate(after.x) - np.concatenate(before.x)
    own = slice(0, len(change))
    inverse = np.linalg.pinv(after.covariance[own, own], hermitian=True)
    return float(np.sqrt(max(change @ inverse @ change, 0.0)))

"""How long the windows of a diagnosis are, and how many of them are taken."""

from math import sqrt

import numpy as np

from bo_sysid.diagnosis.sets.fit import Fit
from bo_sysid.diagnosis.sets.rules import CLEAN, LOOSE
from bo_sysid.diagnosis.windows.cutting import cut_problem
from bo_sysid.diagnosis.windows.evidence import CONTACT_WINDOW, Evidence
from bo_sysid.diagnosis.windows.hypothesis import Hypothesis
from bo_sysid.diagnosis.windows.input_noise import disturbances
from bo_sysid.diagnosis.windows.linear import linearise
from bo_sysid.diagnosis.windows.problem import Problem
from bo_sysid.diagnosis.windows.projection import project
from bo_sysid.diagnosis.windows.windowing import Prepared, chaos, in_contact, nothing, prepare
from bo_sysid.mjcf.touching import can_touch

LEAST = 6
"""Instants in the shortest window."""

TRACTABLE = 12.0
"""What the nominal model may leave in [sigma], for linear screening to serve."""

_SHORTEST = 1 / 6  # of the full horizon
_GROWTH, _ALMOST = 2.2, 2.6  # of the windows; times their length that are full ones at once
_UNSTABLE = 2.0  # growth λT of disturbances in a window, as a logarithm
_LESS = 3  # times shorter at most: what acts slowly is not seen in less
_OFTEN = 0.9  # quantile of λ over the recordings
_BY_CHANCE = 2.0  # [sigma] that the noise of a start changes in half of the windows
_SHAKEN = 100.0  # [sigma] that noise of the controls may move a window
_WINDOWS = 24  # in the search
_RARE = 1.5  # times what a search leaves of its windows, above which it needs others
_MORE = 4  # standard deviations of rms², from which all windows show more than those
_MOST = 10  # times that number at most in the final fits
_MOST_IN_CONTACT = 4  # the same, where each is fitted by itself and takes its time


def windows_of(evidence: Evidence, horizon: int, step: float, everything: bool = False) -> Problem:
    """Return windows spread evenly over the recordings.

    Args:
        evidence: the recordings and the nominal model.
        horizon: instants in a window, of a recording of the usual rate; others last as long.
        step: of the simulation in [s].
        everything: for the final fits, which take many more than the search.
    """
    whole = sum(r.duration for r in evidence.recordings) / evidence.machine.sampling
    count = max(int(whole / horizon), 1)
    keep_every = max(round(count / _WINDOWS), 1)
    if everything:
        most = _MOST_IN_CONTACT if evidence.machine.impacts else _MOST
        keep_every = -(-count // (most * _WINDOWS))
    return cut_problem(
        evidence.model,
        evidence.machine,
        evidence.recordings,
        evidence.sigma,
        evidence.nuisances,
        horizon=evidence.horizons(horizon, LEAST),
        lead=evidence.leads(horizon),
        keep_every=keep_every,
        timestep=step,
        engine=evidence.engine,
        laws=evidence.laws,
        kept=evidence.kept,
        input_noise=evidence.input_noise,
    )


def contact_decides(evidence: Evidence) -> bool:
    """Whether a contact that lasts decides as impacts do.

    Where a wheel rolls on the edges of a cylinder, or a box slips or not, noise of a start changes
    what follows by more than its slopes say. Most that rolls or slides moves smoothly.
    """
    machine = evidence.machine
    if machine.impacts or not can_touch(machine.model):
        return False
    instants = max(round(CONTACT_WINDOW / machine.sampling), LEAST)
    prepared = prepare(windows_of(evidence, instants, machine.model.opt.timestep))
    if not in_contact(prepared.problem):
        return False
    changed = np.sqrt(chaos(prepared.linear).sum(axis=(1, 2)) / prepared.problem.seen_in_each)
    return bool(np.median(changed) > _BY_CHANCE)


def limit_by_growth_rate(
    evidence: Evidence, horizon: int, step: float, at: Hypothesis | None = None
) -> int:
    """Shorten the windows until little disturbances do not grow to many times their size in them.

    λ = max log|eig A|/h of one step of the linear model of the mechanics is the rate at which the
    motion leaves a recorded one; where λ ≥ 15/s (a short pendulum upright), 0.3 s multiply what the
    model lacks by a hundred, and a fit follows those moments alone.

    Args:
        evidence: the recordings and the nominal model.
        horizon: instants in a full window.
        step: of the simulation in [s].
        at: the set whose mechanics are meant, by default nothing.
    """
    problem = windows_of(evidence, max(int(horizon * _SHORTEST), LEAST), step)
    at = at or nothing(problem)
    linear = linearise(problem, at, problem.smoothed(at))
    mechanics = slice(0, 2 * linear.points.model.nv)  # with joints that the set adds
    growth = np.abs(np.linalg.eigvals(linear.A[..., mechanics, mechanics])).max(axis=-1)
    rates = np.log(np.maximum(growth, 1e-12)) / (linear.macro * problem.windows.timestep)
    rate = float(np.quantile(rates, _OFTEN))
    most = _UNSTABLE / rate if rate > 0 else np.inf
    return int(max(min(horizon, most / evidence.machine.sampling), horizon / _LESS, LEAST))


def limit_by_input_noise(evidence: Evidence, horizon: int, step: float) -> int:
    """Shorten the windows until noise of the controls does not move them far.

    Noise of acceleration moves a position with the power 3/2 of the time. Where it is moved by
    hundreds of sigma, what the hypotheses change is not the same along the likely course of the
    noise and along the true one.
    """
    problem = windows_of(evidence, horizon, step)
    linear = linearise(problem, nothing(problem), problem.windows.start)
    response, _ = disturbances(linear, evidence.input_noise)
    moved = float(np.sqrt(np.median((response**2).sum(axis=(1, 2)) / problem.seen_in_each)))
    if moved < _SHAKEN:
        return horizon
    return int(max(horizon * (_SHAKEN / moved) ** (2 / 3), LEAST))


def limit_by_residual(evidence: Evidence, horizon: int, step: float) -> tuple[Prepared, int]:
    """Shorten the windows until the nominal residual is small enough for linear screening."""
    least = max(int(horizon * _SHORTEST), LEAST)
    length = horizon
    while True:
        prepared = prepare(windows_of(evidence, length, step))
        problem = prepared.problem
        r = problem.residual(nothing(problem), prepared.start)
        rms = float(np.sqrt((project(prepared.linear.Q, r) ** 2).sum() / problem.dof))
        if rms < TRACTABLE or length <= least:
            return prepared, length
        factor = max(min((TRACTABLE / rms) ** 0.4, 0.75), 0.4)
        length = max(int(length * factor), least)


def next_length(length: int, horizon: int) -> int:
    """Return how long windows are to be next, on the way to full ones."""
    return horizon if length * _ALMOST > horizon else int(length * _GROWTH)


def show_more(whole: Fit, seen: Fit, dof: int) -> bool:
    """Return whether all windows show what those of a search did not.

    A limit that is reached once in a while is in few of them, and small over all.

    Args:
        whole: the best fit on all windows.
        seen: the best one on those of the search.
        dof: of the search.
    """
    chance = _MORE * sqrt(2 / dof)  # of rms², a mean of χ²
    more = (whole.rms / seen.rms) ** 2 - 1 > max(CLEAN, chance)
    return whole.rms > _RARE * seen.rms or (seen.rms < LOOSE and more)


def most_informative(prepared: Prepared, fit: Fit) -> Prepared:
    """Return as many of all windows as a search takes, and as many that a fit leaves most of.

    What acts once in a recording, such as a limit that is reached, is seen in few windows.
    """
    left = (project(prepared.linear.Q, fit.residual) ** 2).sum(axis=1)
    keep = np.zeros(len(left), bool)
    keep[np.linspace(0, len(left) - 1, _WINDOWS).round().astype(int)] = True
    others = np.argsort(np.where(keep, -1.0, left))
    keep[others[-_WINDOWS:]] = True
    return prepared.rows(keep)

"""The clock of the controls: when they act, and whether all of them do at once."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from bo_sysid.checks.estimate import Estimate
from bo_sysid.checks.flags import Flag
from bo_sysid.checks.traces import LATEST

LATE = 2.5e-3  # [s] a delay below is not worth a word
_UNTOLD = 0.5  # share of (sampling interval + time step), below which a delay is not reported
_SURE = 4.0  # standard deviations that a delay must differ from nothing, or from another
_HALF = 0.2  # of an interval, about half of one, by which what changes between samples is early
_APART = 5e-3  # [s] from which on one control's delay is told apart from the others'
_FLOOR = 3e-4  # [s] what the model's step leaves undecided about a delay
_SIDES = {
    True: (
        "later",
        "actuators that are late (a lag, which `diagnose` names where the clock stays as it is)",
    ),
    False: ("earlier", "commands that change between samples"),
}


@dataclass(frozen=True)
class Clock:
    """When the controls of a log act, after their stamps.

    Attributes:
        common: weighted mean of the delays in [s], without those far from their median.
        apart: delays that differ from it, by control.
        shared: whether more than half of the controls agree, so that it is their clock's.
        least: the shortest delay that is told, in [s].
        sampling: interval between the controls' samples, in [s].
    """

    common: Estimate
    apart: Mapping[str, Estimate] = field(default_factory=dict)
    shared: bool = True
    least: float = LATE
    sampling: float = 0.0

    @property
    def delay(self) -> float:
        """How much later than stamped all controls act, in [s]; 0 where that is not certain."""
        return self.common.value if self.shared and self.certain(self.common) else 0.0

    @property
    def half_early(self) -> bool:
        """Whether controls act half an interval early: what changes linearly between samples does.

        Held until the next sample, what was measured is late by that on the mean.
        """
        off = abs(self.common.value + 0.5 * self.sampling)
        return self.delay < 0 and off < max(_HALF * self.sampling, 2 * self.common.sigma)

    def certain(self, e: Estimate) -> bool:
        """Whether a delay is told from none."""
        return max(self.least, _SURE * e.sigma) < abs(e.value) < LATEST


def least_delay(sampling: float, timestep: float) -> float:
    """Return the shortest delay, in [s], that logs with such an interval tell from none.

    Accelerations are of positions at samples, smoothed over several of them, and positions of a
    simulated machine lead by half a step: of brisk motion both look like a command that is early.
    """
    return max(LATE, _UNTOLD * (sampling + timestep))


def clock_of(late: Mapping[str, Estimate], least: float = LATE, sampling: float = 0.0) -> Clock:
    """Return the clock that controls share, from the delay of each that tells one.

    Args:
        late: of each control.
        least: the shortest delay that is told, in [s].
        sampling: interval between the controls' samples, in [s].
    """
    late = {n: e for n, e in late.items() if np.isfinite(e.sigma)}
    if not late:
        return Clock(Estimate(0.0, np.inf))
    values = np.array([e.value for e in late.values()])
    sigmas = np.hypot([e.sigma for e in late.values()], _FLOOR)
    middle = _weighted_median(values, 1 / sigmas)
    near = np.abs(values - middle) <= np.maximum(3 * sigmas, 1e-3)
    weight = 1 / sigmas[near] ** 2
    common = Estimate(float(weight @ values[near] / weight.sum()), float(weight.sum() ** -0.5))
    apart = {n: e for n, e in late.items() if _differ(e, common)}
    return Clock(common, apart, 2 * len(apart) < len(late), least, sampling)


def _weighted_median(values: np.ndarray, weight: np.ndarray) -> float:
    order = np.argsort(values)
    share = np.cumsum(weight[order]) / weight.sum()
    return float(values[order][np.searchsorted(share, 0.5)])


def _differ(one: Estimate, two: Estimate) -> bool:
    return abs(one.value - two.value) > max(_APART, _SURE * float(np.hypot(one.sigma, two.sigma)))


def clock_flags(clock: Clock, late: Mapping[str, Estimate]) -> list[Flag]:
    """Return what is to be said about when the controls act.

    Controls that share a clock share its error. Where they do not agree, what is late is a drive.
    """
    flags = []
    if clock.delay:
        side, cause = _SIDES[clock.delay > 0]
        cause += ", by half an interval as these are (hold: linear)" * clock.half_early
        size = Estimate(abs(clock.delay), clock.common.sigma)
        sentence = f"The controls act {_estimate_text(size)} {side} than their stamps say: another "
        evidence = {"delay": clock.delay, "sigma": clock.common.sigma}
        flags.append(Flag("wrong", "clock", tuple(late), f"{sentence}clock, or {cause}.", evidence))
    odd = clock.apart if clock.shared else {n: e for n, e in late.items() if clock.certain(e)}
    for name, e in odd.items():
        others = [f"{n} {_estimate_text(o)}" for n, o in late.items() if n != name]
        if clock.shared:
            others = [f"the others {_estimate_text(clock.common)}"]
        sentence = (
            f"{name} acts {_estimate_text(e)} after its stamps, {', '.join(others)}: "
            "that is no error of a shared clock, but this drive (a lag or a delay: `diagnose` "
            "tells which)."
        )
        evidence = {"delay": e.value, "sigma": e.sigma}
        flags.append(Flag("look", "clock", (name,), sentence, evidence))
    return flags


def _estimate_text(e: Estimate) -> str:
    return f"{1e3 * e.value:.1f} ± {1.96e3 * e.sigma:.1f} ms"

"""The wiring of a log: what each channel really is, when the controls act, and how sure that is."""

import copy
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import mujoco
import numpy as np
import pandas as pd

from bo_sysid.checks import estimate, motors
from bo_sysid.checks.flags import Flag
from bo_sysid.checks.hypothesis import Evidence, Hypothesis, Laws, Wire
from bo_sysid.checks.motion import beyond_range
from bo_sysid.checks.search import SUSPICIOUS, search, zero_groups
from bo_sysid.checks.speeds import speed_wires
from bo_sysid.checks.told import balance_flags, clock_flags, speed_flags, twin_flags, wire_flags
from bo_sysid.checks.traces import LATEST, Traces
from bo_sysid.recording import Recording

_LATE = 2.5e-3  # [s] a delay below is not worth a word
_SURE = 4.0  # standard deviations that a delay, and
_SURE_ZERO = 6.0  # that a zero must differ from nothing
_LEAST_ZERO = 0.015  # [rad] or [m]
_LEAST_GAIN = 0.5  # of the score, that a zero must bring
_FLOOR = 3e-4  # [s] what the model's step leaves undecided about a delay
_EXPLAINED = 0.3  # J that a hypothesis must reach at every joint to be proposed
_MOST, _LEAST = 1500, 60  # instants that are looked at


@dataclass(frozen=True)
class Wiring:
    """What the channels of a log are.

    Attributes:
        wires: by channel, what it should be read from, for those that are not what they are called.
        delay: how much later than stamped the controls act, in [s]; 0 where that is not certain.
        delays: one row a control: control, delay [ms], sigma [ms].
        balance: one row a joint: joint, before and after (J, see balance.py), used.
        flags: what was found, in words.
    """

    wires: Mapping[str, Wire]
    delay: float
    delays: pd.DataFrame
    balance: pd.DataFrame
    flags: tuple[Flag, ...]


def find_wiring(
    model: mujoco.MjModel, recordings: Sequence[Recording], laws: Laws | None = None
) -> Wiring:
    """Find out what the channels of some recordings are.

    Args:
        model: the compiled nominal model; it is not changed.
        recordings: as read with the study's column rules.
        laws: by actuator, the law that computes its control and the channels that it reads.
    """
    scalar = (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE))
    positions = [f"qpos.{model.joint(j).name}" for j in range(model.njnt)]
    measured = [n for n in positions if all(n in r.channels for r in recordings)]
    if not all(int(t) in scalar for t in model.jnt_type) or not measured:
        return _untested("a joint is neither a hinge nor a slide, or none was recorded")
    traces = Traces(recordings, measured, _MOST)
    if traces.count < _LEAST:
        return _untested("the recordings are too short")
    model = copy.copy(model)
    for joint in beyond_range(model, recordings):  # its stops did not act
        model.jnt_limited[model.joint(joint).id] = 0
    coarse = Evidence(copy.copy(model), traces, laws=laws)
    fine = Evidence(copy.copy(model), traces, _MOST, laws)
    before = fine.identity()
    found, twins = _searched(coarse, fine)
    found, late = _timed(fine, found)
    speeds, alike = speed_wires(traces, found, sorted(fine.hinges))
    wires = {n: w for n, w in {**found.wires, **speeds}.items() if not w.plain(n)}
    told = {n: e for n, e in late.items() if _joint(fine, n) not in _doubted(fine, found)}
    delay = _common(told)
    certain = max(_LATE, _SURE * delay.sigma) < abs(delay.value) < LATEST
    balance = _balance(fine, before, found)
    table = pd.DataFrame(
        {
            "control": list(late),
            "delay": [1e3 * e.value for e in late.values()],
            "sigma": [1e3 * e.sigma for e in late.values()],
        }
    )
    value = delay.value if certain else 0.0
    gives = motors.in_words(fine, found, recordings)
    flags = [*wire_flags(wires, balance, gives), *clock_flags(value, delay, told)]
    flags += [*twin_flags(twins), *speed_flags(alike), *balance_flags(balance)]
    return Wiring(wires, value, table, balance, tuple(flags))


def _untested(reason: str) -> Wiring:
    flag = Flag("note", "balance", (), f"The wiring was not tested against the model: {reason}.")
    empty = pd.DataFrame({"control": [], "delay": [], "sigma": []})
    balance = pd.DataFrame({"joint": [], "before": [], "after": [], "used": []})
    return Wiring({}, 0.0, empty, balance, (flag,))


def _balance(evidence: Evidence, before: Hypothesis, after: Hypothesis) -> pd.DataFrame:
    """Return J of each joint under two hypotheses, and whether it counts."""
    shares = [evidence.shares(h, [h.delay])[0] for h in (before, after)]
    used = evidence.weights > 0
    return pd.DataFrame(
        {"joint": evidence.joints, "before": shares[0], "after": shares[1], "used": used}
    )


def _searched(coarse: Evidence, fine: Evidence) -> tuple[Hypothesis, tuple[Hypothesis, ...]]:
    """Return the hypothesis that is believed, with its zeros, and what may be instead."""
    tried, twins = search(coarse)
    tried = motors.refined(fine, tried)
    found = _believed(fine, tried)
    if found.wires != tried.wires:
        twins = (tried,)
    found, _ = _timed(fine, found)
    found, _ = _timed(fine, _zeroed(fine, found))
    return motors.refined(fine, found), twins


def _timed(evidence: Evidence, h: Hypothesis) -> tuple[Hypothesis, Mapping[str, estimate.Estimate]]:
    """Return the hypothesis at the delay that its controls agree on, and the delay of each."""
    controls = [n for n in sorted(evidence.inputs) if _telling(evidence, n)]
    late = {n: estimate.delay(evidence, h, n) for n in controls}
    return (replace(h, delay=_common(late).value) if late else h), late


def _believed(evidence: Evidence, h: Hypothesis) -> Hypothesis:
    """Return the hypothesis without what it changes at joints that it does not explain.

    What leaves much at any joint is no more than a try, and nothing of it is believed.
    """
    while changed := {n for n, w in h.wires.items() if not w.plain(n)}:
        if _doubted(evidence, h, _EXPLAINED):
            return evidence.identity()
        doubted = _doubted(evidence, h)
        if not (out := {n for n in changed if _joint(evidence, n) in doubted}):
            break
        h = replace(
            h, wires={n: Wire(n) if n in _linked(h, out) else w for n, w in h.wires.items()}
        )
    return h


def _doubted(evidence: Evidence, h: Hypothesis, most: float = SUSPICIOUS) -> set[str]:
    """Return the joints of which a hypothesis leaves more than a share unexplained."""
    shares = evidence.shares(h, [h.delay])[0]
    bad = (shares > most) & (evidence.weights > 0)
    return {j for j, doubted in zip(evidence.joints, bad, strict=True) if doubted}


def _joint(evidence: Evidence, name: str) -> str:
    """Return the joint that a position or a control is about."""
    return evidence.driven(name) if name in evidence.inputs else name.removeprefix("qpos.")


def _linked(h: Hypothesis, names: set[str]) -> set[str]:
    """Return channels with all that were exchanged with them."""
    while True:
        sources = {h.wires[n].source for n in names}
        more = names | {n for n, w in h.wires.items() if n in sources or w.source in names}
        if more == names:
            return names
        names = more


def _telling(evidence: Evidence, control: str) -> bool:
    """Whether a control drives a joint whose balance is known."""
    return bool(evidence.driven(control) and evidence.weights[evidence.dof(control)] > 0)


def _common(late: Mapping[str, estimate.Estimate]) -> estimate.Estimate:
    """Return the weighted mean of the delays, without those far from their median."""
    if not late:
        return estimate.Estimate(0.0, np.inf)
    values = np.array([e.value for e in late.values()])
    sigmas = np.hypot([e.sigma for e in late.values()], _FLOOR)
    middle = _weighted_median(values, 1 / sigmas)
    near = np.abs(values - middle) <= np.maximum(3 * sigmas, 1e-3)
    weight = 1 / sigmas[near] ** 2
    return estimate.Estimate(
        float(weight @ values[near] / weight.sum()), float(weight.sum() ** -0.5)
    )


def _weighted_median(values: np.ndarray, weight: np.ndarray) -> float:
    order = np.argsort(values)
    share = np.cumsum(weight[order]) / weight.sum()
    return float(values[order][np.searchsorted(share, 0.5)])


def _zeroed(evidence: Evidence, h: Hypothesis) -> Hypothesis:
    """Return the hypothesis with encoder zeros refined, and new ones where they are certain."""
    for _ in range(len(evidence.joints)):
        best, gain = h, _LEAST_GAIN
        now = evidence.scores(h, [h.delay])[0]
        for names, _ in zero_groups(evidence, h):
            known = any(h.wires[n].offset for n in names)
            moved = estimate.zero(evidence, h, names)
            if not abs(moved.value) > max(_SURE_ZERO * moved.sigma, 0.0 if known else _LEAST_ZERO):
                continue
            trial, _ = _timed(evidence, estimate.with_zero(h, names, moved.value))
            if not known and _doubted(evidence, trial) & {_joint(evidence, n) for n in names}:
                continue
            better = now - evidence.scores(trial, [trial.delay])[0]
            if better > gain or (known and better > 0.02):
                best, gain = trial, max(better, gain)
        if best is h:
            break
        h = best
    return h

"""The wiring of a log: what each channel really is, when the controls act, and how sure that is."""

import copy
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import mujoco
import numpy as np
import pandas as pd
from jaxtyping import Float

from bo_sysid.checks import estimate, motors
from bo_sysid.checks.beginning import by_ranges
from bo_sysid.checks.clocks import clock_flags, clock_of, least_delay
from bo_sysid.checks.comparable import as_acting, comparable
from bo_sysid.checks.evidence import FLOOR, Laws, WiringEvidence
from bo_sysid.checks.flags import Flag
from bo_sysid.checks.hypothesis import Wire, WiringHypothesis
from bo_sysid.checks.limits import unlimited
from bo_sysid.checks.loads import without_loads
from bo_sysid.checks.moves import zero_groups
from bo_sysid.checks.rates import rate_flags
from bo_sysid.checks.score import MARGIN
from bo_sysid.checks.search import SUSPICIOUS, search
from bo_sysid.checks.speeds import speed_wires
from bo_sysid.checks.traces import LATEST, Traces, interval
from bo_sysid.checks.wiring_text import (
    balance_flags,
    noise_flags,
    not_tested,
    open_flags,
    speed_flags,
    twin_flags,
    untested_flags,
    wire_flags,
)
from bo_sysid.execution import OnProgress, silent
from bo_sysid.recording import Recording

_SURE_ZERO = 6.0  # standard deviations that a zero must differ from nothing
_LEAST_ZERO = 0.015  # [rad] or [m]
_LEAST_GAIN = 0.5  # of the score, that a zero must bring
_EXPLAINED = 0.3  # J that a hypothesis must reach at every joint to be proposed
_FINE = 0.5e-3  # [s] between the delays at which the model is asked
_HALVED = 0.5  # of what stays unexplained as stamped: a delay must leave less
_LITTLE = 0.005  # J that is not to be lessened
_MOST = 1500  # instants that are looked at


@dataclass(frozen=True)
class Wiring:
    """What the channels of a log are.

    Attributes:
        wires: by channel, what it should be read from, for those that are not what they are called.
        delay: how much later than stamped the controls act, in [s]; 0 where that is not certain.
        sigma: standard deviation of that delay, in [s].
        half_early: whether that delay is what is due to controls that change between samples.
        delays: one row a control: control, delay [ms], sigma [ms].
        balance: one row a joint: joint, before and after (J, see balance.py) and how much of
            J is noise of the motion, which `after` is without; used.
        flags: what was found, in words.
    """

    wires: Mapping[str, Wire]
    delay: float
    sigma: float
    half_early: bool
    delays: pd.DataFrame
    balance: pd.DataFrame
    flags: tuple[Flag, ...]


def find_wiring(
    model: mujoco.MjModel,
    recordings: Sequence[Recording],
    laws: Laws | None = None,
    progress: OnProgress = silent,
) -> Wiring:
    """Find out what the channels of some recordings are.

    Args:
        model: the compiled nominal model; it is not changed.
        recordings: as read with the study's column rules.
        laws: by actuator, the law that computes its control and the channels that it reads.
        progress: is called while other wirings are tried, which may take a minute.
    """
    made = _comparable(model, recordings, laws)
    if isinstance(made, str):
        return _untested(made, rate_flags(model, recordings))
    free, traces = made
    coarse, fine = (
        WiringEvidence(copy.copy(free), traces, laws=laws),
        WiringEvidence(free, traces, _MOST, laws),
    )
    before = fine.identity()
    first = by_ranges(fine, model, recordings)
    found, twins = _searched(coarse, fine, first, progress)
    found, loads = without_loads(fine, found, first)
    found, late = _timed(fine, found)
    noise = fine.noise(found)
    left = _left(fine, found, late, noise)
    speeds, correlations = speed_wires(traces, found, sorted(fine.hinges))
    wires = {n: w for n, w in {**found.wires, **speeds}.items() if not w.plain(n)}
    explained = {n: e for n, e in late.items() if left[fine.dof(n)] <= SUSPICIOUS}
    sampling = interval(recordings, traces.measured)
    clock = clock_of(explained, least_delay(sampling, model.opt.timestep), sampling)
    stamped = fine.shares(before, [before.delay])[0]
    balance = pd.DataFrame(
        {
            "joint": fine.joints,
            "before": stamped,
            "after": left,
            "noise": noise,
            "used": fine.weights > 0,
        }
    )
    table = pd.DataFrame(
        {
            "control": list(late),
            "delay": [1e3 * e.value for e in late.values()],
            "sigma": [1e3 * e.sigma for e in late.values()],
        }
    )
    gives = motors.in_words(fine, found, recordings)
    flags = [*wire_flags(wires, balance, gives), *loads, *clock_flags(clock, explained)]
    flags += [*twin_flags(twins), *speed_flags(correlations), *balance_flags(balance, fine.still)]
    flags += [*noise_flags(balance), *open_flags(fine, found), *untested_flags(fine)]
    return Wiring(
        wires, clock.delay, clock.common.sigma, clock.half_early, table, balance, tuple(flags)
    )


def _comparable(
    model: mujoco.MjModel, recordings: Sequence[Recording], laws: Laws | None
) -> tuple[mujoco.MjModel, Traces] | str:
    """Return what is compared, see `comparable`; with commands clipped where that explains more.

    In another unit as well they may leave their range, and are not clipped. Forces are within the
    model's limits, but where they explain far more without.
    """
    acting = as_acting(model, recordings)
    choices = []
    for logs in (recordings, *([acting] if acting else [])):
        made = comparable(model, logs, _MOST)
        if isinstance(made, str):
            return made
        choices.append(made)
    for free, traces in tuple(choices):
        if (strong := unlimited(free)) is not None:
            choices.append((strong, traces))
    best = choices[0]
    least = _score(best, laws) if len(choices) > 1 else 0.0
    for choice in choices[1:]:
        if (score := _score(choice, laws)) < least - MARGIN:
            best, least = choice, score
    return best


def _score(choice: tuple[mujoco.MjModel, Traces], laws: Laws | None) -> float:
    """Return the score of a log as it is; see `WiringEvidence`."""
    evidence = WiringEvidence(copy.copy(choice[0]), choice[1], laws=laws)
    h = evidence.identity()
    return float(evidence.scores(h, [h.delay])[0])


def _untested(reason: str, rates: tuple[Flag, ...]) -> Wiring:
    empty = pd.DataFrame({"control": [], "delay": [], "sigma": []})
    balance = pd.DataFrame({"joint": [], "before": [], "after": [], "noise": [], "used": []})
    return Wiring({}, 0.0, np.inf, False, empty, balance, (not_tested(reason), *rates))


def _left(
    evidence: WiringEvidence,
    h: WiringHypothesis,
    late: Mapping[str, estimate.Estimate],
    noise: Float[np.ndarray, " nv"],
) -> Float[np.ndarray, " nv"]:
    """Return J of each degree of freedom but for noise, with its own control as late as it acts."""
    left = evidence.shares(h, [h.delay])[0].copy()
    for name, e in late.items():
        j = evidence.dof(name)
        left[j] = min(left[j], evidence.shares(h, [e.value])[0, j])
    return np.asarray(np.maximum(left - noise, 0.0))


def _searched(
    coarse: WiringEvidence, fine: WiringEvidence, first: WiringHypothesis, progress: OnProgress
) -> tuple[WiringHypothesis, tuple[WiringHypothesis, ...]]:
    """Return the hypothesis that is believed, with its zeros, and what may be instead."""
    tried, twins = search(coarse, first, progress)
    tried = motors.refined(fine, tried)
    found = _believed(fine, tried, first)
    if found.wires != tried.wires:
        twins = (tried,)
    found, _ = _timed(fine, found)
    found, _ = _timed(fine, _zeroed(fine, found))
    return motors.refined(fine, found), twins


def _timed(
    evidence: WiringEvidence, h: WiringHypothesis
) -> tuple[WiringHypothesis, Mapping[str, estimate.Estimate]]:
    """Return the hypothesis at the delay that its controls agree on, and the delay of each."""
    controls = [n for n in sorted(evidence.inputs) if _drives_known_joint(evidence, n)]
    late = {
        n: _moved_where_clearly_better(evidence, h, n, estimate.delay(evidence, h, n))
        for n in controls
    }
    return (replace(h, delay=clock_of(late).common.value) if late else h), late


def _moved_where_clearly_better(
    evidence: WiringEvidence, h: WiringHypothesis, control: str, e: estimate.Estimate
) -> estimate.Estimate:
    """Return a delay, moved to where the model explains its joint's forces far better, if anywhere.

    The regression behind a delay lets masses be anything, less than nothing as well: to a servo
    of speed, which follows its command closely, a joint that lacks inertia is one that is late.
    Looked at are the delays within two deviations, or all where the model explains nothing at this
    one. The deviation grows by as much as the delay is moved, and covers none where the delay
    hardly lessens what stays unexplained: dry friction that sticks is not all in the regression.
    """
    if not np.isfinite(e.sigma):
        return e
    j = evidence.dof(control)
    left, stamped = evidence.shares(h, [e.value, 0.0])[:, j]
    reach = min(LATEST if left > SUSPICIOUS else 2 * e.sigma, LATEST)
    tried = e.value + _FINE * np.arange(-int(reach / _FINE), int(reach / _FINE) + 1)
    shares = evidence.shares(h, tried.tolist())[:, j]
    best = int(np.argmin(shares))
    if shares[best] > SUSPICIOUS or np.log((left + FLOOR) / (shares[best] + FLOOR)) < MARGIN:
        helps = left <= stamped and left < max(_HALVED * stamped, _LITTLE)
        return e if helps else replace(e, sigma=float(np.hypot(e.sigma, e.value)))
    moved = float(tried[best])
    return estimate.Estimate(moved, float(np.hypot(e.sigma, e.value - moved)))


def _believed(
    evidence: WiringEvidence, h: WiringHypothesis, first: WiringHypothesis
) -> WiringHypothesis:
    """Return the hypothesis without what it changes at joints that it does not explain.

    What leaves much at any joint is no more than a try, and nothing of it is believed: that is
    the first hypothesis then.
    """
    while changed := {n for n, w in h.wires.items() if w != first.wires[n]}:
        if _doubted(evidence, h, _EXPLAINED):
            return first
        doubted = _doubted(evidence, h)
        if not (out := {n for n in changed if _joint(evidence, n) in doubted}):
            break
        h = replace(
            h, wires={n: first.wires[n] if n in _linked(h, out) else w for n, w in h.wires.items()}
        )
    return h


def _doubted(evidence: WiringEvidence, h: WiringHypothesis, most: float = SUSPICIOUS) -> set[str]:
    """Return the joints of which a hypothesis leaves more than a share unexplained."""
    shares = evidence.shares(h, [h.delay])[0]
    bad = (shares > most) & (evidence.weights > 0)
    return {j for j, doubted in zip(evidence.joints, bad, strict=True) if doubted}


def _joint(evidence: WiringEvidence, name: str) -> str:
    """Return the joint that a position or a control is about."""
    return evidence.driven(name) if name in evidence.inputs else name.removeprefix("qpos.")


def _linked(h: WiringHypothesis, names: set[str]) -> set[str]:
    """Return channels with all that were exchanged with them."""
    while True:
        sources = {h.wires[n].source for n in names}
        more = names | {n for n, w in h.wires.items() if n in sources or w.source in names}
        if more == names:
            return names
        names = more


def _drives_known_joint(evidence: WiringEvidence, control: str) -> bool:
    """Whether a control drives a joint whose balance is known."""
    return bool(evidence.driven(control) and evidence.weights[evidence.dof(control)] > 0)


def _zeroed(evidence: WiringEvidence, h: WiringHypothesis) -> WiringHypothesis:
    """Return the hypothesis with encoder zeros refined, and new ones where they are certain."""
    for _ in range(len(evidence.joints)):
        best, gain = h, _LEAST_GAIN
        now = evidence.scores(h, [h.delay])[0]
        for names, _ in zero_groups(evidence, h):
            known = any(h.wires[n].offset and not h.wires[n].centred for n in names)
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

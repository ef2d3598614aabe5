"""Which channel is which: the hypothesis about signs, units and order that a log supports best.

The search starts from the log as it is and adds one fault at a time, keeping the few best. A fault
is believed where it lowers the score by `MARGIN` and nothing simpler does as well.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import combinations
from math import pi
from operator import itemgetter

import numpy as np
from scipy.optimize import linear_sum_assignment, minimize_scalar

from bo_sysid.checks.estimate import with_zero
from bo_sysid.checks.evidence import WiringEvidence
from bo_sysid.checks.hypothesis import (
    ANGLES,
    FREE,
    INPUTS,
    LENGTHS,
    UNDONE,
    Units,
    Wire,
    WiringHypothesis,
)
from bo_sysid.checks.motors import scaled
from bo_sysid.checks.speeds import moving
from bo_sysid.execution import OnProgress, Progress, silent

SUSPICIOUS = 0.08
"""J of a degree of freedom from which on its channels are doubted."""
MARGIN = 0.8
"""Least gain of the score per fault."""
_BEYOND_DOUBT = 3.0  # gain of the score by a sign where nothing is doubted: a twentieth is left
_FITTED = 0.3  # of the score, that a fitted constant costs beside: a known unit comes first
_TIE = 0.05  # of the score, within which two hypotheses are alike
_SPARED = 0.1  # of the score, that a change which is not needed may bring
_STEPS = (0.012, 0.002, 0.0003)  # [s] of the delays tried; a stiff servo tells 0.3 ms
_REACH = 9  # steps to either side
_DELAYS = tuple(_STEPS[0] * np.arange(-_REACH, _REACH + 1))
_BEAM, _WIDE, _FEW = 3, 10, 3  # hypotheses that are followed; more for so few joints
_MOST = 4  # faults at once


def search(
    evidence: WiringEvidence, first: WiringHypothesis, progress: OnProgress = silent
) -> tuple[WiringHypothesis, tuple[WiringHypothesis, ...]]:
    """Return the hypothesis that the recordings support, with the fewest faults, and its twins.

    Twins are others with as many faults that the recordings support as well: those of a machine
    that is its own mirror image, for instance.

    Args:
        evidence: the recordings.
        first: what is supposed before any fault.
        progress: is called with each number of faults that is tried.
    """
    twins: tuple[WiringHypothesis, ...] = ()
    width = _WIDE if len(evidence.joints) <= _FEW else _BEAM
    best = _timed(evidence, first)
    if not _doubtful(evidence, best[1]):
        best = _turned(evidence, best)
    seen = {best[1].key}
    beam = [best]
    for fault in range(_MOST):
        if not _doubtful(evidence, best[1]):
            break
        grown = []
        for _, parent in beam:
            for child in moves(evidence, parent):
                if child.key not in seen:
                    seen.add(child.key)
                    grown.append(_timed(evidence, child))
                    text = f"{len(seen)} wirings tried, since the forces are not explained"
                    progress(Progress(fault + 1, _MOST + 1, text))
        beam = sorted(grown, key=lambda pair: pair[0])[:width]
        if not beam:
            break
        if beam[0][0] < best[0]:
            best = beam[0]
            twins = tuple(h for score, h in beam[1:] if score < best[0] + _TIE)
        elif len(beam[0][1].causes) > len(best[1].causes) + 1:
            break  # two faults more did not help either
    return _pruned(evidence, best[1], first), twins


def _timed(
    evidence: WiringEvidence, hypothesis: WiringHypothesis
) -> tuple[float, WiringHypothesis]:
    """Return score (faults paid for) and hypothesis, at the delay of the controls that suits."""
    best, delay = np.inf, 0.0
    for step in _STEPS:
        delays = np.append(delay + step * np.arange(-_REACH, _REACH + 1), 0.0)
        scores = evidence.scores(hypothesis, delays.tolist()) + MARGIN * (delays != 0.0)
        k = int(np.argmin(scores))
        if scores[k] < best:
            best, delay = float(scores[k]), float(delays[k])
    return best + _paid(evidence, hypothesis), replace(hypothesis, delay=delay)


def _turned(
    evidence: WiringEvidence, best: tuple[float, WiringHypothesis]
) -> tuple[float, WiringHypothesis]:
    """Return score and hypothesis with other signs or bases that explain forces much better yet.

    Where gravity is most of what motors bear, a turned sign leaves a few per cent of the forces:
    little enough for missing physics, but a hundred times what the right one leaves.
    """
    for _ in range(_MOST):
        others = (*_signs(best[1]), *_absolute(evidence, best[1]))
        turned = min((_timed(evidence, h) for h in others), key=itemgetter(0))
        if turned[0] > best[0] - _BEYOND_DOUBT:
            break
        best = turned
    return best


def _paid(evidence: WiringEvidence, hypothesis: WiringHypothesis) -> float:
    """Return what the faults of a hypothesis cost."""
    # a command's sign is likelier wrong than an encoder's, where both say the same
    turned = sum(w.sign < 0 and n not in evidence.inputs for n, w in hypothesis.wires.items())
    fitted = sum(w.unit == FREE for w in hypothesis.wires.values())
    return MARGIN * len(hypothesis.causes) + 0.1 * _TIE * turned + _FITTED * fitted


def _doubtful(evidence: WiringEvidence, hypothesis: WiringHypothesis) -> bool:
    """Whether a joint's forces are not explained, however late its own control may act."""
    shares = evidence.shares(hypothesis, [hypothesis.delay, *_DELAYS]).min(axis=0)
    if (shares * evidence.weights > SUSPICIOUS).any():
        shares -= evidence.noise(hypothesis)
    return bool((shares * evidence.weights > SUSPICIOUS).any())


def _pruned(
    evidence: WiringEvidence, hypothesis: WiringHypothesis, first: WiringHypothesis
) -> WiringHypothesis:
    """Return the hypothesis without channels whose change it does not need."""
    delay = hypothesis.delay
    most = evidence.scores(hypothesis, [delay])[0] + _SPARED
    for name, wire in sorted(hypothesis.wires.items()):
        if wire.source == name and wire != first.wires[name]:
            simpler = replace(hypothesis, wires={**hypothesis.wires, name: first.wires[name]})
            if evidence.scores(simpler, [delay])[0] < most:
                hypothesis = simpler
    return hypothesis


def moves(evidence: WiringEvidence, h: WiringHypothesis) -> Iterator[WiringHypothesis]:
    """Yield hypotheses with one more fault."""
    yield from _signs(h)
    yield from _units(evidence, h)
    yield from scaled(evidence, h, _DELAYS)
    yield from _orders(evidence, h)
    yield from _confusions(evidence, h)
    yield from _absolute(evidence, h)
    yield from _zeros(evidence, h)


def _signs(h: WiringHypothesis) -> Iterator[WiringHypothesis]:
    for name, wire in h.wires.items():
        turned = replace(wire, sign=-wire.sign, offset=0.0 - wire.offset)
        yield h.with_wires({name: turned}, f"sign of {name}")


def _units(evidence: WiringEvidence, h: WiringHypothesis) -> Iterator[WiringHypothesis]:
    """Yield other units of one channel, and of all channels that one logger writes alike."""
    for names, unit, factor in dict.fromkeys(_other_units(evidence, h)):
        wires = {
            n: replace(h.wires[n], scale=h.wires[n].scale * factor, unit=unit)
            for n in names
            if not h.wires[n].unit
        }
        if wires:
            yield h.with_wires(wires, f"unit of {', '.join(wires)}: {unit}")


def _other_units(
    evidence: WiringEvidence, h: WiringHypothesis
) -> Iterator[tuple[tuple[str, ...], str, float]]:
    """Yield channels with a unit that they may be in, and the factor to SI from what they are.

    What was converted already is in no other unit than the stated one, or in none: of a balancer
    whose place was not recorded, degrees converted twice explained more than once.
    """
    turning = [f"qpos.{j}" for j in evidence.joints if j in evidence.hinges]
    turning = [n for n in turning if n in h.wires]
    sliding = [n for n in h.wires if n.startswith("qpos.") and n not in turning]
    servos = [n for n in sorted(evidence.inputs) if evidence.servo(n)]
    motors = [n for n in sorted(evidence.inputs) if n not in servos]
    goals = [n for n in servos if evidence.driven(n) in evidence.hinges]
    groups: list[tuple[Sequence[str], Units]] = [
        (turning, ANGLES), (goals, ANGLES), ([*turning, *goals], ANGLES),
        (sliding, LENGTHS), (motors, INPUTS),
    ]  # fmt: skip
    groups += [([n], ANGLES) for n in (*turning, *goals)]
    groups += [([n], LENGTHS) for n in sliding] + [([n], INPUTS) for n in motors]
    for names, units in groups:
        plain = tuple(n for n in names if h.wires[n].source not in evidence.converted)
        yield from ((plain, unit, factor) for unit, factor in units)
        for si, back in UNDONE.items():
            stated = tuple(n for n in names if evidence.stated[h.wires[n].source] == si)
            yield from ((stated, unit, factor) for unit, factor in back)


def _orders(evidence: WiringEvidence, h: WiringHypothesis) -> Iterator[WiringHypothesis]:
    """Yield exchanges of two channels of a kind, and the orders that the data propose."""
    positions = [n for n in h.wires if n not in evidence.inputs]
    for kind, names in (("qpos", positions), ("ctrl", sorted(evidence.inputs))):
        for a, b in combinations(names, 2):
            yield h.with_wires({a: h.wires[b], b: h.wires[a]}, f"order of {kind}")
    for kind, order in (("ctrl", _control_order(evidence, h)), ("qpos", _joint_order(evidence, h))):
        if order:
            yield h.with_wires(order, f"order of {kind}")


def _control_order(evidence: WiringEvidence, h: WiringHypothesis) -> Mapping[str, Wire]:
    """Return the order of the controls that balances the degrees of freedom best."""
    names = [n for n in h.wires if n in evidence.inputs and evidence.driven(n)]
    if len(names) < 3:
        return {}
    cost = np.empty((len(names), len(names)))
    for k, other in enumerate(names):
        trial = replace(h, wires={**h.wires, **dict.fromkeys(names, h.wires[other])})
        shares = evidence.shares(trial, _DELAYS).min(axis=0)
        cost[:, k] = [np.log(shares[evidence.dof(n)] + 1e-3) for n in names]
    return _assigned(h, names, names, cost)


def _joint_order(evidence: WiringEvidence, h: WiringHypothesis) -> Mapping[str, Wire]:
    """Return the order of the positions that follows the servos' goals best."""
    pairs = [(f"qpos.{evidence.driven(n)}", n) for n in h.wires if n in evidence.inputs]
    pairs = [(q, u) for q, u in pairs if q in h.wires and evidence.servo(u)]
    if len(pairs) < 3:
        return {}
    joints, goals = [q for q, _ in pairs], [u for _, u in pairs]
    cost = np.zeros((len(pairs), len(pairs)))
    for delay in _DELAYS:
        u = [evidence.traces.column(h.wires[n].source, held=True, delay=delay) for n in goals]
        q = [evidence.traces.column(h.wires[n].source, held=False) for n in joints]
        with np.errstate(divide="ignore", invalid="ignore"):  # a constant follows nothing
            correlation = np.corrcoef(np.array(u), np.array(q))[: len(u), len(u) :]
        cost = np.minimum(cost, -np.abs(np.nan_to_num(correlation)))
    return _assigned(h, joints, joints, cost)


def _assigned(
    h: WiringHypothesis, names: Sequence[str], sources: Sequence[str], cost: np.ndarray
) -> Mapping[str, Wire]:
    rows, columns = linear_sum_assignment(cost)
    if (rows == columns).all():
        return {}
    pairs = zip(rows.tolist(), columns.tolist(), strict=True)
    return {names[r]: h.wires[sources[c]] for r, c in pairs if r != c}


def _confusions(evidence: WiringEvidence, h: WiringHypothesis) -> Iterator[WiringHypothesis]:
    """Yield exchanges of commands and positions, of one joint and of all."""
    pairs = [(f"qpos.{evidence.driven(n)}", n) for n in h.wires if n in evidence.inputs]
    pairs = [(q, u) for q, u in pairs if q in h.wires]
    groups = [[p] for p in pairs] + ([pairs] if len(pairs) > 1 else [])
    for group in groups:
        wires: dict[str, Wire] = {}
        for q, u in group:
            wires |= {q: h.wires[u], u: h.wires[q]}
        yield h.with_wires(wires, "commands and positions swapped")


def _absolute(evidence: WiringEvidence, h: WiringHypothesis) -> Iterator[WiringHypothesis]:
    """Yield encoders that count from the base, and show the joint that carries theirs as well."""
    for joint, carrier in evidence.carriers.items():
        name, other = f"qpos.{joint}", f"qpos.{carrier}"
        if name in h.wires and other in h.wires and not h.wires[name].less:
            cause = f"{name} shows {other} as well"
            yield h.with_wires({name: replace(h.wires[name], less=other)}, cause)


def _zeros(evidence: WiringEvidence, h: WiringHypothesis) -> Iterator[WiringHypothesis]:
    """Yield encoders with another zero; the goal of a servo may or may not move along."""
    for names, starts in zero_groups(evidence, h):
        cause = f"zero of {', '.join(names)}"
        timed = [
            _timed(evidence, replace(with_zero(h, names, o), causes=(*h.causes, cause)))
            for o in starts
        ]
        _, first = min(timed, key=lambda pair: pair[0])
        score = _score_of_zero(evidence, first, names)
        width = 0.5 * abs(starts[1] - starts[0]) if len(starts) > 1 else 0.1
        found = minimize_scalar(
            score, bounds=(-width, width), method="bounded", options={"maxiter": 12}
        )
        yield with_zero(first, names, float(found.x))


def _score_of_zero(
    evidence: WiringEvidence, h: WiringHypothesis, names: Sequence[str]
) -> Callable[[float], float]:
    return lambda o: float(evidence.scores(with_zero(h, names, float(o)), [h.delay])[0])


def zero_groups(
    evidence: WiringEvidence, h: WiringHypothesis
) -> Iterator[tuple[tuple[str, ...], Sequence[float]]]:
    """Yield channels whose zeros may be wrong together, each with values to start from."""
    turn = [k * pi / 6 for k in range(-5, 7)]
    for joint in evidence.joints:
        position = f"qpos.{joint}"
        servos = [n for n in h.wires if n in evidence.inputs and evidence.servo(n)]
        servos = [n for n in servos if evidence.driven(n) == joint]
        if position not in h.wires:
            continue
        held = servos and not moving(evidence.traces, position)  # and where, a brake may say
        for servo in () if held else servos:  # it rests where it is told to, but for its load
            rest = float(np.mean(evidence.value(h, servo, held=True) - evidence.value(h, position)))
            yield (position,), (rest,)
            yield (servo,), (-rest,)
        if joint in evidence.hinges:
            yield (position, *servos), turn

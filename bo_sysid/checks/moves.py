"""The faults that a log's wiring may have: hypotheses with one more than another."""

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
    CENTRED,
    COUNTED,
    INPUTS,
    LENGTHS,
    UNDONE,
    Units,
    Wire,
    WiringHypothesis,
)
from bo_sysid.checks.motors import scaled
from bo_sysid.checks.score import DELAYS, timed
from bo_sysid.checks.speeds import moving


def moves(evidence: WiringEvidence, h: WiringHypothesis) -> Iterator[WiringHypothesis]:
    """Yield hypotheses with one more fault."""
    yield from signs(h)
    yield from _units(evidence, h)
    yield from scaled(evidence, h, DELAYS)
    yield from _orders(evidence, h)
    yield from _confusions(evidence, h)
    yield from absolute(evidence, h)
    yield from _zeros(evidence, h)
    yield from centres(evidence, h)


def signs(h: WiringHypothesis) -> Iterator[WiringHypothesis]:
    """Yield hypotheses with the sign of one channel turned."""
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
    turning, goals = _angles(evidence, h)
    sliding = [n for n in h.wires if n.startswith("qpos.") and n not in turning]
    motors = [n for n in sorted(evidence.inputs) if not evidence.servo(n)]
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


def _angles(evidence: WiringEvidence, h: WiringHypothesis) -> tuple[list[str], list[str]]:
    """Return the positions of hinges and the goals of servos that turn one."""
    turning = [f"qpos.{j}" for j in evidence.joints if j in evidence.hinges]
    goals = [n for n in sorted(evidence.inputs) if evidence.servo(n)]
    goals = [n for n in goals if evidence.driven(n) in evidence.hinges]
    return [n for n in turning if n in h.wires], goals


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
        shares = evidence.shares(trial, DELAYS).min(axis=0)
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
    for delay in DELAYS:
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


def absolute(evidence: WiringEvidence, h: WiringHypothesis) -> Iterator[WiringHypothesis]:
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
        changed = (replace(with_zero(h, names, o), causes=(*h.causes, cause)) for o in starts)
        _, first = min((timed(evidence, g) for g in changed), key=itemgetter(0))
        score = _score_of_zero(evidence, first, names)
        width = 0.5 * abs(starts[1] - starts[0]) if len(starts) > 1 else 0.1
        found = minimize_scalar(
            score, bounds=(-width, width), method="bounded", options={"maxiter": 12}
        )
        yield with_zero(first, names, float(found.x))


def centres(evidence: WiringEvidence, h: WiringHypothesis) -> Iterator[WiringHypothesis]:
    """Yield all angles counted from the middle of what their servos count, one fault.

    Such counts are never negative and end with the servo's turn, and work is done about the middle.
    """
    turning, goals = _angles(evidence, h)
    names = [*turning, *goals]
    values = [evidence.value(h, n, held=n in goals) for n in names]
    if len(turning) < 2 or any(h.wires[n].offset for n in names):
        return
    if any(v.min() < 0 for v in values):
        return
    middle = float(np.mean([v.mean() for v in values]))
    turn = min(COUNTED, key=lambda t: abs(middle - t / 2))
    if abs(middle - turn / 2) < turn / 8 and all(v.max() <= turn for v in values):
        yield replace(with_zero(h, names, -turn / 2), causes=(*h.causes, CENTRED))


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

"""A motor's constant: how much force one unit of its control gives, from the balance of forces.

A current in A or a duty is no torque, and no list of units holds its factor. The recordings tell
it as far as the model's masses are right.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from math import exp

import numpy as np

from bo_sysid.checks.balance import GAIN, free_gain
from bo_sysid.checks.evidence import WiringEvidence
from bo_sysid.checks.hypothesis import FREE, WiringHypothesis
from bo_sysid.recording import Recording

_TOLD = exp(-0.8)  # of what physics alone leaves, that a constant leaves at most


def scaled(
    evidence: WiringEvidence, h: WiringHypothesis, delays: Sequence[float]
) -> Iterator[WiringHypothesis]:
    """Yield hypotheses in which a motor, and all motors, have constants of their own.

    A constant below zero is a wrong sign beside it, and counts as one fault more.
    """
    found = {}
    for name in sorted(evidence.motors):
        wire = h.wires.get(name)
        if wire is None or wire.unit or not evidence.weights[evidence.dof(name)]:
            continue
        gain = _gain(evidence, h, name, delays)
        if gain and not GAIN[0] <= gain <= GAIN[1]:
            found[name] = gain
    for names in [*([n] for n in found), *([list(found)] if len(found) > 1 else [])]:
        yield _with_gains(h, {n: found[n] for n in names})


def told(evidence: WiringEvidence, delays: Sequence[float]) -> frozenset[str]:
    """Return the controls of motors of which the recordings tell what one unit gives.

    Of others friction or a rotor that the model lacks explains as much, whatever their constant is.
    """
    h = evidence.identity()
    known = [n for n in evidence.motors if evidence.weights[evidence.dof(n)]]
    return frozenset(n for n in known if _gain(evidence, h, n, delays))


def refined(evidence: WiringEvidence, h: WiringHypothesis) -> WiringHypothesis:
    """Return the hypothesis with the constants that suit its delay, of three digits."""
    for name, wire in h.wires.items():
        if wire.unit == FREE and name in evidence.motors:
            gain = max(_gain(evidence, h, name, [h.delay]), 0.0) or 1.0
            scale = float(f"{gain * wire.scale:.3g}")
            h = replace(h, wires={**h.wires, name: replace(wire, scale=scale)})
    return h


def in_words(
    evidence: WiringEvidence, h: WiringHypothesis, recordings: Sequence[Recording]
) -> Mapping[str, str]:
    """Return by channel what one unit gives, of those with a constant of their own."""
    sentences = {}
    for name, wire in h.wires.items():
        if wire.unit == FREE and name in evidence.motors:
            joint = evidence.driven(name)
            force = wire.scale * float(np.abs(_per_unit(evidence, h, name)).mean())
            unit = recordings[0].channels[wire.source].unit or "unit"
            what = "N m" if joint in evidence.hinges else "N"
            sentences[name] = f"one {unit} of {name} gives about {force:.3g} {what} at {joint}"
    return sentences


def _with_gains(h: WiringHypothesis, gains: Mapping[str, float]) -> WiringHypothesis:
    wires, turned = {}, []
    for name, gain in gains.items():
        wire = h.wires[name]
        sign = -1 if gain < 0 else 1
        turned += [f"sign of {name}"] if sign < 0 else []
        wires[name] = replace(wire, sign=sign * wire.sign, scale=abs(gain) * wire.scale, unit=FREE)
    constant = f"what one unit of {', '.join(gains)} gives"
    return replace(h, wires={**h.wires, **wires}, causes=(*h.causes, *turned, constant))


def _gain(
    evidence: WiringEvidence, h: WiringHypothesis, name: str, delays: Sequence[float]
) -> float:
    """Return the factor of a control at the delay that suits; 0 where physics does as well."""
    terms, j = evidence.terms(h), evidence.dof(name)
    per_unit, actuator = _per_unit(evidence, h, name), name.split(".", 1)[1]
    own = np.stack([per_unit * evidence.command(actuator, h, d) for d in delays])
    others = np.array([n != actuator for n in evidence.actuators])
    rest = np.stack([terms.actuated(evidence.controls(h, d) * others)[:, j] for d in delays])
    gain, left = free_gain(terms, j, own, rest)
    return gain if left < _TOLD else 0.0


def _per_unit(evidence: WiringEvidence, h: WiringHypothesis, name: str) -> np.ndarray:
    """Return the force along its joint that the model gives for one unit of a control."""
    terms, a = evidence.terms(h), evidence.actuators.index(name.split(".", 1)[1])
    return np.asarray(terms.gain[:, a] * terms.moment[:, a, evidence.dof(name)])

"""What a hypothesis about the wiring scores, with its faults paid for."""

from dataclasses import replace

import numpy as np

from bo_sysid.checks.evidence import WiringEvidence
from bo_sysid.checks.hypothesis import CENTRED, FREE, WiringHypothesis

MARGIN = 0.8
"""Least gain of the score per fault."""
TIE = 0.05
"""Of the score, within which two hypotheses are alike."""
_FITTED = 0.3  # of the score, that a fitted constant costs beside: a known unit comes first
_USUAL = 0.25  # of a fault, that counting from one end is: servos of a kind all do
_STEPS = (0.012, 0.002, 0.0003)  # [s] of the delays tried; a stiff servo tells 0.3 ms
_REACH = 9  # steps to either side
DELAYS = tuple(_STEPS[0] * np.arange(-_REACH, _REACH + 1))
"""Delays of controls that are tried first, in [s]."""


def timed(evidence: WiringEvidence, hypothesis: WiringHypothesis) -> tuple[float, WiringHypothesis]:
    """Return score (faults paid for) and hypothesis, at the delay of the controls that suits."""
    best, delay = np.inf, 0.0
    for step in _STEPS:
        delays = np.append(delay + step * np.arange(-_REACH, _REACH + 1), 0.0)
        scores = evidence.scores(hypothesis, delays.tolist()) + MARGIN * (delays != 0.0)
        k = int(np.argmin(scores))
        if scores[k] < best:
            best, delay = float(scores[k]), float(delays[k])
    return best + _paid(evidence, hypothesis), replace(hypothesis, delay=delay)


def _paid(evidence: WiringEvidence, hypothesis: WiringHypothesis) -> float:
    """Return what the faults of a hypothesis cost."""
    # a command's sign is likelier wrong than an encoder's, where both say the same
    turned = sum(w.sign < 0 and n not in evidence.inputs for n, w in hypothesis.wires.items())
    fitted = sum(w.unit == FREE for w in hypothesis.wires.values())
    faults = len(hypothesis.causes) - (1 - _USUAL) * (CENTRED in hypothesis.causes)
    return MARGIN * faults + 0.1 * TIE * turned + _FITTED * fitted

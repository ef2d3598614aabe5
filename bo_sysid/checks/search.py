"""Which channel is which: the hypothesis about signs, units and order that a log supports best.

The search starts from the log as it is and adds one fault at a time, keeping the few best. A fault
is believed where it lowers the score by `MARGIN` and nothing simpler does as well.
"""

from dataclasses import replace
from operator import itemgetter

from bo_sysid.checks.evidence import WiringEvidence
from bo_sysid.checks.hypothesis import WiringHypothesis
from bo_sysid.checks.moves import absolute, moves, signs
from bo_sysid.checks.score import DELAYS, TIE, timed
from bo_sysid.execution import OnProgress, Progress, silent

SUSPICIOUS = 0.08
"""J of a degree of freedom from which on its channels are doubted."""
_BEYOND_DOUBT = 3.0  # gain of the score by a sign where nothing is doubted: a twentieth is left
_SPARED = 0.1  # of the score, that a change which is not needed may bring
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
    best = timed(evidence, first)
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
                    grown.append(timed(evidence, child))
                    text = f"{len(seen)} wirings tried, since the forces are not explained"
                    progress(Progress(fault + 1, _MOST + 1, text))
        beam = sorted(grown, key=lambda pair: pair[0])[:width]
        if not beam:
            break
        if beam[0][0] < best[0]:
            best = beam[0]
            twins = tuple(h for score, h in beam[1:] if score < best[0] + TIE)
        elif len(beam[0][1].causes) > len(best[1].causes) + 1:
            break  # two faults more did not help either
    return _pruned(evidence, best[1], first), twins


def _turned(
    evidence: WiringEvidence, best: tuple[float, WiringHypothesis]
) -> tuple[float, WiringHypothesis]:
    """Return score and hypothesis with other signs or bases that explain forces much better yet.

    Where gravity is most of what motors bear, a turned sign leaves a few per cent of the forces:
    little enough for missing physics, but a hundred times what the right one leaves.
    """
    for _ in range(_MOST):
        others = (*signs(best[1]), *absolute(evidence, best[1]))
        turned = min((timed(evidence, h) for h in others), key=itemgetter(0))
        if turned[0] > best[0] - _BEYOND_DOUBT:
            break
        best = turned
    return best


def _doubtful(evidence: WiringEvidence, hypothesis: WiringHypothesis) -> bool:
    """Whether a joint's forces are not explained, however late its own control may act."""
    shares = evidence.shares(hypothesis, [hypothesis.delay, *DELAYS]).min(axis=0)
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

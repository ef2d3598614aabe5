"""What is supposed of a log before any fault is looked for: what the model's ranges ask for."""

from collections.abc import Sequence
from dataclasses import replace

import mujoco

from bo_sysid.checks.evidence import WiringEvidence
from bo_sysid.checks.hypothesis import Wire, WiringHypothesis
from bo_sysid.checks.motion import BEYOND, beyond_range, turned_inside
from bo_sysid.checks.moves import centres
from bo_sysid.checks.score import MARGIN, timed
from bo_sysid.recording import Recording


def by_ranges(
    evidence: WiringEvidence, model: mujoco.MjModel, recordings: Sequence[Recording]
) -> WiringHypothesis:
    """Return the log as it is, but for encoders that their ranges turn, or count from the middle.

    The forces must not deny it.

    Args:
        evidence: of the recordings.
        model: has the ranges.
        recordings: what was recorded.
    """
    h = evidence.identity()
    for name in (f"qpos.{j}" for j in turned_inside(model, recordings)):
        turned = replace(h, wires={**h.wires, name: Wire(name, sign=-1)})
        if timed(evidence, turned)[0] < timed(evidence, h)[0]:
            h = turned
    if not beyond_range(model, recordings):
        return h
    for centred in centres(evidence, h):
        supposed = replace(centred, causes=h.causes)
        denied = timed(evidence, supposed)[0] > timed(evidence, h)[0] + MARGIN
        if _inside(evidence, model, supposed) and not denied:
            return supposed
    return h


def _inside(evidence: WiringEvidence, model: mujoco.MjModel, h: WiringHypothesis) -> bool:
    """Whether all joints with a range stay within it, as a hypothesis reads them."""
    for joint in evidence.hinges:
        name, own = f"qpos.{joint}", model.joint(joint)
        if name not in h.wires or not model.jnt_limited[own.id]:
            continue
        low, high = own.range
        values, more = evidence.value(h, name), BEYOND * (high - low)
        if values.min() < low - more or values.max() > high + more:
            return False
    return True

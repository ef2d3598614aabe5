"""The signs of encoders and controls, tested by ranges and by the motion."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from math import pi

import mujoco
import numpy as np

from bo_sysid.checks import motors
from bo_sysid.checks.evidence import WiringEvidence
from bo_sysid.checks.motion import beyond_range, turned_inside
from bo_sysid.checks.score import MARGIN
from bo_sysid.checks.search import SUSPICIOUS
from bo_sysid.mjcf.joints import HINGE
from bo_sysid.recording import Recording
from bo_sysid.starter.guess import Rules
from bo_sysid.starter.movers import evidence_of

_EXPLAINED = 0.3  # share of the forces from which on a joint's balance tells no sign
_FLOOR = 1e-3  # what may stay unexplained of any balance
_DELAYS = tuple(0.008 * np.arange(-4, 8))  # [s]; controls may act apart from each other
_TURNED = 0.8


def turned_by_range(model: mujoco.MjModel, recordings: Sequence[Recording], rules: Rules) -> Rules:
    """Return the rules with the sign of encoders turned whose mirror image alone fits the model."""
    columns, guesses = dict(rules.columns), dict(rules.guesses)
    beyond = beyond_range(model, recordings)
    for joint in turned_inside(model, recordings):
        name, (least, most) = f"qpos.{joint}", beyond[joint]
        if name not in guesses:
            continue
        low, high = (float(v) for v in model.joint(joint).range)
        columns[name] = {**columns[name], "sign": -int(columns[name].get("sign", 1))}
        size, unit = 1.0, "m"
        if int(model.joint(joint).type[0]) == HINGE:
            size, unit = 180 / pi, "deg"
        reason = (
            f"turned, since {size * least:.3g} to {size * most:.3g} {unit} lie outside the "
            f"model's range of {size * low:.3g} to {size * high:.3g} and the mirror image inside"
        )
        old = guesses[name]
        guesses[name] = replace(
            old, reason=f"{old.reason}; {reason}", confidence=min(old.confidence, _TURNED)
        )
    return replace(rules, columns=columns, guesses=guesses)


@dataclass(frozen=True)
class Tested:
    """What the motion says about the channels as they are read.

    Attributes:
        left: by joint whose balance of forces is known, the share that stays unexplained.
        undetermined: by channel whose sign the motion does not tell, why.
        mirrored: by position or control that may be turned together with the other of its joint,
            that other.
    """

    left: Mapping[str, float]
    undetermined: Mapping[str, str]
    mirrored: Mapping[str, str]


def tested_signs(model: mujoco.MjModel, recordings: Sequence[Recording]) -> Tested:
    """Return whose signs the motion does not tell, and how far it agrees with the model.

    A sign is told where the balance of forces of a joint that the model explains gets worse by as
    much as a fault counts, once the channel alone is turned. A joint that counts the other way and
    its motor with it look the same to themselves; whether others tell is tested as well.
    """
    evidence = evidence_of(model, recordings)
    if isinstance(evidence, str):
        joints = {f"qpos.{model.joint(j).name}" for j in range(model.njnt)}
        names = {n for r in recordings for n in r.channels if n in joints or n.startswith("ctrl.")}
        reason = f"these logs cannot be compared with the model: {evidence}"
        return Tested({}, dict.fromkeys(names, reason), {})
    h = evidence.identity()
    before = evidence.shares(h, _DELAYS).min(axis=0)
    explained = evidence.weights * (before < _EXPLAINED)

    def sign_determined(names: Sequence[str]) -> bool:
        turned = {n: replace(h.wires[n], sign=-1) for n in names}
        after = evidence.shares(replace(h, wires={**h.wires, **turned}), _DELAYS).min(axis=0)
        worse = np.log((after + _FLOOR) / (before + _FLOOR)) * explained
        return bool(worse.max(initial=0.0) > MARGIN)

    undetermined = {n: _why(evidence, n, before) for n in h.wires if not sign_determined([n])}
    mirrored: dict[str, str] = {}
    for name in evidence.inputs:
        pair = [f"qpos.{evidence.driven(name)}", name]
        if all(n in h.wires and n not in undetermined for n in pair) and not sign_determined(pair):
            mirrored |= dict(zip(pair, reversed(pair), strict=True))
    known = zip(evidence.joints, before.tolist(), evidence.weights, strict=True)
    return Tested({j: share for j, share, weight in known if weight}, undetermined, mirrored)


def constants_told(model: mujoco.MjModel, recordings: Sequence[Recording]) -> frozenset[str]:
    """Return the controls of motors of which the motion tells what one unit of them gives."""
    evidence = evidence_of(model, recordings)
    return frozenset() if isinstance(evidence, str) else motors.told(evidence, _DELAYS)


def _why(evidence: WiringEvidence, name: str, shares: np.ndarray) -> str:
    """Return why the motion does not tell a sign."""
    joint = evidence.driven(name) if name in evidence.inputs else name.removeprefix("qpos.")
    if not joint:
        return "no joint shows it whose forces the model explains"
    if not evidence.weights[evidence.joints.index(joint)]:
        return f"not all that moves {joint} is known"
    share = float(shares[evidence.joints.index(joint)])
    if share > SUSPICIOUS:
        return f"{100 * share:.0f} % of the forces at {joint} stay unexplained"
    return "the motion fits either"

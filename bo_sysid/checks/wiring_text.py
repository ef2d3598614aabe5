"""What the wiring of a log comes to, in words."""

from collections.abc import Mapping, Sequence

import pandas as pd

from bo_sysid.checks.evidence import WiringEvidence
from bo_sysid.checks.flags import Flag
from bo_sysid.checks.hypothesis import FREE, Wire, WiringHypothesis
from bo_sysid.checks.search import SUSPICIOUS
from bo_sysid.checks.sensitivity import listed
from bo_sysid.checks.speeds import MIN_CORRELATION
from bo_sysid.recording import kind_of

_DOUBT = (
    "No joint is explained well with it either, and a force that the model lacks may look like it: "
    "look at the machine."
)
LOADED = (
    "a load that the model lacks, as a tool, or a base that is not level may look like another zero"
)
_DROWNED = 0.5  # of the forces, which noise of the motion makes
_OPEN = 1e-3  # [m] or [rad] by which a chain may stay open
_OFTEN_OPEN = 0.02  # of the positions
_CONSTANT = ", as the model's masses have it; a constant from a data sheet is better"


def wire_flags(
    wires: Mapping[str, Wire], balance: pd.DataFrame, gives: Mapping[str, str]
) -> list[Flag]:
    """Return a flag for each fault, with J of the joints that it concerns, before and after.

    Faults that leave every joint badly explained are no more than likely: a force that the model
    lacks may be what seems to be a sign.

    Args:
        wires: what the channels really are.
        balance: one row a joint.
        gives: by control with a constant of its own, what one unit of it gives.
    """
    support, explained = _support(balance), _explained(balance)
    kinds: dict[tuple[str, str], list[str]] = {}
    for name, wire in wires.items():
        for kind, what in _faults(name, wire):
            kinds.setdefault((kind, what), []).append(name)
    flags = []
    for (kind, what), names in kinds.items():
        corrections = "; ".join(
            gives[n] if kind == "scale" else _correction_text(n, wires[n], kind) for n in names
        )
        corrections += _CONSTANT if kind == "scale" else ""
        sentence = f"{what}: {corrections}. {support}"
        if kind == "zero" and all(wires[n].centred for n in names):
            sentence += " That is the middle of what servos count from one end."
        elif kind == "zero":
            sentence += f" {LOADED.capitalize()}: leave this out where the zeros are known."
        if explained or all(kind_of(n) == "qvel" for n in names):  # a rate needs no forces
            flags.append(Flag("wrong", kind, tuple(names), sentence))
        else:
            flags.append(Flag("look", kind, tuple(names), f"Perhaps: {sentence} {_DOUBT}"))
    return flags


def twin_flags(twins: Sequence[WiringHypothesis]) -> list[Flag]:
    """Return other faults that would explain the recordings as well."""
    return [
        Flag(
            "look",
            "sign",
            (),
            f"Perhaps: {'; '.join(h.causes)}. These recordings cannot tell for certain; look at "
            "the machine.",
        )
        for h in twins
    ]


def _explained(balance: pd.DataFrame) -> bool:
    """Whether the forces at a joint that the faults concern are explained once it is corrected."""
    better = balance[balance["used"].astype(bool) & (balance["after"] < balance["before"])]
    return len(better) == 0 or float(better["after"].min()) <= SUSPICIOUS


def _support(balance: pd.DataFrame) -> str:
    worst = balance[balance["used"]].nlargest(3, "before")
    shares = ", ".join(
        f"{joint} {before:.2g} → {after:.2g}"
        for joint, before, after in zip(
            worst["joint"], worst["before"], worst["after"], strict=True
        )
    )
    return f"Unexplained share of the forces as it was → corrected: {shares}."


def _faults(name: str, wire: Wire) -> list[tuple[str, str]]:
    """Return kind and title of each fault of one channel."""
    faults = []
    if wire.source != name:
        same = kind_of(wire.source) == kind_of(name)
        faults.append(("order", "Order") if same else ("swap", "Commands and measurements swapped"))
    if wire.unit == FREE:
        faults.append(("scale", "Scale"))
    elif wire.unit:
        faults.append(("unit", f"Unit is {wire.unit}"))
    if wire.sign < 0:
        faults.append(("sign", "Sign"))
    if wire.offset:
        faults.append(("zero", "Zero"))
    if wire.less:
        faults.append(("absolute", "Counted from the base"))
    return faults


def _correction_text(name: str, wire: Wire, kind: str) -> str:
    if kind in ("order", "swap"):
        return f"{name} is in column {wire.source}"
    if kind == "absolute":
        return f"{name} shows {wire.less} as well"
    if kind == "zero":
        return f"{name} lacks {wire.offset:+.4g}"
    return name


def speed_flags(correlations: Mapping[str, float]) -> list[Flag]:
    """Return speeds that belong to no position."""
    return [
        Flag(
            "look",
            "order",
            (name,),
            f"{name} is not the rate of any recorded position (correlation {c:.2f}).",
            {"correlation": c},
        )
        for name, c in correlations.items()
        if abs(c) < MIN_CORRELATION
    ]


def balance_flags(balance: pd.DataFrame, still: Sequence[str] = ()) -> list[Flag]:
    """Return joints whose forces the model does not explain.

    Args:
        balance: one row a joint.
        still: joints that were not recorded, and are taken to stand still.
    """
    bad = balance[balance["used"] & (balance["after"] > SUSPICIOUS)]
    beside = (
        f" What {listed(still)} did was not recorded: here it counts as standing still, and the "
        "forces that it makes as unexplained."
        if still
        else ""
    )
    return [
        Flag(
            "look",
            "balance",
            (joint,),
            f"{100 * share:.0f} % of the forces at {joint} are not explained by the model, under "
            "any wiring that was tried: it lacks something (a rotor behind a gear, a spring), a "
            "mass or a motor is far from what it says, it touches something for most of the time, "
            f"or the motion is too small.{beside}",
            {"share": share},
        )
        for joint, share in zip(bad["joint"], bad["after"], strict=True)
    ]


def drowned(balance: pd.DataFrame) -> pd.DataFrame:
    """Return the rows of joints whose forces are drowned by noise of the motion."""
    return balance[balance["used"].astype(bool) & (balance["noise"] > _DROWNED)]


def noise_flags(balance: pd.DataFrame) -> list[Flag]:
    """Return of which joints the balance says nothing, since noise makes most of it."""
    rows = drowned(balance)
    joints = tuple(rows["joint"])
    if not joints:
        return []
    return [
        Flag(
            "look",
            "balance",
            joints,
            f"Signs, units and zeros at {listed(joints)} are not tested: the noise of the recorded "
            "motion makes forces as large as all others there. Scales or zeros may be wrong, or "
            "the encoders too coarse for how slowly it moves.",
            dict(zip(joints, rows["noise"], strict=True)),
        )
    ]


def open_flags(evidence: WiringEvidence, found: WiringHypothesis) -> list[Flag]:
    """Return that a closed chain of the model cannot close where it was recorded."""
    opening = evidence.opening(found)
    share = float((opening > _OPEN).mean()) if opening.size else 0.0
    if share < _OFTEN_OPEN:
        return []
    joints = tuple(j for j in evidence.joints if f"qpos.{j}" in evidence.recorded)
    return [
        Flag(
            "wrong",
            "balance",
            joints,
            f"At {100 * share:.0f} % of the recorded positions the model's closed chain cannot "
            f"close; it stays open by up to {opening.max():.2g} m (or rad). Units, scales or zeros "
            f"among {listed(joints)} are wrong, or lengths of the model: put them right first, "
            "since no force says anything before.",
            {"share": share, "opening": float(opening.max())},
        )
    ]


def untested_flags(evidence: WiringEvidence) -> list[Flag]:
    """Return why no forces were compared, or at which joints not: their drives keep a state."""
    stateful = {
        j: [n for n in names if f"ctrl.{n}" in evidence.recorded]
        for j, names in evidence.unknown.items()
    }
    own = dict.fromkeys(n for names in stateful.values() for n in names)
    reasons = []
    if own:
        verb = "acts" if len(own) == 1 else "act"
        reasons.append(
            f"{listed(list(own))} {verb} by an activation that no control tells at once, as that "
            "of a servo that integrates, or of a muscle"
        )
    if evidence.weights.any():
        joints = tuple(j for j, names in stateful.items() if names)
        stateful_flags = [not_tested(reasons[0], joints)] if joints else []
        return stateful_flags + _late_untested(evidence)
    lacking = dict.fromkeys(n for names in evidence.unknown.values() for n in names if n not in own)
    if lacking:
        commands = ", ".join(f"ctrl.{n}" for n in lacking)
        reasons.append(f"commands were not recorded ({commands})")
    return [not_tested(", and ".join(reasons) or "none of the recorded joints moves on its own")]


def _late_untested(evidence: WiringEvidence) -> list[Flag]:
    """Return the controls of which no delay is known: those that drive no one joint."""
    names = tuple(n for n in sorted(evidence.inputs) if not evidence.driven(n))
    if not names:
        return []
    sentence = (
        f"When {listed(names)} {'acts' if len(names) == 1 else 'act'} was not tested: a delay is "
        "looked for at controls that drive one joint, by no tendon over several. `diagnose` looks "
        "for it everywhere."
    )
    return [Flag("note", "clock", names, sentence)]


def not_tested(reason: str, joints: Sequence[str] = ()) -> Flag:
    """Return that the wiring, or that of some joints, was not tested, and why."""
    what = f"The wiring of {listed(joints)}" if joints else "The wiring"
    sentence = f"{what} was not tested against the model: {reason}."
    return Flag("note", "balance", tuple(joints), sentence)

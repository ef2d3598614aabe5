"""Why the names of a set that fits may be hints and not yet findings, and what would tell."""

from collections.abc import Mapping, Sequence
from math import hypot, inf, pi, sqrt

import numpy as np

from bo_sysid.diagnosis.answer.quantities import quantities
from bo_sysid.diagnosis.answer.sentences import set_words
from bo_sysid.diagnosis.answer.servo_hints import servo_hints
from bo_sysid.diagnosis.answer.wording import definite, spoken
from bo_sysid.diagnosis.sets.fit import Fit
from bo_sysid.diagnosis.sets.groups import units_of
from bo_sysid.diagnosis.sets.meshing import LATE, backlash_suspects
from bo_sysid.diagnosis.sets.rules import FLAT, clean
from bo_sysid.diagnosis.windows.candidate import Candidate
from bo_sysid.effects import Machine
from bo_sysid.intervals import Quantity, amount
from bo_sysid.mjcf.joints import BALL

_LEFT = 0.2  # excess from which more than noise is left, whatever it is
# another set casts doubt where it leaves less than this share of what the answer leaves
_MUCH_LESS = 0.9
_SOFT = "joint_compliance"
_MORE = 0.15  # share by which a compliance must explain more than a late motor to be no hint
_AT_BOUND = 1e-6  # of the bounds of a magnitude, within which it is at one
_SMALL_LOAD = 2.0  # [sigma] below which a load with a place of its own may be something else
_STANDS_OUT = 0.15  # share of the smallest effect, below which what is left casts no doubt on it


def doubtful(
    best: Fit, machine: Machine, others: Sequence[Fit] = (), still: Sequence[str] = ()
) -> bool:
    """Return whether something, or one of the other sets, casts doubt on the names of a set."""
    return leaves_much(best) or bool(hints(best, machine, others, still))


def hints(
    best: Fit, machine: Machine, others: Sequence[Fit] = (), still: Sequence[str] = ()
) -> tuple[str, ...]:
    """Return in words which effects of a set others may stand behind, and what would tell.

    Args:
        best: the set.
        machine: the scales of its sites.
        others: fits of other sets.
        still: joints that do not move in the recordings.
    """
    sentences = []
    if fixed := joints_at_rest(best, machine, still):
        sentences.append(_at_rest_sentence(fixed))
    if late := compliance_or_motor_lag(best, others, machine):
        sentences.append(_motor_lag_sentence(late))
    if soft := compliance_or_presliding(best):
        sentences.append(_presliding_sentence(soft))
    if held := stuck_joints(best):
        sentences.append(_stuck_sentence(held))
    if unseen := unswept_cogging(best, machine):
        sentences.append(_unswept_sentence(unseen, machine))
    if small := small_loads(best):
        sentences.append(_small_loads_sentence(small))
    if late := backlash_suspects(best, machine):
        sentences.append(_backlash_sentence(late))
    sentences += servo_hints(best.hypothesis, machine)
    sentences += [_nothing_sentence(*member) for member in perhaps_nothing(best, machine)]
    if best.members and (joints := balls(machine)):
        sentences.append(_balls_sentence(joints))
    return tuple(sentences)


def joints_at_rest(best: Fit, machine: Machine, still: Sequence[str]) -> tuple[str, ...]:
    """Return the joints among some at rest at which a set names anything but friction."""
    sites = {c.site.name for c in best.members if not c.may_preslide}
    body = {j: machine.model.body(int(machine.model.joint(j).bodyid[0])).name for j in still}
    return tuple(j for j in still if {j, body[j], *machine.joints[j].actuators} & sites)


def _at_rest_sentence(joints: Sequence[str]) -> str:
    """Return in words that a joint does not move, and what would tell why."""
    which, one = " and ".join(joints), len(joints) == 1
    return (
        f"{which} {'does' if one else 'do'} not move in these recordings: friction that holds "
        f"{'it' if one else 'them'}, a brake or a stop does the same as what was named there. "
        f"Commands that move {which} would tell."
    )


def balls(machine: Machine) -> tuple[str, ...]:
    """Return the ball joints of a machine, at which no effect of the catalogue can act."""
    model = machine.model
    return tuple(model.joint(int(j)).name for j in np.flatnonzero(model.jnt_type == BALL))


def _balls_sentence(joints: Sequence[str]) -> str:
    """Return in words that what acts at ball joints was not looked for.

    Damping there is the same as masses and torques that are all smaller by one factor.
    """
    return (
        f"Nothing is looked for at the ball {'joint' if len(joints) == 1 else 'joints'} "
        f"{' and '.join(joints)}: damping, friction or a spring there may stand behind what was "
        f"named. Damping can be a parameter of the study (joint[{joints[0]}].damping)."
    )


def leaves_much(best: Fit) -> bool:
    """Return whether the best set leaves so much that something else must be missing, too.

    That is so, too, where an effect does not stand out from what is left: it may stand in for it.
    """
    if clean(best):
        return False
    sizes = [hypot(*(best.unique[k] for k in unit)) for unit in units_of(best)]
    return best.excess > _LEFT or sqrt(best.excess) > _STANDS_OUT * min(sizes, default=inf)


def compliance_or_presliding(best: Fit) -> tuple[str, ...]:
    """Return the joints with a compliance beside friction: friction preslides, too.

    Its presliding is not always found, and a compliance was named in its place.
    """
    with_friction = {c.site.name for c in best.members if c.may_preslide}
    springy = [c.site.name for c in best.members if c.effect.id == _SOFT]
    return tuple(joint for joint in springy if joint in with_friction)


def _presliding_sentence(joints: Sequence[str]) -> str:
    """Return in words that a compliance may be the friction beside it, and what would tell."""
    return (
        f"The compliance at {' and '.join(joints)} may be the friction there, which bends before "
        "it slips: a load that changes while the joint moves one way would tell."
    )


def compliance_or_motor_lag(best: Fit, others: Sequence[Fit], machine: Machine) -> tuple[str, ...]:
    """Return the joints with a compliance in whose place a late motor leaves hardly more.

    A lag below the model's time step leaves what the step gets wrong of it, and a soft joint, which
    has more magnitudes, leaves less.
    """
    soft = {c: u for c, u in zip(best.members, best.unique, strict=True) if c.effect.id == _SOFT}
    found = []
    for c, size in soft.items():
        rest = best.names - {c.key}
        late = [f for f in others if rest < f.names and _is_late(f.names - rest, c, machine)]
        more = min((sqrt(max(f.excess - best.excess, 0.0)) for f in late), default=inf)
        if more < _MORE * size:
            found.append(c.site.name)
    return tuple(found)


def _is_late(names: frozenset[tuple[str, str]], soft: Candidate, machine: Machine) -> bool:
    """Whether names are a lag or a delay alone, of the motor of a joint that is soft."""
    ((effect, site), *more) = names
    joint = machine.joint_of("actuator", site) if effect in LATE and not more else None
    return joint is not None and joint.name == soft.site.name


def _motor_lag_sentence(joints: Sequence[str]) -> str:
    """Return in words that a compliance may be a late motor, and what would tell."""
    which = " and ".join(joints)
    return (
        f"The compliance at {which} explains hardly more than a motor that is late: slow motion "
        f"under a large load, which bends {which} and makes no motor late, would tell."
    )


def stuck_joints(best: Fit) -> tuple[str, ...]:
    """Return the joints that friction holds all the time, where any friction does the same.

    Such as that of a worn spot in which the joint rests.
    """
    members = zip(best.members, best.groups, best.linear_rms, strict=True)
    return tuple(
        c.site.name for c, g, linear in members if c.may_preslide and not g and linear <= FLAT
    )


def _stuck_sentence(joints: Sequence[str]) -> str:
    """Return in words that friction is seen at one place only, and what would tell."""
    which = " and ".join(joints)
    return (
        f"Friction holds {which} all the time in these recordings: how much it is, and whether it "
        f"is the same elsewhere, would be told by commands that move {which}."
    )


def unswept_cogging(best: Fit, machine: Machine) -> Mapping[str, float]:
    """Return the joints that swept less than one period of a cogging there, and a period's length.

    Within one period a magnet, or a spring, may look the same.
    """
    found = {}
    for c in best.members:
        joint = machine.joint_of(c.site.kind, c.site.name)
        if c.effect.id == "cogging" and joint is not None:
            period = 2 * pi / float(c.shapes[0])
            if joint.span < period:
                found[joint.name] = period
    return found


def small_loads(best: Fit) -> Mapping[str, float]:
    """Return the bodies with a small load at a place of its own, and its size in sigma.

    It has four magnitudes, and a cable that pulls by 1.2 sigma was one with certainty.
    """
    sized = zip(best.members, best.unique, strict=True)
    return {spoken(c.site): size for c, size in sized if c.moved and size < _SMALL_LOAD}


def _small_loads_sentence(loads: Mapping[str, float]) -> str:
    """Return in words that what a load does is little for four numbers, and what would tell."""
    which = " and ".join(loads)
    return (
        f"What the load of {which} does is little ({max(loads.values()):.1f} sigma), and with a "
        "place of its own it has four numbers: something else may do the same. Faster motion, "
        f"over more of the range that {which} moves in, would tell."
    )


def _unswept_sentence(periods: Mapping[str, float], machine: Machine) -> str:
    """Return in words that less than a period was seen, and what would tell."""
    which = " and ".join(periods)
    reach = " and ".join(
        f"{length:.3g} {'rad' if machine.joints[name].hinge else 'm'}"
        for name, length in periods.items()
    )
    return (
        f"That the cogging at {which} repeats was not seen: less than a period was swept, and a "
        f"magnet or a spring may look the same. Motion of {which} over more than {reach} would "
        "tell."
    )


def _backlash_sentence(joints: Sequence[str]) -> str:
    """Return in words that a late motor may be a gap, and what would tell."""
    which = " and ".join(joints)
    return (
        f"That the motor of {which} is late, and the small effect beside it, may both be a gap in "
        f"the gear: slow reversals of {which} under little torque would tell."
    )


def perhaps_nothing(best: Fit, machine: Machine) -> tuple[tuple[Candidate, float, Quantity], ...]:
    """Return the members of a set whose interval holds 0: what they explain, chance may explain.

    So far from the recordings that what is left of them is no noise. Friction that changes in its
    presliding alone is none of them. With each come its first magnitude and what is reported of it.
    """
    members = zip(best.members, best.x, quantities(best, machine), strict=True)
    return tuple(
        (c, float(x[0]), q)
        for c, x, q in members
        if not c.preslides and q.interval[0] < 0 < q.interval[1]
    )


def _nothing_sentence(c: Candidate, x: float, quantity: Quantity) -> str:
    """Return in words that an effect may as well not be there."""
    near = _AT_BOUND * (c.high[0] - c.low[0])
    most, least = x >= c.high[0] - near, x <= c.low[0] + near
    end = f", the {'most' if most else 'least'} that was looked for," if most or least else ""
    return (
        f"{definite(c.effect.noun)} at {spoken(c.site)} ({amount(quantity)}){end} may as well be "
        "none: its interval holds 0, beside all that is left unexplained."
    )


def left_sentence(best: Fit, most: int, nearest: Fit) -> str:
    """Return in words that more than noise is left, and what can be done.

    Args:
        best: the set that is answered.
        most: effects that the study allows.
        nearest: the set that leaves least of all that were fitted.
    """
    small = "" if best.excess > _LEFT else ", and the smallest effect does not stand out from that"
    left = f"{best.rms:.3g} sensor sigmas are left where 1 is noise{small}: the names are hints"
    if best.size >= most:
        return (
            f"{left}. All {most} effects that diagnosis.most allows are used, and more may be "
            "missing."
        )
    if nearest.rms < _MUCH_LESS * best.rms:
        return (
            f"{left}. Other sets leave down to {nearest.rms:.3g} ({set_words(nearest)}), but have "
            "effects too small beside what stays unexplained to be named."
        )
    return f"{left}. No further effect that was tried explains more."

"""Effects at a servo that together may be one number of it: its gear, or its gain alone."""

from collections.abc import Mapping

from bo_sysid.diagnosis.windows.hypothesis import Hypothesis
from bo_sysid.effects import Machine
from bo_sysid.effects.machine import ActuatorScale

_ALIKE = 0.05  # of what one number makes of an effect, by which the effect is that


def servo_hints(hypothesis: Hypothesis, machine: Machine) -> tuple[str, ...]:
    """Return in words which members of a set may be one number of a servo, and what would tell."""
    geared = [
        f"The output of {servo} and the spring at {machine.actuators[servo].joint}, and damping "
        f"there, have the sizes of one gear between servo and joint that is {ratio:.3g} times the "
        "model's: what the encoder and the set points count, or an unpowered run, would tell."
        for servo, ratio in geared_servos(hypothesis, machine).items()
    ]
    retuned = [
        f"The output of {servo} and the damping at {machine.actuators[servo].joint} have the sizes "
        f"of another proportional gain alone, {kp:.3g} instead of "
        f"{-machine.actuators[servo].bias[1]:.3g}: an unpowered run would tell."
        for servo, kp in retuned_servos(hypothesis, machine).items()
    ]
    return (*geared, *retuned)


def geared_servos(hypothesis: Hypothesis, machine: Machine) -> Mapping[str, float]:
    """Return the servos whose output and a spring at their joint are what one gear does.

    A servo with the gear G gives its joint the torque G kp u - G² kp q. With g G it is

        g (G kp u - G² kp q) - G² kp g (g - 1) q,

    an output that is g times as large and a spring of G² kp g (g - 1), which stands in no machine.

    Returns:
        The ratio g by servo.
    """
    found = {}
    for a, share in _outputs(hypothesis, machine).items():
        ratio = 1.0 + share
        if _is_there("joint_spring", a, -(a.gear**2) * a.bias[1] * ratio * share, hypothesis):
            found[a.name] = ratio
    return found


def retuned_servos(hypothesis: Hypothesis, machine: Machine) -> Mapping[str, float]:
    """Return the servos whose output and damping at their joint are what another kp does.

    A servo's force is kp (u - q) - kd v. With (1 + x) kp alone it is

        (1 + x) (kp (u - q) - kd v) + x kd v,

    an output that is x larger and damping that is x kd less, by gear² at the joint.

    Returns:
        The proportional gain (1 + x) kp by servo.
    """
    found = {}
    for a, share in _outputs(hypothesis, machine).items():
        if a.bias[2] and _is_there("viscous_damping", a, a.gear**2 * a.bias[2] * share, hypothesis):
            found[a.name] = -(1.0 + share) * a.bias[1]
    return {n: kp for n, kp in found.items() if n not in geared_servos(hypothesis, machine)}


def _outputs(hypothesis: Hypothesis, machine: Machine) -> dict[ActuatorScale, float]:
    """Return the change of the output of each servo that a set changes, relative."""
    members = zip(hypothesis.members, hypothesis.x, strict=True)
    changed = {c.site.name: float(x[0]) for c, x in members if c.effect.id == "actuator_gain"}
    servos = {n: machine.actuators[n] for n in changed}
    return {a: changed[n] for n, a in servos.items() if a.servo and a.joint}


def _is_there(effect: str, servo: ActuatorScale, size: float, hypothesis: Hypothesis) -> bool:
    """Whether a set has an effect of about a size at the joint of a servo."""
    members = zip(hypothesis.members, hypothesis.x, strict=True)
    own = [float(x[0]) for c, x in members if (c.effect.id, c.site.name) == (effect, servo.joint)]
    return any(abs(x - size) < _ALIKE * abs(size) for x in own)

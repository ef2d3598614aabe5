"""Sensors that read something else than the model says."""

from collections.abc import Mapping

import mujoco
import numpy as np

from bo_sysid.effects.actuators import with_own_bias
from bo_sysid.effects.contract import Component, Extent, Magnitudes, Site
from bo_sysid.effects.machine import Machine
from bo_sysid.effects.parts import Part, Reading
from bo_sysid.effects.registry import effect
from bo_sysid.effects.units import CHANNEL_UNIT

_OFFSET = 0.01  # [rad] at a hinge, share of the recorded range at a slide
_SCALE = 0.02  # relative: a probe
_GEARED = (1.0, -0.5)  # relative: an encoder behind gears of 2:1, or before them
_SAME, _POSITION, _GOAL = (1.0, 0.0), (0.0, 0.0), (0.0, 1.0)  # what a servo takes from an encoder
_MOST_DELAY = 0.06


def _encoder_extent(site: Site, machine: Machine) -> Extent:
    joint = machine.joints[site.name]
    unit = 1.0 if joint.hinge else joint.span
    return Extent((_OFFSET * unit,), (-0.5 * unit,), (0.5 * unit,))


@effect(
    "encoder_offset",
    kind="joint",
    components=(Component("offset", "rad"),),
    extent=_encoder_extent,
    noun="an encoder offset",
    sentence="The encoder of {site} reads {value} too much.",
    form="reading; a servo's bias shifts along",
    evidence="gravity, or the other links, act as at another posture",
    separation="several postures; a known posture at rest",
    family="sensing",
    grouped=True,
)
def encoder_offset(
    spec: mujoco.MjSpec, site: Site, x: Magnitudes, machine: Machine
) -> tuple[Part, ...]:
    """The encoder reads x[0] more than the joint's position, and so does a servo.

    A servo's force is g u + b r (q + x[0]) with gain g, bias b per length and gear r: its constant
    bias grows by b r x[0]. Its control is clipped as before.
    """
    for servo in machine.actuators.values():
        if servo.joint == site.name and servo.servo:
            a = with_own_bias(spec, servo.name)
            a.biasprm[0] += a.biasprm[1] * a.gear[0] * float(x[0])
    return (Reading(f"qpos.{site.name}", offset=float(x[0]), encoder=True),)


def _scaled_extent(site: Site, machine: Machine) -> Extent:
    """Bounds, with the ways in which a servo on the joint may take what the encoder reads."""
    servos = [a for a in machine.actuators.values() if a.joint == site.name and a.servo]
    ways = [_SAME, _GOAL] if servos else []
    ways += [_POSITION] if any(a.bias[2] for a in servos) else []
    grid = tuple((_SCALE, *way) for way in ways)
    secants = tuple((x, *way) for way in ways for x in _GEARED)
    return Extent((_SCALE, *_SAME), (-0.9, -1e-9, -1e-9), (3.0, 1.0, 1.0), grid, secants=secants)


@effect(
    "encoder_scale",
    kind="joint",
    components=(
        Component("change", "relative"),
        Component("servo's rate as well", "–"),
        Component("servo's goal instead", "–"),
    ),
    shapes=2,
    extent=_scaled_extent,
    noun="an encoder scale",
    sentence="The encoder of {site} reads {value} too much of every position.",
    form="reading; a servo's bias or goal scales along",
    evidence="gravity and the other links act as at another posture, more so far from zero",
    separation="two known postures",
    family="sensing",
    grouped=True,
)
def encoder_scale(
    spec: mujoco.MjSpec, site: Site, x: Magnitudes, machine: Machine
) -> tuple[Part, ...]:
    """The encoder reads 1 + x[0] times the joint's position, and its rate as much.

    A servo compares its goal u with what it reads, kp (u - (1 + s) q) - kd (1 + s) q'. Not all take
    the rate from the encoder: with x[1] = 0 its factor stays 1. With x[2] = 1 the goal is brought
    to the joint's own scale instead, kp (u / (1 + s) - q) - kd q'; a constant bias is of the goal.
    """
    scale, rate, goal = 1.0 + float(x[0]), 1.0 + float(x[0] * x[1]), float(x[2])
    for actuator in machine.actuators.values():
        if actuator.joint == site.name and actuator.servo:
            a = with_own_bias(spec, actuator.name)
            if goal:
                a.gainprm[0] /= scale
                a.biasprm[0] /= scale
            else:
                a.biasprm[1:3] = np.asarray(a.biasprm[1:3]) * (scale, rate)
    return tuple(
        Reading(f"{kind}.{site.name}", scale=float(x[0]), encoder=True) for kind in ("qpos", "qvel")
    )


def _delay_extent(site: Site, machine: Machine) -> Extent | None:
    if not (site.name.startswith("qpos.") and _scalar(site, machine)):
        return None
    return Extent((max(machine.sampling, 1e-3),), (0.0,), (_MOST_DELAY,))


@effect(
    "sensor_delay",
    kind="channel",
    components=(Component("delay", "s"),),
    extent=_delay_extent,
    noun="a delay",
    sentence="{site} is reported {value} late.",
    form="reading",
    evidence="everything that the sensor shows comes later than it should",
    separation="a sensor with another clock",
    family="sensing",
)
def sensor_delay(spec: mujoco.MjSpec, site: Site, x: Magnitudes, machine: Machine) -> Part:
    """The channel shows what was x[0] earlier."""
    return Reading(site.name, delay=float(np.maximum(x[0], 0.0)))


def _scalar(site: Site, machine: Machine) -> bool:
    """Whether the channel shows one hinge or slide joint, or is a sensor's."""
    kind, element = site.name.split(".", 1)
    return kind == "sensor" or element in machine.joints


def _besides_encoder(site: Site, machine: Machine) -> bool:
    """Whether the channel can be wrong in another way than the joint's encoder is.

    The encoder of a servo also moves its goal; without one, the two are the same.
    """
    kind, element = site.name.split(".", 1)
    if not (_scalar(site, machine) and machine.scales[site.name].spread > 0):
        return False
    servo = any(a.servo and a.joint == element for a in machine.actuators.values())
    return kind != "qpos" or servo


def _offset_extent(site: Site, machine: Machine) -> Extent | None:
    if not _besides_encoder(site, machine):
        return None
    spread = machine.scales[site.name].spread
    return Extent((0.05 * spread,), (-10 * spread,), (10 * spread,))


@effect(
    "sensor_offset",
    kind="channel",
    components=(Component("offset", CHANNEL_UNIT),),
    extent=_offset_extent,
    noun="an offset",
    sentence="{site} reads {value} too much.",
    form="reading",
    evidence="the same difference at every value",
    separation="a known value at rest",
    family="sensing",
)
def sensor_offset(spec: mujoco.MjSpec, site: Site, x: Magnitudes, machine: Machine) -> Part:
    """The channel reads x[0] too much."""
    return Reading(site.name, offset=float(x[0]))


def _scale_extent(site: Site, machine: Machine) -> Extent | None:
    return Extent((0.02,), (-0.9,), (3.0,)) if _besides_encoder(site, machine) else None


@effect(
    "sensor_scale",
    kind="channel",
    components=(Component("change", "relative"),),
    extent=_scale_extent,
    noun="a scale",
    sentence="{site} reads {value} too much of every value.",
    form="reading",
    evidence="a difference in proportion to the value",
    separation="two known values",
    family="sensing",
)
def sensor_scale(spec: mujoco.MjSpec, site: Site, x: Magnitudes, machine: Machine) -> Part:
    """The channel reads 1 + x[0] times the value."""
    return Reading(site.name, scale=float(x[0]))


def _sign_extent(site: Site, machine: Machine) -> Extent | None:
    return Extent((1.0,), (0.0,), (1.0,)) if _scalar(site, machine) else None


@effect(
    "sensor_sign",
    discrete=True,
    kind="channel",
    components=(Component("reversed", "–"),),
    extent=_sign_extent,
    noun="a reversed sign",
    sentence="{site} counts the other way; `sign: -1` in the study's columns turns it.",
    form="reading",
    evidence="motion against every force",
    separation="one push in a known direction",
    family="sensing",
)
def sensor_sign(spec: mujoco.MjSpec, site: Site, x: Magnitudes, machine: Machine) -> Part:
    """The channel reads 1 - 2 x[0] times the value: its negative at x[0] = 1."""
    return Reading(site.name, scale=-2.0 * float(x[0]))


def _later_of_same_quantity(site: Site, machine: Machine) -> tuple[int, ...]:
    """Return the numbers of the later channels that show the same kind of quantity.

    Positions or velocities of joints of one kind; axes of one sensor.
    """
    after = machine.channels.index(site.name) + 1
    own = _quantity(site.name, machine)
    later = enumerate(machine.channels[after:], after)
    return tuple(k for k, name in later if own and _quantity(name, machine) == own)


def _quantity(channel: str, machine: Machine) -> tuple[str, str] | None:
    kind, element = channel.split(".", 1)
    if kind == "sensor":
        return kind, element.rpartition(".")[0] or element
    return (kind, machine.scales[channel].unit) if element in machine.joints else None


def _swap_extent(site: Site, machine: Machine) -> Extent | None:
    partners = _later_of_same_quantity(site, machine)
    if not partners:
        return None
    grid = tuple((1.0, float(p)) for p in partners)
    return Extent(grid[0], (0.0, -0.5), (1.0, len(machine.channels) - 0.5), grid)


def _partner(x: Magnitudes, machine: Machine) -> str:
    return machine.channels[round(float(x[1]))]


def _swapped(x: Magnitudes, machine: Machine, site: Site) -> Mapping[str, tuple[float, str]]:
    return {f"with {_partner(x, machine)}": (float(x[0]), "–")}


@effect(
    "channel_swap",
    discrete=True,
    kind="channel",
    components=(Component("swapped", "–"), Component("channel", "–")),
    shapes=1,
    extent=_swap_extent,
    noun="a swap of channels",
    sentence="{site} is swapped {details}; exchange their columns in the study.",
    form="reading",
    evidence="each of two channels fits the prediction of the other",
    separation="moving one joint alone",
    family="sensing",
    details=_swapped,
)
def channel_swap(
    spec: mujoco.MjSpec, site: Site, x: Magnitudes, machine: Machine
) -> tuple[Part, ...]:
    """Two channels show each other's quantity where x[0] > 1/2; x[1] is the other's number."""
    other = _partner(x, machine)
    if x[0] <= 0.5:
        return ()
    return Reading(site.name, source=other), Reading(other, source=site.name)

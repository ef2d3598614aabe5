"""Sensors that read something else than the model says."""

import mujoco
import numpy as np

from bo_sysid.effects.contract import Component, Extent, Filter, Magnitudes, Part, Reading, Site
from bo_sysid.effects.machine import Machine
from bo_sysid.effects.registry import effect
from bo_sysid.recording import Channel

_OFFSET = 0.01  # of a turn's radian, or of the range of a slide
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
    evidence="gravity, or the other links, act as at another posture",
    separation="several postures; a known posture at rest",
    family="sensing",
    grouped=True,
)
def encoder_offset(
    spec: mujoco.MjSpec, site: Site, x: Magnitudes, machine: Machine
) -> tuple[Part, ...]:
    """The encoder reads x[0] more than the joint's position; a servo's goal shifts along."""
    shift = float(x[0])

    def shifted(channel: Channel, dt: float) -> Channel:
        return Channel(
            channel.time, channel.values - shift, channel.unit, channel.source, channel.hold
        )

    servos = [a.name for a in machine.actuators.values() if a.joint == site.name and a.servo]
    filters = tuple(Filter(name, shifted) for name in servos)
    return (Reading(f"qpos.{site.name}", offset=shift), *filters)


def _delay_extent(site: Site, machine: Machine) -> Extent | None:
    if not site.name.startswith("qpos."):
        return None
    return Extent((max(machine.sampling, 1e-3),), (0.0,), (_MOST_DELAY,))


@effect(
    "sensor_delay",
    kind="channel",
    components=(Component("delay", "s"),),
    extent=_delay_extent,
    noun="a delay",
    sentence="{site} is reported {value} late.",
    evidence="everything that the sensor shows comes later than it should",
    separation="a sensor with another clock",
    family="sensing",
)
def sensor_delay(spec: mujoco.MjSpec, site: Site, x: Magnitudes, machine: Machine) -> Part:
    """The channel shows what was x[0] earlier."""
    return Reading(site.name, delay=float(np.maximum(x[0], 0.0)))

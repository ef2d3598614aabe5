"""What a diagnosis sees of recordings: the instants at which positions were recorded."""

from collections.abc import Collection, Sequence
from dataclasses import replace

import numpy as np

from bo_sysid.mjcf import Model
from bo_sysid.recording import Channel, Recording


def at_positions(
    model: Model, recordings: Sequence[Recording], observed: Collection[str]
) -> tuple[Recording, ...]:
    """Return recordings whose measured channels add no instants that nothing is compared at.

    A window is counted in instants. Those of a force at 1 kHz, which no residual has, would fill
    one that is meant for a hundred positions per second.

    Args:
        model: names the channels.
        recordings: to be cut.
        observed: channels that are compared; they and positions are kept as they are.

    Returns:
        Velocities, of which starts are made, only where a position has the same stamp; sensors
        only where observed; all that is no measurement.
    """
    return tuple(_at_positions(model, r, observed) for r in recordings)


def _at_positions(model: Model, recording: Recording, observed: Collection[str]) -> Recording:
    kept = {*model.qpos_channels, *observed}
    times = [c.time for n, c in recording.channels.items() if n in kept]
    stamps = np.unique(np.concatenate(times)) if times else np.empty(0)
    channels = dict(recording.channels)
    for name in {*model.qvel_channels, *model.sensor_channels} & channels.keys() - kept:
        channel = channels.pop(name)
        there = np.isin(channel.time, stamps)
        if name in model.qvel_channels and there.sum() >= 2:
            channels[name] = Channel(
                channel.time[there], channel.values[there], channel.unit, channel.source
            )
    ordered = {n: channels[n] for n in recording.channels if n in channels}
    return replace(recording, channels=ordered)

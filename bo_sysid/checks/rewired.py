"""Recordings as they should be read."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from bo_sysid.checks.hypothesis import Wire
from bo_sysid.recording import Recording


def rewired(
    recordings: Sequence[Recording], wires: Mapping[str, Wire], delay: float, kind: str
) -> tuple[Recording, ...]:
    """Return recordings whose channels are what they are called.

    Args:
        recordings: as they were read.
        wires: by channel, what it really is.
        delay: added to the stamps of the controls, in [s].
        kind: of the channels that are delayed: "ctrl" or "goal".
    """
    return tuple(_rewired(r, wires, delay, kind) for r in recordings)


def _rewired(recording: Recording, wires: Mapping[str, Wire], delay: float, kind: str) -> Recording:
    channels = {}
    for name, own in recording.channels.items():
        wire = wires.get(name, Wire(name))
        c = recording.channels[wire.source]
        time = c.time + delay if name.startswith(f"{kind}.") else c.time
        values = wire.sign * wire.scale * c.values + wire.offset
        if wire.less:
            other = wires.get(wire.less, Wire(wire.less))
            shown = recording.channels[other.source]
            less = other.sign * other.scale * shown.values + other.offset
            values = values - np.interp(c.time, shown.time, less)
        channels[name] = replace(c, time=time, values=values, unit=own.unit, hold=own.hold)
    return replace(recording, channels=channels)

"""The noise of each observed channel."""

from collections.abc import Mapping, Sequence

import numpy as np

from bo_sysid.effects import Machine
from bo_sysid.errors import RecordingError
from bo_sysid.recording import Recording
from bo_sysid.recording.noise import noise_sigma

_LEAST = 1e-9
_MOVES = 15.0  # [sigma] range below which a joint shows noise only


def channel_noise(
    recordings: Sequence[Recording], machine: Machine, given: Mapping[str, float]
) -> dict[str, float]:
    """Return σ of each position channel: what is given, else from third differences.

    Recorded velocities are not observed: most are differences of the same positions, with noise
    that is neither white nor independent.

    Raises:
        RecordingError: no joint's position was recorded, or none moves.
    """
    found: dict[str, float] = {}
    moves = False
    for name in (n for n in machine.channels if n.startswith("qpos.")):
        series = [r.channels[name] for r in recordings if name in r.channels]
        sigma = float(np.median([noise_sigma(c.time, c.values) for c in series]))
        sigma = float(given.get(name, given.get("qpos", sigma)))
        moved = max(float(np.ptp(c.values)) for c in series)
        if moved > 0:
            found[name] = max(sigma, _LEAST, 1e-6 * moved)
            moves |= moved > _MOVES * sigma
    if not moves:
        raise RecordingError(
            "no joint of the model moves by more than its noise in the recordings: there is "
            "nothing to diagnose; record motion of every joint (bo-sysid excite)"
        )
    return found

"""The noise of each observed channel."""

from collections.abc import Mapping, Sequence

import numpy as np

from bo_sysid.effects import Machine
from bo_sysid.errors import RecordingError
from bo_sysid.recording import Recording
from bo_sysid.recording.noise import MOVES, noise_sigma

_LEAST = 1e-9


def channel_noise(
    recordings: Sequence[Recording], machine: Machine, given: Mapping[str, float]
) -> dict[str, float]:
    """Return σ of each position channel: what is given, else what `noise_sigma` estimates.

    Recorded velocities are not observed: most are differences of the same positions, with noise
    that is neither white nor independent.

    Raises:
        RecordingError: no joint's position was recorded, or none moves.
    """
    found: dict[str, float] = {}
    most = 0.0, ""  # [sigma] by which a channel moves, and which
    for name in (n for n in machine.channels if n.startswith("qpos.")):
        series = [r.channels[name] for r in recordings if name in r.channels]
        sigma = float(np.median([noise_sigma(c.time, c.values) for c in series]))
        sigma = float(given.get(name, given.get("qpos", sigma)))
        moved = max(float(np.ptp(c.values)) for c in series)
        if moved > 0:
            found[name] = max(sigma, _LEAST, 1e-6 * moved)
            most = max(most, (moved / found[name], name))
    recorded = ", ".join(r.name for r in recordings)
    if not found:
        raise RecordingError(
            f"{recorded}: no position of the model's joints that moves is recorded; a diagnosis "
            "needs a channel qpos.<joint> (bo-sysid check says what was read)"
        )
    if most[0] <= MOVES:
        raise RecordingError(
            f"{recorded}: no joint moves by more than its noise; {most[1]} moves most, by "
            f"{most[0]:.3g} sigma, and {MOVES:g} are needed; record motion of every joint "
            "(bo-sysid excite)"
        )
    return found

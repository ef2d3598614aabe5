"""The noise of each observed channel."""

from collections.abc import Collection, Mapping, Sequence
from itertools import product

import numpy as np
from jaxtyping import Float

from bo_sysid.effects import Machine
from bo_sysid.errors import RecordingError
from bo_sysid.mjcf.joints import quaternions
from bo_sysid.recording import Channel, Recording, stated_for
from bo_sysid.recording.noise import MOVES, noise_sigma, underrated
from bo_sysid.recording.timing_noise import speeds, timing_noise
from bo_sysid.simulation.windows import Windows

_LEAST = 1e-9
_FIXED = 0.3  # of the noise of its numbers, that the length of a quaternion shows at most


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
        sigma = float(np.median([_at_rest(c) for c in series]))
        sigma = float(stated_for(name, given, sigma))
        moved = max(float(np.ptp(c.values)) for c in series)
        if moved > 0:
            found[name] = max(sigma, _LEAST, 1e-6 * moved)
            most = max(most, (moved / found[name], name))
    poses = [q for q in quaternions(machine.model) if set(q) <= set(found)]
    for name, factor in _of_poses(recordings, poses).items():
        found[name] *= factor if stated_for(name, given, None) is None else 1.0
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


def _at_rest(channel: Channel) -> float:
    """Return σ of a channel without what jitter of its stamps adds in motion."""
    timing = timing_noise(channel.time, channel.values)
    return timing.sigma if timing else noise_sigma(channel.time, channel.values)


def noise_of(
    windows: Windows, recordings: Sequence[Recording], sigma: Mapping[str, float]
) -> Float[np.ndarray, "W H c"]:
    """Return the standard deviation of each observation, with what jitter of its stamps adds."""
    found = np.broadcast_to([sigma[n] for n in windows.channels], windows.observed.shape).copy()
    time = windows.time[:, None] + (windows.step + windows.fraction) * windows.timestep
    for number, recording in enumerate(recordings):
        own = windows.recording == number
        for k, name in enumerate(windows.channels):
            channel = recording.channels.get(name)
            timing = channel and timing_noise(channel.time, channel.values)
            if channel and timing:
                speed = np.interp(time[own], channel.time, speeds(channel.time, channel.values))
                found[own, :, k] = np.hypot(sigma[name], timing.late * speed)
    return found


def timing_note(recordings: Sequence[Recording], channels: Collection[str]) -> tuple[str, ...]:
    """Return of which channels samples are taken beside their stamps, in words."""
    late: dict[str, float] = {}
    for name, recording in product(channels, recordings):
        channel = recording.channels.get(name)
        timing = channel and timing_noise(channel.time, channel.values)
        if timing:
            late[name] = max(timing.late, late.get(name, 0.0))
    if not late:
        return ()
    return (
        f"Samples of {', '.join(late)} were taken {1e3 * max(late.values()):.2g} ms beside their "
        "stamps (standard deviation), which counts as noise in proportion to speed.",
    )


def _of_poses(
    recordings: Sequence[Recording], poses: Sequence[tuple[str, ...]]
) -> dict[str, float]:
    """Return the factor of σ by number of each quaternion whose length is kept at 1.

    Noise that turns a pose by equal angles about all axes moves number i by √(1 - qᵢ²) of it: less
    where the number is near 1.
    """
    factors = {}
    for numbers in poses:
        complete = [r for r in recordings if all(n in r.channels for n in numbers)]
        if not complete or not all(_of_length_one(r, numbers) for r in complete):
            continue
        for name in numbers:
            values = np.concatenate([r.channels[name].values for r in complete])
            factors[name] = underrated(np.sqrt(np.clip(1.0 - values**2, 0.0, 1.0)))
    return factors


def _of_length_one(recording: Recording, names: Sequence[str]) -> bool:
    """Whether the length of a quaternion has less noise than its numbers."""
    found = [recording.channels[n] for n in names]
    if len({len(c.values) for c in found}) > 1:
        return False
    noise = max(noise_sigma(c.time, c.values) for c in found)
    length = np.linalg.norm(np.stack([c.values for c in found]), axis=0)
    return bool(np.std(length) < _FIXED * noise)

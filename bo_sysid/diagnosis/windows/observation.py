"""What the channels show of a trajectory, after the readings that a hypothesis has of them."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from bo_sysid.effects import Part
from bo_sysid.effects.readings import readings
from bo_sysid.simulation import State, Trajectory
from bo_sysid.simulation.windows import Layout, Windows, predicted


def observe(
    layout: Layout, windows: Windows, trajectory: Trajectory, parts: Sequence[Part]
) -> Float[np.ndarray, "W H c"]:
    """Return what the channels show of a trajectory, after the readings among `parts`."""
    true = predicted(layout, windows, trajectory)
    shown = true.copy()
    for r in readings(parts).values():
        if r.channel in windows.channels:
            source = windows.channels.index(r.source or r.channel)
            value = true[..., source]
            if r.delay:
                value = value + _delayed(layout, windows, trajectory, source, r.delay)
            shown[..., windows.channels.index(r.channel)] = (1.0 + r.scale) * value + r.offset
    return shown


def undone(layout: Layout, shown: State, parts: Sequence[Part]) -> State:
    """Return states that channels show, with the readings among `parts` undone.

    q = (shown - offset) / (1 + scale), and rates alike, of hinges and slides. What a delay does to
    a start is small.
    """
    qpos, qvel = shown.qpos.copy(), shown.qvel.copy()
    for r in readings(parts).values():
        if r.channel not in layout.qpos or 1.0 + r.scale == 0.0:
            continue
        channel, of = (layout.qpos[name] for name in (r.channel, r.source or r.channel))
        rate, rate_of = int(layout.velocity[channel]), int(layout.velocity[of])
        if min(rate, rate_of) >= 0:
            qpos[:, of] = (shown.qpos[:, channel] - r.offset) / (1.0 + r.scale)
            qvel[:, rate_of] = shown.qvel[:, rate] / (1.0 + r.scale)
    return replace(shown, qpos=qpos, qvel=qvel)


def _delayed(
    layout: Layout, windows: Windows, trajectory: Trajectory, channel: int, delay: float
) -> Float[np.ndarray, "W H"]:
    """Return what a channel shows `delay` earlier minus what it shows now.

    Before the start of the window the motion is continued with the acceleration that it had there.
    """
    at = (windows.step + windows.fraction) - delay / windows.timestep
    inside = np.clip(at, 0.0, windows.steps)
    step = np.minimum(np.floor(inside).astype(int), windows.steps - 1)
    now = replace(
        windows,
        channels=(windows.channels[channel],),
        observed=windows.observed[..., channel : channel + 1],
    )
    then = replace(now, step=step, fraction=inside - step)
    late = predicted(layout, then, trajectory)[..., 0]
    before, still = np.minimum(at, 0.0), np.zeros_like(inside)
    q0, q1, q2 = (
        predicted(layout, replace(now, step=np.full_like(step, k), fraction=still), trajectory)
        for k in range(3)
    )
    # Newton's polynomial through the first three steps
    late = late + before * (q1 - q0)[..., 0]
    late = late + 0.5 * before * (before - 1) * (q2 - 2 * q1 + q0)[..., 0]
    return np.asarray(late - predicted(layout, now, trajectory)[..., 0])

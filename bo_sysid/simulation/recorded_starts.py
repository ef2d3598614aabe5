"""Where windows begin: recorded states, what was not recorded estimated, loops closed."""

from collections.abc import Sequence
from dataclasses import replace

import mujoco
import numpy as np
from jaxtyping import Float, Int

from bo_sysid.arrays import Ctrl
from bo_sysid.effects.balance import balance_notes
from bo_sysid.mjcf import Loops, Model
from bo_sysid.recording import Recording
from bo_sysid.simulation.activations import activations
from bo_sysid.simulation.smoothing import smooth
from bo_sysid.simulation.state import State

WARMSTART = "aux.qacc_warmstart"  # recorded only from simulated plants
_OPEN = 1e-3  # [m] or [rad] that a loop may stay open without a word


def recorded_start(
    model: Model,
    compiled: mujoco.MjModel,
    recording: Recording,
    time: np.ndarray,
    table: np.ndarray,
    channels: Sequence[str],
    first: Int[np.ndarray, " W"],
    ctrl: Ctrl,
) -> tuple[State, tuple[str, ...]]:
    """Return the recorded states; velocities that were not recorded come from a smoother.

    Joints that nothing measures are at rest where the model puts them.
    """
    positions = np.tile(compiled.qpos0, (len(table), 1))
    for k, name in enumerate(model.qpos_channels):
        if name in channels:
            positions[:, k] = table[:, channels.index(name)]
    qpos = positions[first]
    notes: tuple[str, ...] = ()
    at_rest = [n.removeprefix("qvel.") in model.unrecorded for n in model.qvel_channels]
    recorded = [n in channels for n in model.qvel_channels]
    qvel = np.zeros((len(first), compiled.nv))
    for k, name in enumerate(model.qvel_channels):
        if recorded[k]:
            qvel[:, k] = table[first, channels.index(name)]
    if not np.logical_or(recorded, at_rest).all() or np.isnan(qvel).any():
        have = np.isfinite(positions).all(axis=1)
        rank = np.cumsum(have) - 1
        fit = smooth(compiled, time[have], positions[have], rank[first])
        kept = (np.array(recorded) & np.isfinite(qvel)) | np.array(at_rest)
        qvel = np.where(kept, qvel, fit.velocity)
        if not any(recorded):  # the smoother's position belongs to the smoother's velocity
            zero = np.zeros((len(first), compiled.nv))
            state = State(qpos, zero, np.zeros((len(first), 0)))
            qpos = state.moved(compiled, np.hstack([fit.offset, zero])).qpos
        notes = _estimated(recording, fit.samples[~kept.all(axis=0)])
    act = activations(model, compiled, recording, time[first], ctrl)
    notes += tuple(f"{recording.name}: {n}" for n in balance_notes(compiled, recording))
    return State(qpos, qvel, act, _warmstart(compiled, recording, time[first])), notes


def _estimated(recording: Recording, samples: Int[np.ndarray, " j"]) -> tuple[str, ...]:
    """Return in words from how many samples the velocities of some joints are estimated."""
    if not len(samples):
        return ()
    few, many = int(samples.min()), int(samples.max())
    count = f"{few}" if few == many else f"{few} to {many}"
    return (f"{recording.name}: start velocities are estimated from {count} samples each",)


def on_loops(loops: Loops, recording: Recording, start: State) -> tuple[State, tuple[str, ...]]:
    """Return the states with their loops closed, and notes on that in words.

    States that were recorded whole, as those of a simulated plant, stay as they are.
    """
    whole = all(f"qvel.{j}" in recording.channels for j in loops.joints)
    if not loops or (whole and not loops.silent):
        return start, ()
    if loops.silent:
        start = replace(start, qpos=loops.followed(start.qpos))
    start = start.closed(loops)
    which = " and ".join(loops.joints)
    note = f"{which} begin where the model's equalities put them"
    opening = float(loops.opening(start.qpos).max())
    if opening > _OPEN:
        return start, (
            f"{recording.name}: {note}, which stay open by up to {opening:.2g} m or rad: are the "
            "zeros and signs of the other joints right, and the lengths of the links?",
        )
    return start, (f"{recording.name}: {note}",)


def _warmstart(
    compiled: mujoco.MjModel, recording: Recording, start: Float[np.ndarray, " W"]
) -> Float[np.ndarray, "W nv"] | None:
    names = [f"{WARMSTART}.{k}" for k in range(compiled.nv)]
    if any(n not in recording.channels for n in names):
        return None
    return np.stack([recording.channels[n].at(start) for n in names], axis=1)

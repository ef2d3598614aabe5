"""How the joints moved in the recordings: velocities and accelerations from a filter."""

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
from jaxtyping import Float
from scipy.signal import savgol_filter

from bo_sysid.errors import RecordingError
from bo_sysid.mjcf.joints import SCALAR
from bo_sysid.recording import Recording
from bo_sysid.recording.alignment import stretches

_SMOOTHING = 0.062  # [s] length of the filters that give velocities and accelerations for scales
_FEWEST = 5  # samples that the shortest filter needs


@dataclass(frozen=True)
class Motion:
    """Position, velocity and acceleration of one joint on even grids, all recordings in a row."""

    times: tuple[np.ndarray, ...]
    q: np.ndarray
    v: np.ndarray
    a: np.ndarray


def motion_of(recordings: Sequence[Recording], joint: str) -> Motion:
    """Return how one joint moved in all recordings.

    Raises:
        RecordingError: a recording has too few samples of it.
    """
    grids, q, v, a = [], [], [], []
    for r in recordings:
        c = r.channels[f"qpos.{joint}"]
        dt = float(np.median(np.diff(c.time)))
        ends = [(c.time[s.start], c.time[s.stop - 1]) for s in stretches(c.time)]
        pieces = [np.arange(first, last, dt) for first, last in ends]
        pieces = [grid for grid in pieces if len(grid) >= _FEWEST]
        if not pieces:
            raise RecordingError(
                f"{r.name}: {len(c.time)} samples of qpos.{joint} tell nothing of how it moves; at "
                f"least {_FEWEST + 1} are needed; leave the recording out"
            )
        grids.append(np.concatenate(pieces))
        for grid in pieces:
            x = np.interp(grid, c.time, c.values)
            half = int(np.clip(round(0.5 * _SMOOTHING / dt), 2, (len(x) - 1) // 4 or 1))
            q.append(x)
            v.append(savgol_filter(x, 2 * half + 1, min(3, 2 * half), deriv=1, delta=dt))
            a.append(savgol_filter(x, 4 * half + 1, min(3, 2 * half), deriv=2, delta=dt))
    return Motion(tuple(grids), np.concatenate(q), np.concatenate(v), np.concatenate(a))


def along(
    model: mujoco.MjModel, recording: Recording, time: Float[np.ndarray, " n"]
) -> tuple[Float[np.ndarray, "n nq"], Float[np.ndarray, "n nv"], Float[np.ndarray, "n nv"]]:
    """Return positions, velocities and accelerations of a model at some times in [s].

    Joints that were not recorded, and such with several coordinates, rest where the model puts
    them; so do those of which there are too few samples.
    """
    qpos, qvel, qacc = np.tile(model.qpos0, (len(time), 1)), *np.zeros((2, len(time), model.nv))
    for j in range(model.njnt):
        name, dof = model.joint(j).name, model.jnt_dofadr[j]
        if int(model.jnt_type[j]) not in SCALAR or f"qpos.{name}" not in recording.channels:
            continue
        seen = recording.channels[f"qpos.{name}"]
        qpos[:, model.jnt_qposadr[j]] = np.interp(time, seen.time, seen.values)
        try:
            motion = motion_of([recording], name)
        except RecordingError:  # too short
            continue
        qvel[:, dof], qacc[:, dof] = (
            np.interp(time, motion.times[0], x) for x in (motion.v, motion.a)
        )
        if rate := recording.channels.get(f"qvel.{name}"):
            qvel[:, dof] = np.interp(time, rate.time, rate.values)
    return qpos, qvel, qacc

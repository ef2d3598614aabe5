"""What of a log can be compared with a model: hinges and slides that were recorded for a while."""

import copy
from collections.abc import Sequence

import mujoco
import numpy as np

from bo_sysid.checks.motion import beyond_range
from bo_sysid.checks.traces import Traces
from bo_sysid.mjcf.joints import SCALAR
from bo_sysid.recording import Recording

_LEAST = 60  # instants that are looked at
_RARELY = 0.01  # of the instants, in which a tendon may be at its limit


def comparable(
    model: mujoco.MjModel, recordings: Sequence[Recording], most: int
) -> tuple[mujoco.MjModel, Traces] | str:
    """Return a copy of a model without stops that did not act, and traces to compare it with.

    Where they cannot be compared, why.

    Args:
        model: the compiled model; it is not changed.
        recordings: of the machine.
        most: number of instants that are looked at.
    """
    positions = [f"qpos.{model.joint(j).name}" for j in range(model.njnt)]
    measured = [n for n in positions if all(n in r.channels for r in recordings)]
    if not all(int(t) in SCALAR for t in model.jnt_type) or not measured:
        return "a joint is neither a hinge nor a slide, or none was recorded"
    traces = Traces(recordings, measured, most)
    if traces.count < _LEAST:
        return "the recordings are too short"
    if tight := _tight(model, traces):
        return f"the tendon {tight} is at its limit in the recordings, and pulls as nothing tells"
    free = copy.copy(model)
    for joint in beyond_range(model, recordings):
        free.jnt_limited[free.joint(joint).id] = 0
    return free, traces


def _tight(model: mujoco.MjModel, traces: Traces) -> str:
    """Return a tendon that is at its limit in the recorded poses, empty where none is."""
    if not model.tendon_limited.any():
        return ""
    poses, data = np.tile(model.qpos0, (traces.count, 1)), mujoco.MjData(model)
    for name in traces.measured:
        column = int(model.joint(name.removeprefix("qpos.")).qposadr[0])
        poses[:, column] = traces.column(name, held=False)
    lengths = np.empty((traces.count, model.ntendon))
    for length, pose in zip(lengths, poses, strict=True):
        data.qpos[:] = pose
        mujoco.mj_fwdPosition(model, data)
        length[:] = data.ten_length
    low, high = (model.tendon_range + np.array([1, -1]) * model.tendon_margin[:, None]).T
    at = ((lengths < low) | (lengths > high)).mean(axis=0) * model.tendon_limited
    worst = int(np.argmax(at))
    return str(model.tendon(worst).name) if at[worst] > _RARELY else ""

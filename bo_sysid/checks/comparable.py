"""What of a log can be compared with a model: hinges and slides that were recorded for a while."""

import copy
from collections.abc import Sequence

import mujoco

from bo_sysid.checks.motion import beyond_range
from bo_sysid.checks.traces import Traces
from bo_sysid.recording import Recording

_LEAST = 60  # instants that are looked at
_SCALAR = (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE))


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
    if not all(int(t) in _SCALAR for t in model.jnt_type) or not measured:
        return "a joint is neither a hinge nor a slide, or none was recorded"
    traces = Traces(recordings, measured, most)
    if traces.count < _LEAST:
        return "the recordings are too short"
    free = copy.copy(model)
    for joint in beyond_range(model, recordings):
        free.jnt_limited[free.joint(joint).id] = 0
    return free, traces

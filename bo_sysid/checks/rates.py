"""Positions and speeds of joints that do not describe one motion, where no forces say which errs.

A floating base has no balance of forces that is known, and so the wiring of such a machine is not
tested; what a joint's position and its speed say of each other needs none.
"""

from collections.abc import Sequence

import mujoco
import numpy as np

from bo_sysid.checks.flags import Flag
from bo_sysid.checks.speeds import EXACT, MIN_CORRELATION, SLIDING, TURNING
from bo_sysid.checks.traces import Traces
from bo_sysid.mjcf.joints import HINGE, SCALAR
from bo_sysid.recording import Recording

_MOST, _LEAST = 1500, 60  # instants that are looked at


def rate_flags(model: mujoco.MjModel, recordings: Sequence[Recording]) -> tuple[Flag, ...]:
    """Return the hinges and slides whose recorded speed is not the rate of their position.

    Args:
        model: the compiled model.
        recordings: of the machine.
    """
    pairs = {}
    for j in range(model.njnt):
        names = [f"{kind}.{model.joint(j).name}" for kind in ("qpos", "qvel")]
        if int(model.jnt_type[j]) in SCALAR and all(
            n in r.channels for n in names for r in recordings
        ):
            pairs[j] = names
    if not pairs:
        return ()
    traces = Traces(recordings, [n for names in pairs.values() for n in names], _MOST)
    if traces.count < _LEAST:
        return ()
    flags = []
    for j, (position, speed) in pairs.items():
        rate = traces.column(position, held=False, order=1)
        recorded = traces.column(speed, held=False)
        units = TURNING if int(model.jnt_type[j]) == HINGE else SLIDING
        flags += _flags(position, speed, rate, recorded, [u for _, u in units])
    return tuple(flags)


def _flags(
    position: str, speed: str, rate: np.ndarray, recorded: np.ndarray, units: Sequence[float]
) -> list[Flag]:
    """Return what a speed and the rate of a position say of each other."""
    if not (rate.std() and recorded.std()):
        return []
    correlation = float(np.corrcoef(rate, recorded)[0, 1])
    if abs(correlation) < MIN_CORRELATION:
        return []
    factor, found = float(rate.std() / recorded.std()), []
    if correlation < 0:
        found.append(("sign", "have opposite signs: one of the two is reversed"))
    near = [u for u in (*units, *(1 / u for u in units)) if abs(np.log(factor / u)) < np.log(EXACT)]
    if near:
        found.append(
            ("unit", f"differ by a factor of {factor:.3g}: one of the two is in another unit")
        )
    return [
        Flag("wrong", kind, (position, speed), f"{speed} and the rate of {position} {what}.",
             {"correlation": correlation, "factor": factor})
        for kind, what in found
    ]  # fmt: skip

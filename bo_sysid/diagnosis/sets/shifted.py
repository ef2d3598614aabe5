"""Sets that make a machine late as a whole: motors that act late, or encoders that show late.

A machine whose motors all act d later moves as it would, d later, and encoders that all show it d
later show the same. What tells the two apart is only what was sent before a log, which is not
known, and how a motion went on before a window, which is not exact.
"""

import numpy as np

from bo_sysid.diagnosis.sets.fit import Fit
from bo_sysid.diagnosis.windows.problem import Problem

_ALIKE = 0.1  # of their mean, by which delays of one cause differ at most


def same_but_late(one: Fit, two: Fit, problem: Problem) -> bool:
    """Whether two sets differ in what makes the whole machine late, and in nothing else."""
    others = (_besides_lateness(one, problem), _besides_lateness(two, problem))
    return others[0] is not None and others[0] == others[1]


def _besides_lateness(fit: Fit, problem: Problem) -> frozenset[tuple[str, str]] | None:
    """Return the other names of a set that delays all motors, or all channels, by one time.

    None where it delays neither, or not all alike.
    """
    sites = {"actuator_delay": problem.machine.actuators, "sensor_delay": problem.windows.channels}
    for effect, whole in sites.items():
        late = [k for k, c in enumerate(fit.members) if c.effect.id == effect]
        delays = np.array([fit.x[k][0] for k in late])
        named = {fit.members[k].site.name for k in late}
        if late and named == set(whole) and np.ptp(delays) <= _ALIKE * delays.mean():
            return frozenset(c.key for c in fit.members if c.effect.id != effect)
    return None

"""What windows longer than those of a search show: where those were too short to show anything."""

import numpy as np

from bo_sysid.diagnosis.windows.cutting import cut_problem
from bo_sysid.diagnosis.windows.evidence import Evidence
from bo_sysid.diagnosis.windows.forecast import LONGER, fitted
from bo_sysid.diagnosis.windows.hypothesis import Hypothesis
from bo_sysid.diagnosis.windows.problem import Problem
from bo_sysid.errors import RecordingError
from bo_sysid.recording.alignment import instants_in

_WINDOWS = 24
_SHORT = 0.5  # of the longer windows, below which those of a search are too short to say nothing
# [sigma] in half of the longer windows. Of hoppers and cheetahs of which nothing is missing it was
# 2.7 to 5.1, since noise of a start grows; of a balancer with friction, whose place on the floor
# was not recorded, 340, where windows of 32 ms left .63.
_MUCH = 20.0


def too_short(problem: Problem) -> bool:
    """Return whether windows are much shorter than those by which a hold-out is judged."""
    w = problem.windows
    return float((w.step[:, -1] + w.fraction[:, -1]).mean() * w.timestep) < _SHORT * LONGER


def shows_more(evidence: Evidence, hypothesis: Hypothesis, timestep: float) -> float:
    """Return what longer windows leave in [sigma] where it is much, else 0.

    Windows in contact are short, since impacts soon decide. The starts of what was not recorded
    are fitted in each, and where they are short enough follow anything.

    Args:
        evidence: the training recordings.
        hypothesis: what is answered.
        timestep: of the simulation in [s], which the hypothesis divides.
    """
    compared = {*evidence.model.qpos_channels, *evidence.sigma}
    try:
        each = [max(instants_in(LONGER, [r], compared), 4) for r in evidence.recordings]
        problem = cut_problem(
            evidence.model, evidence.machine, evidence.recordings, evidence.sigma, (),
            horizon=each, timestep=timestep, engine=evidence.engine,
            laws=evidence.laws, input_noise=evidence.input_noise,
        )  # fmt: skip
    except RecordingError:  # none is that long
        return 0.0
    problem = problem.rows(problem.windows.evenly(_WINDOWS))
    squares = (fitted(problem, hypothesis).residual ** 2).sum(axis=(1, 2))
    dof = np.maximum((problem.weight > 0).sum(axis=(1, 2)) - problem.start_size, 1)
    left = float(np.median(np.sqrt(squares / dof)))
    return left if left > _MUCH else 0.0

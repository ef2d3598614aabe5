"""What a set leaves of windows that it was not fitted to, by the simulator."""

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from bo_sysid.diagnosis.sets.fit import Fit
from bo_sysid.diagnosis.sets.refit import Effort, refit
from bo_sysid.diagnosis.windows.linear import Linear
from bo_sysid.diagnosis.windows.projection import project
from bo_sysid.diagnosis.windows.settling import first_start, settle

_FOLDS = 5
_WITHOUT = Effort(iterations=2, gain=1.0)  # from where all windows led


def cross_validated(frame: Linear, fit: Fit) -> Fit:
    """Return a fit whose `cv` is what fits to the other windows leave of each block.

    Every fifth block is left out at a time, the set fitted to the rest from where it is, and the
    blocks simulated from the starts that suit them. Far from the recordings slopes at the fit
    foretell neither where the other blocks lead nor what that leaves: of one machine's friction,
    at its bounds, they foretold 4.5 times what the fit leaves of a block.
    """
    block, left = frame.problem.block, _squares(frame, fit.residual)
    for fold in range(_FOLDS):
        out = block % _FOLDS == fold
        if not out.any() or out.all():
            continue
        known, own = frame.rows(~out), frame.rows(out)
        made = refit(
            known, fit.members, fit.x, groups=fit.groups, start=fit.start.rows(~out),
            guess=fit.hypothesis, columns=fit.jacobian[~out], effort=_WITHOUT,
        )  # fmt: skip
        start, r = first_start(own.problem, made.hypothesis, fit.start.rows(out))
        r = settle(own.problem, own, made.hypothesis, start, r=r)[1]
        left[out] = _squares(own, r)
    return replace(fit, cv=np.bincount(block, left, len(fit.cv)), simulated=True)


def _squares(frame: Linear, residual: Float[np.ndarray, "W R"]) -> Float[np.ndarray, " W"]:
    """Return what each window leaves, whatever its start could do."""
    return np.asarray((project(frame.Q, residual) ** 2).sum(axis=1))

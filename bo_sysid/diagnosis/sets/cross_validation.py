"""What a set leaves of each block of windows with magnitudes from the others, by the simulator."""

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from bo_sysid.diagnosis.sets.fit import CV_RIDGE, Fit, by_block, nearest
from bo_sysid.diagnosis.sets.space import Space
from bo_sysid.diagnosis.windows.linear import Linear, project
from bo_sysid.diagnosis.windows.settling import first_start, settle

_TINY = 1e-12


def cross_validated(frame: Linear, fit: Fit) -> Fit:
    """Return a fit whose `cv` is what the simulator leaves of each block.

    The magnitudes without a block are where slopes at the fit lead, within their bounds, as if the
    fit were the least of all blocks; its windows begin where that leaves least. What slopes
    foretell of the block itself is no guide far from the recordings: of a friction at its bounds
    they foretold four times of one block what is left there.
    """
    problem, own = frame.problem, Space.of(frame.problem, fit.members)
    theta = own.vector(fit.x, fit.hypothesis)
    cv = fit.cv.copy()
    for k, other in enumerate(_without_each(frame, fit, (own.low - theta, own.high - theta))):
        rows = problem.block == k
        part, hypothesis = frame.rows(rows), own.hypothesis(theta + other)
        start, r = first_start(part.problem, hypothesis, fit.start.rows(rows))
        r = settle(part.problem, part, hypothesis, start, r=r)[1]
        cv[k] = float((project(part.Q, r) ** 2).sum())
    return replace(fit, cv=cv, simulated=True)


def _without_each(
    frame: Linear, fit: Fit, room: tuple[Float[np.ndarray, " p"], Float[np.ndarray, " p"]]
) -> Float[np.ndarray, "b p"]:
    """Return how far the magnitudes move when each block is left out.

    With G and g the normal equations of all blocks at the fit, and G_k, g_k those of block k, that
    is the difference of two minima within the room that the bounds leave,

        argmin ½ z'(G - G_k + λ)z - (g - g_k)'z  and  argmin ½ z'(G + λ)z - g'z,

    on columns of unit length.
    """
    y = project(frame.Q, fit.residual)
    S = project(frame.Q, fit.jacobian.astype(float))
    scale = np.sqrt((S**2).sum(axis=(0, 1))) + _TINY
    G, g, _ = by_block(S / scale, y, frame.problem.block)
    within = (np.minimum(room[0], 0.0) * scale, np.maximum(room[1], 0.0) * scale)
    ridge = CV_RIDGE * np.eye(len(scale))
    all_of_them = nearest(G.sum(axis=0) + ridge, g.sum(axis=0), within)
    others = [
        nearest(G.sum(axis=0) - G[k] + ridge, g.sum(axis=0) - g[k], within) for k in range(len(G))
    ]
    return np.asarray(np.clip((np.array(others) - all_of_them) / scale, *room))

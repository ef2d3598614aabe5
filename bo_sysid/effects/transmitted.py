"""Forces that actuators make along joints which they do not drive themselves.

They come through tendons, sites and closed chains. Where such a joint moves slowly, what rubs there
may be far above what its own inertia needs, so that only these forces tell how much it may be.
"""

from collections.abc import Sequence

import mujoco
import numpy as np
from jaxtyping import Float

from bo_sysid.effects.recorded_forces import forces_along, unseen, with_control
from bo_sysid.effects.recorded_motion import along
from bo_sysid.mjcf.commands import driven_joint
from bo_sysid.mjcf.loops import Loops
from bo_sysid.recording import Recording

_INSTANTS = 200
_LEAST = 0.1  # of the largest ratio of two joints of a loop: near a dead point none is taken


def transmitted(
    model: mujoco.MjModel, recordings: Sequence[Recording]
) -> Float[np.ndarray, "T nv"]:
    """Return the forces along all degrees of freedom that come from elsewhere.

    Args:
        model: the compiled nominal model.
        recordings: with positions of its joints and controls, or without.

    Returns:
        Forces in [N m] or [N] at instants spread over the recordings, zero where every actuator
        drives a joint of its own and no chain is closed.
    """
    recorded = [with_control(model, r) for r in recordings]
    loops = Loops.of(model, unseen(model, recordings))
    own = {a for a in range(model.nactuator) if driven_joint(model, a)}
    if not recorded or (not loops and all(acting <= own for acting in recorded)):
        return np.zeros((1, model.nv))
    count = max(_INSTANTS // len(recorded), 1)
    found = []
    for r, acting in zip(recordings, recorded, strict=True):
        time = np.linspace(*r.span, count)
        every, direct = (forces_along(model, r, time, a)[1] for a in (acting, acting & own))
        through = every if not loops else _through(loops, along(model, r, time)[0], every)
        found.append(through - direct)
    return np.concatenate(found)


def _through(
    loops: Loops, qpos: Float[np.ndarray, "n nq"], forces: Float[np.ndarray, "n nv"]
) -> Float[np.ndarray, "n nv"]:
    """Return forces as closed chains pass them on.

    With velocities v = Z vᵢ of joints that are free, forces F do on these what Zᵀ F does; at a
    joint that follows it takes (Zᵀ F)ᵢ / Z_di to hold the free one that moves it most.
    """
    Z = loops.response(loops.closed(qpos, np.zeros((len(qpos), forces.shape[1])))[0])
    out = np.asarray(np.einsum("nji,nj->ni", Z, forces))
    for d in loops.dofs:
        i = int(np.abs(Z[:, d]).mean(axis=0).argmax())
        ratio = Z[:, d, i]
        determined = np.abs(ratio) > _LEAST * np.abs(ratio).max(initial=0.0)
        out[:, d] = np.divide(out[:, i], ratio, where=determined, out=np.zeros(len(out)))
    return out

"""What the recordings show of contact: none, one that lasts, or impacts."""

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float

from bo_sysid.mjcf import Model
from bo_sysid.mjcf.touching import can_touch, comes_and_goes, ever_touching
from bo_sysid.recording import Recording

_APART = 2e-3  # [s] between recorded poses in which geoms may touch
_MOST = 5000  # poses of a recording by which contacts are seen to come and go


def without_unused_contact(model: Model, recordings: Sequence[Recording]) -> Model:
    """Return the model without contact, where none of its geoms touched as the machine moved.

    Most robots' geoms can touch, and most motion is free: where impacts decide nothing, windows may
    be long and slopes tell magnitudes. Where a coordinate was not recorded nothing is known.
    """
    compiled = model.compile()
    if not can_touch(compiled):
        return model
    for r in recordings:
        poses = _poses(model.qpos_channels, r)
        if poses is None or ever_touching(compiled, poses):
            return model
    return model.without_contact()


def shows_impacts(
    model: Model, recordings: Sequence[Recording], sigma: Mapping[str, float]
) -> bool:
    """Whether contacts come and go in recordings, for all that they tell.

    Where those that there are last, as of wheels that roll, motion is as smooth as without any.

    Args:
        model: the model.
        recordings: of positions.
        sigma: noise by channel.
    """
    compiled, names = model.compile(), model.qpos_channels
    if not can_touch(compiled):
        return False
    rng = np.random.default_rng(0)
    noise = np.array([sigma.get(n, 0.0) for n in names])
    for r in recordings:
        poses = _poses(names, r)
        if poses is None:
            return True
        poses = poses[np.unique(np.linspace(0, len(poses) - 1, _MOST).astype(int))]
        moved = poses + noise * rng.standard_normal(poses.shape)
        if comes_and_goes(compiled, poses, moved):
            return True
    return False


def _poses(names: Sequence[str], r: Recording) -> Float[np.ndarray, "W nq"] | None:
    """Return the poses of a recording, None where a coordinate was not recorded."""
    if not all(n in r.channels for n in names):
        return None
    stamps = np.concatenate([r.channels[n].time for n in names])
    time = stamps[np.unique(np.floor(stamps / _APART), return_index=True)[1]]
    return np.stack([r.channels[n].at(time) for n in names], axis=1)

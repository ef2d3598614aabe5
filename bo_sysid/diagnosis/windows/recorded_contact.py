"""What the recordings show of contact: none, one that lasts, or impacts, also with stops."""

from collections.abc import Mapping, Sequence

import mujoco
import numpy as np
from jaxtyping import Bool, Float

from bo_sysid.mjcf import Model
from bo_sysid.mjcf.joints import SCALAR
from bo_sysid.mjcf.touching import can_touch, comes_and_goes, ever_touching
from bo_sysid.recording import Recording

_APART = 2e-3  # [s] between recorded poses in which geoms may touch
_STRETCH = 0.3  # [s]
_AT_STOPS = 0.05  # share of stretches from which a machine counts as one that meets its stops
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
    """Whether contacts come and go in recordings, for all that they tell, or stops are met.

    Where those that there are last, as of wheels that roll, motion is as smooth as without any.

    Args:
        model: the model.
        recordings: of positions.
        sigma: noise by channel.
    """
    compiled, names = model.compile(), model.qpos_channels
    if meets_stops(compiled, recordings):
        return True
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


def meets_stops(model: mujoco.MjModel, recordings: Sequence[Recording]) -> bool:
    """Whether joints were at or beyond their stops in more than a few stretches of recordings.

    A stop is met at an instant, as a contact is, and yields as little.

    Args:
        model: the compiled model.
        recordings: of positions.
    """
    met = [_at_stops(model, r) for r in recordings]
    return bool(met) and float(np.concatenate(met).mean()) > _AT_STOPS


def _at_stops(model: mujoco.MjModel, r: Recording) -> Bool[np.ndarray, " k"]:
    """Return for each stretch of a recording whether a joint was at or beyond a stop in it."""
    begin, end = r.span
    at = np.zeros(max(int(np.ceil((end - begin) / _STRETCH)), 1), bool)
    for j in np.flatnonzero(model.jnt_limited):
        channel = r.channels.get(f"qpos.{model.joint(j).name}")
        if channel is not None and model.jnt_type[j] in SCALAR:
            inside = np.array([1.0, -1.0]) * model.jnt_margin[j]
            low, high = model.jnt_range[j] + inside
            beyond = channel.time[(channel.values < low) | (channel.values > high)]
            at[np.minimum(((beyond - begin) / _STRETCH).astype(int), len(at) - 1)] = True
    return at


def _poses(names: Sequence[str], r: Recording) -> Float[np.ndarray, "W nq"] | None:
    """Return the poses of a recording, None where a coordinate was not recorded."""
    if not all(n in r.channels for n in names):
        return None
    stamps = np.concatenate([r.channels[n].time for n in names])
    time = stamps[np.unique(np.floor(stamps / _APART), return_index=True)[1]]
    return np.stack([r.channels[n].at(time) for n in names], axis=1)

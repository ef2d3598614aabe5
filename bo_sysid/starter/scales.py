"""What a joint may lack, and how it moved: bounds and limits of a first study."""

from collections.abc import Sequence

import mujoco
import numpy as np
import pandas as pd

from bo_sysid.checks.motion import excitation, resting
from bo_sysid.effects.surveying import survey
from bo_sysid.mjcf import Model
from bo_sysid.mjcf.commands import driven_joint, other_drives
from bo_sysid.mjcf.joints import SLIDE
from bo_sysid.recording import Recording
from bo_sysid.recording.alignment import instants_in

_WINDOW = 0.3  # [s]
_RESTING = 2  # times the drive's standard deviation, that friction may be of what rests at times


def joint_scales(model: Model, recordings: Sequence[Recording]) -> pd.DataFrame:
    """Return bounds of what a joint may lack, and how it moved in any recording.

    Damping or a rotor that alone needs what the actuators gave, as a standard deviation, is the
    most that is worth trying, or twice what the model has where that is more; a joint without any
    is bounded by what moved it. Of friction it is twice that: a joint that rests most of the time
    needs less than its friction, as a standard deviation.
    """
    compiled = model.compile()
    machine = survey(compiled, recordings)
    motion = excitation(recordings, compiled)
    fastest = motion.groupby("joint")["fastest"].max()
    still = resting(motion)
    floating = _floating_by_joints(compiled)
    rows = []
    for name, joint in machine.joints.items():
        values = np.concatenate([r.channels[f"qpos.{name}"].values for r in recordings])
        force = sum(machine.actuators[a].force_std for a in joint.actuators)
        own = compiled.joint(name)
        rows.append(
            {
                "joint": name,
                "slides": int(own.type[0]) == SLIDE,
                "mute": "never moves in the log, which says nothing of it"
                if name in still
                else "is how the base floats: nothing rubs there"
                if name in floating
                else "",
                "friction": _bound(_RESTING * (force or joint.force), own.frictionloss),
                "damping": _bound((force or joint.force) / joint.speed, own.damping),
                "armature": _bound(force / joint.acceleration or joint.inertia, own.armature),
                "low": float(values.min()),
                "high": float(values.max()),
                "speed": float(fastest[name]),
            }
        )
    horizon = instants_in(_WINDOW, recordings, model.shown_channels)
    return pd.DataFrame(rows).assign(horizon=horizon)


def _bound(tried: float, own: np.ndarray) -> float:
    """Return the most of what a joint has that is worth trying; what the model has lies inside."""
    return max(tried, 2 * float(own[0]))


def _floating_by_joints(model: mujoco.MjModel) -> set[str]:
    """Return the joints by which a base floats in a plane: several of a body, none of them driven.

    Unlike bearings they are no part of the machine. One of them slides: two hinges of a body are a
    universal joint.
    """
    directly = {driven_joint(model, a) for a in range(len(model.actuator_trntype))}
    found: set[str] = set()
    for body in np.flatnonzero((model.body_parentid == 0) & (model.body_jntnum > 1)):
        first, count = int(model.body_jntadr[body]), int(model.body_jntnum[body])
        own = range(first, first + count)
        names = {model.joint(j).name for j in own}
        slides = (model.jnt_type[list(own)] == SLIDE).any()
        if slides and names.isdisjoint(directly) and not any(other_drives(model, n) for n in names):
            found |= names
    return found

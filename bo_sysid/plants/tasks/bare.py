"""No task: a model that is only moved and recorded."""

from typing import ClassVar

import mujoco
import numpy as np

from bo_sysid.plants.simulations import Simulations
from bo_sysid.plants.tasks.base import Start, VectorTask


class Bare(VectorTask):
    """Begins at the first keyframe, or at the reference position, at rest; has no reward.

    Args:
        control_timestep: time between two rows of controls in [s].
    """

    rewarded: ClassVar[bool] = False
    time_limit: float = np.inf

    def __init__(self, control_timestep: float) -> None:
        self.control_timestep = control_timestep

    def draw_start(self, model: mujoco.MjModel, rng: np.random.Generator) -> Start:
        """Return the first keyframe, or the reference position."""
        if model.nkey:
            return Start(np.array(model.key_qpos[0]), np.array(model.key_qvel[0]))
        return Start(np.array(model.qpos0))

    def get_observation(self, sims: Simulations) -> np.ndarray:
        """Positions and velocities."""
        return np.concatenate([sims.qpos, sims.qvel], axis=1)

    def get_reward(self, sims: Simulations) -> np.ndarray:
        """Return zeros."""
        return np.zeros(len(sims))

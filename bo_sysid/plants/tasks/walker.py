"""dm_control's planar walker: stand, walk, run."""

import mujoco
import numpy as np

from bo_sysid.plants.simulations import Simulations
from bo_sysid.plants.tasks.base import Start, VectorTask, register
from bo_sysid.plants.tasks.shaping import random_joints, tolerance

_HEIGHT = 1.2  # m


@register("walker", "stand", 0.0)
@register("walker", "walk", 1.0)
@register("walker", "run", 8.0)
class Walker(VectorTask):
    """Stay upright and move forward at `speed` in [m/s]; with 0, only stand."""

    control_timestep: float = 0.025
    time_limit: float = 25.0

    def __init__(self, speed: float) -> None:
        self.speed = speed

    def draw_start(self, model: mujoco.MjModel, rng: np.random.Generator) -> Start:
        """Draw all joints but the slides."""
        return Start(random_joints(model, rng))

    def get_observation(self, sims: Simulations) -> np.ndarray:
        """Orientation of every body (xx and xz), height of the torso, velocities."""
        orientations = sims.field("xmat")[:, 1:][:, :, [0, 2]].reshape(len(sims), -1)
        height = sims.named("body", "torso", "xpos")[:, 2:]
        return np.concatenate([orientations, height, sims.qvel], axis=1)

    def get_reward(self, sims: Simulations) -> np.ndarray:
        """(3 standing + upright) / 4, times (5 moving + 1) / 6."""
        height = sims.named("body", "torso", "xpos")[:, 2]
        standing = tolerance(height, _HEIGHT, np.inf, _HEIGHT / 2)
        upright = (1 + sims.named("body", "torso", "xmat")[:, 8]) / 2
        stand = (3 * standing + upright) / 4
        speed = sims.named("sensor", "torso_subtreelinvel", "data")[:, 0]
        if self.speed == 0.0:
            return stand
        moving = tolerance(speed, self.speed, np.inf, self.speed / 2, "linear", 0.5)
        return np.asarray(stand * (5 * moving + 1) / 6)

"""dm_control's two-link planar reacher: bring the finger to a target."""

from typing import ClassVar

import mujoco
import numpy as np

from bo_sysid.plants.simulations import Simulations
from bo_sysid.plants.tasks.base import Start, VectorTask, register
from bo_sysid.plants.tasks.shaping import random_joints, tolerance


@register("reacher", "easy", 0.05)
@register("reacher", "hard", 0.015)
class Reacher(VectorTask):
    """Rewarded while the finger touches a target of radius `size` in [m], drawn at every start."""

    control_timestep: float = 0.02
    time_limit: float = 20.0
    goal_size: ClassVar[int] = 2

    def __init__(self, size: float) -> None:
        self.size = size

    def draw_start(self, model: mujoco.MjModel, rng: np.random.Generator) -> Start:
        """Draw joints, and the target in a ring around the shoulder."""
        qpos = random_joints(model, rng)
        angle = rng.uniform(0, 2 * np.pi)
        radius = rng.uniform(0.05, 0.20)
        return Start(qpos, goal=radius * np.array([np.sin(angle), np.cos(angle)]))

    def get_observation(self, sims: Simulations) -> np.ndarray:
        """Joint positions, vector from finger to target in the world, joint velocities."""
        return np.concatenate([sims.qpos, _to_target(sims), sims.qvel], axis=1)

    def get_reward(self, sims: Simulations) -> np.ndarray:
        """1 while finger and target overlap, else 0."""
        radii = self.size + sims.constant("geom", "finger", "size")[:, 0]
        return tolerance(np.linalg.norm(_to_target(sims), axis=1) - radii, -np.inf)


def _to_target(sims: Simulations) -> np.ndarray:
    return np.asarray(sims.goal - sims.named("geom", "finger", "xpos")[:, :2])

"""dm_control's planar hopper: stand, or hop forward."""

import mujoco
import numpy as np

from bo_sysid.plants.simulations import Simulations
from bo_sysid.plants.tasks.base import Start, VectorTask, register
from bo_sysid.plants.tasks.shaping import random_joints, tolerance

_HEIGHT = 0.6  # m, torso above foot
_SPEED = 2.0  # m/s


class _Hopper(VectorTask):
    control_timestep: float = 0.02
    time_limit: float = 20.0

    def draw_start(self, model: mujoco.MjModel, rng: np.random.Generator) -> Start:
        """Draw all joints but the slides."""
        return Start(random_joints(model, rng))

    def get_observation(self, sims: Simulations) -> np.ndarray:
        """Positions but the horizontal one, velocities, and both touch sensors."""
        toe = sims.named("sensor", "touch_toe", "data")
        heel = sims.named("sensor", "touch_heel", "data")
        return np.concatenate([sims.qpos[:, 1:], sims.qvel, np.log1p(toe), np.log1p(heel)], axis=1)

    def _standing(self, sims: Simulations) -> np.ndarray:
        torso = sims.named("body", "torso", "xipos")[:, 2]
        foot = sims.named("body", "foot", "xipos")[:, 2]
        return tolerance(torso - foot, _HEIGHT, 2.0)


@register("hopper", "stand")
class HopperStand(_Hopper):
    """Keep the torso 0.6 m above the foot, with little control."""

    def get_reward(self, sims: Simulations) -> np.ndarray:
        """Whether it stands, times (4 + small control) / 5."""
        small = tolerance(sims.ctrl, margin=1.0, shape="quadratic", at_margin=0.0)
        mean = small.sum(axis=1) / small.shape[1]  # np.mean takes a percent of a collection
        return np.asarray(self._standing(sims) * ((mean + 4) / 5))


@register("hopper", "hop")
class HopperHop(_Hopper):
    """Stand and move forward at 2 m/s."""

    def get_reward(self, sims: Simulations) -> np.ndarray:
        """Whether it stands, times how near its speed is to 2 m/s."""
        speed = sims.named("sensor", "torso_subtreelinvel", "data")[:, 0]
        hopping = tolerance(speed, _SPEED, np.inf, _SPEED / 2, "linear", 0.5)
        return np.asarray(self._standing(sims) * hopping)

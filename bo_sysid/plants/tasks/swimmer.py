"""dm_control's swimmer: bring the nose to a target."""

from typing import ClassVar

import mujoco
import numpy as np

from bo_sysid.plants.simulations import Simulations
from bo_sysid.plants.tasks.base import Start, VectorTask, register
from bo_sysid.plants.tasks.shaping import random_joints, tolerance

_PLANAR = [0, 1, 5]  # x and y velocity and z rate within (velocimeter, gyro)
_NEAR, _FAR, _SHARE_NEAR = 0.3, 2.0, 0.2  # m, m


@register("swimmer", "swimmer3")
@register("swimmer", "swimmer6")
@register("swimmer", "swimmer15")
class Swimmer(VectorTask):
    """Swim to a target that is drawn at every start; any number of links."""

    control_timestep: float = 0.03
    time_limit: float = 30.0
    goal_size: ClassVar[int] = 2

    def draw_start(self, model: mujoco.MjModel, rng: np.random.Generator) -> Start:
        """Draw heading and joints, and a target that is near in one of five episodes."""
        qpos = random_joints(model, rng)
        box = _NEAR if rng.uniform() < _SHARE_NEAR else _FAR
        return Start(qpos, goal=rng.uniform(-box, box, size=2))

    def get_observation(self, sims: Simulations) -> np.ndarray:
        """Joint angles, target in the head's frame, planar velocities of every link."""
        links = sims.field("sensordata")[:, 12:].reshape(len(sims), -1, 6)
        velocities = links[:, :, _PLANAR].reshape(len(sims), -1)
        return np.concatenate([sims.qpos[:, 3:], _to_target(sims), velocities], axis=1)

    def get_reward(self, sims: Simulations) -> np.ndarray:
        """1 with the nose inside the target, falling with the distance in target sizes."""
        size = sims.constant("geom", "target", "size")[:, 0]
        sizes_away = np.linalg.norm(_to_target(sims), axis=1) / size
        return tolerance(sizes_away, 0.0, 1.0, 5.0, "long_tail")


def _to_target(sims: Simulations) -> np.ndarray:
    """Return the vector from nose to target, first two coordinates in the head's frame."""
    nose = sims.named("geom", "nose", "xpos")
    head = sims.named("body", "head", "xmat").reshape(-1, 3, 3)
    height = sims.constant("geom", "target", "pos")[:, 2]
    to_target = np.empty_like(nose)
    to_target[:, :2] = sims.goal - nose[:, :2]
    to_target[:, 2] = height - nose[:, 2]
    return np.asarray(np.einsum("ni,nij->nj", to_target, head)[:, :2])

"""dm_control's cheetah: run as fast as 10 m/s."""

from typing import ClassVar

import mujoco
import numpy as np

from bo_sysid.plants.simulations import Simulations
from bo_sysid.plants.tasks.base import Start, VectorTask, register
from bo_sysid.plants.tasks.shaping import tolerance

_SPEED = 10.0  # m/s


@register("cheetah", "run")
class CheetahRun(VectorTask):
    """Reward is linear in the forward speed; an episode begins after 2 s of falling."""

    control_timestep: float = 0.01
    time_limit: float = 10.0
    settle_time: ClassVar[float] = 2.0

    def draw_start(self, model: mujoco.MjModel, rng: np.random.Generator) -> Start:
        """Draw the limited joints within their ranges."""
        limited = model.jnt_limited == 1
        qpos = np.array(model.qpos0)
        qpos[model.jnt_qposadr[limited]] = rng.uniform(*model.jnt_range[limited].T)
        return Start(qpos)

    def get_observation(self, sims: Simulations) -> np.ndarray:
        """Positions but the horizontal one, and velocities."""
        return np.concatenate([sims.qpos[:, 1:], sims.qvel], axis=1)

    def get_reward(self, sims: Simulations) -> np.ndarray:
        """Forward speed of the centre of mass over 10 m/s, within [0, 1]."""
        speed = sims.named("sensor", "torso_subtreelinvel", "data")[:, 0]
        return tolerance(speed, _SPEED, np.inf, _SPEED, "linear", 0.0)

"""dm_control's pendulum: swing up with little torque and stay."""

import mujoco
import numpy as np

from bo_sysid.plants.simulations import Simulations
from bo_sysid.plants.tasks.base import Start, VectorTask, register
from bo_sysid.plants.tasks.shaping import tolerance

_UPRIGHT = float(np.cos(np.deg2rad(8)))


@register("pendulum", "swingup")
class PendulumSwingup(VectorTask):
    """Rewarded only within 8 degrees of the vertical."""

    control_timestep: float = 0.02
    time_limit: float = 20.0

    def draw_start(self, model: mujoco.MjModel, rng: np.random.Generator) -> Start:
        """Draw any angle, at rest."""
        qpos = np.array(model.qpos0)
        qpos[model.joint("hinge").qposadr[0]] = rng.uniform(-np.pi, np.pi)
        return Start(qpos)

    def get_observation(self, sims: Simulations) -> np.ndarray:
        """Cosine and sine of the angle, and its rate."""
        orientation = sims.named("body", "pole", "xmat")[:, [8, 2]]
        return np.concatenate([orientation, sims.qvel], axis=1)

    def get_reward(self, sims: Simulations) -> np.ndarray:
        """1 near the vertical, else 0."""
        return tolerance(sims.named("body", "pole", "xmat")[:, 8], _UPRIGHT, 1.0)

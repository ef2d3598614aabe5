"""dm_control's cart-pole: swing up, or balance."""

import mujoco
import numpy as np

from bo_sysid.plants.simulations import Simulations
from bo_sysid.plants.tasks.base import Start, VectorTask, register
from bo_sysid.plants.tasks.shaping import tolerance


class _CartPole(VectorTask):
    control_timestep: float = 0.01
    time_limit: float = 10.0

    def get_observation(self, sims: Simulations) -> np.ndarray:
        """Cart position, cosine and sine of every pole, velocities."""
        poles = sims.field("xmat")[:, 2:][:, :, [8, 2]].reshape(len(sims), -1)
        return np.concatenate([sims.qpos[:, :1], poles, sims.qvel], axis=1)

    def get_reward(self, sims: Simulations) -> np.ndarray:
        """Upright, with the cart near the middle, little control and slow poles."""
        upright = ((sims.field("xmat")[:, 2:, 8] + 1) / 2).mean(axis=1)
        centred = (1 + tolerance(sims.qpos[:, 0], margin=2.0)) / 2
        small = tolerance(sims.ctrl[:, 0], margin=1.0, shape="quadratic", at_margin=0.0)
        slow = (1 + tolerance(sims.qvel[:, 1:], margin=5.0).min(axis=1)) / 2
        return np.asarray(upright * ((4 + small) / 5) * slow * centred)


@register("cartpole", "swingup")
class CartPoleSwingup(_CartPole):
    """An episode begins with the pole hanging down."""

    def draw_start(self, model: mujoco.MjModel, rng: np.random.Generator) -> Start:
        """Cart in the middle, pole down, all a little off."""
        qpos = np.zeros(model.nq)
        qpos[0] = 0.01 * rng.standard_normal()
        qpos[1] = np.pi + 0.01 * rng.standard_normal()
        qpos[2:] = 0.1 * rng.standard_normal(model.nq - 2)
        return Start(qpos, 0.01 * rng.standard_normal(model.nv))


@register("cartpole", "balance")
class CartPoleBalance(_CartPole):
    """An episode begins with the pole almost upright."""

    def draw_start(self, model: mujoco.MjModel, rng: np.random.Generator) -> Start:
        """Cart and pole near the middle and the vertical."""
        qpos = np.zeros(model.nq)
        qpos[0] = rng.uniform(-0.1, 0.1)
        qpos[1:] = rng.uniform(-0.034, 0.034, model.nq - 1)
        return Start(qpos, 0.01 * rng.standard_normal(model.nv))

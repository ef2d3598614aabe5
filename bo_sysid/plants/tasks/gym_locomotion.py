"""Gymnasium's HalfCheetah-v5, Hopper-v5 and Swimmer-v5, for comparisons with other packages.

The models are Gymnasium's own files, `assets/*.xml` of its MuJoCo environments.
"""

from dataclasses import dataclass
from typing import ClassVar

import mujoco
import numpy as np

from bo_sysid.plants.simulations import Simulations
from bo_sysid.plants.tasks.base import Start, VectorTask, register

_STEPS = 1000  # control steps of an episode


@dataclass(frozen=True)
class Locomotion:
    """What the three tasks differ in.

    Attributes:
        file: name of the model's file.
        control_timestep: in [s].
        hidden: how many of the first positions are not observed.
        spread: of the start.
        normal_velocity: starting velocities are normal, else uniform.
        control_cost: weight of the squared controls.
        hops: rewarded for being upright; ends, and is observed with velocities within 10, as the
            hopper does.
    """

    file: str
    control_timestep: float
    hidden: int
    spread: float
    normal_velocity: bool
    control_cost: float
    hops: bool = False


@register("gymnasium", "HalfCheetah-v5", Locomotion("half_cheetah.xml", 0.05, 1, 0.1, True, 0.1))
@register("gymnasium", "Hopper-v5", Locomotion("hopper.xml", 0.008, 1, 5e-3, False, 1e-3, True))
@register("gymnasium", "Swimmer-v5", Locomotion("swimmer.xml", 0.04, 2, 0.1, False, 1e-4))
class GymLocomotion(VectorTask):
    """Move forward; the goal holds the horizontal position before the step."""

    goal_size: ClassVar[int] = 1

    def __init__(self, kind: Locomotion) -> None:
        self.kind = kind
        self.control_timestep = kind.control_timestep
        self.time_limit = _STEPS * kind.control_timestep

    def draw_start(self, model: mujoco.MjModel, rng: np.random.Generator) -> Start:
        """Draw positions and velocities near the reference."""
        spread = self.kind.spread
        qpos = model.qpos0 + rng.uniform(-spread, spread, model.nq)
        if self.kind.normal_velocity:
            qvel = spread * rng.standard_normal(model.nv)
        else:
            qvel = rng.uniform(-spread, spread, model.nv)
        return Start(qpos, qvel, goal=qpos[:1])

    def get_observation(self, sims: Simulations) -> np.ndarray:
        """Positions but the horizontal ones, and velocities."""
        qvel = np.clip(sims.qvel, -10, 10) if self.kind.hops else sims.qvel
        return np.concatenate([sims.qpos[:, self.kind.hidden :], qvel], axis=1)

    def get_reward(self, sims: Simulations) -> np.ndarray:
        """Forward speed over the step, less a control cost; 1 more for a hopper that is upright."""
        x = sims.qpos[:, 0]
        reward = (x - sims.goal[:, 0]) / self.kind.control_timestep
        reward -= self.kind.control_cost * np.square(sims.ctrl).sum(axis=1)
        if self.kind.hops:
            reward += ~self.is_terminated(sims)
        sims.goal[:, 0] = x
        return np.asarray(reward)

    def is_terminated(self, sims: Simulations) -> np.ndarray:
        """A hopper ends where it is low, leans, or is anything but calm."""
        if not self.kind.hops:
            return np.zeros(len(sims), bool)
        calm = np.maximum(np.abs(sims.qpos[:, 2:]).max(axis=1), np.abs(sims.qvel).max(axis=1)) < 100
        upright = (sims.qpos[:, 1] > 0.7) & (np.abs(sims.qpos[:, 2]) < 0.2)
        return np.asarray(~(calm & upright))

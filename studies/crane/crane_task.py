"""A crane that is to bring its load to a place and hold it still."""

from dm_control.suite import base
from dm_control.utils import rewards


class Park(base.Task):
    """Bring the trolley to x = 0.8 m and hold the load still."""

    control_timestep = 0.02
    time_limit = 6.0

    def initialize_episode(self, physics):
        """Begin left of the middle, at rest."""
        physics.named.data.qpos["slide"] = self.random.uniform(-1.0, -0.6)
        super().initialize_episode(physics)

    def get_observation(self, physics):
        """Return what the policy sees."""
        return {"position": physics.data.qpos.copy(), "velocity": physics.data.qvel.copy()}

    def get_reward(self, physics):
        """Return 1 at most: near the place, times near to hanging straight."""
        x, angle = physics.data.qpos
        return float(
            rewards.tolerance(x - 0.8, margin=1.5) * (1 + rewards.tolerance(angle, margin=0.5)) / 2
        )

"""Action repeat: a task whose actions are held for several of its control steps."""

from bo_sysid.plants.tasks.base import VectorTask, WrappedTask


class RepeatedTask(WrappedTask):
    """A task in which every action is held for `repeat` control steps and earns all their rewards.

    Exploration with independent noise in every action reaches further where actions last longer.

    Args:
        task: the task.
        repeat: control steps of the task an action, at least 1.
    """

    def __init__(self, task: VectorTask, repeat: int) -> None:
        super().__init__(task)
        self.repeat *= repeat
        self.control_timestep *= repeat

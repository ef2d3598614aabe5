"""Tasks whose starts, observations and rewards are computed for many simulations at once.

A task is one small file with a class under `@register(domain, name)`; importing this package
registers those that come with it. Every registered task passes tests/test_plants_tasks.py, which
compares it with dm_control's own.
"""

from bo_sysid.plants.tasks import (
    cartpole,
    cheetah,
    gym_locomotion,
    hopper,
    pendulum,
    reacher,
    swimmer,
    walker,
)
from bo_sysid.plants.tasks.base import Start, VectorTask, find_task, register, registered

__all__ = [
    "Start",
    "VectorTask",
    "cartpole",
    "cheetah",
    "find_task",
    "gym_locomotion",
    "hopper",
    "pendulum",
    "reacher",
    "register",
    "registered",
    "swimmer",
    "walker",
]

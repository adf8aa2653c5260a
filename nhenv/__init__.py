"""Gymnasium environments for mechanisms that roll without slipping.

Importing this package registers `nhenv/SnakeboardForward-v0` and the like: one id for each
mechanism of the catalogue and each task.
"""

import gymnasium as gym

import mechanics
from nhenv.tasks import TASKS, Task

__all__ = ["TASKS", "Task", "environment_ids"]


def environment_ids() -> tuple[str, ...]:
    """Ids of the registered environments."""
    return tuple(_environments())


def _environments() -> dict[str, tuple[str, Task]]:
    """Id -> (mechanism, task)."""
    return {
        f"nhenv/{name.title().replace('_', '')}{task.name}-v0": (name, task)
        for name in mechanics.names()
        for task in TASKS
    }


for _id, (_mechanism, _task) in _environments().items():
    gym.register(
        id=_id,
        entry_point="nhenv.env:LocomotionEnv",
        max_episode_steps=_task.max_episode_steps,
        # The environment refuses a step before reset itself, and the test suite runs Gymnasium's
        # checker on every id: two wrappers less around each step.
        order_enforce=False,
        disable_env_checker=True,
        kwargs={"mechanism": _mechanism, "task": _task.name},
    )

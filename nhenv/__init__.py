"""Gymnasium environments for mechanisms that roll without slipping.

Importing this package registers `nhenv/SnakeboardForward-v0` and the like: one id for each
mechanism of the catalogue that moves in the plane, and each task. `register` adds those of a
mechanism of the user's own.
"""

from nhenv.registration import environment_ids, register, register_catalogue
from nhenv.tasks import TASKS, Task

__all__ = ["TASKS", "Task", "environment_ids", "register"]

register_catalogue()

"""Tasks as data: what is observed, what is rewarded, when an episode ends.

A task is written in the language of `mechanics.expressions`, over these names:

NAME           a coordinate or parameter of the mechanism, after the step
NAME_dot       the rate of a coordinate
NAME_before    a coordinate at the beginning of the step
heading        the third fibre coordinate
speed, drift   velocity along and across the heading, m/s
effort         mean squared action of the step, between 0 and 1
forward        +1 or -1: the way along x in which the mechanism's gaits drive it
dt             control period, s
WEIGHT         one of the task's own weights

so that any mechanism with a pose in the plane can be given any task, and a kernel computes only
what the expressions reach.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from mechanics.expressions import unknown_name

__all__ = ["TASKS", "Task", "get"]


@dataclass(frozen=True, kw_only=True)
class Task:
    """A task.

    Attributes:
        name: CamelCase, part of the environment's id.
        observation: label -> expression, observed after the mechanism's own observation.
        reward: info key -> expression; the reward is their sum.
        info: info key -> expression, reported and not rewarded.
        weights: weight -> default; each is an argument of the environment.
        max_episode_steps: steps after which the registered environment truncates.
    """

    name: str
    observation: Mapping[str, str] = field(default_factory=dict)
    reward: Mapping[str, str]
    info: Mapping[str, str] = field(default_factory=dict)
    weights: Mapping[str, float] = field(default_factory=dict)
    max_episode_steps: int


TASKS: tuple[Task, ...] = (
    Task(
        name="Forward",
        observation={"cos_heading": "cos(heading)", "sin_heading": "sin(heading)"},
        reward={
            "reward_forward": "forward_reward_weight*forward*(x - x_before)/dt",
            "reward_ctrl": "-ctrl_cost_weight*effort",
        },
        info={"x_position": "x", "x_velocity": "(x - x_before)/dt"},
        weights={"forward_reward_weight": 1.0, "ctrl_cost_weight": 0.02},
        max_episode_steps=300,
    ),
)


def get(name: str) -> Task:
    """Task of this name; raise ValueError with the known names if there is none."""
    for task in TASKS:
        if task.name == name:
            return task
    raise ValueError(unknown_name("task", str(name), [task.name for task in TASKS]))

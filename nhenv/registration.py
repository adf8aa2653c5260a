"""Which mechanism has which task, under which id.

The catalogue's environments are registered with `import nhenv`; `register` does the same for a
mechanism that a user writes down. An id's arguments are plain data, so that it can be printed, turned
into JSON and sent to another process.
"""

from __future__ import annotations

import dataclasses
import json
import os
from collections.abc import Iterable, Mapping
from functools import lru_cache
from typing import Any

import gymnasium as gym

import mechanics
from mechanics.mechanism import Mechanism
from nhenv.tasks import POSE, TASKS, Task
from nhenv.tasks import get as get_task

__all__ = [
    "MechanismLike",
    "TaskLike",
    "as_mechanism",
    "environment_ids",
    "in_the_plane",
    "register",
    "register_catalogue",
    "unfit",
]

ENTRY_POINT = "nhenv.env:LocomotionEnv"
VECTOR_ENTRY_POINT = "nhenv.vector_env:LocomotionVectorEnv"

MechanismLike = Mechanism | Mapping[str, Any] | str | os.PathLike[str]
TaskLike = Task | Mapping[str, Any] | str


def environment_ids() -> tuple[str, ...]:
    """Ids of the registered environments: the catalogue's, then those of `register`."""
    return tuple(name for name, spec in gym.registry.items() if spec.entry_point == ENTRY_POINT)


def register(mechanism: MechanismLike, tasks: Iterable[TaskLike] | None = None) -> tuple[str, ...]:
    """Make environments of a mechanism known to Gymnasium, and return their ids.

    ids = nhenv.register("my_robot.toml")
    env = gymnasium.make(ids[0])
    envs = gymnasium.make_vec(ids[0], num_envs=8)

    An id is made of the names, nhenv/MyRobotForward-v0 of `my_robot` and Forward. It lives as long as the process:
    other processes register for themselves, except the workers of `make_vec`, which are told.

    Args:
        mechanism: a `Mechanism`, its plain data, or the path of a file that has them. Without a `fibre`, position and
            heading are looked for: coordinates x, y and an angle by which the mechanism may be displaced in the plane
            without anything changing.
        tasks: tasks or their names; None for every task of this package that fits, but for those that take a mechanism
            which comes to rest in any pose: these have to be asked for.

    Raises:
        ValueError: no task fits, or not one of those asked for; or an id is another mechanism's already.
    """
    mechanism = in_the_plane(as_mechanism(mechanism))
    if tasks is None:
        any_pose = mechanism.name in mechanics.names(any_pose=True)
        fitting = [task for task in TASKS if unfit(mechanism, task) is None]
        chosen = [task for task in fitting if any_pose or not task.any_pose] or TASKS[:1]
    elif isinstance(tasks, str | Mapping | Task):
        raise TypeError(f"tasks must be several tasks or names, such as ['Forward'], got {tasks!r}")
    else:
        chosen = [get_task(task) for task in tasks]
        if not chosen or len({task.name for task in chosen}) < len(chosen):
            names = [task.name for task in chosen]
            raise ValueError(f"tasks must be at least one, of different names, or None for all that fit; got {names}")
    for task in chosen:
        if problem := unfit(mechanism, task):
            raise ValueError(problem)
    ids = [environment_id(mechanism.name, task) for task in chosen]
    new = [(name, task) for name, task in zip(ids, chosen, strict=True) if not _registered(name, mechanism, task)]
    data = json.loads(json.dumps(mechanism.to_dict()))
    for name, task in new:
        _register(name, data, task.name if task in TASKS else dataclasses.asdict(task), task.max_episode_steps)
    return tuple(ids)


def register_catalogue() -> None:
    """Register every task for every mechanism of the catalogue that moves in the plane by controls of its own."""
    for mechanism in mechanics.names(in_the_plane=True):
        any_pose = mechanism in mechanics.names(any_pose=True)
        for task in TASKS:
            if any_pose or not task.any_pose:
                _register(environment_id(mechanism, task), mechanism, task.name, task.max_episode_steps)


def environment_id(mechanism: str, task: Task) -> str:
    """Id of a mechanism, given by name, with a task."""
    return f"nhenv/{mechanism.title().replace('_', '')}{task.name}-v0"


def as_mechanism(mechanism: MechanismLike) -> Mechanism:
    """The mechanism itself, or that of the catalogue of this name, of these plain data, or of this file."""
    match mechanism:
        case Mechanism():
            return mechanism
        case Mapping():
            try:
                text = json.dumps(mechanism)
            except (TypeError, ValueError):  # it says itself what is wrong with such data
                return Mechanism.from_dict(mechanism)
            return _from_text(text)
        case str() if mechanism in mechanics.names() or not _is_path(mechanism):
            return mechanics.get(mechanism)
        case str() | os.PathLike():
            return Mechanism.from_file(mechanism)
    raise TypeError(
        f"a mechanism must be a Mechanism, a name of the catalogue, plain data or the path of a file, got {mechanism!r}"
    )


def unfit(mechanism: Mechanism, task: Task) -> str | None:
    """Why this mechanism cannot have this task and what to declare, or None if it can."""
    if not mechanism.controls:
        return f"{mechanism.name} has no controls, so there is nothing to decide: declare forces, such as a torque"
    missing = task.missing(mechanism)
    if not missing:
        return None
    problem = f"task {task.name!r} uses {', '.join(missing)}, which {mechanism.name} does not have"
    if set(missing) <= set(POSE):
        problem += (
            ", nor do its symmetries show a position and heading in the plane: declare them as its fibre, such as "
            "('x', 'y', 'theta')"
        )
    return problem


def in_the_plane(mechanism: Mechanism) -> Mechanism:
    """The mechanism with the fibre that its symmetry shows, if it declares none."""
    if mechanism.fibre:
        return mechanism
    from mechanics.geometry.symmetry import find_fibre

    fibre = find_fibre(mechanism)
    return dataclasses.replace(mechanism, fibre=fibre) if fibre else mechanism


def _registered(name: str, mechanism: Mechanism, task: Task) -> bool:
    """Whether this id is this mechanism's and this task's already; raise if it is another's."""
    spec = gym.registry.get(name)
    if spec is None:
        return False
    if spec.entry_point == ENTRY_POINT:
        known = as_mechanism(spec.kwargs["mechanism"]), get_task(spec.kwargs["task"])
        if known == (mechanism, task):
            return True
    raise ValueError(
        f"{name} is registered already, for another mechanism or task of this name: give yours another name, or forget "
        f"the other one by gymnasium.registry.pop({name!r})"
    )


def _register(name: str, mechanism: str | dict[str, Any], task: str | dict[str, Any], steps: int) -> None:
    gym.register(
        id=name,
        entry_point=ENTRY_POINT,
        vector_entry_point=VECTOR_ENTRY_POINT,
        max_episode_steps=steps,
        # The environment refuses a step before reset itself, and the test suite runs Gymnasium's
        # checker on every task: two wrappers less around each step.
        order_enforce=False,
        disable_env_checker=True,
        kwargs={"mechanism": mechanism, "task": task},
    )


@lru_cache(maxsize=32)
def _from_text(text: str) -> Mechanism:
    # A mechanism checks itself on construction, for ten milliseconds: not once for each of many environments.
    return Mechanism.from_dict(json.loads(text))


def _is_path(text: str) -> bool:
    return os.sep in text or bool(os.path.splitext(text)[1]) or os.path.exists(text)

"""Tasks as data: what is observed, what is rewarded, when an episode ends.

A task is written in the language of `mechanics.expressions`, over these names:

NAME            a coordinate or parameter of the mechanism, after the step
NAME_dot        the rate of a coordinate
x, y, heading   the fibre coordinates, whatever the mechanism calls them; also x_dot, y_dot, heading_dot
speed, drift    velocity along and across the heading, m/s
effort          mean squared action of the step, between 0 and 1
forward         +1 or -1: the way along x in which the mechanism's gaits drive it
dt              control period, s
WEIGHT          one of the task's own weights
TARGET          a number that is drawn at reset and kept for the episode
DEFINITION      one of the task's own shorthands
NAME_before     a coordinate, x, y, heading or a DEFINITION made of coordinates at the beginning of the step
terminated      1 if the task ends the episode with this step, else 0; in rewards and info only

so that any mechanism with a pose in the plane can be given any task, and a kernel computes only
what the expressions reach. In the rule of a TARGET, x, y and heading are where the episode starts.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field, fields
from numbers import Real
from typing import Any

from mechanics.expressions import (
    QUANTITY,
    ExpressionError,
    Extent,
    check_name,
    extent,
    names_in,
    unknown_name,
    wrong_keys,
)
from mechanics.mechanism import Mechanism

__all__ = ["MARKER", "POSE", "START", "TASKS", "Task", "get"]

# Names that a mechanism has if it declares a fibre.
POSE = (
    "x", "y", "heading", "x_dot", "y_dot", "heading_dot", "x_before", "y_before", "heading_before", "speed", "drift",
)  # fmt: skip
START = ("x", "y", "heading")
_WORDS = ("effort", "forward", "dt")
MARKER = ("x", "y", "heading", "radius")


@dataclass(frozen=True, kw_only=True)
class Task:
    """A task, which checks itself on construction.

    Attributes:
        name: CamelCase, part of the environment's id.
        observation: label -> expression, observed after the mechanism's own observation.
        reward: info key -> expression; the reward is their sum.
        info: info key -> expression, reported and not rewarded.
        weights: weight -> default; each is an argument of the environment.
        targets: name -> (low, high), drawn uniformly at reset in this order, or an expression in the targets
            before it and in x, y and heading at the start; a number for the whole episode.
        definitions: shorthand -> expression; one may use those before it.
        terminated: expression; the episode ends with the step after which it is positive. None: it never does.
        max_episode_steps: steps after which the registered environment truncates.
        any_pose: whether it takes a mechanism that can be brought to rest in any pose nearby, as not all can.
        marker: where pictures show the target: "x" and "y" in m, and optionally "heading" in rad and "radius" in m, as
            expressions in targets and weights. No result follows from it.
    """

    name: str
    observation: Mapping[str, str] = field(default_factory=dict)
    reward: Mapping[str, str]
    info: Mapping[str, str] = field(default_factory=dict)
    weights: Mapping[str, float] = field(default_factory=dict)
    targets: Mapping[str, tuple[float, float] | str] = field(default_factory=dict)
    definitions: Mapping[str, str] = field(default_factory=dict)
    terminated: str | None = None
    max_episode_steps: int
    any_pose: bool = False
    marker: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if not isinstance(self.name, str) or not re.fullmatch(r"[A-Z][A-Za-z0-9]*", self.name):
            raise ValueError(f"a task's name must be CamelCase letters and digits, as in an id, got {self.name!r}")
        for kind in ("observation", "reward", "info", "weights", "targets", "definitions", "marker"):
            if not isinstance(getattr(self, kind), Mapping):
                raise ValueError(f"task {self.name!r}: {kind} must be a dictionary, got {getattr(self, kind)!r}")
        for name, value in self.weights.items():
            if isinstance(value, bool) or not isinstance(value, Real) or not math.isfinite(value):
                raise ValueError(f"task {self.name!r}: weight {name!r} must be a finite number, got {value!r}")
        self._check_names()
        for name, rule in self.targets.items():
            if not isinstance(rule, str) and not _is_interval(rule):
                raise ValueError(
                    f"task {self.name!r}: target {name!r} must be (low, high), two finite numbers in this order, or an "
                    f"expression in the targets before it and in x, y and heading at the start; got {rule!r}"
                )
        self._check_expressions()
        self._check_marker()
        steps = self.max_episode_steps
        if isinstance(steps, bool) or not isinstance(steps, int) or steps < 1:
            raise ValueError(f"task {self.name!r}: max_episode_steps must be a positive whole number, got {steps!r}")
        if not isinstance(self.any_pose, bool):
            raise ValueError(f"task {self.name!r}: any_pose must be True or False, got {self.any_pose!r}")

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> Task:
        """Build a task from plain data, such as `dataclasses.asdict` of one, or that read back from JSON."""
        if not isinstance(data, Mapping):
            raise ValueError(f"a task's spec must be a dictionary, got {data!r}")
        known, required = [f.name for f in fields(cls)], ("name", "reward", "max_episode_steps")
        if problem := wrong_keys(data, known, required, "a task's spec"):
            raise ValueError(problem)
        targets = data.get("targets", {})
        if isinstance(targets, Mapping):
            targets = {name: tuple(rule) if isinstance(rule, list) else rule for name, rule in targets.items()}
        return cls(**{**data, "targets": targets})

    def to_dict(self, *, drawing: bool = True) -> dict[str, Any]:
        """Plain data of this task; `from_dict` makes an equal one of it.

        Args:
            drawing: whether with the marker, from which nothing follows but pictures.
        """
        data = asdict(self)
        if not drawing:
            del data["marker"]
        return data

    def missing(self, mechanism: Mechanism) -> tuple[str, ...]:
        """Names that this task uses and `mechanism` does not have: none if the task fits."""
        known = {*_WORDS, *self.weights, *self.targets, *self.definitions}
        known |= {*mechanism.coordinates, *mechanism.rates, *mechanism.parameters}
        known |= {f"{name}_before" for name in (*mechanism.coordinates, *self.definitions)}
        known |= set(POSE) if mechanism.fibre else set()
        known |= {"terminated"} if self.terminated is not None else set()
        used = {name for _, text in self._texts() for name in names_in(text)} | {*self.start}
        return tuple(sorted(used - known))

    @property
    def start(self) -> tuple[str, ...]:
        """What of the pose at the start, of x, y and heading, the targets depend on."""
        used = {name for rule in self.targets.values() if isinstance(rule, str) for name in names_in(rule)}
        return tuple(name for name in START if name in used)

    def _texts(self) -> Iterable[tuple[str, str]]:
        """Every expression, with the word for where it stands."""
        for kind in ("definitions", "observation", "reward", "info"):
            for label, text in getattr(self, kind).items():
                yield f"{kind}, {label}", text
        if self.terminated is not None:
            yield "terminated", self.terminated

    def _check_names(self) -> None:
        seen: dict[str, str] = {}
        for kind, names in (("weight", self.weights), ("target", self.targets), ("definition", self.definitions)):
            for name in names:
                check_name(name, f"task {self.name!r}: {kind}")
                if name in (*POSE, *_WORDS, "terminated") or re.fullmatch(r"v\d+|\w+_(dot|before)", name):
                    raise ExpressionError(f"task {self.name!r}: {kind} {name!r} is a word with a meaning of its own")
                if name in seen:
                    raise ExpressionError(f"task {self.name!r}: {name!r} is both a {seen[name]} and a {kind}")
                seen[name] = kind
        for key in self.info:
            if key in self.reward:
                raise ValueError(f"task {self.name!r}: {key!r} is both a reward and info")

    def _check_expressions(self) -> None:
        try:
            earlier: list[str] = []
            for name, rule in self.targets.items():
                kind = f"targets, {name}"
                for unknown in (names_in(rule) if isinstance(rule, str) else set()) - {*earlier, *START}:
                    raise ExpressionError(unknown_name("target", unknown, (*earlier, *START)))
                earlier.append(name)
            extents: dict[str, Extent] = {}
            for kind, text in self._texts():
                known = {name: extents.get(name.removesuffix("_before"), QUANTITY) for name in names_in(text)}
                size = extent(text, known)
                if kind.startswith("definitions, "):
                    extents[kind.partition(", ")[2]] = size
        except ExpressionError as error:
            raise ExpressionError(f"task {self.name!r}, {kind}: {error}") from None

    def _check_marker(self) -> None:
        known = (*self.targets, *self.weights)
        for key, text in self.marker.items():
            if key not in MARKER:
                raise ValueError(f"task {self.name!r}, marker: {unknown_name('key', str(key), MARKER)}")
            try:
                for unknown in names_in(text) - set(known):
                    raise ExpressionError(unknown_name("name", unknown, known))
            except ExpressionError as error:
                raise ExpressionError(f"task {self.name!r}, marker, {key}: {error}") from None
        if self.marker and not {"x", "y"} <= self.marker.keys():
            raise ValueError(f"task {self.name!r}: a marker needs 'x' and 'y', got {', '.join(self.marker)}")


def _is_interval(rule: Any) -> bool:
    try:
        low, high = map(float, rule)
    except (TypeError, ValueError):
        return False
    return low <= high and math.isfinite(high - low)


# -- what tasks have in common that lead to a place, or to a place and a heading there -------------


def _way_to(place: str) -> dict[str, str]:
    """Definitions: the way to a place along x and y, and its length."""
    return {
        f"to_{place}_x": f"{place}_x - x",
        f"to_{place}_y": f"{place}_y - y",
        f"to_{place}": f"sqrt(to_{place}_x**2 + to_{place}_y**2)",
    }


def _ahead(place: str) -> str:
    """The way to a place along the body."""
    return f"cos(heading)*to_{place}_x + sin(heading)*to_{place}_y"


def _left(place: str) -> str:
    """The way to a place across the body."""
    return f"cos(heading)*to_{place}_y - sin(heading)*to_{place}_x"


def _way_to_pose(place: str) -> dict[str, str]:
    """Definitions: the way to a place, and the angle in (-π, π] still to turn."""
    return {**_way_to(place), "to_turn": "atan2(sin(target_heading - heading), cos(target_heading - heading))"}


def _pose_seen(place: str) -> dict[str, str]:
    """Observation of the way to a place in the body's axes, and of the angle still to turn."""
    return {
        f"{place}_ahead": _ahead(place),
        f"{place}_left": _left(place),
        "cos_to_turn": "cos(target_heading - heading)",
        "sin_to_turn": "sin(target_heading - heading)",
    }


def _arrival(place: str) -> str:
    """Reward for being at a place and turned as asked."""
    return f"arrival_reward_weight*exp(-(to_{place}/offset_tolerance)**2 - (to_turn/heading_tolerance)**2)"


def _pose_info(place: str) -> dict[str, str]:
    """Info: what is left of the way and of the angle, and 1 where both are within their tolerances."""
    return {
        "heading_error": "to_turn",
        "offset": f"to_{place}",
        "is_success": f"(1 + sign(heading_tolerance - abs(to_turn)))*(1 + sign(offset_tolerance - to_{place}))/4",
    }


# -- the tasks -------------------------------------------------------------------------------------

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
    # Velocities at the end of the step, not differences of positions: x and y are never integrated.
    Task(
        name="Velocity",
        observation={
            "cos_heading": "cos(heading)",
            "sin_heading": "sin(heading)",
            "commanded_speed": "commanded_speed",
        },
        reward={
            "reward_velocity": "1 - velocity_cost_weight*abs(forward*x_dot - commanded_speed)",
            "reward_sideways": "-sideways_cost_weight*abs(y_dot)",
            "reward_ctrl": "-ctrl_cost_weight*effort",
        },
        info={"x_velocity": "x_dot", "y_velocity": "y_dot"},
        weights={"velocity_cost_weight": 2.0, "sideways_cost_weight": 0.2, "ctrl_cost_weight": 0.02},
        targets={"commanded_speed": (0.2, 1.0)},
        max_episode_steps=300,
    ),
    Task(
        name="Goal",
        observation={
            # The direction of the goal; a nanometre keeps it finite on the goal itself.
            "goal_ahead": f"({_ahead('goal')})/(to_goal + 1e-9)",
            "goal_left": f"({_left('goal')})/(to_goal + 1e-9)",
            "goal_distance": "to_goal/2",
        },
        reward={
            "reward_progress": "progress_reward_weight*(to_goal_before - to_goal)/dt",
            "reward_time": "-time_cost_weight",
            "reward_ctrl": "-ctrl_cost_weight*effort",
            "reward_goal": "goal_reward_weight*terminated",
        },
        info={"x_position": "x", "y_position": "y", "goal_distance": "to_goal", "is_success": "terminated"},
        weights={
            "progress_reward_weight": 1.0,
            "time_cost_weight": 0.5,
            "ctrl_cost_weight": 0.02,
            "goal_reward_weight": 5.0,
            "goal_radius": 0.15,
        },
        targets={
            "start_distance": (1.0, 3.0),
            "start_bearing": (-math.pi, math.pi),
            "goal_x": "x + start_distance*cos(heading + start_bearing)",
            "goal_y": "y + start_distance*sin(heading + start_bearing)",
        },
        definitions=_way_to("goal"),
        terminated="goal_radius - to_goal",
        max_episode_steps=300,
        marker={"x": "goal_x", "y": "goal_y", "radius": "goal_radius"},
    ),
    # Paid for being there, not for the way: it is to turn, and to come to rest, on the spot.
    Task(
        name="Turn",
        observation=_pose_seen("start"),
        reward={
            "reward_heading": "-heading_cost_weight*abs(to_turn)/pi",
            "reward_offset": "-offset_cost_weight*to_start",
            "reward_arrival": _arrival("start"),
            "reward_ctrl": "-ctrl_cost_weight*effort",
        },
        info=_pose_info("start"),
        weights={
            "heading_cost_weight": 1.0,
            "offset_cost_weight": 0.5,
            "arrival_reward_weight": 1.0,
            "ctrl_cost_weight": 0.02,
            "heading_tolerance": 0.15,
            "offset_tolerance": 0.15,
        },
        targets={
            "turn_size": (math.pi / 4, math.pi),
            "turn_side": (-1.0, 1.0),
            "target_heading": "heading + sign(turn_side)*turn_size",
            "start_x": "x",
            "start_y": "y",
        },
        definitions=_way_to_pose("start"),
        max_episode_steps=160,
        any_pose=True,
        marker={"x": "start_x", "y": "start_y", "heading": "target_heading", "radius": "offset_tolerance"},
    ),
    # The heading counts near the place only; if it counted everywhere, doing nothing would be the best.
    Task(
        name="Park",
        observation=_pose_seen("place"),
        reward={
            "reward_progress": "progress_reward_weight*(to_place_before - to_place)/dt",
            "reward_near": "near_reward_weight*exp(-(to_place/0.2)**2)"
            "*(0.25 + 0.75*((1 + cos(target_heading - heading))/2)**2)",
            "reward_arrival": _arrival("place"),
            "reward_ctrl": "-ctrl_cost_weight*effort",
        },
        info=_pose_info("place"),
        weights={
            "progress_reward_weight": 1.0,
            "near_reward_weight": 1.0,
            "arrival_reward_weight": 1.0,
            "ctrl_cost_weight": 0.02,
            "heading_tolerance": 0.15,
            "offset_tolerance": 0.1,
        },
        targets={
            "park_size": (0.3, 1.0),
            "park_side": (-1.0, 1.0),
            "place_x": "x - sign(park_side)*park_size*sin(heading)",
            "place_y": "y + sign(park_side)*park_size*cos(heading)",
            "target_heading": "heading",
        },
        definitions=_way_to_pose("place"),
        max_episode_steps=240,
        any_pose=True,
        marker={"x": "place_x", "y": "place_y", "heading": "target_heading", "radius": "offset_tolerance"},
    ),
)


def get(task: str | Mapping[str, Any] | Task) -> Task:
    """Task of this name, or made of these plain data; raise ValueError with the known names if there is none."""
    if isinstance(task, Task):
        return task
    if isinstance(task, Mapping):
        return Task.from_dict(task)
    for known in TASKS:
        if known.name == task:
            return known
    raise ValueError(unknown_name("task", str(task), [known.name for known in TASKS]))

"""What is measured of an episode: a table of metrics, each with what a task must offer to have it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mechanics.expressions import names_in
from mechanics.mechanism import Mechanism
from mechanics.model import Model
from nhenv.tasks import Task
from nhenv.vector_env import LocomotionVectorEnv
from training.rollout import Rollout

__all__ = ["METRICS", "Metric", "headline", "joint_index", "measure", "metric_of", "metrics_of"]

Array = NDArray[np.float64]

GRAVITY = 9.81  # m/s²; only the cost of transport uses it
SETTLED = 5.0  # s, after which a mechanism may be expected to run at a speed that it was told


@dataclass(frozen=True)
class Metric:
    """A number for each episode.

    Attributes:
        name: key of results, with its unit.
        heading: column of tables.
        digits: decimals in tables.
        better: +1 if more is better, -1 if less is.
        needs: what a task must offer: names in its info or targets, "terminated" for an end, names in its rewards.
        measure: of environments like those of the episodes, and the episodes, to values (N,).
        statistic: what episodes and runs are reduced to, one of `training.statistics.STATISTICS`.
    """

    name: str
    heading: str
    digits: int
    better: int
    needs: frozenset[str]
    measure: Callable[[LocomotionVectorEnv, Rollout], Array]
    statistic: str = "interquartile mean"


def metrics_of(task: Task) -> tuple[Metric, ...]:
    """Metrics that a task has, in the order of `METRICS`."""
    rewarded = {name for text in task.reward.values() for name in names_in(text)}
    offered = {*task.info, *task.targets, *rewarded} | ({"terminated"} if task.terminated is not None else set())
    return tuple(metric for metric in METRICS if metric.needs <= offered)


def metric_of(name: str) -> Metric:
    """The metric of this name."""
    return next(metric for metric in METRICS if metric.name == name)


def headline(task: Task) -> Metric:
    """The metric by which controllers are compared at this task: its first."""
    return metrics_of(task)[0]


def measure(envs: LocomotionVectorEnv, episodes: Rollout) -> dict[str, Array]:
    """Numbers (N,) of each episode by metric, recorded in environments like these."""
    return {metric.name: metric.measure(envs, episodes) for metric in metrics_of(envs.task)}


def joint_index(mechanism: Mechanism) -> NDArray[np.intp]:
    """Coordinate that each control turns, shape (m,); ValueError if a control is not the torque on one joint."""
    for name, row in mechanism.forces.items():
        if sorted(row) != ["0"] * (mechanism.n - 1) + ["1"]:
            raise ValueError(f"{mechanism.name}: {name} is not the torque on one joint, it is the covector {row}")
    return np.array([row.index("1") for row in mechanism.forces.values()])


def _distance(envs: LocomotionVectorEnv, episodes: Rollout) -> Array:
    """Metres along the mechanism's forward direction."""
    x = _along(envs)
    return _forward(envs) * (episodes.q[:, -1, x] - episodes.q[:, 0, x])


def _energy(envs: LocomotionVectorEnv, episodes: Rollout) -> Array:
    """∫ Σ_a |u_a q̇_a| dt, so that no motor gives energy back; exact over a hold, unless the joint turns round in it."""
    turned = np.diff(episodes.q[:, :, joint_index(envs.mechanism)], axis=1)
    return np.abs(episodes.torques * turned).sum(axis=(1, 2))


def _cost_of_transport(envs: LocomotionVectorEnv, episodes: Rollout) -> Array:
    """Energy over weight times distance."""
    mechanism, x = envs.mechanism, _along(envs)
    at_origin = envs.params | dict.fromkeys(mechanism.coordinates, 0.0)
    weight = GRAVITY * mechanism.numeric(mechanism.inertia, at_origin)[x, x]
    with np.errstate(divide="ignore", invalid="ignore"):
        return _energy(envs, episodes) / (weight * _distance(envs, episodes))


def _success(envs: LocomotionVectorEnv, episodes: Rollout) -> Array:
    """1 where the last step of an episode was a success, else 0."""
    if "is_success" not in episodes.final:
        raise ValueError(
            "success was not recorded: make the environments with info='final', as training.rollout.recorded does"
        )
    return (episodes.final["is_success"] > 0).astype(float)


def _seconds_to_success(envs: LocomotionVectorEnv, episodes: Rollout) -> Array:
    """Seconds until success; where there is none, as long as an episode may last, so that failures don't flatter."""
    longest = envs.max_episode_steps or episodes.torques.shape[1]
    return np.where(_success(envs, episodes) > 0, episodes.steps, longest) * envs.dt


def _speed_error(envs: LocomotionVectorEnv, episodes: Rollout) -> Array:
    """Mean absolute difference of the speed after each step and the command, the start from rest included."""
    return np.nanmean(_speed_errors(envs, episodes), axis=1)


def _settled_speed_error(envs: LocomotionVectorEnv, episodes: Rollout) -> Array:
    """The same, without the first seconds; with them if no episode lasts longer."""
    errors = _speed_errors(envs, episodes)
    first = round(SETTLED / envs.dt)
    return np.nanmean(errors[:, first if first < errors.shape[1] else 0 :], axis=1)


def _speed_errors(envs: LocomotionVectorEnv, episodes: Rollout) -> Array:
    model = Model(envs.mechanism, envs.params, envs.frame)
    speed = _forward(envs) * model.velocity(episodes.q[:, 1:], episodes.v[:, 1:])[..., _along(envs)]
    errors = np.abs(speed - episodes.targets["commanded_speed"][:, None])
    over = np.arange(errors.shape[1]) >= episodes.steps[:, None]
    return np.where(over, np.nan, errors)


def _along(envs: LocomotionVectorEnv) -> int:
    return envs.mechanism.coordinates.index(envs.mechanism.fibre[0])


def _forward(envs: LocomotionVectorEnv) -> float:
    return envs.mechanism.direction(envs.params)


_ON_COMMAND = frozenset({"forward", "commanded_speed"})
_FORWARD = frozenset({"forward"})

# The first that a task has is what it is about. Success comes after time, which counts failures too.
METRICS: tuple[Metric, ...] = (
    Metric("time_s", "time to success (s)", 2, -1, frozenset({"is_success", "terminated"}), _seconds_to_success),
    Metric("success", "success", 3, +1, frozenset({"is_success"}), _success, "mean"),
    Metric("speed_error_mps", "speed error (m/s)", 3, -1, _ON_COMMAND, _speed_error),
    Metric("settled_speed_error_mps", f"after {SETTLED:g} s", 3, -1, _ON_COMMAND, _settled_speed_error),
    Metric("distance_m", "distance (m)", 2, +1, _FORWARD, _distance),
    Metric("return", "return", 1, +1, frozenset(), lambda envs, episodes: episodes.returns),
    Metric("energy_j", "energy (J)", 1, -1, frozenset(), _energy),
    Metric("cost_of_transport", "cost of transport", 4, -1, _FORWARD, _cost_of_transport),
)

"""Run a controller, gait or policy, in one and the same way, and measure what it did.

python -m training.evaluate runs/compare/SnakeboardForward-v0/ppo-seed0-0123456789ab.zip
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import gymnasium as gym
import numpy as np
import tyro
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from mechanics.expressions import evaluate as value_of
from mechanics.mechanism import Mechanism
from nhenv.vector_env import LocomotionVectorEnv
from training.config import EVALUATION_SEEDS, EvaluationConfig, check_env_id
from training.store import read_json

if TYPE_CHECKING:
    from stable_baselines3 import PPO

__all__ = [
    "METRICS",
    "Controller",
    "PolicyController",
    "Rollout",
    "evaluate",
    "joint_index",
    "load_policy",
    "make_envs",
    "measure",
    "rollout",
    "summary",
]

Array = NDArray[np.float64]

METRICS = ("distance_m", "energy_j", "cost_of_transport", "return")
GRAVITY = 9.81  # m/s²; only the cost of transport uses it


class Controller(Protocol):
    """What the harness drives: it is shown observations and nothing else."""

    def reset(self, episodes: int) -> None:
        """Begin `episodes` episodes, which run in lockstep."""

    def __call__(self, observations: NDArray[np.float32], /) -> NDArray[np.float32]:
        """Actions (N, m) for observations (N, d)."""


class PolicyController:
    """The mean action of a policy of Stable-Baselines3."""

    def __init__(self, model: PPO) -> None:
        self.model = model

    def reset(self, episodes: int) -> None:
        """Nothing to do: the policy has no memory."""

    def __call__(self, observations: NDArray[np.float32], /) -> NDArray[np.float32]:
        """Actions (N, m) for observations (N, d)."""
        return self.model.predict(observations, deterministic=True)[0]


@dataclass(frozen=True)
class Rollout:
    """N episodes of T steps.

    Attributes:
        returns: sums of rewards, shape (N,).
        q: coordinates before each step and after the last, shape (N, T + 1, n); after an episode's end its last ones.
        torques: torques that were held, in N m, shape (N, T, m); zero after an episode's end.
    """

    returns: Array
    q: Array
    torques: Array


def make_envs(env_id: str, count: int, **options: Any) -> LocomotionVectorEnv:
    """Environments to run in lockstep; with `whole_state=True` their coordinates can be recorded."""
    envs = gym.make_vec(check_env_id(env_id), count, **options)
    assert isinstance(envs, LocomotionVectorEnv)
    return envs


def rollout(controller: Controller, envs: LocomotionVectorEnv, seeds: Sequence[int], *, record: bool = True) -> Rollout:
    """Run one episode in each environment, to the last bit as it would run alone.

    Args:
        controller: what drives them.
        envs: N environments, whose episodes are reset by the step after the last.
        seeds: N seeds of their resets.
        record: whether to keep q and torques, which needs environments made with `whole_state=True`. Without them
            (T = 0) it is faster.
    """
    controller.reset(envs.num_envs)
    observations, _ = envs.reset(seed=list(seeds))
    q = [envs.q]
    if record and np.isnan(q[0]).any():
        raise ValueError(
            "these environments do not follow every coordinate: make them with whole_state=True, or give record=False"
        )
    returns = np.zeros(envs.num_envs)
    torques = [np.empty((envs.num_envs, 0, len(envs.mechanism.controls)))]
    running = np.ones(envs.num_envs, bool)  # the others are in another episode, which does not count
    while running.any():
        actions = controller(observations)
        observations, rewards, terminated, truncated, infos = envs.step(actions)
        if infos:
            _raise_failure(infos, running, seeds, actions)
        returns[running] += rewards[running]
        if record:
            q.append(np.where(running[:, None], envs.q, q[-1]))
            held = np.clip(actions, -1, 1) * envs.torque_limits
            torques.append(np.where(running[:, None], held, 0.0)[:, None])
        running &= ~(terminated | truncated)
    return Rollout(returns, np.stack(q, axis=1), np.concatenate(torques, axis=1))


def joint_index(mechanism: Mechanism) -> NDArray[np.intp]:
    """Coordinate that each control turns, shape (m,); ValueError if a control is not the torque on one joint."""
    for name, row in mechanism.forces.items():
        if sorted(row) != ["0"] * (mechanism.n - 1) + ["1"]:
            raise ValueError(f"{mechanism.name}: {name} is not the torque on one joint, it is the covector {row}")
    return np.array([row.index("1") for row in mechanism.forces.values()])


def measure(envs: LocomotionVectorEnv, episodes: Rollout) -> dict[str, Array]:
    """Numbers (N,) of each episode, recorded in environments like these.

    distance_m is along the mechanism's forward direction; energy_j is ∫ Σ_a |u_a q̇_a| dt, so that no
    motor gives energy back (exact over a hold, unless the joint turns round in it); cost_of_transport is
    the energy over weight times distance.
    """
    mechanism, params = envs.mechanism, envs.params
    forward = np.sign(value_of(mechanism.forward, params))
    x = mechanism.coordinates.index(mechanism.fibre[0])
    distance = forward * (episodes.q[:, -1, x] - episodes.q[:, 0, x])
    turned = np.diff(episodes.q[:, :, joint_index(mechanism)], axis=1)
    energy = np.abs(episodes.torques * turned).sum(axis=(1, 2))
    at_origin = params | dict.fromkeys(mechanism.coordinates, 0.0)
    weight = GRAVITY * mechanism.numeric(mechanism.inertia, at_origin)[x, x]
    with np.errstate(divide="ignore", invalid="ignore"):
        cost = energy / (weight * distance)
    return dict(zip(METRICS, (distance, energy, cost, episodes.returns), strict=True))


def evaluate(
    controller: Controller, env_id: str, config: EvaluationConfig, **options: Any
) -> tuple[Rollout, dict[str, Array]]:
    """Episodes of a controller from the starts that are kept for judging, and the numbers of each."""
    envs = make_envs(env_id, config.episodes, whole_state=True, **{**config.env_kwargs, **options})
    episodes = rollout(controller, envs, range(EVALUATION_SEEDS, EVALUATION_SEEDS + config.episodes))
    return episodes, measure(envs, episodes)


def summary(values: Array) -> dict[str, float]:
    """Mean, standard deviation and extremes."""
    return {
        "mean": float(np.mean(values)),
        "std": float(np.std(values)),
        "min": float(np.min(values)),
        "max": float(np.max(values)),
    }


def load_policy(path: Path) -> PolicyController:
    """Policy of a zip file of Stable-Baselines3. Loading unpickles: only load what you trust."""
    from stable_baselines3 import PPO

    return PolicyController(PPO.load(path, device="cpu"))


def _raise_failure(
    infos: Mapping[str, Any], running: NDArray[np.bool_], seeds: Sequence[int], actions: NDArray[np.float32]
) -> None:
    """Raise what a single environment would, for the first of the episodes that are not over."""
    for key, error, what in (
        ("bad_action", ValueError, "was given actions that are not numbers,"),
        ("diverged", FloatingPointError, "diverged after actions"),
    ):
        failed = np.flatnonzero(running & infos.get(key, False))
        if len(failed):
            raise error(f"the episode with seed {seeds[failed[0]]} {what} {actions[failed[0]]}")


@dataclass(frozen=True)
class Evaluate:
    """Judge a trained policy.

    Loading a policy unpickles it, which can run any code: only load files that you trust.

    Attributes:
        policy: zip file written by `training.train`.
        env_id: environment; None for the one in the JSON file beside the policy.
        episodes: number of episodes.
        substeps: steps of the integrator in a hold; None for the environment's default.
        drag: whether the mechanism's drag acts; None for what the JSON file beside the policy says it learned with.
    """

    policy: tyro.conf.Positional[Path]
    env_id: str | None = None
    episodes: int = 100
    substeps: int | None = None
    drag: bool | None = None

    def __post_init__(self) -> None:
        if not self.policy.is_file():
            raise ValueError(f"there is no policy {self.policy}; training.train and training.compare write them")
        self.environment()

    def environment(self) -> str:
        """Id of the environment, as given or as written beside the policy."""
        if self.env_id is not None:
            return check_env_id(self.env_id)
        beside = self.policy.with_suffix(".json")
        if not beside.is_file():
            raise ValueError(f"give --env-id: there is no {beside} that names the environment")
        return check_env_id(str(read_json(beside)["settings"]["env_id"]))

    def env_kwargs(self) -> dict[str, Any]:
        """Arguments of the environment: those it learned with if they are written beside the policy, and `drag`."""
        beside = self.policy.with_suffix(".json")
        learned = read_json(beside)["settings"].get("ppo", {}).get("env_kwargs", {}) if beside.is_file() else {}
        return learned if self.drag is None else {**learned, "drag": self.drag}


def main(options: Evaluate) -> None:
    """Print a table of what the policy does."""
    config = EvaluationConfig(episodes=options.episodes, env_kwargs=options.env_kwargs())
    env_id = options.environment()
    _, numbers = evaluate(load_policy(options.policy), env_id, config, substeps=options.substeps)
    made_with = "".join(f", {name}={value}" for name, value in config.env_kwargs.items())
    table = Table(title=f"{env_id}{made_with}: {options.episodes} episodes")
    for heading in ("", "mean", "std", "min", "max"):
        table.add_column(heading, justify="right")
    for name, values in numbers.items():
        table.add_row(name, *(f"{value:.4g}" for value in summary(values).values()))
    Console().print(table)


if __name__ == "__main__":
    main(tyro.cli(Evaluate, prog="python -m training.evaluate"))

"""Run a controller, gait or policy, in one and the same way, and measure what it did.

python -m training.evaluate runs/compare/SnakeboardForward-v0/ppo-seed0-0123456789ab.zip
python -m training.evaluate runs/policies/SnakeboardForward-v0.safetensors
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

from nhenv.vector_env import LocomotionVectorEnv
from training import policies
from training.config import EVALUATION_SEEDS, EvaluationConfig, check_env_id
from training.metrics import measure, metrics_of
from training.statistics import summary
from training.store import read_json

if TYPE_CHECKING:
    from stable_baselines3 import PPO

__all__ = [
    "Controller",
    "PolicyController",
    "Rollout",
    "evaluate",
    "load_policy",
    "make_envs",
    "origin",
    "recorded",
    "rollout",
]

Array = NDArray[np.float64]


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
        v: pseudo-velocities in the frame of the environments, as q, shape (N, T + 1, k).
        steps: steps of each episode, shape (N,).
        targets: the task's targets by name, shape (N,).
        final: info of the last step of each episode by name, shape (N,); empty if the environments don't tell.
    """

    returns: Array
    q: Array
    torques: Array
    v: Array
    steps: NDArray[np.int64]
    targets: dict[str, Array]
    final: dict[str, Array]


def make_envs(env_id: str, count: int, **options: Any) -> LocomotionVectorEnv:
    """Environments to run in lockstep; with `whole_state=True` their coordinates can be recorded."""
    envs = gym.make_vec(check_env_id(env_id), count, **options)
    assert isinstance(envs, LocomotionVectorEnv)
    return envs


def recorded(env_id: str, count: int, **options: Any) -> LocomotionVectorEnv:
    """Environments to run in lockstep that tell all that is measured."""
    return make_envs(env_id, count, whole_state=True, info="final", **options)


def rollout(controller: Controller, envs: LocomotionVectorEnv, seeds: Sequence[int], *, record: bool = True) -> Rollout:
    """Run one episode in each environment, to the last bit as it would run alone.

    Args:
        controller: what drives them.
        envs: N environments, whose episodes are reset by the step after the last.
        seeds: N seeds of their resets.
        record: whether to keep q, v and torques, which needs environments made with `whole_state=True`. Without them
            (T = 0) it is faster.
    """
    controller.reset(envs.num_envs)
    observations, _ = envs.reset(seed=list(seeds))
    q, v, targets = [envs.q], [envs.v], envs.targets
    if record and np.isnan(q[0]).any():
        raise ValueError(
            "these environments do not follow every coordinate: make them with whole_state=True, or give record=False"
        )
    returns = np.zeros(envs.num_envs)
    torques = [np.empty((envs.num_envs, 0, len(envs.mechanism.controls)))]
    final: dict[str, Array] = {}
    steps = np.zeros(envs.num_envs, np.int64)
    running = np.ones(envs.num_envs, bool)  # the others are in another episode, which does not count
    while running.any():
        actions = controller(observations)
        observations, rewards, terminated, truncated, infos = envs.step(actions)
        if infos:
            _raise_failure(infos, running, seeds, actions)
        returns[running] += rewards[running]
        steps += running
        if record:
            q.append(np.where(running[:, None], envs.q, q[-1]))
            v.append(np.where(running[:, None], envs.v, v[-1]))
            held = np.clip(actions, -1, 1) * envs.torque_limits
            torques.append(np.where(running[:, None], held, 0.0)[:, None])
        ended = running & (terminated | truncated)
        for name in envs.task.info:
            if f"_{name}" in infos:
                final[name] = np.where(ended & infos[f"_{name}"], infos[name], final.get(name, np.nan))
        running &= ~ended
    stacked = np.stack(q, axis=1), np.concatenate(torques, axis=1), np.stack(v, axis=1)
    return Rollout(returns, *stacked, steps, targets, final)


def evaluate(
    controller: Controller, env_id: str, config: EvaluationConfig, *, seeds: int = EVALUATION_SEEDS, **options: Any
) -> tuple[Rollout, dict[str, Array]]:
    """Episodes of a controller from the starts that are kept for judging, and the numbers of each.

    Args:
        controller: what drives.
        env_id: environment.
        config: how many episodes, and in which environment.
        seeds: seed of the first episode, if not of those for judging.
        **options: arguments of the environment, besides those of `config` or instead.
    """
    envs = recorded(env_id, config.episodes, **{**config.env_kwargs, **options})
    episodes = rollout(controller, envs, range(seeds, seeds + config.episodes))
    return episodes, measure(envs, episodes)


def load_policy(path: Path) -> Controller:
    """Policy of a file: as plain data (.safetensors), or of Stable-Baselines3 (.zip).

    Loading a zip file unpickles: only load what you trust.
    """
    if path.suffix == policies.SUFFIX:
        return policies.load(path)
    from stable_baselines3 import PPO

    return PolicyController(PPO.load(path, device="cpu"))


def origin(path: Path) -> tuple[str | None, dict[str, Any]]:
    """Environment in which a policy learned, and its arguments, as written beside it; None and none if nothing is."""
    if path.suffix == policies.SUFFIX:
        card = policies.load(path).card
        return card["env_id"], card["env_kwargs"]
    beside = path.with_suffix(".json")
    if not beside.is_file():
        return None, {}
    settings = read_json(beside)["settings"]
    return settings["env_id"], settings.get("ppo", {}).get("env_kwargs", {})


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

    Loading a zip file unpickles it, which can run any code: only load files that you trust. A .safetensors file, with
    its card beside it, holds numbers only.

    Attributes:
        policy: zip file written by `training.train`, or file written by `training.export`.
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
        env_id = self.env_id or origin(self.policy)[0]
        if env_id is None:
            raise ValueError(
                f"give --env-id: there is no {self.policy.with_suffix('.json')} that names the environment"
            )
        return check_env_id(env_id)

    def env_kwargs(self) -> dict[str, Any]:
        """Arguments of the environment: those it learned with if they are written beside the policy, and `drag`."""
        learned = origin(self.policy)[1]
        return learned if self.drag is None else {**learned, "drag": self.drag}


def main(options: Evaluate) -> None:
    """Print a table of what the policy does."""
    config = EvaluationConfig(episodes=options.episodes, env_kwargs=options.env_kwargs())
    env_id = options.environment()
    envs, controller = make_envs(env_id, 1, **config.env_kwargs), load_policy(options.policy)
    if isinstance(controller, policies.Policy):
        controller.require(envs.observation_labels)
    _, numbers = evaluate(controller, env_id, config, substeps=options.substeps)
    made_with = "".join(f", {name}={value}" for name, value in config.env_kwargs.items())
    title = f"{env_id}{made_with}: {options.episodes} episodes, interquartile means (of success the mean)"
    table = Table(title=title)
    for heading in ("", "estimate", "95 % interval", "min", "max"):
        table.add_column(heading, justify="right")
    for metric in metrics_of(envs.task):
        one = summary(numbers[metric.name], metric.statistic)
        estimate, low, high, least, most = (f"{one[key]:.4g}" for key in ("estimate", "low", "high", "min", "max"))
        table.add_row(metric.name, estimate, f"{low} to {high}", least, most)
    Console().print(table)


if __name__ == "__main__":
    main(tyro.cli(Evaluate, prog="python -m training.evaluate"))

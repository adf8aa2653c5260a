"""Run a controller, gait or policy, in one and the same way, and measure what it did.

python -m training.evaluate runs/compare/SnakeboardForward-v0/ppo-seed0-0123456789ab.zip
python -m training.evaluate runs/policies/SnakeboardForward-v0.safetensors
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from training import policies
from training.config import EVALUATION_SEEDS, EvaluationConfig, check_env_id
from training.metrics import measure, metrics_of
from training.rollout import Controller, PolicyController, Rollout, make_envs, recorded, rollout
from training.statistics import summary
from training.store import read_json

__all__ = ["Evaluate", "evaluate", "load_policy", "origin"]

Array = NDArray[np.float64]


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

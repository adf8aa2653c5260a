"""Tuning of gaits and laws: differential evolution on the return that a policy learns from, with equal budgets."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import ArrayLike, NDArray

from mechanics.expressions import unknown_name
from nhenv.env import LocomotionEnv
from nhenv.vector_env import LocomotionVectorEnv
from training.config import TUNING_SEEDS, GaitConfig, LawConfig, SearchConfig, TorqueConfig
from training.evolution import evolve
from training.family import Family
from training.gaits import sinusoids, torque_sinusoids
from training.laws import law_family
from training.progress import Report, ignore
from training.rollout import Controller, make_envs, rollout
from training.store import piece_path, settings, source_digest, versions, write_json

__all__ = ["FAMILIES", "Tuned", "controller", "family", "gait_path", "search_config", "tune", "tune_piece"]

Array = NDArray[np.float64]
Env = LocomotionEnv | LocomotionVectorEnv

# kind of settings -> what makes the family of them, for an environment and the duration of its episodes in s
FAMILIES: dict[type[SearchConfig], Callable[[Env, Any, float], Family]] = {
    GaitConfig: sinusoids,
    TorqueConfig: torque_sinusoids,
    LawConfig: law_family,
}

# Whatever a tuned vector follows from here; a change of one law makes all results old, which is on the safe side.
_HERE = Path(__file__).parent
_MODULES = ("tuning", "evolution", "family", "gaits", "observed", "rollout", "metrics")
_CODE = source_digest(*(_HERE / f"{name}.py" for name in _MODULES), *sorted(_HERE.joinpath("laws").glob("*.py")))


def family(env: gym.Env[Any, Any] | LocomotionVectorEnv, config: SearchConfig) -> Family:
    """The controllers that these settings speak of, made for episodes as long as those of the environment's id."""
    inner, spec = env.unwrapped, env.spec
    assert isinstance(inner, LocomotionEnv | LocomotionVectorEnv)
    assert spec is not None
    assert spec.max_episode_steps is not None
    return FAMILIES[type(config)](inner, config, spec.max_episode_steps * inner.dt)


def controller(env: gym.Env[Any, Any] | LocomotionVectorEnv, config: SearchConfig, vector: ArrayLike) -> Controller:
    """Controller of a vector (p,), or of one vector an episode (N, p)."""
    return family(env, config).controller(np.asarray(vector, dtype=float))


@dataclass(frozen=True)
class Tuned:
    """Outcome of a search.

    Attributes:
        vector: the best parameters, as `controller` takes them.
        parameters: the same by name.
        history: best mean return after each generation, the random first one included.
        episodes: episodes simulated.
    """

    vector: list[float]
    parameters: dict[str, float]
    history: list[float]
    episodes: int


def tune(env_id: str, config: SearchConfig, report: Report = ignore) -> Tuned:
    """Search for the controller with the largest mean return: the reward that a policy learns from.

    Args:
        env_id: environment.
        config: settings of the search.
        report: hears of every generation.
    """
    searched = family(make_envs(env_id, 1, **config.env_kwargs), config)
    history: list[float] = []
    episodes = 0

    def loss(candidates: Array) -> Array:
        """Negative mean returns (S,) of vectors (p, S)."""
        nonlocal episodes
        count = candidates.shape[1]
        seeds = [TUNING_SEEDS + start for start in range(config.starts)] * count
        envs = make_envs(env_id, len(seeds), **config.env_kwargs)
        candidate = controller(envs, config, np.repeat(candidates.T, config.starts, axis=0))
        outcome = rollout(candidate, envs, seeds, record=False)
        means = outcome.returns.reshape(count, config.starts).mean(axis=1)
        episodes += len(seeds)
        history.append(float(max([*history[-1:], means.max()])))
        report(len(history), config.generations + 1, f"return {history[-1]:.0f}")
        return -means

    best = evolve(loss, searched.bounds, population=config.population, generations=config.generations, seed=config.seed)
    vector = best.tolist()
    return Tuned(vector, dict(zip(searched.ranges, vector, strict=True)), history, episodes)


def tune_piece(env_id: str, config: SearchConfig, out: Path, report: Report = ignore) -> None:
    """Tune a gait or a law and write it, unless that is done."""
    path = gait_path(env_id, config, out)
    if path.exists():
        return
    wall, cpu = time.perf_counter(), time.process_time()
    tuned = tune(env_id, config, report)
    result = dataclasses.asdict(tuned) | {
        "wall_s": time.perf_counter() - wall,
        "cpu_s": time.process_time() - cpu,
        "versions": versions(),
    }
    write_json(path, {"settings": gait_settings(env_id, config), "result": result})


def gait_settings(env_id: str, config: SearchConfig) -> dict[str, Any]:
    """All that a tuned controller follows from."""
    return settings(env_id, _CODE, gait=config, kind=type(config).__name__, seeds=TUNING_SEEDS)


def search_config(data: Mapping[str, Any]) -> SearchConfig:
    """Settings of a search among `gait_settings`, as they are read back; without a kind they are a sinusoid's."""
    kinds = {kind.__name__: kind for kind in FAMILIES}
    kind = data.get("kind", GaitConfig.__name__)
    if kind not in kinds:
        raise ValueError(unknown_name("kind of settings", kind, kinds))
    return kinds[kind](**data["gait"])


def gait_path(env_id: str, config: SearchConfig, out: Path) -> Path:
    """File of a tuned controller."""
    return piece_path(out, gait_settings(env_id, config), "gait")

"""Who drives: what a file holds of a gait or a policy, for whatever wants to see it drive."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nhenv.vector_env import LocomotionVectorEnv
from training import policies
from training.evaluate import load_policy
from training.rollout import Controller
from training.store import read_json
from training.tuning import controller, search_config

__all__ = ["Actor", "actor", "actors_of", "random_actor"]


@dataclass(frozen=True)
class Actor:
    """Who drives, in films, pictures and searches.

    Attributes:
        label: what pictures call it.
        env_id: environment.
        env_kwargs: arguments of the environment, as plain data.
        make: controller for environments.
    """

    label: str
    env_id: str
    env_kwargs: Mapping[str, Any]
    make: Callable[[LocomotionVectorEnv], Controller]


class _Random:
    """Uniform actions, the same for everybody."""

    def __init__(self, envs: LocomotionVectorEnv) -> None:
        self._shape = envs.action_space.shape
        self.reset(0)

    def reset(self, episodes: int) -> None:
        """Begin again."""
        self._rng = np.random.default_rng(0)

    def __call__(self, observations: NDArray[np.float32], /) -> NDArray[np.float32]:
        """Actions (N, m)."""
        return self._rng.uniform(-1, 1, self._shape).astype(np.float32)


def actor(path: Path, label: str | None = None) -> Actor:
    """What a file holds: a tuned gait (JSON), or a policy (.safetensors, .zip, or the JSON beside a zip file).

    Loading a zip file unpickles it: only load what you trust.
    """
    if path.suffix == policies.SUFFIX:
        policy = policies.load(path)
        return Actor(label or "PPO", policy.card["env_id"], policy.card["env_kwargs"], lambda envs: policy)
    beside = path.with_suffix(".json")
    for file in (path, beside):
        if not file.is_file():
            raise ValueError(f"there is no {file}; training.compare writes gait-*.json, ppo-*.zip and ppo-*.json")
    piece = read_json(beside)
    settings, result = piece["settings"], piece["result"]
    for kind, read in _KINDS.items():
        if kind in settings:
            name, make = read(path, settings, result)
            return Actor(label or name, settings["env_id"], settings[kind].get("env_kwargs", {}), make)
    raise ValueError(f"{beside} is of neither kind that can drive: {', '.join(_KINDS)}")


def actors_of(pieces: Sequence[Path], labels: Sequence[str], same_arguments: bool = True) -> list[Actor]:
    """Actors of files, which must be of one environment; the first of them are called by `labels`.

    Args:
        pieces: files.
        labels: at most one for each.
        same_arguments: whether they must have been made for the same arguments of that environment too.
    """
    actors = [actor(path, label) for path, label in itertools.zip_longest(pieces, labels[: len(pieces)])]
    env_ids = dict.fromkeys(one.env_id for one in actors)
    if len(env_ids) > 1:
        raise ValueError(f"only controllers of one environment go together, not of {' and '.join(env_ids)}")
    for other in actors[1:]:
        if same_arguments and other.env_kwargs != actors[0].env_kwargs:
            raise ValueError(
                f"{actors[0].label} was made for {dict(actors[0].env_kwargs)}, {other.label} for "
                f"{dict(other.env_kwargs)}: a film shows both in one environment if --drag says in which"
            )
    return actors


_Read = tuple[str, Callable[[LocomotionVectorEnv], Controller]]


def _gait(path: Path, settings: Mapping[str, Any], result: Mapping[str, Any]) -> _Read:
    config = search_config(settings)
    return config.label, lambda envs: controller(envs, config, result["vector"])


def _policy(path: Path, settings: Mapping[str, Any], result: Mapping[str, Any]) -> _Read:
    return f"PPO, seed {settings['seed']}", lambda envs: load_policy(path.with_suffix(".zip"))


_KINDS: dict[str, Callable[[Path, Mapping[str, Any], Mapping[str, Any]], _Read]] = {"gait": _gait, "ppo": _policy}


def random_actor(env_id: str, label: str | None = None) -> Actor:
    """Random actions in an environment, whatever its task."""
    return Actor(label or "random actions", env_id, {}, _Random)

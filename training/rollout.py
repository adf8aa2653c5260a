"""Who drives, and what happens: whole episodes in lockstep, recorded."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from nhenv.vector_env import LocomotionVectorEnv
from training.config import check_env_id

if TYPE_CHECKING:
    from stable_baselines3 import PPO

__all__ = ["Controller", "PolicyController", "Rollout", "make_envs", "recorded", "rollout"]

Array = NDArray[np.float64]


class Controller(Protocol):
    """What the harness drives: it is shown observations and nothing else."""

    def reset(self, episodes: int) -> None:
        """Begin `episodes` episodes, which run in lockstep."""

    def __call__(self, observations: NDArray[np.float32], /) -> NDArray[np.float32]:
        """Actions (N, m) for observations (N, d)."""


class PolicyController:
    """The action that a policy of Stable-Baselines3 prefers: the mean, or the most probable one."""

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

"""What learning changes about its environments; judging knows nothing of it."""

from __future__ import annotations

import inspect
from functools import cached_property
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper
from stable_baselines3.common.vec_env.base_vec_env import VecEnvObs, VecEnvStepReturn

from mechanics.model import Model
from nhenv.sb3 import SB3VecEnv
from nhenv.vector_env import LocomotionVectorEnv

__all__ = ["Clock", "MovingStarts", "ScaledReward"]

Array = NDArray[np.float64]


class _Pickled(VecEnvWrapper):
    """A wrapper that can be pickled with what it wraps: all but a table of its class's members."""

    def __getstate__(self) -> dict[str, Any]:
        return {name: value for name, value in self.__dict__.items() if name != "class_attributes"}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state, class_attributes=dict(inspect.getmembers(type(self))))


class ScaledReward(_Pickled):
    """Multiplies rewards.

    `VecNormalize` finds a factor by itself, but cannot be pickled with its environments, as checkpoints need.

    Args:
        venv: any environments.
        factor: what rewards are multiplied by.
    """

    def __init__(self, venv: VecEnv, factor: float) -> None:
        super().__init__(venv)
        self.factor = np.float32(factor)

    def reset(self) -> VecEnvObs:
        """Reset all rows."""
        return self.venv.reset()

    def step_wait(self) -> VecEnvStepReturn:
        """Step all rows."""
        observations, rewards, dones, infos = self.venv.step_wait()
        return observations, self.factor * rewards, dones, infos


class MovingStarts(_Pickled):
    """Begins a share of the episodes in motion; the share falls from 1 to 0.

    At rest nothing tells a policy what momentum is worth. One that has begun in motion often enough knows, and then
    finds out by itself how to come by it.

    Such an episode begins with any heading, joints anywhere within their stops and at rest, and other pseudo-velocities
    in any direction, with a kinetic energy that is uniform up to `energy`; in x and y, anywhere up to `offset` from the
    origin, from where its targets are drawn. So who is to come back has seen what being away is like.

    Args:
        venv: native environments of `nhenv.sb3.make_sb3_vec_env`.
        energy: largest kinetic energy at the start, J.
        offset: largest distance from the origin along x and along y, m.
        steps: environment steps, over all rows, after which every episode begins at rest.
        seed: seed of these starts.
    """

    def __init__(self, venv: SB3VecEnv, energy: float, offset: float, steps: int, seed: int) -> None:
        super().__init__(venv)
        self._envs = _native(venv, "begin in motion")
        self.energy, self.offset, self.steps, self.taken = energy, offset, steps, 0
        self._rng = np.random.default_rng([seed, 1])
        mechanism = self._envs.mechanism
        self._place = [mechanism.coordinates.index(name) for name in mechanism.fibre[:2]]

    @cached_property
    def _model(self) -> Model:
        return Model(self._envs.mechanism, self._envs.params)

    def __getstate__(self) -> dict[str, Any]:
        """As for every wrapper, and without the model, which is made again."""
        return {name: value for name, value in super().__getstate__().items() if name != "_model"}

    def reset(self) -> NDArray[np.float32]:
        """Reset all rows."""
        return self._move(np.asarray(self.venv.reset()), np.ones(self.num_envs, bool))

    def step_wait(self) -> VecEnvStepReturn:
        """Step all rows; the next episodes of those that are done may begin in motion."""
        observations, rewards, dones, infos = self.venv.step_wait()
        self.taken += self.num_envs
        if dones.any():
            observations = self._move(np.asarray(observations), dones)
        return observations, rewards, dones, infos

    def _move(self, observations: NDArray[np.float32], begun: NDArray[np.bool_]) -> NDArray[np.float32]:
        """Observations in which some of the rows that have `begun` are in motion."""
        moving = begun & (self._rng.random(self.num_envs) < 1 - self.taken / self.steps)
        if not moving.any():
            return observations
        # Every row takes part in the drawing, so that what one gets does not depend on the others.
        q, qdot = self._states()
        elapsed = self._envs.elapsed_steps  # first episodes end out of phase
        start = {"reset_mask": moving, "q": q, "qdot": qdot}
        seen, _ = self._envs.reset(options=start)
        if self.offset:
            away = self._rng.uniform(-self.offset, self.offset, (self.num_envs, 2))
            q[:, self._place] += away
            seen, _ = self._envs.reset(options=start | {"target": self._envs.targets})
        self._envs.elapsed_steps = elapsed
        return np.where(moving[:, None], seen, observations)

    def _states(self) -> tuple[Array, Array]:
        """Coordinates and velocities (N, n) of rows in motion."""
        mechanism, model = self._envs.mechanism, self._model
        coordinates, rows = mechanism.coordinates, self.num_envs
        q = np.zeros((rows, mechanism.n))
        q[:, coordinates.index(mechanism.fibre[2])] = self._rng.uniform(-np.pi, np.pi, rows)
        joints = [coordinates.index(joint) for joint in self._envs.joint_limits]
        for joint, stop in zip(joints, self._envs.joint_limits.values(), strict=True):
            q[:, joint] = self._rng.uniform(-stop, stop, rows)
        turns = model.velocity(q[:1].repeat(mechanism.rank, 0), np.eye(mechanism.rank))[:, joints].any(axis=1)
        v = np.where(turns, 0.0, self._rng.normal(size=(rows, mechanism.rank)))
        v *= np.sqrt(self._rng.uniform(0, self.energy, rows) / model.energy(q, v))[:, None]
        return q, model.velocity(q, v)


class Clock(_Pickled):
    """Shows how much of the episode is over, and makes the time limit an end like any other.

    What is still to come depends on the time that is left, so whoever is to foretell it has to see it (Pardo et al.,
    *Time limits in reinforcement learning*, 2018). It is the last observation, from -1 to 1; `training.time_aware`
    shows it to the value function and not to the policy.

    Args:
        venv: native environments of `nhenv.sb3.make_sb3_vec_env`, with a time limit, wrapped or not.
    """

    def __init__(self, venv: VecEnv) -> None:
        self._envs = _native(venv, "tell the time")
        limit = self._envs.max_episode_steps
        if limit is None:
            raise ValueError("without max_episode_steps there is no time that is left: give the environments a limit")
        shown = venv.observation_space
        assert isinstance(shown, spaces.Box)
        ends = np.append(shown.low, np.float32(-1)), np.append(shown.high, np.float32(1))
        super().__init__(venv, observation_space=spaces.Box(*ends, dtype=np.float32))
        self._limit = limit

    def reset(self) -> NDArray[np.float32]:
        """Reset all rows."""
        return self._with_time(self.venv.reset())

    def step_wait(self) -> VecEnvStepReturn:
        """Step all rows."""
        observations, rewards, dones, infos = self.venv.step_wait()
        for row in np.flatnonzero(dones):
            infos[row]["TimeLimit.truncated"] = False  # else Stable-Baselines3 adds what would come after
        return self._with_time(observations), rewards, dones, infos

    def _with_time(self, observations: VecEnvObs) -> NDArray[np.float32]:
        over = 2 * self._envs.elapsed_steps / self._limit - 1
        return np.column_stack([np.asarray(observations), over.astype(np.float32)])


def _native(venv: VecEnv, what: str) -> LocomotionVectorEnv:
    """The environments within all wrappers, which are to do `what`."""
    while isinstance(venv, VecEnvWrapper):
        venv = venv.venv
    envs = venv.vector_env.unwrapped if isinstance(venv, SB3VecEnv) else venv
    if not isinstance(envs, LocomotionVectorEnv):
        raise TypeError(f"only native environments can {what}, got {envs}")
    return envs

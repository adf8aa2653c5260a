"""How far a sequence of held torques drives a mechanism, and how that changes with each of them.

The whole episode is one function of its actions. Its derivatives are those of its single holds: central differences
through the simulator, of all holds at once, in one vector step.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import ArrayLike, NDArray

from mechanics.model import Model
from nhenv.vector_env import LocomotionVectorEnv
from training.rollout import make_envs

__all__ = ["Linear", "Shooting"]

Array = NDArray[np.float64]

# Half the distance between two probes. Truncation is of its square, noise is the integrator's 1e-10 over it.
STEP = 1e-5
# States on which nothing depends move with themselves, up to such noise.
NOISE = 1e-4


@dataclass(frozen=True)
class Linear:
    """Holds near those of an episode: δs_t+1 = A_t δs_t + B_t δu_t, and Δx grows by c_t δs_t + d_t δu_t in each.

    Attributes:
        kept: which states (q, v) are among s: those on which anything depends, shape (k,).
        A: shape (T, k, k).
        B: shape (T, k, m).
        c: in metres along the mechanism's forward direction, shape (T, k).
        d: likewise, shape (T, m).
    """

    kept: NDArray[np.intp]
    A: Array
    B: Array
    c: Array
    d: Array

    def gradient(self) -> Array:
        """Derivatives (T, m) of the distance with respect to the actions, from the end backwards."""
        gradient, costate = np.empty_like(self.d), np.zeros(len(self.kept))
        for t in reversed(range(len(gradient))):
            gradient[t] = self.d[t] + costate @ self.B[t]
            costate = self.c[t] + costate @ self.A[t]
        return gradient


class Shooting:
    """Distance along the mechanism's forward direction as a function of all actions of an episode.

    Args:
        env_id: environment.
        start: coordinates from which episodes begin, at rest, shape (n,); all zero by default.
        trials: how many sequences of actions `distances` takes.
        **env_kwargs: arguments of the environment.

    Attributes:
        mechanism: what moves.
        shape: of the actions, (T, m).
        start: coordinates (n,).
        heading: its place among the states (q, v).
        stops: largest angles of the coordinates (n,), inf where there is no stop.
    """

    def __init__(self, env_id: str, start: ArrayLike | None = None, trials: int = 1, **env_kwargs: Any) -> None:
        spec = gym.spec(env_id)
        assert spec.max_episode_steps is not None
        self._env_id, self._env_kwargs = env_id, env_kwargs
        self._envs = envs = self._make(trials)
        self.mechanism = mechanism = envs.mechanism
        self.shape = (spec.max_episode_steps, len(mechanism.controls))
        self.start = np.zeros(mechanism.n) if start is None else np.array(start, dtype=float)
        self._n, self._size = mechanism.n, mechanism.n + mechanism.rank
        self._x, self.heading = (mechanism.coordinates.index(mechanism.fibre[i]) for i in (0, 2))
        self._forward = mechanism.direction(envs.params)
        self._env = self._make(1)
        self.stops = np.full(mechanism.n, np.inf)
        for name, stop in envs.joint_limits.items():
            self.stops[mechanism.coordinates.index(name)] = stop

    def _make(self, count: int) -> LocomotionVectorEnv:
        return make_envs(self._env_id, count, whole_state=True, **self._env_kwargs)

    # What derivatives need, and replays do not.

    @cached_property
    def _probes(self) -> LocomotionVectorEnv:
        return self._make(self.shape[0] * 2 * (self._size + self.shape[1]))

    @cached_property
    def _model(self) -> Model:
        envs = self._envs
        return Model(envs.mechanism, envs.params, envs.frame, envs.drag)

    def states(self, actions: Array) -> Array:
        """States (q, v) before each hold and after the last, shape (T + 1, n + k)."""
        env = self._env
        env.reset(options={"q": self.start})
        rows = [np.concatenate([env.q[0], env.v[0]])]
        for action in actions:
            env.step(action[None])
            rows.append(np.concatenate([env.q[0], env.v[0]]))
        return np.array(rows)

    def distance(self, actions: ArrayLike) -> float:
        """Metres that the actions (T, m) drive the mechanism forward."""
        return float(self._covered(self._env, np.asarray(actions)[None])[0])

    def distances(self, actions: Array) -> Array:
        """Metres (S,) that each of the actions (S, T, m) drive the mechanism forward, S the number of trials."""
        return self._covered(self._envs, actions)

    def _covered(self, envs: LocomotionVectorEnv, actions: Array) -> Array:
        envs.reset(options={"q": self.start})
        for held in np.ascontiguousarray(np.moveaxis(actions, 1, 0)):
            envs.step(held)
        return self._forward * (envs.q[:, self._x] - self.start[self._x])

    def linear(self, actions: Array) -> tuple[Array, Linear]:
        """States as `states` has them, and how they and the distance change with states and actions."""
        states = self.states(actions)
        by_state, by_action = self._derivatives(states[:-1], actions)
        others = by_state - np.eye(self._size)
        kept = np.flatnonzero(np.abs(others).max(axis=(0, 2)) > NOISE)
        x = self._x
        return states, Linear(
            kept,
            by_state[:, kept][:, :, kept].swapaxes(1, 2),
            by_action[:, :, kept].swapaxes(1, 2),
            self._forward * by_state[:, kept, x],
            self._forward * by_action[:, :, x],
        )

    def _derivatives(self, states: Array, actions: Array) -> tuple[Array, Array]:
        """Of the state after each hold by that before it (T, n + k, n + k) and by the action (T, m, n + k)."""
        steps, m = self.shape
        width = self._size + m
        signs = np.concatenate([np.eye(width), -np.eye(width)])
        probes = np.concatenate([states, actions], axis=1)[:, None] + STEP * signs  # (T, 2 * width, width)
        # Where a stop or a limit is in the way, the difference is one-sided.
        n = self._n
        probes[..., :n] = np.clip(probes[..., :n], -self.stops, self.stops)
        probes[..., self._size :] = np.clip(probes[..., self._size :], -1, 1)
        apart = np.einsum("tii->ti", probes[:, :width] - probes[:, width:])  # (T, width)
        q, v, u = np.split(probes.reshape(-1, width), [n, self._size], axis=1)
        envs = self._probes
        envs.reset(options={"q": q, "qdot": self._model.velocity(q, v)})
        envs.step(np.ascontiguousarray(u))
        after = np.concatenate([envs.q, envs.v], axis=1).reshape(steps, 2 * width, self._size)
        change = (after[:, :width] - after[:, width:]) / apart[..., None]
        return change[:, : self._size], change[:, self._size :]

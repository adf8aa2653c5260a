"""What closed-form laws have in common: a clock, what is observed, and parameters with ranges."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from nhenv.env import LocomotionEnv
from nhenv.vector_env import LocomotionVectorEnv
from training.observed import Observed, Seen

__all__ = ["Law", "side_of"]

Array = NDArray[np.float64]


class Law(ABC):
    """A law in closed form: it sees what a policy sees, and a clock, and may remember a side for each episode.

    Attributes:
        RANGES: parameter -> smallest and largest value of a search.
        values: parameter -> its value, shape (N,) or ().
        params: the mechanism's parameters by name.
        drag: coefficients of its drag, 0 if none acts.
        limits: torque limits by control, N m.
        stops: largest angles by joint, rad.
        dt: control period in s.
        duration: time T in s over which what changes with time does so.
        side: +1 or -1, shape (N,) or () before the first observation.
    """

    RANGES: ClassVar[Mapping[str, tuple[float, float]]]

    def __init__(self, env: LocomotionEnv | LocomotionVectorEnv, duration: float, vector: Array) -> None:
        """Law with parameters `vector`, shape (p,), or (N, p) for one set of parameters an episode."""
        if vector.shape[-1:] != (len(self.RANGES),):
            raise ValueError(
                f"{type(self).__name__} takes {len(self.RANGES)} parameters ({', '.join(self.RANGES)}), "
                f"got an array of shape {vector.shape}"
            )
        # Not the environment itself, which would show more of the state than what is observed.
        self.params, self.dt, self.duration = env.params, env.dt, duration
        self.stops = {**env.mechanism.joint_limits, **env.joint_limits}
        self.values = dict(zip(self.RANGES, np.moveaxis(vector, -1, 0), strict=True))
        self.limits = dict(zip(env.mechanism.controls, np.moveaxis(env.torque_limits, -1, 0), strict=True))
        self.drag = {**dict.fromkeys(env.mechanism.drag, 0.0), **(env.drag or {})}
        self._observed = Observed(env)
        self.reset(1)

    def reset(self, episodes: int) -> None:
        """Start the clock; `episodes` must fit the parameters' leading axis."""
        self._steps = 0
        self.side: Array = np.ones(())

    def __call__(self, observations: NDArray[np.float32], /) -> NDArray[np.float32]:
        """Actions (N, m) for observations (N, d)."""
        seen = self._observed(observations)
        if self._steps == 0:
            self.side = self.first_side(seen)
        t = self._steps * self.dt
        self._steps += 1
        actions = np.stack(np.broadcast_arrays(*self.actions(seen, t)), axis=-1)
        return np.clip(actions, -1, 1).astype(np.float32)

    @abstractmethod
    def first_side(self, seen: Seen) -> Array:
        """Side (N,) with which an episode begins."""

    @abstractmethod
    def actions(self, seen: Seen, t: float) -> tuple[Array, ...]:
        """Share of each control's limit, m arrays (N,), at time t in s; it may change `side`."""

    def left(self, t: float) -> float:
        """Share of the time that is left, from 1 to 0."""
        return max(0.0, 1 - t / self.duration)


def side_of(values: Array) -> Array:
    """+1 where a value is positive or zero, -1 elsewhere: a side, which is never nought."""
    return np.where(values >= 0, 1.0, -1.0)

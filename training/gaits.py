"""Sinusoidal gaits: joints that follow a sin(w t + b) by computed torque, tuned by differential evolution.

A steered gait also changes a and w over the episode and leans against the heading, because a fixed
sinusoid is the weak member of its family.

A gait knows its mechanism through data only: which coordinate each torque turns, whether that joint
has stops, and the reduced equations. It sees what a policy sees, and a clock.
"""

from __future__ import annotations

import dataclasses
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import Bounds, differential_evolution

from mechanics.expressions import evaluate
from mechanics.model import Model
from nhenv.env import LocomotionEnv
from nhenv.vector_env import LocomotionVectorEnv
from training.config import TUNING_SEEDS, GaitConfig
from training.evaluate import joint_index, make_envs, rollout
from training.progress import Report, ignore
from training.store import piece_path, settings, source_digest, versions, write_json

__all__ = ["Gait", "Joints", "Sinusoid", "Tuned", "bounds", "gait_path", "sinusoid", "tune", "tune_piece"]

Array = NDArray[np.float64]

_CODE = source_digest(__file__)


class Joints:
    """The actuated joints of an environment's mechanism: their state, and the torque that moves them.

    The observation holds the angles of the joints with stops, the rates of all joints and the speed
    along the heading. By symmetry in the plane and in cyclic joints, no more of the state matters.

    Attributes:
        model: the mechanism's equations.
        index: coordinate that each control turns, shape (m,).
        stops: largest angles of these joints in rad, inf where there is no stop, shape (m,).
        cyclic: whether a joint is without stops, shape (m,).
        limits: torque limits in N m, shape (m,).
        dt: control period in s.
    """

    def __init__(self, env: LocomotionEnv | LocomotionVectorEnv) -> None:
        mechanism, names = env.mechanism, env.mechanism.coordinates
        self.model = Model(mechanism, env.params, drag=env.drag)
        self.limits, self.dt = env.torque_limits, env.dt
        self.index = joint_index(mechanism)
        self.stops = np.array([mechanism.joint_limits.get(names[i], np.inf) for i in self.index])
        self.cyclic = np.isinf(self.stops)
        # The label of an observation names a quantity, its expression only scales it.
        labels = [*mechanism.observation, *env.task.observation]
        self._sine = labels.index("sin_heading") if "sin_heading" in labels else None
        self._units = np.array([1 / evaluate(text, {label: 1.0}) for label, text in mechanism.observation.items()])
        self._angles = [(labels.index(name), i) for i, name in enumerate(names) if name in labels]
        rates = [(labels.index(f"{name}_dot"), i) for i, name in enumerate(names) if f"{name}_dot" in labels]
        rates.append((labels.index("speed"), names.index(mechanism.fibre[0])))  # heading 0: speed is ẋ
        self._observed, self._moving = (list(column) for column in zip(*rates, strict=True))

    def state(self, observations: ArrayLike) -> tuple[Array, Array]:
        """Coordinates (..., n) and pseudo-velocities (..., k) behind observations (..., d).

        Up to symmetry: position, heading and cyclic angles are put to zero.
        """
        n, k = self.model.mechanism.n, self.model.mechanism.rank
        values = np.asarray(observations, dtype=float)[..., : len(self._units)] * self._units
        q = np.zeros((*values.shape[:-1], n))
        for source, target in self._angles:
            q[..., target] = values[..., source]
        frame = self.model.velocity(q, _stack(np.eye(k), q))  # (k, ..., n): one vector field a row
        matrix = np.moveaxis(frame[..., self._moving], 0, -1)
        return q, np.linalg.solve(matrix, values[..., self._observed, None])[..., 0]

    def heading_sine(self, observations: ArrayLike) -> Array:
        """Sine of the heading (..., 1); zero if the task does not show it."""
        values = np.asarray(observations, dtype=float)
        return np.zeros_like(values[..., :1]) if self._sine is None else values[..., self._sine, None]

    def torque(self, q: Array, v: Array, acceleration: Array) -> Array:
        """Torques (..., m) in N m that give the joints these accelerations (..., m) in rad/s²."""
        m = len(self.index)
        trial = _stack(np.vstack([np.zeros(m), np.eye(m)]), q)
        free, *response = self.model.acceleration(q, v, trial)[..., self.index]  # affine in the torque
        matrix = np.stack(response, axis=-1) - free[..., None]
        return np.linalg.solve(matrix, (acceleration - free)[..., None])[..., 0]


@dataclass(frozen=True)
class Gait:
    """References a sin(r w t + b) of the joints, and their feedback. Leading axes are for many gaits at once.

    In a steered gait a and the frequency w change linearly, with rates a' and w', and the joints with
    stops are turned further by g sin(heading).

    Attributes:
        amplitude: a at the start in rad, shape (..., m).
        amplitude_rate: a' in rad/s, shape (..., m).
        phase: b in rad, shape (..., m).
        damping: kd in 1/s, shape (..., m); kp is kd²/4, the critically damped value.
        frequency: w at the start in rad/s, shape (..., 1).
        frequency_rate: w' in rad/s², shape (..., 1).
        steering: g in rad, shape (..., 1).
        ratio: r, shape (m,).
    """

    amplitude: Array
    amplitude_rate: Array
    phase: Array
    damping: Array
    frequency: Array
    frequency_rate: Array
    steering: Array
    ratio: Array

    @classmethod
    def from_vector(cls, vector: Array, ratio: Array, duration: float) -> Gait:
        """Gait of a vector: amplitudes, phases, dampings, w; if steered also the last amplitudes, the last w, and g.

        Args:
            vector: shape (..., 3m + 1), or (..., 4m + 3) if steered.
            ratio: shape (m,).
            duration: time in s after which a steered gait has its last amplitudes and frequency.
        """
        m = len(ratio)
        amplitude, phase, damping, frequency = np.split(vector[..., : 3 * m + 1], [m, 2 * m, 3 * m], -1)
        last_amplitude, last_frequency, steering = amplitude, frequency, np.zeros_like(frequency)
        if vector.shape[-1] > 3 * m + 1:
            last_amplitude, last_frequency, steering = np.split(vector[..., 3 * m + 1 :], [m, m + 1], -1)
        return cls(
            amplitude,
            (last_amplitude - amplitude) / duration,
            phase,
            damping,
            frequency,
            (last_frequency - frequency) / duration,
            steering,
            ratio,
        )

    def angle(self, t: float) -> Array:
        """Reference angles at time t in s, shape (..., m)."""
        return (self.amplitude + self.amplitude_rate * t) * np.sin(self._turned(t))

    def rate(self, t: float) -> Array:
        """Reference rates at time t in s, shape (..., m)."""
        turned, frequency = self._turned(t), self.ratio * (self.frequency + self.frequency_rate * t)
        amplitude = self.amplitude + self.amplitude_rate * t
        return self.amplitude_rate * np.sin(turned) + amplitude * frequency * np.cos(turned)

    def _turned(self, t: float) -> Array:
        return self.ratio * (self.frequency * t + self.frequency_rate * t**2 / 2) + self.phase


class Sinusoid:
    """Controller that makes the joints follow a gait: computed torque plus feedback, saturated."""

    def __init__(self, joints: Joints, gait: Gait) -> None:
        self.joints, self.gait = joints, gait
        self.steps = 0

    def reset(self, episodes: int) -> None:
        """Start the clock; `episodes` must fit the gait's leading axes."""
        self.steps = 0

    def __call__(self, observations: NDArray[np.float32]) -> NDArray[np.float32]:
        """Actions (N, m) for observations (N, d)."""
        joints, gait, t = self.joints, self.gait, self.steps * self.joints.dt
        self.steps += 1
        q, v = joints.state(observations)
        rate = gait.rate(t)
        rate_error = rate - joints.model.velocity(q, v)[..., joints.index]
        # A rotor may be anywhere: only its rate is held.
        wanted = gait.angle(t) + gait.steering * joints.heading_sine(observations)
        angle_error = np.where(joints.cyclic, 0.0, wanted - q[..., joints.index])
        # The torque is held, so what counts is the acceleration on average over the hold.
        forward = (gait.rate(t + joints.dt) - rate) / joints.dt
        acceleration = forward + gait.damping * rate_error + gait.damping**2 / 4 * angle_error
        torque = joints.torque(q, v, acceleration)
        return np.clip(torque / joints.limits, -1, 1).astype(np.float32)


@dataclass(frozen=True)
class Tuned:
    """Outcome of a search.

    Attributes:
        vector: the best gait, as `Gait.from_vector` takes it.
        history: best mean return after each generation, the random first one included.
        episodes: episodes simulated.
    """

    vector: list[float]
    history: list[float]
    episodes: int


def bounds(joints: Joints, config: GaitConfig) -> Bounds:
    """Range of each entry of a gait's vector."""
    m = len(joints.index)
    amplitude = [(0.0, largest) for largest in np.where(joints.cyclic, config.cyclic_amplitude, joints.stops).tolist()]
    ranges = [*amplitude, *[(-np.pi, np.pi)] * m, *[config.damping] * m, config.frequency]
    if config.steered:
        ranges += [*amplitude, config.frequency, (-config.steering, config.steering)]
    return Bounds(*np.transpose(ranges))


def sinusoid(env: gym.Env[Any, Any] | LocomotionVectorEnv, config: GaitConfig, vector: ArrayLike) -> Sinusoid:
    """Controller for the gait (p,), or for one gait an episode (N, p), made for episodes as long as those of the id."""
    inner, spec = env.unwrapped, env.spec
    assert isinstance(inner, LocomotionEnv | LocomotionVectorEnv)
    assert spec is not None
    assert spec.max_episode_steps is not None
    joints = Joints(inner)
    ratio = np.where(joints.cyclic, config.cyclic_ratio, 1.0)
    duration = spec.max_episode_steps * joints.dt
    return Sinusoid(joints, Gait.from_vector(np.asarray(vector, dtype=float), ratio, duration))


def tune(env_id: str, config: GaitConfig, report: Report = ignore) -> Tuned:
    """Search for the gait with the largest mean return: the reward that a policy learns from.

    Args:
        env_id: environment.
        config: settings of the search.
        report: hears of every generation.
    """
    ranges = bounds(Joints(make_envs(env_id, 1, **config.env_kwargs)), config)
    history: list[float] = []
    episodes = 0

    def loss(candidates: Array) -> Array:
        """Negative mean returns (S,) of gaits (p, S)."""
        nonlocal episodes
        count = candidates.shape[1]
        seeds = [TUNING_SEEDS + start for start in range(config.starts)] * count
        envs = make_envs(env_id, len(seeds), **config.env_kwargs)
        controller = sinusoid(envs, config, np.repeat(candidates.T, config.starts, axis=0))
        outcome = rollout(controller, envs, seeds, record=False)
        means = outcome.returns.reshape(count, config.starts).mean(axis=1)
        episodes += len(seeds)
        history.append(float(max([*history[-1:], means.max()])))
        report(len(history), config.generations + 1, f"return {history[-1]:.0f}")
        return -means

    result = differential_evolution(
        loss,  # type: ignore[arg-type]  # the stubs forget that a vectorized function returns an array
        ranges,
        popsize=max(1, config.population // len(ranges.lb)),
        maxiter=config.generations,
        rng=np.random.default_rng(config.seed),
        vectorized=True,
        updating="deferred",
        polish=False,
        tol=0,
    )
    return Tuned(result.x.tolist(), history, episodes)


def tune_piece(env_id: str, config: GaitConfig, out: Path, report: Report = ignore) -> None:
    """Tune a gait and write it, unless that is done."""
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


def gait_settings(env_id: str, config: GaitConfig) -> dict[str, Any]:
    """All that a tuned gait follows from."""
    return settings(env_id, _CODE, gait=config)


def gait_path(env_id: str, config: GaitConfig, out: Path) -> Path:
    """File of a tuned gait."""
    return piece_path(out, gait_settings(env_id, config), "gait")


def _stack(rows: Array, like: Array) -> Array:
    """Rows (r, j) shaped (r, 1, ..., 1, j), to meet an array (..., n)."""
    return rows.reshape(len(rows), *[1] * (like.ndim - 1), rows.shape[1])

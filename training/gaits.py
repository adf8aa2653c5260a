"""Sinusoidal gaits: joints that follow a sin(w t + b) by computed torque, or torques that are such sines.

A steered gait also changes a and w over the episode and leans against the heading, because a fixed
sinusoid is the weak member of its family. For tasks with a target, what is observed of it scales the
amplitudes and turns the joints with stops: an expression says how, and a tuned gain how much.

A gait knows its mechanism through data only: which coordinate each torque turns, whether that joint
has stops, and the reduced equations. It sees what a policy sees, and a clock.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mechanics.model import Model
from nhenv.env import LocomotionEnv
from nhenv.vector_env import LocomotionVectorEnv
from training.config import GaitConfig, TorqueConfig
from training.family import Family
from training.metrics import joint_index
from training.observed import Observed, Seen

__all__ = ["Feedback", "Gait", "Joints", "Sinusoid", "TorqueSinusoid", "sinusoids", "torque_sinusoids"]

Array = NDArray[np.float64]


class Joints:
    """The actuated joints of an environment's mechanism: their state, and the torque that moves them.

    The observation holds the angles of the joints with stops, the rates of all joints and the speed
    along the heading. By symmetry in the plane and in cyclic joints, no more of the state matters.

    Attributes:
        model: the mechanism's equations.
        observed: reads observations.
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
        self.observed = Observed(env)
        labels = self.observed.labels
        self._angles = [(labels.index(name), i) for i, name in enumerate(names) if name in labels]
        rates = [(labels.index(f"{name}_dot"), i) for i, name in enumerate(names) if f"{name}_dot" in labels]
        rates.append((labels.index("speed"), names.index(mechanism.fibre[0])))  # heading 0: speed is ẋ
        self._rates, self._moving = (list(column) for column in zip(*rates, strict=True))

    def state(self, observations: ArrayLike) -> tuple[Array, Array]:
        """Coordinates (..., n) and pseudo-velocities (..., k) behind observations (..., d).

        Up to symmetry: position, heading and cyclic angles are put to zero.
        """
        n, k = self.model.mechanism.n, self.model.mechanism.rank
        values = self.observed.values(observations)
        q = np.zeros((*values.shape[:-1], n))
        for source, target in self._angles:
            q[..., target] = values[..., source]
        fields = np.eye(k).reshape(k, *[1] * (q.ndim - 1), k)
        frame = self.model.velocity(q, fields)  # (k, ..., n): one vector field a row
        matrix = np.moveaxis(frame[..., self._moving], 0, -1)
        v = np.linalg.solve(matrix, values[..., self._rates, None])[..., 0]
        return q, v.astype(float, copy=False)

    def rates(self, seen: Seen) -> Array:
        """Rates of the joints (..., m), rad/s."""
        names = self.model.mechanism.coordinates
        return np.stack([seen[f"{names[i]}_dot"] for i in self.index], axis=-1)

    def torque(self, q: Array, v: Array, acceleration: Array) -> Array:
        """Torques (..., m) in N m that give the joints these accelerations (..., m) in rad/s²."""
        return self.model.controls_for(q, v, self.index, acceleration)


@dataclass(frozen=True)
class Gait:
    """References a sin(r w t + b) of the joints, and their feedback. Leading axes are for many gaits at once.

    In a scheduled gait a and the frequency w change linearly, with rates a' and w'.

    Attributes:
        amplitude: a at the start in rad, shape (..., m).
        amplitude_rate: a' in rad/s, shape (..., m).
        phase: b in rad, shape (..., m).
        damping: kd in 1/s, shape (..., m); kp is kd²/4, the critically damped value.
        frequency: w at the start in rad/s, shape (..., 1).
        frequency_rate: w' in rad/s², shape (..., 1).
        ratio: r, shape (m,).
    """

    amplitude: Array
    amplitude_rate: Array
    phase: Array
    damping: Array
    frequency: Array
    frequency_rate: Array
    ratio: Array

    @classmethod
    def from_vector(cls, vector: Array, ratio: Array, duration: float) -> Gait:
        """Gait of a vector: amplitudes, phases, dampings, w; if scheduled also the last amplitudes and the last w.

        Args:
            vector: shape (..., 3m + 1), or (..., 4m + 2) if scheduled.
            ratio: shape (m,).
            duration: time in s after which a scheduled gait has its last amplitudes and frequency.
        """
        m = len(ratio)
        amplitude, phase, damping, frequency = np.split(vector[..., : 3 * m + 1], [m, 2 * m, 3 * m], -1)
        last_amplitude, last_frequency = amplitude, frequency
        if vector.shape[-1] > 3 * m + 1:
            last_amplitude, last_frequency = np.split(vector[..., 3 * m + 1 :], [m], -1)
        return cls(
            amplitude,
            (last_amplitude - amplitude) / duration,
            phase,
            damping,
            frequency,
            (last_frequency - frequency) / duration,
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


@dataclass(frozen=True)
class Feedback:
    """How what is observed changes a gait: expressions, and a gain for each, shape (...).

    Attributes:
        steering: turns the joints with stops further, by the gain times its value, rad.
        cyclic: scales the amplitudes of the joints without stops, by the gain times its value, from -1 to 1.
        limited: scales the amplitudes of the joints with stops in the same way.
    """

    steering: tuple[str, Array] | None = None
    cyclic: tuple[str, Array] | None = None
    limited: tuple[str, Array] | None = None

    def offset(self, seen: Seen) -> Array:
        """What is added to the angles of the joints with stops, shape (..., 1)."""
        return np.zeros(1) if self.steering is None else self._value(self.steering, seen)

    def scale(self, seen: Seen, cyclic: NDArray[np.bool_]) -> Array:
        """What multiplies the amplitudes, shape (..., m)."""
        free, held = (
            np.ones(1) if rule is None else np.clip(self._value(rule, seen), -1, 1)
            for rule in (self.cyclic, self.limited)
        )
        return np.where(cyclic, free, held)

    @staticmethod
    def _value(rule: tuple[str, Array], seen: Seen) -> Array:
        text, gain = rule
        return (gain * seen.value(text))[..., None]


class Sinusoid:
    """Controller that makes the joints follow a gait: computed torque plus feedback, saturated."""

    def __init__(self, joints: Joints, gait: Gait, feedback: Feedback | None = None) -> None:
        self.joints, self.gait = joints, gait
        self.feedback = feedback or Feedback()
        self.steps = 0

    def reset(self, episodes: int) -> None:
        """Start the clock; `episodes` must fit the gait's leading axes."""
        self.steps = 0

    def __call__(self, observations: NDArray[np.float32], /) -> NDArray[np.float32]:
        """Actions (N, m) for observations (N, d)."""
        joints, gait, t = self.joints, self.gait, self.steps * self.joints.dt
        self.steps += 1
        q, v = joints.state(observations)
        seen = joints.observed(observations)
        scale = self.feedback.scale(seen, joints.cyclic)
        rate = gait.rate(t)
        rate_error = scale * rate - joints.rates(seen)
        # A rotor may be anywhere: only its rate is held.
        wanted = scale * gait.angle(t) + self.feedback.offset(seen)
        angle_error = np.where(joints.cyclic, 0.0, wanted - q[..., joints.index])
        # The torque is held, so what counts is the acceleration on average over the hold.
        forward = scale * (gait.rate(t + joints.dt) - rate) / joints.dt
        acceleration = forward + gait.damping * rate_error + gait.damping**2 / 4 * angle_error
        torque = joints.torque(q, v, acceleration)
        return np.clip(torque / joints.limits, -1, 1).astype(np.float32)


class TorqueSinusoid:
    """Controller that gives torques a sin(r w t + b) in open loop, a in shares of the limits: it looks at nothing."""

    def __init__(self, dt: float, amplitude: Array, phase: Array, frequency: Array) -> None:
        """Amplitudes (..., m) from 0 to 1, phases (..., m) in rad and angular frequencies r w (..., m) in rad/s."""
        self.dt, self.amplitude, self.phase, self.frequency = dt, amplitude, phase, frequency
        self.steps = 0

    def reset(self, episodes: int) -> None:
        """Start the clock; `episodes` must fit the leading axes."""
        self.steps = 0

    def __call__(self, observations: NDArray[np.float32], /) -> NDArray[np.float32]:
        """Actions (N, m), whatever the observations (N, d)."""
        turned = self.frequency * (self.steps * self.dt) + self.phase
        self.steps += 1
        actions = self.amplitude * np.sin(turned)
        return np.broadcast_to(actions, (len(observations), actions.shape[-1])).astype(np.float32)


def sinusoids(env: LocomotionEnv | LocomotionVectorEnv, config: GaitConfig, duration: float) -> Family:
    """Gaits by computed torque; a steered one has its last amplitudes and frequency after `duration` seconds."""
    joints = Joints(env)
    names = [env.mechanism.coordinates[i] for i in joints.index]
    amplitudes = [(0.0, a) for a in np.where(joints.cyclic, config.cyclic_amplitude, joints.stops).tolist()]
    ranges = dict(zip([f"{name} amplitude" for name in names], amplitudes, strict=True))
    ranges |= {f"{name} phase": (-np.pi, np.pi) for name in names}
    ranges |= {f"{name} damping": config.damping for name in names}
    ranges["frequency"] = config.frequency
    if config.steered:
        ranges |= dict(zip([f"{name} last amplitude" for name in names], amplitudes, strict=True))
        ranges["last frequency"] = config.frequency
    entries = len(ranges)
    wanted = {"steering": config.steered_by if config.steered else None}
    wanted |= {"cyclic": config.cyclic_by, "limited": config.limited_by}
    rules = {name: joints.observed.check(text) for name, text in wanted.items() if text is not None}
    largest = {"steering": config.steering, "cyclic": config.gain, "limited": config.gain}
    ranges |= {f"{name} gain": (-largest[name], largest[name]) for name in rules}

    def controller(vector: Array) -> Sinusoid:
        gait = Gait.from_vector(vector[..., :entries], _ratio(joints, config), duration)
        gains = np.moveaxis(vector[..., entries:], -1, 0)
        pairs = zip(rules.values(), gains, strict=True)
        return Sinusoid(joints, gait, Feedback(**dict(zip(rules, pairs, strict=True))))

    return Family(ranges, controller)


def torque_sinusoids(env: LocomotionEnv | LocomotionVectorEnv, config: TorqueConfig, duration: float) -> Family:
    """Gaits whose torques are sinusoids; they do not change with time, so `duration` does not matter."""
    joints, controls = Joints(env), env.mechanism.controls
    m = len(controls)
    ranges = {f"{name} amplitude": (0.0, 1.0) for name in controls}
    ranges |= {f"{name} phase": (-np.pi, np.pi) for name in controls} | {"frequency": config.frequency}

    def controller(vector: Array) -> TorqueSinusoid:
        amplitude, phase, frequency = np.split(vector, [m, 2 * m], -1)
        return TorqueSinusoid(joints.dt, amplitude, phase, frequency * _ratio(joints, config))

    return Family(ranges, controller)


def _ratio(joints: Joints, config: GaitConfig | TorqueConfig) -> Array:
    return np.where(joints.cyclic, config.cyclic_ratio, 1.0)

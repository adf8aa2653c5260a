"""Laws of the snakeboard: a rotor that always pushes, and steering that shares out what it gains.

In the flat frame c2' = u_psi sin(phi)/sqrt(D) with D = m l^2 - J_r sin(phi)^2, so u_psi = u_max sign(phi) makes the
momentum c2 grow whatever else happens, and fastest with the steering at its stop. But the heading turns with
-c2 sin(phi)/sqrt(D), so the faster the board, the less it may steer.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from training.gaits import Gait
from training.laws.law import Law, side_of
from training.observed import Seen

__all__ = ["BangBang", "ChargeThenGo", "ChirpedSteering", "acceleration_to_rest", "momentum"]

Array = NDArray[np.float64]

SLOWEST = 0.3  # sqrt(J); below this momentum the steering would be divided by nearly nothing


def momentum(seen: Seen, params: Mapping[str, float]) -> tuple[Array, Array]:
    """Momentum c2 of the flat frame, and the turning rate over it, both (N,), from the speed l c2 cos(phi)/sqrt(D)."""
    root = np.sqrt(params["m"] * params["l"] ** 2 - params["J_r"] * np.sin(seen["phi"]) ** 2)
    return seen["speed"] * root / (params["l"] * np.cos(seen["phi"])), -np.sin(seen["phi"]) / root


def acceleration_to_rest(error: Array, rate: Array, limit: Array | float, dt: float) -> Array:
    """Acceleration, held for dt, that brings a joint to rest at its reference in about the least number of holds.

    J. Han's function for the discrete double integrator (From PID to active disturbance rejection control, IEEE
    Transactions on Industrial Electronics 56, 2009, eq. 10). It is written for Euler's method, which
    error - dt/2 rate obeys exactly when the acceleration is held.

    Args:
        error: angle minus reference in rad.
        rate: its rate in rad/s.
        limit: largest acceleration in rad/s².
        dt: duration of a hold in s.
    """
    unit = limit * dt**2
    step = dt * rate
    y = error + step / 2
    far = step + np.sign(y) * (np.sqrt(unit * (unit + 8 * np.abs(y))) - unit) / 2
    return -limit * np.clip(np.where(np.abs(y) < unit, step + y, far) / unit, -1, 1)


class _PushingRotor(Law):
    """The rotor always pushes so that c2 grows; what the steering does is up to the law."""

    def first_side(self, seen: Seen) -> Array:
        """The side to which the wheels are turned."""
        return side_of(seen["phi"])

    def actions(self, seen: Seen, t: float) -> tuple[Array, ...]:
        """Shares of u_psi and u_phi."""
        # Where the wheels will be in the middle of the hold.
        rotor = np.sign(seen["phi"] + self.dt / 2 * seen["phi_dot"])
        torque = self.params["J_w"] * self.acceleration(seen, t) + self.drag["b_phi"] * seen["phi_dot"]
        return rotor, torque / self.limits["u_phi"]

    def acceleration(self, seen: Seen, t: float) -> Array:
        """Wanted acceleration of the steering, rad/s²."""
        raise NotImplementedError


class BangBang(_PushingRotor):
    """The heading swings between -swing and swing, less and less; the steering goes where it is sent as fast as it can.

    Of the board's sides, `side` is the one to which it steers: with the wheels to the left (phi > 0) it turns right.
    """

    RANGES: ClassVar[Mapping[str, tuple[float, float]]] = {
        "swing": (0.1, 2.5),  # amplitude of the heading at the start, rad
        "decay": (0.05, 1.5),  # exponent with which it vanishes towards the end
        "lookahead": (0.02, 0.4),  # s, so much ahead a swing is seen to end
        "steering": (0.1, 1.2),  # largest angle of the wheels, rad
        "approach": (0.02, 0.4),  # s, in which the heading would come up to the end of a swing
    }

    def acceleration(self, seen: Seen, t: float) -> Array:
        """Wanted acceleration of the steering, rad/s²."""
        limit = self.limits["u_phi"] / self.params["J_w"]
        return acceleration_to_rest(seen["phi"] - self.reference(seen, t), seen["phi_dot"], limit, self.dt)

    def reference(self, seen: Seen, t: float) -> Array:
        """Angle (N,) to which the wheels are sent, rad."""
        has, params, heading = self.values, self.params, seen.heading
        c2, turning = momentum(seen, params)
        swing = has["swing"] * self.left(t) ** has["decay"]
        predicted = _wrapped(heading + c2 * has["lookahead"] * turning)
        self.side = np.where(self.swinging(t) & (-self.side * predicted > swing), -self.side, self.side)
        # With straight wheels the heading turns by -phi c2 / sqrt(m l^2).
        straight = np.sqrt(params["m"]) * params["l"] / (np.maximum(c2, SLOWEST) * has["approach"])
        return np.clip(straight * (heading + self.side * swing), -has["steering"], has["steering"])

    def swinging(self, t: float) -> NDArray[np.bool_]:
        """Whether an episode swings at time t."""
        return np.array(True)


class ChargeThenGo(BangBang):
    """First the wheels stay at their stop and the board spins while momentum grows; then as above."""

    RANGES: ClassVar[Mapping[str, tuple[float, float]]] = {"charge": (0.0, 10.0), **BangBang.RANGES}  # charge in s

    def reference(self, seen: Seen, t: float) -> Array:
        """Angle (N,) to which the wheels are sent, rad."""
        stop = self.stops["phi"]
        return np.where(self.swinging(t), super().reference(seen, t), self.side * stop)

    def swinging(self, t: float) -> NDArray[np.bool_]:
        """Whether an episode swings at time t."""
        return t >= self.values["charge"]


class ChirpedSteering(_PushingRotor):
    """The wheels follow a sinusoid whose amplitude and frequency drift, and lean against the heading."""

    RANGES: ClassVar[Mapping[str, tuple[float, float]]] = {
        "amplitude": (0.0, 1.2),  # rad, of the wheels at the start
        "phase": (-np.pi, np.pi),  # rad
        "damping": (2.0, 38.0),  # 1/s; a held torque needs less than 2 / 0.05 s
        "frequency": (1.0, 30.0),  # rad/s at the start
        "last amplitude": (0.0, 1.2),
        "last frequency": (1.0, 30.0),
        "heading gain": (-2.0, 2.0),  # rad
    }

    def acceleration(self, seen: Seen, t: float) -> Array:
        """Wanted acceleration of the steering, rad/s²."""
        gait, damping = self._gait, self.values["damping"]
        angle, rate, next_rate = (x[..., 0] for x in (gait.angle(t), gait.rate(t), gait.rate(t + self.dt)))
        wanted = self.side * angle + self.values["heading gain"] * seen["sin_heading"]
        feedback = damping * (self.side * rate - seen["phi_dot"]) + damping**2 / 4 * (wanted - seen["phi"])
        return self.side * (next_rate - rate) / self.dt + feedback

    @cached_property
    def _gait(self) -> Gait:
        entries = [*self.values.values()][:-1]  # the gain is not the gait's
        return Gait.from_vector(np.stack(entries, axis=-1), np.ones(1), self.duration)


def _wrapped(angle: Array) -> Array:
    """The same angle in [-π, π)."""
    return (angle + np.pi) % (2 * np.pi) - np.pi

"""The motion of a mechanism whose joints are made to follow given angles, whatever torques that takes.

The torques that do it are computed from the mechanism's own reduced equations, which are then integrated with them:
nothing here knows a mechanism. Theory speaks of such motions, see `training.predictions`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mechanics.mechanism import Mechanism
from mechanics.model import Model
from training.metrics import joint_index

__all__ = ["Sinusoids", "follow"]

Array = NDArray[np.float64]

# Tight enough for an error of fifth order to be seen at a tenth of a radian; SciPy goes no lower than 2.2e-14.
RTOL, ATOL = 3e-14, 1e-16


@dataclass(frozen=True)
class Sinusoids:
    """Angles a sin(w t + b) of the joints that the controls turn. Leading axes are for many motions at once.

    Attributes:
        amplitude: a in rad, shape (..., m).
        frequency: w in rad/s, shape (m,).
        phase: b in rad, shape (m,).
    """

    amplitude: Array
    frequency: Array
    phase: Array

    def angle(self, t: float) -> Array:
        """Angles at time t in s, shape (..., m)."""
        return self.amplitude * np.sin(self.frequency * t + self.phase)

    def rate(self, t: float) -> Array:
        """Rates at time t in rad/s, shape (..., m)."""
        return self.amplitude * self.frequency * np.cos(self.frequency * t + self.phase)

    def acceleration(self, t: float) -> Array:
        """Accelerations at time t in rad/s², shape (..., m)."""
        return -(self.frequency**2) * self.angle(t)


def follow(
    mechanism: Mechanism, shapes: Sinusoids, t: ArrayLike, params: Mapping[str, float] | None = None
) -> tuple[Array, Array]:
    """Coordinates and velocities at times t, each of shape (T, ..., n), of the motion that the joints force.

    It begins at t = 0 at rest, with every coordinate but the joints' at zero. The joints have their rates from then
    on: impulses of the controls give them, as strong torques for a short time would.

    Args:
        mechanism: what moves; its controls must be torques on single joints.
        shapes: the angles of these joints.
        t: increasing times in s, shape (T,), none before 0.
        params: values that replace the mechanism's default parameters.
    """
    from scipy.integrate import solve_ivp

    model, joints = Model(mechanism, params), joint_index(mechanism)
    n, k, m = mechanism.n, mechanism.rank, len(joints)
    many = np.shape(shapes.amplitude)[:-1]

    def rates(time: float, state: Array) -> Array:
        q, v = np.split(state.reshape(*many, n + k), [n], axis=-1)
        u = model.controls_for(q, v, joints, shapes.acceleration(time))
        return np.concatenate([model.velocity(q, v), model.rates(q, v, u)], axis=-1).ravel()

    q = np.zeros((*many, n))
    q[..., joints] = shapes.angle(0.0)
    still = np.zeros((*many, k))
    probe = np.vstack([np.zeros(m), np.eye(m)]).reshape(m + 1, *[1] * len(many), m)  # none, then one after another
    unpushed, *pushed = model.rates(q, still, probe)
    push = np.stack(pushed, axis=-1) - unpushed[..., None]  # (..., k, m): Y, what impulses change v by
    frame = np.stack([model.velocity(q, still + column) for column in np.eye(k)], axis=-1)  # (..., n, k): X
    impulse = np.linalg.solve(frame[..., joints, :] @ push, shapes.rate(0.0)[..., None])
    v = (push @ impulse)[..., 0]
    times = np.asarray(t, dtype=float)
    begun = np.concatenate([q, v], axis=-1).ravel()
    solution = solve_ivp(rates, (0.0, times[-1]), begun, "DOP853", times, rtol=RTOL, atol=ATOL)
    if not solution.success:
        raise RuntimeError(f"{mechanism.name}: the joints could not be made to follow {shapes}: {solution.message}")
    q, v = np.split(solution.y.T.reshape(len(times), *many, n + k), [n], axis=-1)
    return q, model.velocity(q, v)

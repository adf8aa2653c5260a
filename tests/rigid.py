"""A stranger for inertia tensors: kinetic energy from where the bodies are, by finite differences."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import numpy as np

from mechanics.mechanism import Mechanism

__all__ = ["Bodies", "assert_inertia_is_that_of", "rotation"]

# Mass, inertia tensor in the body's axes [3, 3], position of the centre of mass [3], attitude [3, 3].
Body = tuple[float, Any, Any, Any]
Bodies = Callable[[dict[str, float]], Iterable[Body]]

STEP = 1e-3


def rotation(axis: int, angle: float) -> np.ndarray:
    """Rotation matrix about a coordinate axis."""
    c, s = np.cos(angle), np.sin(angle)
    matrix = np.array([[1.0, 0, 0], [0, c, -s], [0, s, c]])
    return np.roll(matrix, (axis, axis), (0, 1))


def assert_inertia_is_that_of(mechanism: Mechanism, bodies: Bodies, samples: int = 5) -> None:
    """Compare 1/2 q̇ M q̇ with the energy of the bodies' motion, for any q̇: the constraints do not matter here."""
    rng = np.random.default_rng(5)
    for _ in range(samples):
        q, qdot = rng.uniform(-1, 1, (2, mechanism.n))
        parameters = {name: value * rng.uniform(0.8, 1.2) for name, value in mechanism.parameters.items()}
        values = parameters | dict(zip(mechanism.coordinates, q, strict=True))
        energy = 0.5 * qdot @ mechanism.numeric(mechanism.inertia, values) @ qdot

        def at(t: float, q=q, qdot=qdot, parameters=parameters) -> list[Body]:
            return list(bodies(parameters | dict(zip(mechanism.coordinates, q + t * qdot, strict=True))))

        # Central difference of order 4: h^4 = 1e-12 times fifth derivatives of order 1 to 10, and 1e-16/h = 1e-13.
        around = [at(STEP * k) for k in (-2, -1, 1, 2)]
        expected = 0.0
        for i, (mass, inertia, _, attitude) in enumerate(at(0.0)):
            (position_rate, attitude_rate) = (
                np.tensordot([1, -8, 8, -1], np.array([a[i][part] for a in around]), 1) / (12 * STEP) for part in (2, 3)
            )
            spin = np.asarray(attitude).T @ attitude_rate
            omega = np.array([spin[2, 1], spin[0, 2], spin[1, 0]])
            expected += 0.5 * mass * position_rate @ position_rate + 0.5 * omega @ np.asarray(inertia) @ omega
        np.testing.assert_allclose(energy, expected, rtol=1e-9)

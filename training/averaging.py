"""Fast torques, and the slow motion that is left of them on average.

Torques (A/ε) cos(t/ε), all in phase and large, shake a mechanism back and forth by an amount of order ε. What remains
is not rest: with the constrained connection ∇̃ and the symmetric products ⟨Y_a : Y_b⟩ of the input fields,

    ∇̃_ṙ ṙ = -Σ Λ_ab ⟨Y_a : Y_b⟩,  Λ_ab = A_a A_b / 4

is the motion r(t) about which it is shaken (F. Bullo, Averaging and vibrational control of mechanical systems, 2002).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mechanics import simulate
from mechanics.mechanism import Mechanism
from mechanics.model import Model

__all__ = ["averaged", "mean_acceleration", "shaken"]

Array = NDArray[np.float64]


def mean_acceleration(
    mechanism: Mechanism, amplitudes: ArrayLike, params: Mapping[str, float] | None = None
) -> Callable[[ArrayLike], Array]:
    """The vector field -Σ Λ_ab ⟨Y_a : Y_b⟩ as a function of q (n,) -> (n,), derived with SymPy.

    Args:
        mechanism: what is shaken.
        amplitudes: A in N m s, shape (m,).
        params: values that replace the mechanism's default parameters.
    """
    import sympy as sp

    from mechanics.geometry.connection import Connection

    connection = Connection(mechanism)
    fields = [connection.input_fields[:, a] for a in range(len(mechanism.controls))]
    impulses = np.asarray(amplitudes, dtype=float)
    weights = np.outer(impulses, impulses) / 4
    pairs = [(a, b) for a in range(len(fields)) for b in range(len(fields))]
    products = [connection.symmetric_product(fields[a], fields[b]) for a, b in pairs]
    values = mechanism.resolve(params)
    symbols = [sp.Symbol(name) for name in values]
    function = sp.lambdify([connection.coordinates, symbols], products, "numpy", cse=True)

    def field(q: ArrayLike) -> Array:
        evaluated = np.array(function(q, list(values.values())), dtype=float)[..., 0]
        return -np.tensordot(weights.ravel(), evaluated, axes=1)

    return field


def averaged(
    mechanism: Mechanism, amplitudes: ArrayLike, t: ArrayLike, q0: ArrayLike, params: Mapping[str, float] | None = None
) -> Array:
    """Coordinates (T, n) of the averaged motion r at increasing times t, from rest in q0 at t[0].

    Args:
        mechanism: what is shaken.
        amplitudes: A in N m s, shape (m,).
        t: times in s, shape (T,).
        q0: coordinates (n,).
        params: values that replace the mechanism's default parameters.
    """
    from scipy.integrate import solve_ivp

    model, field = Model(mechanism, params), mean_acceleration(mechanism, amplitudes, params)
    n, none = mechanism.n, np.zeros(len(mechanism.controls))

    def rates(time: float, state: Array) -> Array:
        q, v = state[:n], state[n:]
        return np.concatenate([model.velocity(q, v), model.rates(q, v, none) + model.project(q, field(q))])

    times = np.asarray(t, dtype=float)
    begun = np.concatenate([np.asarray(q0, dtype=float), np.zeros(mechanism.rank)])
    solution = solve_ivp(rates, (times[0], times[-1]), begun, "DOP853", times, rtol=1e-11, atol=1e-13)
    if not solution.success:
        raise RuntimeError(f"{mechanism.name}: the averaged motion could not be followed: {solution.message}")
    return solution.y.T[:, :n]


def shaken(
    mechanism: Mechanism,
    amplitudes: ArrayLike,
    epsilon: float,
    t: ArrayLike,
    q0: ArrayLike,
    params: Mapping[str, float] | None = None,
) -> Array:
    """Coordinates (T, n) of the motion itself, under torques (A/ε) cos(t/ε), from rest in q0 at t[0]."""
    amplitude = np.asarray(amplitudes, dtype=float) / epsilon
    return simulate(mechanism, t, q0, controls=lambda time: amplitude * np.cos(time / epsilon), params=params).q

"""Strangers to compare with: the same physics by another road, written only for the tests."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from functools import cache
from typing import Any

import numpy as np
import sympy as sp

from mechanics.expressions import to_sympy
from mechanics.mechanism import Mechanism

__all__ = ["frame_acceleration", "multiplier_acceleration"]


def multiplier_acceleration(
    mechanism: Mechanism,
    values: Mapping[str, float],
    qdot: Sequence[float],
    u: Sequence[float],
    drag: Mapping[str, float] | None = None,
) -> np.ndarray:
    """Acceleration q̈ [n] by Lagrange-d'Alembert with multipliers.

    Solves [[M, -ω^T], [ω, 0]] (q̈, λ) = (u_a F_a - ∇V - ∂R/∂q̇ - C(q, q̇), -ω̇ q̇), the textbook equations:
    no frame, no connection, no projection.

    Args:
        mechanism: the mechanism.
        values: coordinates and parameters by name.
        qdot: [n] velocity that satisfies the constraints.
        u: [m] controls.
        drag: coefficients of Rayleigh's function R, which does not act if there are none.
    """
    n, c = mechanism.n, len(mechanism.one_forms)
    function = _ingredients(json.dumps(mechanism.to_dict()))
    names = [*mechanism.coordinates, *mechanism.parameters]
    coefficients = [(drag or {}).get(name, 0.0) for name in mechanism.drag]
    numbers = function(*(values[name] for name in names), *coefficients, *qdot)
    M, dM, forms, dforms, forces, gradient, braking = map(np.asarray, numbers)
    qdot = np.asarray(qdot, dtype=float)
    dM = dM.reshape(n, n, n)  # [c, a, b] = ∂_c M_ab
    # d/dt (M q̇) - ∂/∂q (1/2 q̇ M q̇)
    bias = np.einsum("cab,c,b->a", dM, qdot, qdot) - 0.5 * np.einsum("abc,b,c->a", dM, qdot, qdot)
    right = forces.reshape(-1, n).T @ np.asarray(u, dtype=float) - gradient.ravel() - bias
    if drag is not None:
        right = right - braking.ravel()
    if c:
        forms, dforms = forms.reshape(c, n), dforms.reshape(n, c, n)
        system = np.block([[M, -forms.T], [forms, np.zeros((c, c))]])
        right = np.concatenate([right, -np.einsum("crb,c,b->r", dforms, qdot, qdot)])
        return np.linalg.solve(system, right)[:n]
    return np.linalg.solve(M, right)


@cache
def _ingredients(data: str) -> Any:
    m = Mechanism.from_dict(json.loads(data))
    # Real symbols, for which SymPy differentiates abs.
    real = {s: sp.Symbol(name, real=True) for name, s in m.symbols.items()}

    def read(rows: Any) -> list[list[sp.Expr]]:
        return [[m.symbolic(text).xreplace(real) for text in row] for row in rows]

    q = [real[m.symbols[c]] for c in m.coordinates]
    M, forms, forces = sp.Matrix(read(m.inertia)), read(m.one_forms), read(m.forces.values())
    ((V,),) = read([[m.potential]])
    dM = [[[sp.diff(e, c) for e in M.row(a)] for a in range(m.n)] for c in q]
    dforms = [[[sp.diff(e, c) for e in row] for row in forms] for c in q]
    rates = [sp.Symbol(name) for name in m.rates]
    rayleigh = to_sympy(m.rayleigh, {**m.scope(), **{r.name: r for r in rates}}).xreplace(real)
    symbols = [*(real[m.symbols[s]] for s in (*m.coordinates, *m.parameters, *m.drag)), *rates]
    outputs = [M.tolist(), dM, forms, dforms, forces, [sp.diff(V, c) for c in q], [sp.diff(rayleigh, r) for r in rates]]
    return sp.lambdify(symbols, outputs, "numpy", cse=True)


def frame_acceleration(equations: Any, values: Mapping[str, float], v: Sequence[float], u: Sequence[float]) -> Any:
    """(q̇, q̈) [n] each, that reduced equations predict: q̈ = X v̇ + Ẋ v with Ẋ differentiated by SymPy."""
    function = _frame_function(equations)
    names = [s.name for s in (*equations.coordinates, *equations.parameters)]
    velocity, frame, rates, acceleration = map(np.asarray, function(*(values[name] for name in names), *v, *u))
    n, k = frame.shape
    return velocity, frame @ acceleration + rates.reshape(n, n) @ velocity


_functions: dict[int, Any] = {}


def _frame_function(equations: Any) -> Any:
    if id(equations) not in _functions:
        e = equations
        symbols = [*e.coordinates, *e.parameters, *e.pseudo_velocities, *e.controls]
        rates = [[sp.diff(row, c) for c in e.coordinates] for row in e.velocity]
        outputs = [list(e.velocity), e.frame.tolist(), rates, list(e.acceleration)]
        _functions[id(equations)] = equations, sp.lambdify(symbols, outputs, "numpy", cse=True)
    return _functions[id(equations)][1]

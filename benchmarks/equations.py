"""The reduced equations of a mechanism, compiled for other libraries; and the multiplier formulation, compiled.

The source is what our own generator writes, in the frame in which our environments integrate, with divisions, roots and
common subexpressions shared: nobody is slow for want of a better formula.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import sympy as sp
from numpy.typing import NDArray

import mechanics
from benchmarks.textbook import textbook
from mechanics.compiler.backends import BACKENDS
from mechanics.compiler.codegen import Program
from mechanics.geometry.reduction import derive
from mechanics.model import Model

__all__ = ["Equations", "multipliers"]

Array = NDArray[np.float64]


class Equations:
    """Rates of the state y = (q, v) under controls u.

    Args:
        mechanism: name, in the catalogue; its default parameters.
    """

    def __init__(self, mechanism: str) -> None:
        data = mechanics.get(mechanism)
        equations = derive(data, data.frame_rows(None))
        rates = [*equations.velocity, *equations.acceleration]
        self._outputs = [f"{i}" for i in range(len(rates))]
        self._program = Program(
            dict(zip(self._outputs, rates, strict=True)), equations.parameters, equations.definitions
        )
        self._arguments = (*equations.coordinates, *equations.pseudo_velocities, *equations.controls)
        self.size, self.controls = len(rates), len(equations.controls)
        self._model, self._n = Model(data), data.n
        scope = {"sin": np.sin, "cos": np.cos, "sqrt": np.sqrt}
        exec(self._program.constants_function("constants", equations.parameters), scope)  # noqa: S102
        self.constants: Array = np.array(scope["constants"](list(data.resolve(None).values())))

    def start(self, q: Array, qdot: Array) -> Array:
        """States y (B, n + k) of coordinates and velocities (B, n)."""
        return np.concatenate([q, self._model.feasible(q, qdot)], axis=-1)

    def states(self, y: Array) -> tuple[Array, Array]:
        """Coordinates and velocities (..., n) of states y (..., n + k)."""
        q, v = y[..., : self._n], y[..., self._n :]
        return q, self._model.velocity(q, v)

    def function(self, **functions: Any) -> Callable[..., tuple[Any, ...]]:
        """Function of (*y, *u, k) -> rates, k `constants`, from a library's sin, cos and sqrt."""
        scope = dict(functions)
        exec(self._source("numpy"), scope)  # noqa: S102
        return scope["rates"]

    def compiled(self) -> Any:
        """Numba's function of (y, u, k) -> rates, a new array."""
        sizes = {"y": self.size, "u": self.controls}
        return _compiled(self._source("numba"), sizes, len(self._outputs))

    def _source(self, backend: str) -> str:
        return self._program.function("rates", self._arguments, self._outputs, BACKENDS[backend])


def multipliers(mechanism: str) -> Any:
    """Numba's function of (y, u) -> rates of y = (q, q̇), by a linear solve with multipliers in each call."""
    from numba import njit

    data, t = mechanics.get(mechanism), textbook(mechanics.get(mechanism))
    n, c, m = len(t.q), len(t.forms), len(t.forces)
    flat = [*sum(t.inertia, []), *sum(t.forms, []), *sum(t.forces, []), *t.bias, *t.turning]
    values = dict(zip(t.parameters, map(sp.Float, data.resolve(None).values()), strict=True))
    names = [f"{i}" for i in range(len(flat))]
    program = Program(dict(zip(names, (e.xreplace(values) for e in flat), strict=True)), ())
    source = program.function("rates", [*t.q, *t.qdot], names, BACKENDS["numba"])
    numbers, none = _compiled(source, {"y": 2 * n, "u": 0}, len(flat)), np.zeros(0)
    one, two, three, four = n * n, (n + c) * n, (n + c + m) * n, (n + c + m + 1) * n  # ends of M, ω, F and bias

    @njit(error_model="numpy")
    def right(y: Array, u: Array) -> Array:
        flat = numbers(y, u, none)
        forms = flat[one:two].copy().reshape(c, n)
        forces = flat[two:three].copy().reshape(m, n)
        system, side = np.zeros((n + c, n + c)), np.empty(n + c)
        system[:n, :n] = flat[:one].copy().reshape(n, n)
        system[:n, n:], system[n:, :n] = -forms.T, forms
        side[:n], side[n:] = -flat[three:four], -flat[four:]
        for a in range(m):
            side[:n] += u[a] * forces[a]
        rates = np.empty(2 * n)
        rates[:n], rates[n:] = y[n:], np.linalg.solve(system, side)[:n]
        return rates

    return right


def _compiled(source: str, sizes: Mapping[str, int], count: int) -> Any:
    """Numba's function of (y, u, k) -> a new array, of the source of `rates(*y, *u, _k)` -> a tuple."""
    call = ", ".join(f"{name}[{i}]" for name, size in sizes.items() for i in range(size))
    array = ", ".join(f"1.0*found[{i}]" for i in range(count))  # 0 is not a float
    source = f"{BACKENDS['numba'].header}\nimport numpy as np\n\n\n{source}\n\n"
    source += f"@njit(error_model='numpy')\ndef right(y, u, k):\n    found = rates({call}, k)\n"
    source += f"    return np.array(({array},))\n"
    scope: dict[str, Any] = {}
    exec(source, scope)  # noqa: S102
    return scope["right"]

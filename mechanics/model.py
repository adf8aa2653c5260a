"""`Model`: the reduced equations of a mechanism as numerical functions.

Derived once, cached as NumPy source, and vectorised: every method takes arrays whose last axis
counts coordinates, pseudo-velocities or controls, and any leading axes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mechanics.compiler import kernels
from mechanics.mechanism import Mechanism, MechanismError

if TYPE_CHECKING:
    from mechanics.geometry.reduction import ReducedEquations

__all__ = ["Model", "acceleration"]

Array = NDArray[np.float64]

# A velocity counts as feasible if what violates the constraints is rounding: states printed with
# 15 digits leave 1e-14 of the speed, a typing error leaves the order of the speed.
CONSTRAINT_TOLERANCE = 1e-8


class Model:
    """Numerical functions of one mechanism in one frame.

    Args:
        mechanism: what moves.
        params: values that replace the mechanism's defaults.
        frame: as in `mechanics.reduce`.
        drag: False or None for none, True for the mechanism's own, or coefficients by name.
    """

    def __init__(
        self,
        mechanism: Mechanism,
        params: Mapping[str, float] | None = None,
        frame: str | Sequence[Sequence[str]] | None = None,
        drag: bool | Mapping[str, float] | None = None,
    ) -> None:
        self.mechanism = mechanism
        self.params = mechanism.resolve(params)
        rows = mechanism.frame_rows(frame)
        self.drag = mechanism.drag_coefficients(drag)
        acts = self.drag is not None
        specification = {"mechanism": mechanism.to_dict(drawing=False), "frame": rows, "drag": acts}
        self._functions = kernels.load(f"{mechanism.name}_model", specification, lambda: _source(mechanism, rows, acts))
        self._constants = np.array(self._functions.constants([*self.params.values(), *(self.drag or {}).values()]))

    def project(self, q: ArrayLike, qdot: ArrayLike) -> Array:
        """Pseudo-velocities v (..., k) of velocities q̇ (..., n), orthogonally projected onto D."""
        return self._call("project", (q, self.mechanism.n, "q"), (qdot, self.mechanism.n, "qdot"))

    def feasible(self, q: ArrayLike, qdot: ArrayLike) -> Array:
        """Pseudo-velocities v (..., k) of q̇ (..., n); raise `MechanismError` where q̇ is not in D."""
        with np.errstate(over="ignore", invalid="ignore"):  # what is too large is refused below
            v = self.project(q, qdot)
            given, projected = np.asarray(qdot, dtype=float), self.velocity(q, v)
            error = np.linalg.norm(given - projected, axis=-1)
            allowed = CONSTRAINT_TOLERANCE * np.maximum(1.0, np.linalg.norm(given, axis=-1))
        if not (np.isfinite(allowed) & (error <= allowed)).all():
            raise MechanismError(
                f"{self.mechanism.name}: qdot = {given.tolist()} violates the rolling constraints by "
                f"{np.max(error):.3g}; the nearest feasible velocity is {projected.tolist()}"
            )
        return v

    def velocity(self, q: ArrayLike, v: ArrayLike) -> Array:
        """Velocities q̇ = X(q) v, shape (..., n)."""
        return self._call("velocity", (q, self.mechanism.n, "q"), (v, self.mechanism.rank, "v"))

    def rates(self, q: ArrayLike, v: ArrayLike, u: ArrayLike) -> Array:
        """Rates of the pseudo-velocities, -Γ̃(q) v v + Y(q) u + potential and drag parts, shape (..., k)."""
        return self._call("rates", *self._state(q, v), (u, len(self.mechanism.forces), "u"))

    def acceleration(self, q: ArrayLike, v: ArrayLike, u: ArrayLike) -> Array:
        """Accelerations q̈ (..., n) that the rates and the constraints give."""
        return self._call("acceleration", *self._state(q, v), (u, len(self.mechanism.forces), "u"))

    def controls_for(self, q: ArrayLike, v: ArrayLike, index: NDArray[np.intp], acceleration: Array) -> Array:
        """Controls u (..., m) that give the coordinates at `index` (m,) accelerations (..., m)."""
        m = len(self.mechanism.forces)
        # Accelerations are affine in the controls: probe with none, then with one after another.
        probe = np.vstack([np.zeros(m), np.eye(m)]).reshape(m + 1, *[1] * (np.ndim(q) - 1), m)
        free, *response = self.acceleration(q, v, probe)[..., index]
        matrix = np.stack(response, axis=-1) - free[..., None]
        return np.linalg.solve(matrix, (acceleration - free)[..., None])[..., 0]

    def energy(self, q: ArrayLike, v: ArrayLike) -> Array:
        """Kinetic plus potential energy in J, shape (...)."""
        return self._call("energy", *self._state(q, v))[..., 0]

    def power(self, q: ArrayLike, v: ArrayLike, u: ArrayLike) -> Array:
        """Power sum_a u_a <F_a, q̇> of the controls in W, shape (...)."""
        return self._call("power", *self._state(q, v), (u, len(self.mechanism.forces), "u"))[..., 0]

    def constraint_residual(self, q: ArrayLike, qdot: ArrayLike) -> Array:
        """Values of the c constraint one-forms on q̇, shape (..., c); zero on feasible velocities."""
        return self._call("residual", (q, self.mechanism.n, "q"), (qdot, self.mechanism.n, "qdot"))

    def scalar_rates(self, state: Sequence[float], u: Sequence[float]) -> tuple[float, ...]:
        """Rates of (q, v, work) as a tuple: the right-hand side for an ODE solver, nothing checked."""
        return self._functions.right_hand_side(*state, *u, self._constants)

    def trust(self, state: Sequence[float], tolerance: float) -> float:
        """Share of a tolerance that may be used in a state (q, ...): 1 but near a pole of the frame.

        Not positive where roundings alone are more than the tolerance: see `mechanics.compiler.margins`.
        """
        shares = self._functions.trust(*state[: self.mechanism.n], tolerance, self._constants)
        return float(min([1.0, *shares]))

    def _state(self, q: ArrayLike, v: ArrayLike) -> tuple[tuple[ArrayLike, int, str], ...]:
        return (q, self.mechanism.n, "q"), (v, self.mechanism.rank, "v")

    def _call(self, name: str, *arguments: tuple[ArrayLike, int, str]) -> Array:
        columns: list[Array] = []
        for value, size, label in arguments:
            array = np.asarray(value, dtype=float)
            if array.shape[-1:] != (size,):
                raise MechanismError(f"{self.mechanism.name}: {label} must have shape (..., {size}), got {array.shape}")
            columns.extend(np.moveaxis(array, -1, 0))
        result = getattr(self._functions, name)(*columns, self._constants)
        if not result:
            return np.zeros((*np.shape(columns[0]), 0))
        return np.stack(np.broadcast_arrays(*result), axis=-1).astype(float)


def acceleration(
    mechanism: Mechanism,
    q: ArrayLike,
    qdot: ArrayLike,
    u: ArrayLike,
    params: Mapping[str, float] | None = None,
) -> Array:
    """Accelerations q̈ of a mechanism under its constraints: numbers in, numbers out.

    Args:
        mechanism: what moves.
        q: coordinates, shape (..., n), in m and rad.
        qdot: velocities, shape (..., n), in m/s and rad/s.
        u: controls, shape (..., m), in N and N m.
        params: values that replace the mechanism's defaults.

    Returns:
        Accelerations, shape (..., n), in m/s² and rad/s², without drag.

    Raises:
        MechanismError: a parameter that the mechanism does not have or that is impossible, a shape that does not fit,
            or velocities that the constraints forbid.
    """
    model = Model(mechanism, params)
    return model.acceleration(q, model.feasible(q, qdot), u)


def _source(mechanism: Mechanism, rows: Any, drag: bool) -> str:
    """Generate the NumPy module of a mechanism in a frame."""
    import sympy as sp

    from mechanics.compiler.backends import BACKENDS
    from mechanics.compiler.codegen import Program, needed
    from mechanics.compiler.margins import trust
    from mechanics.geometry.reduction import derive

    equations: ReducedEquations = derive(mechanism, rows, drag=drag)
    q, v, u = equations.coordinates, equations.pseudo_velocities, equations.controls
    qdot, tolerance = sp.symbols([f"{c.name}__dot" for c in q]), sp.Symbol("_tolerance")
    forms = [[mechanism.symbolic(text) for text in row] for row in mechanism.one_forms]
    forces = [[mechanism.symbolic(text) for text in row] for row in mechanism.forces.values()]
    rate_of = dict(zip((*q, *v), (*equations.velocity, *equations.acceleration), strict=True))
    power = sum(
        (
            ua * fi * vi
            for ua, row in zip(u, forces, strict=True)
            for fi, vi in zip(row, equations.velocity, strict=True)
        ),
        sp.S.Zero,
    )
    # Rates of the definitions, by the chain rule along the motion.
    definitions, change = list(equations.definitions), dict(rate_of)

    def along(expression: sp.Expr) -> sp.Expr:
        """Derivative along the motion."""
        moving = sorted(expression.free_symbols & change.keys(), key=str)
        return sum((sp.diff(expression, s) * change[s] for s in moving), sp.S.Zero)

    for symbol, expression in needed(equations.velocity, equations.definitions).items():
        change[symbol] = sp.Symbol(f"{symbol.name}_rate")
        definitions.append((change[symbol], along(expression)))
    groups: dict[str, tuple[tuple[Any, ...], list[sp.Expr]]] = {
        "project": ((*q, *qdot), list(equations.projection * sp.Matrix(qdot))),
        "velocity": ((*q, *v), list(equations.velocity)),
        "rates": ((*q, *v, *u), list(equations.acceleration)),
        "acceleration": ((*q, *v, *u), [along(e) for e in equations.velocity]),
        "energy": ((*q, *v), [equations.energy]),
        "power": ((*q, *v, *u), [power]),
        "residual": ((*q, *qdot), [sum(a * b for a, b in zip(row, qdot, strict=True)) for row in forms]),
        "trust": ((*q, tolerance), list(trust(equations, rows, tolerance))),
        "right_hand_side": ((*q, *v, sp.Symbol("_work"), *u), [*rate_of.values(), power]),
    }
    outputs = {f"{group}:{i}": e for group, (_, es) in groups.items() for i, e in enumerate(es)}
    program = Program(outputs, equations.parameters, definitions)
    numpy = BACKENDS["numpy"]
    functions = [
        program.function(group, arguments, [f"{group}:{i}" for i in range(len(expressions))], numpy)
        for group, (arguments, expressions) in groups.items()
    ]
    title = f'"""{mechanism.name}: numerical functions in the frame {equations.frame.T.tolist()}. Do not edit."""\n'
    return "\n\n".join(
        [title + numpy.header, program.constants_function("constants", equations.parameters), *functions]
    )

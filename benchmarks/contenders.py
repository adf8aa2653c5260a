"""Ways to the equations of motion of a mechanism: what `benchmarks.derivation` times and counts.

Each contender is a function from a `Mechanism` to `Equations`, over plain symbols with the mechanism's names.
SymPy's two get their generalized forces by a device that costs them nothing: a point without mass that moves
as one coordinate does, on which a component of a one-form acts.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import combinations
from typing import Any

import numpy as np
import sympy as sp
from numpy.typing import NDArray
from sympy.physics.mechanics import (
    KanesMethod,
    LagrangesMethod,
    Point,
    ReferenceFrame,
    RigidBody,
    dynamicsymbols,
    inertia,
)

from benchmarks.bodies import bodies
from mechanics.compiler.codegen import needed
from mechanics.expressions import to_sympy
from mechanics.geometry.connection import Connection
from mechanics.geometry.counting import count_operations
from mechanics.geometry.reduction import derive
from mechanics.mechanism import Mechanism

__all__ = ["CONTENDERS", "Equations", "NotApplicable", "reference"]

Array = NDArray[np.float64]

STEP = 1e-3  # of central differences of order 4: errors of 1e-12 times fifth derivatives, and 1e-13 by rounding


class NotApplicable(Exception):
    """A contender cannot be given this mechanism."""


@dataclass(frozen=True)
class Equations:
    """Equations of motion over speeds w: q̇ = velocity(q, w), ẇ = rates(q, w, u).

    Attributes:
        mechanism: what moves.
        speeds: (k,) symbols w, pseudo-velocities or q̇.
        velocity: (n,) q̇, linear in the speeds.
        rates: (k,) ẇ.
        definitions: pairs of a symbol and its meaning in terms of those before it.
    """

    mechanism: Mechanism
    speeds: Sequence[sp.Symbol]
    velocity: Sequence[sp.Expr]
    rates: Sequence[sp.Expr]
    definitions: Sequence[tuple[sp.Symbol, sp.Expr]] = ()

    @property
    def operations(self) -> int:
        """Operations of all velocities and rates together, by `count_operations`."""
        constants = [sp.Symbol(name) for name in self.mechanism.parameters]
        return count_operations([*(e for _, e in self.definitions), *self.velocity, *self.rates], constants)

    def acceleration(self, values: Mapping[str, float], qdot: Array, u: Array) -> Array:
        """q̈ [n] in numbers, at coordinates and parameters by name, q̇ [n] and controls u [m]."""
        m, formulas = self.mechanism, [*self.velocity, *self.rates]
        names = [*m.coordinates, *m.parameters, *m.controls]
        # Before `lambdify` has a look at them, which does not see how much they share.
        steps, formulas = (self.definitions, formulas) if self.definitions else sp.cse(formulas, order="none")
        function = sp.lambdify([*map(sp.Symbol, names), *self.speeds], formulas, cse=lambda _: (steps, formulas))

        def motion(q: Array, w: Array) -> list[Array]:
            both = function(*q, *(values[name] for name in m.parameters), *u, *w)
            return np.split(np.array(both, dtype=float), [m.n])

        q = np.array([values[name] for name in m.coordinates])
        frame = np.transpose([motion(q, unit)[0] for unit in np.eye(len(self.speeds))])
        w = np.linalg.lstsq(frame, qdot)[0]
        _, rates = motion(q, w)
        return _slope(lambda t: motion(q + t * qdot, w + t * rates)[0])


# -- ours, and the same equations the long way round ---------------------------------------------


def theorem(mechanism: Mechanism) -> Equations:
    """Theorem 3.2 in the mechanism's default frame."""
    e = derive(mechanism)
    formulas = [*e.velocity, *e.acceleration]
    definitions = tuple(needed(formulas, e.definitions).items())
    return Equations(mechanism, e.pseudo_velocities, tuple(e.velocity), tuple(e.acceleration), definitions)


def theorem_found(mechanism: Mechanism) -> Equations:
    """Theorem 3.2 in the frame that is found where none is given."""
    return theorem(dataclasses.replace(mechanism, frames={}))


def equation_6(mechanism: Mechanism) -> Equations:
    """Equations (5) and (6) over the coordinates, with ∇P⊥."""
    connection = Connection(mechanism)
    return Equations(mechanism, connection.rates, connection.rates, tuple(connection.acceleration))


# -- SymPy ---------------------------------------------------------------------------------------


class _Setting:
    """A mechanism in the terms of `sympy.physics.mechanics`: coordinates are functions of time."""

    def __init__(self, mechanism: Mechanism) -> None:
        self.mechanism = mechanism
        self.time = dynamicsymbols._t
        self.space = ReferenceFrame("N")
        self.q = [dynamicsymbols(name) for name in mechanism.coordinates]
        self.qdot = [q.diff(self.time) for q in self.q]
        self.scope = mechanism.scope(dict(zip(mechanism.coordinates, self.q, strict=True)))
        self.potential = self.read(mechanism.potential)

    def read(self, text: str) -> sp.Expr:
        return to_sympy(text, self.scope)

    def rows(self, rows: Iterable[Sequence[str]]) -> list[list[sp.Expr]]:
        return [[self.read(text) for text in row] for row in rows]

    def loads(self, conservative: bool) -> list[tuple[Point, Any]]:
        """Control forces, with those of the potential or without."""
        m, loads = self.mechanism, []
        forces = self.rows(m.forces.values())
        for i, (q, rate) in enumerate(zip(self.q, self.qdot, strict=True)):
            force = sum((sp.Symbol(u) * row[i] for u, row in zip(m.controls, forces, strict=True)), sp.S.Zero)
            if conservative:
                force -= self.potential.diff(q)
            if force != 0:
                point = Point(f"L_{i}")
                point.set_vel(self.space, rate * self.space.x)
                loads.append((point, force * self.space.x))
        return loads

    def bodies(self) -> list[RigidBody]:
        described = bodies(self.mechanism)
        if described is None:
            raise NotApplicable("it is not described as rigid bodies (benchmarks/bodies.py)")
        origin, made = Point("O"), []
        origin.set_vel(self.space, 0)
        for i, body in enumerate(described):
            axes = self.space
            for turn, (axis, angle) in enumerate(body.turns):
                axes = axes.orientnew(f"B_{i}_{turn}", "Axis", [self.read(angle), getattr(axes, axis)])
            tensor = inertia(axes, *map(self.read, body.inertia))
            if body.spin:
                axis, angle = body.spin
                axes = axes.orientnew(f"B_{i}_spin", "Axis", [self.read(angle), getattr(axes, axis)])
            place = [self.read(text) for text in body.centre]
            unit = (self.space.x, self.space.y, self.space.z)
            centre = origin.locatenew(f"C_{i}", sum(x * e for x, e in zip(place, unit, strict=True)))
            centre.set_vel(self.space, sum(x.diff(self.time) * e for x, e in zip(place, unit, strict=True)))
            made.append(RigidBody(f"B_{i}", centre, axes, self.read(body.mass), (tensor, centre)))
        return made

    def equations(
        self, names: Sequence[str], functions: Sequence[Any], velocity: Iterable[Any], rates: Iterable[Any]
    ) -> Equations:
        """Over symbols with these names in place of functions of time, each shared subexpression replaced once."""
        speeds = [sp.Symbol(name) for name in names]
        meaning = dict(zip(functions, speeds, strict=True))
        meaning |= dict(zip(self.q, map(sp.Symbol, self.mechanism.coordinates), strict=True))

        @cache
        def plain(e: sp.Basic) -> sp.Basic:
            return meaning[e] if e in meaning else e.func(*map(plain, e.args)) if e.args else e

        return Equations(self.mechanism, speeds, [plain(e) for e in velocity], [plain(e) for e in rates])


def kane(mechanism: Mechanism, dependent: Sequence[int] | None = None) -> Equations:
    """`KanesMethod.rhs()` over q̇, some of which depend on the others.

    Args:
        mechanism: one that `bodies` describes.
        dependent: [c] which rates depend; by default those for which the constraints are solved best where all
            coordinates are zero, so that the equations have no pole there.
    """
    s, m = _Setting(mechanism), mechanism
    dependent = _dependent(m) if dependent is None else dependent
    w = [dynamicsymbols(f"w_{name}") for name in m.coordinates]
    order = [*(i for i in range(m.n) if i not in dependent), *dependent]
    method = KanesMethod(
        s.space,
        q_ind=s.q,
        u_ind=[w[i] for i in order[: m.rank]],
        kd_eqs=[rate - speed for rate, speed in zip(s.qdot, w, strict=True)],
        u_dependent=[w[i] for i in dependent],
        velocity_constraints=[sp.Matrix(row).dot(sp.Matrix(w)) for row in s.rows(m.one_forms)],
    )
    method.kanes_equations(s.bodies(), s.loads(conservative=True))
    rhs = method.rhs()
    rates = [rhs[m.n + order.index(i)] for i in range(m.n)]
    return s.equations(m.rates, w, w, rates)


def kane_shortest(mechanism: Mechanism) -> Equations:
    """The shortest of what `kane` gives for every choice of dependent rates, wherever its poles are."""
    found = []
    for dependent in combinations(range(mechanism.n), len(mechanism.one_forms)):
        try:
            found.append(kane(mechanism, dependent))
        except sp.matrices.exceptions.NonInvertibleMatrixError:
            continue  # these rates are not determined by the others
    return min(found, key=lambda e: e.operations)


def kane_in_frame(mechanism: Mechanism) -> Equations:
    """`KanesMethod.rhs()` over the pseudo-velocities of the mechanism's default frame, as its generalized speeds."""
    s, m = _Setting(mechanism), mechanism
    if not m.frames:
        raise NotApplicable("it has no frame of its own")
    w = [dynamicsymbols(f"w_{i}") for i in range(m.rank)]
    velocity = sp.Matrix(s.rows(m.frame_rows() or ())).T * sp.Matrix(w)
    kinematics = [rate - component for rate, component in zip(s.qdot, velocity, strict=True)]
    method = KanesMethod(s.space, q_ind=s.q, u_ind=w, kd_eqs=kinematics)
    method.kanes_equations(s.bodies(), s.loads(conservative=True))
    rhs = method.rhs()
    return s.equations([f"v{i + 1}" for i in range(m.rank)], w, rhs[: m.n], rhs[m.n :])


def lagrange(mechanism: Mechanism) -> Equations:
    """`LagrangesMethod.rhs()`, the constraints with multipliers."""
    s, m = _Setting(mechanism), mechanism
    qdot = sp.Matrix(s.qdot)
    lagrangian = qdot.dot(sp.Matrix(s.rows(m.inertia)) * qdot) / 2 - s.potential
    constraints = [sp.Matrix(row).dot(qdot) for row in s.rows(m.one_forms)]
    method = LagrangesMethod(
        lagrangian, s.q, forcelist=s.loads(conservative=False), frame=s.space, nonhol_coneqs=constraints
    )
    method.form_lagranges_equations()
    return s.equations(m.rates, s.qdot, s.qdot, method.rhs()[m.n : 2 * m.n])


CONTENDERS: dict[str, Callable[[Mechanism], Equations]] = {
    "Thm 3.2": theorem,
    "found": theorem_found,
    "eq. (6)": equation_6,
    "Kane": kane,
    "shortest": kane_shortest,
    "in frame": kane_in_frame,
    "Lagrange": lagrange,
}


# -- numbers -------------------------------------------------------------------------------------


def reference(mechanism: Mechanism, values: Mapping[str, float], qdot: Array, u: Array) -> Array:
    """q̈ [n] with multipliers, [[M, -ω^T], [ω, 0]] (q̈, λ) = (F u - ∇V - Ṁ q̇ + 1/2 ∇(q̇ M q̇), -ω̇ q̇), in numbers.

    Args:
        mechanism: what moves.
        values: coordinates and parameters by name.
        qdot: [n] velocity that satisfies the constraints.
        u: [m] controls.
    """
    m = mechanism

    def partials(entries: Any) -> Array:
        """[n, ...] derivatives by the coordinates."""

        def moved(name: str) -> Callable[[float], Array]:
            return lambda t: m.numeric(entries, {**values, name: values[name] + t})

        return np.array([_slope(moved(name)) for name in m.coordinates])

    M, dM, (dV,) = m.numeric(m.inertia, values), partials(m.inertia), partials([m.potential]).T
    right = np.einsum("a,ai->i", u, m.numeric(tuple(m.forces.values()), values)) - dV
    right = right - np.einsum("cab,c,b->a", dM, qdot, qdot) + np.einsum("abc,b,c->a", dM, qdot, qdot) / 2
    forms, turning = m.numeric(m.one_forms, values), np.einsum("crb,c,b->r", partials(m.one_forms), qdot, qdot)
    system = np.block([[M, -forms.T], [forms, np.zeros((len(forms), len(forms)))]])
    return np.linalg.solve(system, [*right, *-turning])[: m.n]


def _dependent(mechanism: Mechanism) -> tuple[int, ...]:
    forms = mechanism.numeric(mechanism.one_forms, {**mechanism.parameters, **dict.fromkeys(mechanism.coordinates, 0)})
    choices = combinations(range(mechanism.n), len(forms))
    return max(choices, key=lambda columns: np.linalg.svd(forms[:, columns], compute_uv=False).min(initial=np.inf))


def _slope(function: Callable[[float], Array]) -> Array:
    """Derivative at zero."""
    one, two = (function(t) - function(-t) for t in (STEP, 2 * STEP))
    return (8 * one - two) / (12 * STEP)

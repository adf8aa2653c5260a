"""Theorem 3.2: equations of motion of a constrained mechanism in an orthogonal frame.

With <<X, Y>> = X^T M Y the inertia tensor's inner product, D the velocities that the constraints
allow and X_1..X_k an orthogonal frame of D, the motion q̇ = X_i v^i obeys

    v̇^k = -Γ̃^k_ij v^i v^j - X_k(V)/|X_k|^2 + Y^k_a u_a - R(X_k, X_j)/|X_k|^2 v^j,
    Γ̃^k_ij = <<∇_{X_i} X_j, X_k>>/|X_k|^2,    Y^k_a = F_a(X_k)/|X_k|^2,

∇ the Levi-Civita connection of the inertia tensor, R the second derivatives of Rayleigh's function
where drag acts. No multipliers, no inverse, no projection.

A vector field is held as X_i = g_i N_i with N_i polynomial and g_i a function. Since N_j and N_k are
orthogonal, the derivative of g_j does not matter where j != k, and where j = k all that matters is
the length: <<∇_X Y, Y>> = 1/2 X(|Y|^2). So only polynomials are multiplied, and divided once. Where
they would become too long, the same derivation runs on an arithmetic that names its steps instead
(`tape`).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import sympy as sp

from mechanics.expressions import to_sympy
from mechanics.geometry.algebra import Algebra, TooLong
from mechanics.geometry.compact import Product, Writer, nested_sum
from mechanics.geometry.frames import null_frame, orthogonalise
from mechanics.geometry.samples import sample_points
from mechanics.geometry.symmetry import planar_symmetry
from mechanics.geometry.tape import Tape
from mechanics.mechanism import Matrix, Mechanism

__all__ = ["ReducedEquations", "derive", "reduce"]

Number = Any  # an element of the arithmetic at work: `Element` or `Value`
Vector = list[Number]
Move = tuple[tuple[tuple[sp.Symbol, Number], ...], Number]  # a direction, and how fast it turns the heading


@dataclass(frozen=True)
class ReducedEquations:
    """Equations of motion q̇ = X v, v̇ = acceleration(q, v, u), as SymPy expressions.

    Symbols are plain `sympy.Symbol`s with the mechanism's names; v1..vk are the pseudo-velocities.
    n coordinates, k = n - c pseudo-velocities, m controls. Units are SI and follow from the frame:
    X_i v^i is a velocity.

    Attributes:
        mechanism: what was reduced.
        coordinates: (n,) symbols q.
        parameters: symbols of the parameters, and of the drag coefficients where drag acts.
        controls: (m,) symbols u.
        pseudo_velocities: (k,) symbols v1..vk.
        frame: (n, k) columns X_i(q) span D.
        squared_norms: (k,) |X_i|^2 in the inertia tensor.
        christoffel: (k, k, k) indexed [k, i, j]: Γ̃^k_ij, which multiplies v^i v^j. It is not
            symmetric in i, j (Theorem 3.2).
        input_coefficients: (k, m) Y^k_a = F_a(X_k)/|X_k|^2 (Theorem 3.2).
        potential_acceleration: (k,) -X_k(V)/|X_k|^2.
        drag: (k, k) indexed [k, j]: R(X_k, X_j)/|X_k|^2, zero unless asked for.
        velocity: (n,) q̇ = X v.
        acceleration: (k,) v̇ = -Γ̃ v v + Y u + potential_acceleration - drag v.
        projection: (k, n) P with v = P q̇ for every q̇ in D; P = diag(1/|X|^2) X^T M.
        energy: kinetic and potential energy, in J.
        definitions: pairs of a symbol and what it stands for in terms of symbols before it; the formulas
            use them where they would explode otherwise. `reduce` writes them out.
    """

    mechanism: Mechanism
    coordinates: tuple[sp.Symbol, ...]
    parameters: tuple[sp.Symbol, ...]
    controls: tuple[sp.Symbol, ...]
    pseudo_velocities: tuple[sp.Symbol, ...]
    frame: sp.ImmutableMatrix
    squared_norms: sp.ImmutableDenseNDimArray
    christoffel: sp.ImmutableDenseNDimArray
    input_coefficients: sp.ImmutableMatrix
    potential_acceleration: sp.ImmutableDenseNDimArray
    drag: sp.ImmutableMatrix
    velocity: sp.ImmutableDenseNDimArray
    acceleration: sp.ImmutableDenseNDimArray
    projection: sp.ImmutableMatrix
    energy: sp.Expr
    definitions: tuple[tuple[sp.Symbol, sp.Expr], ...] = ()

    def written_out(self) -> ReducedEquations:
        """The same equations without definitions."""
        if not self.definitions:
            return self
        meaning: dict[sp.Symbol, sp.Expr] = {}
        for symbol, expression in self.definitions:
            meaning[symbol] = expression.xreplace(meaning)

        def close(value: Any) -> Any:
            if isinstance(value, sp.Expr):
                return value.xreplace(meaning)
            return value.applyfunc(lambda e: e.xreplace(meaning))

        formulas = {name: close(getattr(self, name)) for name in _FORMULAS}
        return dataclasses.replace(self, **formulas, definitions=())


# The fields of `ReducedEquations` that are formulas.
_FORMULAS = (
    "frame", "squared_norms", "christoffel", "input_coefficients", "potential_acceleration", "drag", "velocity",
    "acceleration", "projection", "energy",
)  # fmt: skip


def reduce(
    mechanism: Mechanism, frame: str | Sequence[Sequence[str]] | None = None, *, drag: bool = False
) -> ReducedEquations:
    """Derive the equations of motion of a mechanism by Theorem 3.2.

    Args:
        mechanism: inertia tensor, constraints, forces.
        frame: name of one of the mechanism's frames, or k rows of n expressions (vector fields that
            span D), or None for the mechanism's default frame, one found if it has none. Fields
            that are not orthogonal are orthogonalised, row after row.
        drag: whether the mechanism's drag acts.

    Returns:
        The reduced equations, in compact form.

    Raises:
        MechanismError: a frame that the mechanism does not have, or whose fields do not span D.
    """
    return derive(mechanism, frame, drag=drag).written_out()


def derive(
    mechanism: Mechanism, frame: str | Sequence[Sequence[str]] | None = None, *, drag: bool = False
) -> ReducedEquations:
    """What `reduce` does, with the steps of a long derivation left as `definitions`: for generating code."""
    rows = mechanism.frame_rows(frame)
    try:
        return _Reduction(mechanism, rows, drag, exact=True).equations()
    except TooLong:
        return _Reduction(mechanism, rows, drag, exact=False).equations()


class _Reduction:
    """The derivation, one method a step."""

    def __init__(self, mechanism: Mechanism, rows: Matrix | None, drag: bool, exact: bool) -> None:
        self.mechanism = mechanism
        self.exact = exact
        self.coefficients = tuple(mechanism.drag) if drag else ()
        n, k = mechanism.n, mechanism.rank
        symbols = mechanism.symbols
        self.q = [symbols[name] for name in mechanism.coordinates]
        self.v = [sp.Symbol(f"v{i + 1}") for i in range(k)]
        self.u = [symbols[name] for name in mechanism.controls]
        self.symmetry = planar_symmetry(mechanism, rows)

        # Lemma 3.3: at the group identity the heading is gone before any algebra.
        s = self.symmetry
        scope = mechanism.scope({self.q[c].name: sp.S.Zero for c in (s.x, s.y, s.heading)} if s else {})
        definitions = [scope[name] for name in mechanism.definitions]
        given = mechanism.one_forms if rows is None else rows
        vectors = [[to_sympy(text, scope) for text in row] for row in given]
        inertia = [[to_sympy(text, scope) for text in row] for row in mechanism.inertia]
        forces = [[to_sympy(text, scope) for text in row] for row in mechanism.forces.values()]
        potential = to_sympy(mechanism.potential, scope)
        rayleigh = _rayleigh(mechanism, scope) if drag else []
        everything = [*sum(vectors, []), *sum(inertia, []), *sum(forces, []), potential, *sum(rayleigh, [])]
        samples = sample_points(mechanism, map(str, (*self.q, *self.v)))
        algebra: Any
        self.product: Callable[[Number], Product]
        if exact:
            algebra = Algebra([*definitions, *everything], samples)
            self.product = Writer(algebra, definitions, everything, self.q).product
            self.definitions: Callable[[], dict[sp.Symbol, sp.Expr]] = dict
        else:
            algebra = Tape(samples, frozenset(map(sp.Symbol, (*mechanism.parameters, *mechanism.drag))))
            self.product, self.definitions = algebra.product, algebra.definitions
        self.algebra = algebra

        self.M = [[algebra.convert(e) for e in row] for row in inertia]
        self.F = [[algebra.convert(e) for e in row] for row in forces]
        self.V = algebra.convert(potential)
        self.R = [[algebra.convert(e) for e in row] for row in rayleigh]
        self.half = algebra.convert(sp.S.Half)
        fields = [[algebra.convert(e) for e in row] for row in vectors]
        if rows is None:
            joints = [mechanism.coordinates.index(name) for name in mechanism.joint_limits]
            fields = null_frame(algebra, fields, self.q, joints)
        self.X = orthogonalise(fields, lambda a, b: self._form(self.M, a, b))
        self.scales, self.N = zip(*map(algebra.primitive, self.X), strict=True)
        self.MN = [self._times_inertia(row) for row in self.N]
        self.norms = [self._dot(row, m) for row, m in zip(self.N, self.MN, strict=True)]  # |N_i|^2
        self.n, self.k = n, k
        self.squared_norms = [g * g * s for g, s in zip(self.scales, self.norms, strict=True)]
        self.moves = [self._move(row) for row in self.N]

    # -- the pieces of Theorem 3.2 -------------------------------------------------------------

    def christoffel(self) -> list[list[Vector]]:
        """Γ̃^k_ij as [k][i][j]."""
        k, one, g = self.k, self.algebra.one, self.scales
        gamma = [[[self.algebra.zero] * k for _ in range(k)] for _ in range(k)]
        inertia = [self._change_of_inertia(move) for move in self.moves]
        for i in range(k):
            for j in range(k):
                gamma[j][i][j] = self._stretch(i, j)
            for a in range(k):
                for b in range(a):
                    # <<∇_X_i X_a, X_b>> = -<<X_a, ∇_X_i X_b>>, since the two fields are orthogonal
                    if value := self._covariant(i, a, b, inertia):
                        gamma[b][i][a] = g[i] * value * g[a] * (one / g[b]) * (one / self.norms[b])
                        gamma[a][i][b] = g[i] * -value * g[b] * (one / g[a]) * (one / self.norms[a])
        return gamma

    def _stretch(self, i: int, j: int) -> Number:
        """<<∇_X_i X_j, X_j>>/|X_j|^2 = 1/2 X_i(log |X_j|^2)."""
        rate = self._along(i, self.squared_norms[j])
        return self.scales[i] * self.half * rate / self.squared_norms[j] if rate else rate

    def _covariant(self, i: int, j: int, k: int, inertia: list[list[Vector]]) -> Number:
        """<<∇_N_i N_j, N_k>> = <<DN_j N_i, N_k>> + Γ_acd N_k^a N_i^c N_j^d."""
        N = self.N
        total = self._dot(self._change(N[j], self.moves[i]), self.MN[k])
        # First-kind symbols 2 Γ_acd = ∂_c M_ad + ∂_d M_ac - ∂_a M_cd, contracted
        second = self._form(inertia[i], N[k], N[j]) + self._form(inertia[j], N[k], N[i])
        second = second - self._form(inertia[k], N[i], N[j])
        return total + self.half * second if second else total

    def inputs(self) -> list[Vector]:
        """Y^k_a = F_a(N_k)/(g_k |N_k|^2) as [k][a]."""
        return [[self._per_norm(k, self._dot(force, self.N[k])) for force in self.F] for k in range(self.k)]

    def gradients(self) -> Vector:
        """-X_k(V)/|X_k|^2."""
        return [self._per_norm(k, -self._along(k, self.V)) for k in range(self.k)]

    def drag(self) -> list[Vector]:
        """R(X_k, X_j)/|X_k|^2 as [k][j]; no rows without drag."""
        columns = [[self._dot(row, field) for row in self.R] for field in self.X] if self.R else []
        return [[self._per_norm(k, self._dot(self.N[k], column)) for column in columns] for k in range(self.k)]

    def projection(self) -> list[Vector]:
        """X_k^T M/|X_k|^2."""
        return [[self._per_norm(k, m) for m in self.MN[k]] for k in range(self.k)]

    def _per_norm(self, k: int, value: Number) -> Number:
        """Divide `value`, which is linear in N_k, so that it counts per unit of |X_k|^2 for X_k in N_k's place."""
        one = self.algebra.one
        return value * (one / self.scales[k]) * (one / self.norms[k]) if value else value

    def geodesic(self) -> Vector:
        """-Γ̃^k_ij v^i v^j as [k] without the Γ̃: -<<∇_W W, X_k>>/|X_k|^2 with W = v^i X_i, v constant.

        For the tape, on which a sum over i and j cannot be simplified: vectors are cheaper than their products.
        """
        v = [self.algebra.convert(symbol) for symbol in self.v]
        W = [self._dot(v, list(component)) for component in zip(*self.X, strict=True)]
        move = self._move(W)
        rates, moved = self._change(W, move), [self._dot(row, W) for row in self._change_of_inertia(move)]
        # Γ_acd W^c W^d = (∂_W M W)_a - 1/2 ∂_a M(W, W)
        second = [a - b for a, b in zip(moved, self._pull(W), strict=True)]
        return [-self._per_norm(k, self._dot(rates, self.MN[k]) + self._dot(second, self.N[k])) for k in range(self.k)]

    def _pull(self, W: Vector) -> Vector:
        """1/2 ∂_a M(W, W) as [a]."""
        axes = [[self.algebra.one if a == b else self.algebra.zero for b in range(self.n)] for a in range(self.n)]
        return [self.half * self._form(self._change_of_inertia(self._move(axis)), W, W) for axis in axes]

    # -- calculus with the symmetry ------------------------------------------------------------

    def _along(self, i: int, function: Number) -> Number:
        """Derivative of an invariant function along N_i."""
        return self.algebra.along(function, self.moves[i][0])

    def _move(self, field: Vector) -> Move:
        """What a field does to what invariant functions see: pairs (coordinate, rate), and how it turns the heading.

        At the identity the fibre's derivatives come from the symmetry: an invariant function has no
        derivative along ∂x, ∂y and ∂θ + Σ ∂(turning) + x∂y - y∂x, so ∂θ = -Σ ∂(turning).
        """
        rates, turn = dict(zip(self.q, field, strict=True)), self.algebra.zero
        if s := self.symmetry:
            turn = field[s.heading]
            for c in s.turning:
                rates[self.q[c]] = rates[self.q[c]] - turn
            for c in (s.x, s.y, s.heading):
                del rates[self.q[c]]
        return tuple((symbol, rate) for symbol, rate in rates.items() if rate), turn

    def _change(self, field: Vector, move: Move) -> Vector:
        """Derivatives of a field's components: those of an invariant field also turn with the heading."""
        direction, turn = move
        rates = [self.algebra.along(e, direction) if e else e for e in field]
        if (s := self.symmetry) and turn:
            rates[s.x], rates[s.y] = rates[s.x] - turn * field[s.y], rates[s.y] + turn * field[s.x]
        return rates

    def _change_of_inertia(self, move: Move) -> list[Vector]:
        """Derivatives of M's entries, likewise: ∂θ M = J M - M J with J: e_x -> e_y -> -e_x."""
        direction, turn = move
        rates = [[self.algebra.along(e, direction) if e else e for e in row] for row in self.M]
        if (s := self.symmetry) and turn:
            for a in range(self.n):
                for c, entry in ((s.x, self.M[a][s.y]), (s.y, -self.M[a][s.x])):
                    rates[a][c] = rates[a][c] - turn * entry
                    rates[c][a] = rates[c][a] - turn * entry
        return rates

    # -- linear algebra ------------------------------------------------------------------------

    def _dot(self, a: Vector, b: Vector) -> Number:
        total = self.algebra.zero
        for left, right in zip(a, b, strict=True):
            if left and right:
                total = total + left * right
        return total

    def _times_inertia(self, field: Vector) -> Vector:
        return [self._dot(row, field) for row in self.M]

    def _form(self, matrix: list[Vector], a: Vector, b: Vector) -> Number:
        return self._dot(a, [self._dot(row, b) for row in matrix])

    # -- writing -------------------------------------------------------------------------------

    def _turn(self, entries: Vector) -> list[list[Product]]:
        """Components in the plane's axes of components in the body's axes."""
        rows = [[self.product(e)] if e else [] for e in entries]
        if s := self.symmetry:
            cosine, sine = (Product(factors={f(self.q[s.heading]): Fraction(1)}) for f in (sp.cos, sp.sin))
            minus = Product(Fraction(-1))
            px, py = rows[s.x], rows[s.y]
            rows[s.x] = [cosine * p for p in px] + [minus * sine * p for p in py]
            rows[s.y] = [sine * p for p in px] + [cosine * p for p in py]
        return rows

    def _write(self, value: Number) -> sp.Expr:
        return self._sum([self.product(value)])

    def _sum(self, terms: Sequence[Product]) -> sp.Expr:
        return self._away_from_identity(nested_sum(terms, [*self.q, *self.v, *self.u]))

    def _away_from_identity(self, expression: sp.Expr) -> sp.Expr:
        """Invariant functions see a turning angle relative to the heading."""
        if not (self.symmetry and self.symmetry.turning):
            return expression
        heading = self.q[self.symmetry.heading]
        return expression.xreplace({self.q[c]: self.q[c] - heading for c in self.symmetry.turning})

    def equations(self) -> ReducedEquations:
        """All of it, written compactly."""
        k, write, product, minus = self.k, self._write, self.product, Product(Fraction(-1))
        gamma, Y, gradients, drag = self.christoffel(), self.inputs(), self.gradients(), self.drag()
        fields = [self._turn(row) for row in self.X]
        covectors = [self._turn(row) for row in self.projection()]
        v, u = ([Product(factors={s: Fraction(1)}) for s in symbols] for symbols in (self.v, self.u))

        geodesic = [] if self.exact else self.geodesic()

        def acceleration(up: int) -> sp.Expr:
            terms = [product(geodesic[up])] if geodesic else []
            for i in range(k) if self.exact else ():
                for j in range(i + 1):
                    both = gamma[up][i][j] if i == j else gamma[up][i][j] + gamma[up][j][i]
                    terms.append(minus * product(both) * v[j] * v[i])
            terms += [product(Y[up][a]) * u[a] for a in range(len(u))]
            terms += [minus * product(entry) * v[j] for j, entry in enumerate(drag[up])]
            return self._sum([*terms, product(gradients[up])])

        kinetic = [Product(Fraction(1, 2)) * product(s) * w * w for s, w in zip(self.squared_norms, v, strict=True)]
        equations = ReducedEquations(
            mechanism=self.mechanism,
            coordinates=tuple(self.q),
            parameters=tuple(sp.Symbol(name) for name in (*self.mechanism.parameters, *self.coefficients)),
            controls=tuple(self.u),
            pseudo_velocities=tuple(self.v),
            frame=sp.ImmutableMatrix([[self._sum(field[a]) for field in fields] for a in range(self.n)]),
            squared_norms=sp.ImmutableDenseNDimArray([write(e) for e in self.squared_norms]),
            christoffel=sp.ImmutableDenseNDimArray([[[write(e) for e in row] for row in plane] for plane in gamma]),
            input_coefficients=sp.ImmutableMatrix(k, len(u), [write(e) for row in Y for e in row]),
            potential_acceleration=sp.ImmutableDenseNDimArray([write(e) for e in gradients]),
            drag=sp.ImmutableMatrix([[write(e) for e in row] for row in drag])
            if self.R
            else sp.zeros(k).as_immutable(),
            velocity=sp.ImmutableDenseNDimArray(
                [self._sum([t * v[i] for i in range(k) for t in fields[i][a]]) for a in range(self.n)]
            ),
            acceleration=sp.ImmutableDenseNDimArray([acceleration(up) for up in range(k)]),
            projection=sp.ImmutableMatrix([[self._sum(terms) for terms in row] for row in covectors]),
            energy=self._sum([*kinetic, product(self.V)]),
        )
        steps = {step: self._away_from_identity(e) for step, e in self.definitions().items()}
        return dataclasses.replace(equations, definitions=tuple(steps.items()))


def _rayleigh(mechanism: Mechanism, scope: Mapping[str, sp.Expr]) -> list[list[sp.Expr]]:
    """[n][n] second derivatives of Rayleigh's function in the rates."""
    rates = [sp.Symbol(name) for name in mechanism.rates]
    function = to_sympy(mechanism.rayleigh, {**scope, **{rate.name: rate for rate in rates}})
    return [[sp.diff(function, a, b) for b in rates] for a in rates]

"""Sections 2 and 3 of Bullo and Zefran taken literally: ∇, the projection P, equations (6) and (7).

`reduction` derives the same motion by Theorem 3.2, which needs no inverse, no projection and no derivative of
one. Here everything is done the long way round, over the coordinates and without any frame, so that each road
can be held against the other. It also serves where a frame is no help: gradients, brackets, symmetric products.

A vector field X is a column [n, 1] and a one-form F a row [1, n] of SymPy expressions over the mechanism's symbols;
any sequence of n expressions is read as either. Results are in a normal form: what vanishes identically is 0.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import cached_property, reduce
from typing import Any

import sympy as sp

from mechanics.expressions import to_sympy
from mechanics.geometry.algebra import Algebra, Element
from mechanics.geometry.compact import Writer
from mechanics.geometry.samples import sample_points
from mechanics.mechanism import Mechanism, MechanismError

__all__ = ["Connection"]


class Connection:
    """Levi-Civita connection ∇ of a mechanism's inertia tensor, and the constrained connection ∇̃ of eq. (6).

    A result too long for a normal form raises `algebra.TooLong`: the snakeboard and the roller racer take a second
    or two, a snake of three links is out of reach.

    Args:
        mechanism: n coordinates, c constraint one-forms, m control forces; its frames are not used. P has a pole
            where the one-forms become dependent, although D may go on smoothly.

    Attributes:
        coordinates: (n,) symbols q.
        rates: (n,) symbols of q̇, named NAME_dot.
        inertia: [n, n] M_ij.
        one_forms: [c, n] rows ω.
        forces: [m, n] rows F_a.
        potential: V, in J.
    """

    def __init__(self, mechanism: Mechanism) -> None:
        self.mechanism = mechanism
        n, scope = mechanism.n, mechanism.scope()
        self.coordinates = tuple(sp.Symbol(name) for name in mechanism.coordinates)
        self.rates = tuple(sp.Symbol(name) for name in mechanism.rates)

        def matrix(rows: Sequence[Sequence[str]]) -> sp.ImmutableMatrix:
            return sp.ImmutableMatrix(len(rows), n, [to_sympy(text, scope) for row in rows for text in row])

        self.inertia = matrix(mechanism.inertia)
        self.one_forms = matrix(mechanism.one_forms)
        self.forces = matrix(tuple(mechanism.forces.values()))
        self.potential = to_sympy(mechanism.potential, scope)
        self._definitions = [scope[name] for name in mechanism.definitions]
        self._entries = [*self.inertia, *self.one_forms, *self.forces, self.potential]
        self._generators: dict[sp.Expr, None] = {}  # what the algebra at work was made with
        self._cover([*self._definitions, *self._entries])

    # -- section 2: the Levi-Civita connection --------------------------------------------------

    @cached_property
    def inverse_inertia(self) -> sp.ImmutableMatrix:
        """M^{-1} [n, n]."""
        return self._solve(self.inertia, sp.eye(self.mechanism.n))

    @cached_property
    def christoffel(self) -> sp.ImmutableDenseNDimArray:
        """Γ^i_jk [i, j, k] = 1/2 M^{il} (∂_k M_lj + ∂_j M_lk - ∂_l M_kj), eq. (1)."""
        size = range(self.mechanism.n)
        d = [self._partial(self.inertia, q) for q in self.coordinates]
        lowered = [[[(d[k][l, j] + d[j][l, k] - d[l][k, j]) / 2 for k in size] for j in size] for l in size]
        inverse = self.inverse_inertia
        entries = [[[sum(inverse[i, l] * lowered[l][j][k] for l in size) for k in size] for j in size] for i in size]
        return self.simplify(sp.ImmutableDenseNDimArray(entries))

    def inner(self, X: Sequence[Any], Y: Sequence[Any]) -> sp.Expr:
        """<<X, Y>> = X^T M Y."""
        return self.simplify((self.inertia * self._column(X)).dot(self._column(Y)))

    def differential(self, f: Any) -> sp.ImmutableMatrix:
        """One-form df [1, n] of a function."""
        return sp.ImmutableMatrix([[self._partial(sp.Matrix([f]), q)[0] for q in self.coordinates]])

    def lie_derivative(self, X: Sequence[Any], f: Any) -> sp.Expr:
        """L_X f = <df, X>."""
        return self.pairing(self.differential(f), X)

    def pairing(self, F: Sequence[Any], X: Sequence[Any]) -> sp.Expr:
        """<F, X> of a one-form and a vector field."""
        return self.simplify(self._column(F).dot(self._column(X)))

    def sharp(self, F: Sequence[Any]) -> sp.ImmutableMatrix:
        """Vector field M^{-1} F [n, 1] of a one-form: <<M^{-1} F, X>> = <F, X>."""
        return self.simplify(self.inverse_inertia * self._column(F))

    def gradient(self, f: Any) -> sp.ImmutableMatrix:
        """Vector field grad f [n, 1]: <<grad f, X>> = L_X f."""
        return self.sharp(self.differential(f))

    def covariant(self, X: Sequence[Any], Y: Sequence[Any]) -> sp.ImmutableMatrix:
        """∇_X Y [n, 1], (∇_X Y)^i = ∂_j Y^i X^j + Γ^i_jk X^j Y^k."""
        return self.simplify(self._covariant(self._column(X), self._column(Y)))

    def bracket(self, X: Sequence[Any], Y: Sequence[Any]) -> sp.ImmutableMatrix:
        """Lie bracket [X, Y] [n, 1], [X, Y]^i = ∂_j Y^i X^j - ∂_j X^i Y^j."""
        X, Y = self._column(X), self._column(Y)
        return self.simplify(self._along(X, Y) - self._along(Y, X))

    # -- section 3: the constrained connection --------------------------------------------------

    @cached_property
    def complement(self) -> sp.ImmutableMatrix:
        """P⊥ [n, n], the orthogonal projection onto D⊥ = span M^{-1} ω: P⊥ = M^{-1} ω^T (ω M^{-1} ω^T)^{-1} ω."""
        raised = self.simplify(self.inverse_inertia * self.one_forms.T)
        gram = self.simplify(self.one_forms * raised)
        return self.simplify(raised * self._solve(gram, self.one_forms))

    @cached_property
    def projection(self) -> sp.ImmutableMatrix:
        """P = I - P⊥ [n, n], the orthogonal projection onto D."""
        return self.simplify(sp.eye(self.mechanism.n) - self.complement)

    def constrained(self, X: Sequence[Any], Y: Sequence[Any]) -> sp.ImmutableMatrix:
        """∇̃_X Y = ∇_X Y + (∇_X P⊥)(Y) [n, 1], eq. (6), for all vector fields."""
        X, Y = self._column(X), self._column(Y)
        nabla = self._covariant(X, Y)
        derivative = self._covariant(X, self.simplify(self.complement * Y)) - self.complement * nabla
        return self.simplify(nabla + derivative)

    def projected(self, X: Sequence[Any], Y: Sequence[Any]) -> sp.ImmutableMatrix:
        """P ∇_X Y [n, 1], which is ∇̃_X Y for Y in D: eq. (7)."""
        return self.simplify(self.projection * self._covariant(self._column(X), self._column(Y)))

    def symmetric_product(self, X: Sequence[Any], Y: Sequence[Any]) -> sp.ImmutableMatrix:
        """<X : Y> = ∇̃_X Y + ∇̃_Y X [n, 1] of section 6, for X and Y in D."""
        X, Y = self._column(X), self._column(Y)
        return self.simplify(self.projection * (self._covariant(X, Y) + self._covariant(Y, X)))

    @cached_property
    def constrained_christoffel(self) -> sp.ImmutableDenseNDimArray:
        """(∇̃_∂i ∂j)^k [k, i, j], the symbols of ∇̃ over the coordinates, by eq. (6)."""
        size, axes = range(self.mechanism.n), sp.eye(self.mechanism.n)
        fields = [[self.constrained(axes[:, i], axes[:, j]) for j in size] for i in size]
        return sp.ImmutableDenseNDimArray([[[fields[i][j][k] for j in size] for i in size] for k in size])

    @cached_property
    def input_fields(self) -> sp.ImmutableMatrix:
        """P M^{-1} F_a [n, m] as columns, the right-hand side of eq. (5)."""
        return self.simplify(self.projection * self.inverse_inertia * self.forces.T)

    @cached_property
    def acceleration(self) -> sp.ImmutableMatrix:
        """q̈ [n, 1] by eq. (5), q̈^k = -(∇̃_∂i ∂j)^k q̇^i q̇^j + P M^{-1} (u_a F_a - dV), for q̇ in D.

        Linear combination of simple coefficients, over `coordinates`, `rates` and the controls' symbols.
        """
        u = sp.Matrix(len(self.mechanism.controls), 1, [sp.Symbol(name) for name in self.mechanism.controls])
        rates = sp.Matrix(self.rates)
        curvature = [(rates.T * sp.Matrix(plane) * rates)[0] for plane in self.constrained_christoffel]
        fall = self.simplify(self.projection * self.gradient(self.potential))
        return sp.ImmutableMatrix(self.input_fields * u - sp.Matrix(curvature) - fall)

    # -- normal forms ---------------------------------------------------------------------------

    def simplify(self, value: Any) -> Any:
        """Normal form of an expression, or of every entry of a matrix or an array: zero is seen as 0."""
        if isinstance(value, sp.MatrixBase | sp.NDimArray):
            self._cover(sp.flatten(value))  # once for all entries
            return value.as_immutable().applyfunc(self.simplify)
        value = sp.sympify(value)
        self._cover([value])
        return self._writer.expression(self._element(value))

    def _element(self, e: sp.Expr) -> Element:
        """Element of the algebra; a sum is put over its least common denominator, which keeps it short."""
        if e in self._elements:
            return self._elements[e]
        ring, result = self._algebra.ring, self._algebra.one
        if e.is_Add:
            terms = [self._element(term) for term in e.args]
            common = reduce(lambda a, b: a if a == b else a.lcm(b), [term.den for term in terms])
            total = sum((term.num * common.exquo(term.den) for term in terms), ring.zero)
            result = self._algebra.ratio(total, common)
        elif e.is_Mul:
            for factor in e.args:
                result = result * self._element(factor)
        else:
            result = self._algebra.convert(e)
        self._elements[e] = result
        return result

    def _cover(self, expressions: Sequence[sp.Expr]) -> None:
        """Make a new algebra if there are sines, roots or functions that the present one was not made with."""
        found = dict.fromkeys(g for e in expressions for g in _generators(e))
        if found.keys() <= self._generators.keys():
            return
        self._generators |= found
        known = {*self.mechanism.parameters, *self.mechanism.drag}
        names = {str(symbol) for g in (*self.coordinates, *self._generators) for symbol in g.free_symbols}
        samples = sample_points(self.mechanism, sorted(names - known))
        self._algebra = Algebra(self._generators, samples)
        self._writer = Writer(self._algebra, self._definitions, self._entries, self.coordinates)
        self._elements: dict[sp.Expr, Element] = {}

    def _column(self, components: Sequence[Any]) -> sp.Matrix:
        column = [sp.sympify(e) for e in sp.flatten(components)]
        if len(column) != self.mechanism.n:
            raise MechanismError(
                f"{self.mechanism.name}: a vector field or one-form has {self.mechanism.n} components, "
                f"one for each of {', '.join(self.mechanism.coordinates)}; got {len(column)}"
            )
        return sp.Matrix(column)

    def _covariant(self, X: sp.Matrix, Y: sp.Matrix) -> sp.Matrix:
        return self._along(X, Y) + sp.Matrix([(X.T * sp.Matrix(plane) * Y)[0] for plane in self.christoffel])

    def _along(self, X: sp.Matrix, Y: sp.Matrix) -> sp.Matrix:
        """∂_j Y^i X^j."""
        terms = [self._partial(Y, q) * x for q, x in zip(self.coordinates, X, strict=True) if x != 0]
        return sum(terms, sp.zeros(*Y.shape))

    def _partial(self, entries: sp.MatrixBase, symbol: sp.Symbol) -> sp.Matrix:
        self._cover(sp.flatten(entries))
        return entries.applyfunc(lambda e: self._writer.expression(self._algebra.diff(self._element(e), symbol)))

    def _solve(self, A: sp.MatrixBase, B: sp.MatrixBase) -> sp.ImmutableMatrix:
        """A^{-1} B by Cramer's rule, whose fractions all have det A below; elimination would pile them up."""
        return self.simplify(self.simplify(A.adjugate() * B) / self.simplify(A.det(method="berkowitz")))


def _generators(e: sp.Expr) -> Iterator[sp.Expr]:
    """What an expression is a rational function of: symbols, roots and functions."""
    if e.is_Add or e.is_Mul:
        for argument in e.args:
            yield from _generators(argument)
    elif e.is_Pow and e.exp.is_Rational:
        yield from _generators(e.base)
        if not e.exp.is_Integer:
            yield sp.sqrt(e.base)
    elif not e.is_Rational:
        yield e

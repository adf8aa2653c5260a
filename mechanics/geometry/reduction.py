"""Theorem 3.2: equations of motion of a constrained mechanism in an orthogonal frame.

With <<X, Y>> = X^T M Y the inertia tensor's inner product, D the velocities that the constraints
allow and X_1..X_k an orthogonal frame of D, the motion q̇ = X_i v^i obeys

    v̇^k = -Γ̃^k_ij v^i v^j - X_k(V)/|X_k|^2 + Y^k_a u_a,
    Γ̃^k_ij = <<∇_{X_i} X_j, X_k>>/|X_k|^2,    Y^k_a = F_a(X_k)/|X_k|^2,

∇ the Levi-Civita connection of the inertia tensor. No multipliers, no inverse, no projection.

A vector field is held as X_i = g_i N_i with N_i polynomial and g_i a function. Since N_j and N_k are
orthogonal, the derivative of g_j does not matter where j != k, and where j = k all that matters is
the length: <<∇_X Y, Y>> = 1/2 X(|Y|^2). So only polynomials are multiplied, and divided once.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import reduce as reduce_product
from operator import mul
from typing import Any

import numpy as np
import sympy as sp

from mechanics.expressions import to_sympy
from mechanics.geometry.algebra import Algebra, Element
from mechanics.geometry.compact import Product, Writer, nested_sum
from mechanics.geometry.symmetry import planar_symmetry
from mechanics.mechanism import Matrix, Mechanism

__all__ = ["ReducedEquations", "reduce"]

Vector = list[Element]
Terms = list[tuple[Element, ...]]  # a sum of products of elements, not multiplied out; empty for zero

# Largest product of numbers of terms that is multiplied out to one fraction. No coefficient of the
# mechanisms in the catalogue comes near; the frame of a three-link snake exceeds it, and its Γ̃ are
# sums of fractions (in which a zero could hide).
FOLD_LIMIT = 50_000


@dataclass(frozen=True)
class ReducedEquations:
    """Equations of motion q̇ = X v, v̇ = acceleration(q, v, u), as SymPy expressions.

    Symbols are plain `sympy.Symbol`s with the mechanism's names; v1..vk are the pseudo-velocities.
    n coordinates, k = n - c pseudo-velocities, m controls. Units are SI and follow from the frame:
    X_i v^i is a velocity.

    Attributes:
        mechanism: what was reduced.
        coordinates: (n,) symbols q.
        parameters: symbols of the parameters.
        controls: (m,) symbols u.
        pseudo_velocities: (k,) symbols v1..vk.
        frame: (n, k) columns X_i(q) span D.
        squared_norms: (k,) |X_i|^2 in the inertia tensor.
        christoffel: (k, k, k) indexed [k, i, j]: Γ̃^k_ij, which multiplies v^i v^j. It is not
            symmetric in i, j (Theorem 3.2).
        input_coefficients: (k, m) Y^k_a = F_a(X_k)/|X_k|^2 (Theorem 3.2).
        potential_acceleration: (k,) -X_k(V)/|X_k|^2.
        velocity: (n,) q̇ = X v.
        acceleration: (k,) v̇ = -Γ̃ v v + Y u + potential_acceleration.
        projection: (k, n) P with v = P q̇ for every q̇ in D; P = diag(1/|X|^2) X^T M.
        energy: kinetic and potential energy, in J.
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
    velocity: sp.ImmutableDenseNDimArray
    acceleration: sp.ImmutableDenseNDimArray
    projection: sp.ImmutableMatrix
    energy: sp.Expr


def reduce(mechanism: Mechanism, frame: str | Sequence[Sequence[str]] | None = None) -> ReducedEquations:
    """Derive the equations of motion of a mechanism by Theorem 3.2.

    Args:
        mechanism: inertia tensor, constraints, forces.
        frame: name of one of the mechanism's frames, or k rows of n expressions (orthogonal vector
            fields that span D), or None for the mechanism's default frame.

    Returns:
        The reduced equations, in compact form.
    """
    return _Reduction(mechanism, mechanism.frame_rows(frame)).equations()


class _Reduction:
    """The derivation, one method a step."""

    def __init__(self, mechanism: Mechanism, rows: Matrix) -> None:
        self.mechanism = mechanism
        n, k = mechanism.n, len(rows)
        symbols = mechanism.symbols
        self.q = [symbols[name] for name in mechanism.coordinates]
        self.v = [sp.Symbol(f"v{i + 1}") for i in range(k)]
        self.u = [symbols[name] for name in mechanism.controls]
        self.symmetry = planar_symmetry(mechanism, rows)

        # Lemma 3.3: at the group identity the heading is gone before any algebra.
        identity = dict.fromkeys(mechanism.fibre, sp.S.Zero) if self.symmetry else {}
        scope = mechanism.scope(identity)
        definitions = [scope[name] for name in mechanism.definitions]
        fields = [[to_sympy(text, scope) for text in row] for row in rows]
        inertia = [[to_sympy(text, scope) for text in row] for row in mechanism.inertia]
        forces = [[to_sympy(text, scope) for text in row] for row in mechanism.forces.values()]
        potential = to_sympy(mechanism.potential, scope)
        everything = [*sum(fields, []), *sum(inertia, []), *sum(forces, []), potential]
        algebra = self.algebra = Algebra([*definitions, *everything], _samples(mechanism))
        self.writer = Writer(algebra, definitions, everything, self.q)

        self.X = [[algebra.convert(e) for e in row] for row in fields]
        self.M = [[algebra.convert(e) for e in row] for row in inertia]
        self.F = [[algebra.convert(e) for e in row] for row in forces]
        self.V = algebra.convert(potential)
        self.half = algebra.convert(sp.S.Half)
        self.scales, self.N = zip(*(_split_scale(row) for row in self.X), strict=True)
        self.MN = [self._times_inertia(row) for row in self.N]
        self.norms = [self._dot(row, m) for row, m in zip(self.N, self.MN, strict=True)]  # |N_i|^2
        self.n, self.k = n, k
        self.squared_norms = [self._fold([(g, g, s)]) for g, s in zip(self.scales, self.norms, strict=True)]

    # -- the pieces of Theorem 3.2 -------------------------------------------------------------

    def christoffel(self) -> list[list[list[Terms]]]:
        """Γ̃^k_ij as [k][i][j]."""
        k, one = self.k, self.algebra.one
        gamma: list[list[list[Terms]]] = [[[[] for _ in range(k)] for _ in range(k)] for _ in range(k)]
        partials = [self._partials_of_field(row) for row in self.N]
        inertia = self._partials_of_inertia()
        for i in range(k):
            for j in range(k):
                gamma[j][i][j] = self._fold(self._stretch(i, j))
            for a in range(k):
                for b in range(a):
                    # <<∇_X_i X_a, X_b>> = -<<X_a, ∇_X_i X_b>>, since the two fields are orthogonal
                    value = self._covariant(i, a, b, partials[a], inertia)
                    if value:
                        g_i, g_a, g_b = (self.scales[index] for index in (i, a, b))
                        gamma[b][i][a] = self._fold([(g_i, value, g_a, one / g_b, one / self.norms[b])])
                        gamma[a][i][b] = self._fold([(g_i, -value, g_b, one / g_a, one / self.norms[a])])
        return gamma

    def _stretch(self, i: int, j: int) -> Terms:
        """<<∇_X_i X_j, X_j>>/|X_j|^2 = 1/2 X_i(log |X_j|^2), |X_j|^2 = g^2 |N_j|^2."""
        ((squared_norm, *others),) = self.squared_norms[j]
        if not others:
            if rate := self._along(self.N[i], squared_norm):
                return [(self.scales[i], self.half, rate, self.algebra.one / squared_norm)]
            return []
        terms: Terms = []
        for factor, weight in ((self.norms[j], self.half), (self.scales[j], self.algebra.one)):
            if rate := self._along(self.N[i], factor):
                terms.append((self.scales[i], weight, rate, self.algebra.one / factor))
        return terms

    def _covariant(self, i: int, j: int, k: int, partials: list[Vector], inertia: list[list[Vector]]) -> Element:
        """<<∇_N_i N_j, N_k>> = N_k^T M (DN_j N_i) + Γ_acd N_k^a N_i^c N_j^d."""
        N, n = self.N, self.n
        total = self.algebra.zero
        for c in range(n):
            if N[i][c] and any(partials[c]):
                total = total + N[i][c] * self._dot(partials[c], self.MN[k])
        # First-kind symbols 2 Γ_acd = ∂_c M_ad + ∂_d M_ac - ∂_a M_cd, contracted
        second = self.algebra.zero
        for c in range(n):
            if any(any(row) for row in inertia[c]):
                second = second + N[i][c] * self._form(inertia[c], N[k], N[j])
                second = second + N[j][c] * self._form(inertia[c], N[k], N[i])
                second = second - N[k][c] * self._form(inertia[c], N[i], N[j])
        return total + self.half * second if second else total

    def inputs(self) -> list[list[Terms]]:
        """Y^k_a = F_a(N_k)/(g_k |N_k|^2) as [k][a]."""
        return [[self._per_norm(k, self._dot(force, self.N[k])) for force in self.F] for k in range(self.k)]

    def gradients(self) -> list[Terms]:
        """-X_k(V)/|X_k|^2."""
        return [self._per_norm(k, -self._along(self.N[k], self.V)) for k in range(self.k)]

    def projection(self) -> list[list[Terms]]:
        """X_k^T M/|X_k|^2."""
        return [[self._per_norm(k, m) for m in self.MN[k]] for k in range(self.k)]

    def _per_norm(self, k: int, value: Element) -> Terms:
        """Divide `value`, which is linear in N_k, so that it counts per unit of |X_k|^2 for X_k in N_k's place."""
        one = self.algebra.one
        return self._fold([(value, one / self.scales[k], one / self.norms[k])]) if value else []

    def _fold(self, terms: Terms) -> Terms:
        """A sum of products of elements as one element, which cancels, unless that would be very long."""
        size = sum(math.prod(len(e.num) * len(e.den) for e in product) for product in terms)
        if size > FOLD_LIMIT:
            return terms
        total = self.algebra.zero
        for product in terms:
            total = total + reduce_product(mul, product)
        return [(total,)] if total else []

    # -- calculus with the symmetry ------------------------------------------------------------

    def _along(self, field: Sequence[Element], function: Element) -> Element:
        """Derivative of a function along a vector field."""
        total = self.algebra.zero
        for component, rate in zip(field, self._rates([function], None), strict=True):
            if component and rate[0]:
                total = total + component * rate[0]
        return total

    def _partials_of_field(self, field: Sequence[Element]) -> list[Vector]:
        """∂_c N as [c][a]."""
        if not (s := self.symmetry):
            return self._rates(field, None)
        # ∂θ N = J N - ..., J maps e_x to e_y and e_y to -e_x
        turned = [self.algebra.zero] * self.n
        turned[s.x], turned[s.y] = -field[s.y], field[s.x]
        return self._rates(field, turned)

    def _partials_of_inertia(self) -> list[list[Vector]]:
        """∂_c M as [c][a][b]."""
        n, flat = self.n, [e for row in self.M for e in row]
        turned = None
        if s := self.symmetry:
            # ∂θ M = -J^T M - M J - ...; (M J)[:, x] = M[:, y] and (M J)[:, y] = -M[:, x]
            MJ = [[self.algebra.zero] * n for _ in range(n)]
            for a in range(n):
                MJ[a][s.x], MJ[a][s.y] = self.M[a][s.y], -self.M[a][s.x]
            turned = [-(MJ[a][b] + MJ[b][a]) for a in range(n) for b in range(n)]
        return [[rates[a * n : (a + 1) * n] for a in range(n)] for rates in self._rates(flat, turned)]

    def _rates(self, entries: Sequence[Element], turned: Vector | None) -> list[Vector]:
        """Partial derivatives [c][entry] along every coordinate.

        At the identity the fibre's derivatives come from the symmetry: an invariant tensor has no Lie
        derivative along ∂x, ∂y and ∂θ + Σ ∂(turning) + x∂y - y∂x, so ∂θ = `turned` - Σ ∂(turning).
        """
        rates = [[self.algebra.diff(e, symbol) for e in entries] for symbol in self.q]
        if s := self.symmetry:
            rates[s.heading] = list(turned) if turned else [self.algebra.zero] * len(entries)
            for c in s.turning:
                rates[s.heading] = [a - b if b else a for a, b in zip(rates[s.heading], rates[c], strict=True)]
        return rates

    # -- linear algebra ------------------------------------------------------------------------

    def _dot(self, a: Sequence[Element], b: Sequence[Element]) -> Element:
        total = self.algebra.zero
        for left, right in zip(a, b, strict=True):
            if left and right:
                total = total + left * right
        return total

    def _times_inertia(self, field: Sequence[Element]) -> Vector:
        return [self._dot(row, field) for row in self.M]

    def _form(self, matrix: Sequence[Sequence[Element]], a: Sequence[Element], b: Sequence[Element]) -> Element:
        return self._dot(a, [self._dot(row, b) for row in matrix])

    # -- writing -------------------------------------------------------------------------------

    def _products(self, terms: Terms) -> list[Product]:
        return [reduce_product(mul, map(self.writer.product, elements)) for elements in terms]

    def _turn(self, entries: Sequence[Terms]) -> list[list[Product]]:
        """Components in the plane's axes of components in the body's axes."""
        rows = [self._products(e) for e in entries]
        if s := self.symmetry:
            cosine, sine = (Product(factors={f(self.q[s.heading]): Fraction(1)}) for f in (sp.cos, sp.sin))
            minus = Product(Fraction(-1))
            px, py = rows[s.x], rows[s.y]
            rows[s.x] = [cosine * p for p in px] + [minus * sine * p for p in py]
            rows[s.y] = [sine * p for p in px] + [cosine * p for p in py]
        return rows

    def _write(self, terms: Terms) -> sp.Expr:
        return self._sum(self._products(terms))

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
        k, write, minus = self.k, self._write, Product(Fraction(-1))
        norms = sp.ImmutableDenseNDimArray([write(terms) for terms in self.squared_norms])
        gamma, Y, gradients = self.christoffel(), self.inputs(), self.gradients()
        fields = [self._turn([[(e,)] if e else [] for e in row]) for row in self.X]
        covectors = [self._turn(row) for row in self.projection()]
        v, u = ([Product(factors={s: Fraction(1)}) for s in symbols] for symbols in (self.v, self.u))

        def acceleration(up: int) -> sp.Expr:
            terms = []
            for i in range(k):
                for j in range(i + 1):
                    both = gamma[up][i][j] if i == j else self._fold(gamma[up][i][j] + gamma[up][j][i])
                    terms += [minus * p * v[j] * v[i] for p in self._products(both)]
            terms += [p * u[a] for a in range(len(u)) for p in self._products(Y[up][a])]
            return self._sum(terms + self._products(gradients[up]))

        kinetic = [
            Product(Fraction(1, 2)) * p * w * w
            for terms, w in zip(self.squared_norms, v, strict=True)
            for p in self._products(terms)
        ]
        return ReducedEquations(
            mechanism=self.mechanism,
            coordinates=tuple(self.q),
            parameters=tuple(sp.Symbol(name) for name in self.mechanism.parameters),
            controls=tuple(self.u),
            pseudo_velocities=tuple(self.v),
            frame=sp.ImmutableMatrix([[self._sum(field[a]) for field in fields] for a in range(self.n)]),
            squared_norms=norms,
            christoffel=sp.ImmutableDenseNDimArray([[[write(e) for e in row] for row in plane] for plane in gamma]),
            input_coefficients=sp.ImmutableMatrix(k, len(u), [write(e) for row in Y for e in row]),
            potential_acceleration=sp.ImmutableDenseNDimArray([write(e) for e in gradients]),
            velocity=sp.ImmutableDenseNDimArray(
                [self._sum([t * v[i] for i in range(k) for t in fields[i][a]]) for a in range(self.n)]
            ),
            acceleration=sp.ImmutableDenseNDimArray([acceleration(up) for up in range(k)]),
            projection=sp.ImmutableMatrix([[self._sum(terms) for terms in row] for row in covectors]),
            energy=self._sum([*kinetic, self.writer.product(self.V)]),
        )


def _split_scale(field: Sequence[Element]) -> tuple[Element, Vector]:
    """Function g and polynomial components N without common factor, X = g N."""
    algebra = field[0].algebra
    ring = algebra.ring
    entries = [e for e in field if e]
    den = ring.one
    for e in entries:
        den = den.lcm(e.den)
    nums = [e.num * den.exquo(e.den) for e in entries]
    gcd = ring.zero
    for num in nums:
        gcd = gcd.gcd(num)
    scale = algebra.ratio(gcd, den)
    numerators = iter(nums)
    return scale, [Element(algebra, next(numerators).exquo(gcd), ring.one) if e else algebra.zero for e in field]


def _samples(mechanism: Mechanism) -> dict[str, Any]:
    """Values at random points of the whole configuration space, to see which factors are positive."""
    rng = np.random.default_rng(3)
    count = 200
    values = {name: value * rng.uniform(0.9, 1.1, count) for name, value in mechanism.parameters.items()}
    return values | {name: rng.uniform(-np.pi, np.pi, count) for name in mechanism.coordinates}

"""Closures of vector fields under the symmetric product and under the Lie bracket.

A field in D is held as its components along the orthogonal frame X_1..X_k, in which the constrained
connection is the generalized Christoffel symbols:

    <Y:Z>^k = Y(Z^k) + Z(Y^k) + (Γ̃^k_ij + Γ̃^k_ji) Y^i Z^j.

Brackets leave D, so they are taken of components along the coordinates. The components are elements of
an `Algebra` (formulas: a field that vanishes is seen to vanish) or of a `Taylor` space (numbers).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from itertools import combinations_with_replacement, product
from typing import Any

import sympy as sp

from mechanics.geometry.algebra import Algebra
from mechanics.geometry.jets import Taylor
from mechanics.geometry.reduction import ReducedEquations

__all__ = ["Brackets", "Calculus", "Field", "SymmetricProducts"]

Number = Any  # an element of the arithmetic at work: `Element` or `Jet`


@dataclass(frozen=True, eq=False)
class Field:
    """A vector field and how it was made.

    Attributes:
        name: such as X2, <X2:X3> or [X1,[X1,X3]].
        counts: how often each of the fields that one began with occurs in it.
        components: along the frame (fields in D) or along the coordinates (brackets).
        recipe: method of `Calculus` that made it, and of what.
    """

    name: str
    counts: tuple[int, ...]
    components: tuple[Number, ...]
    recipe: tuple[Any, ...]

    @property
    def degree(self) -> int:
        """Number of factors."""
        return sum(self.counts)

    @property
    def bad(self) -> bool:
        """True if every field occurs an even number of times: changing the signs of controls does not change it."""
        return not any(count % 2 for count in self.counts)

    def __bool__(self) -> bool:
        return any(self.components)


class Calculus:
    """The frame and the input fields of a mechanism, and how to differentiate fields.

    Args:
        equations: the reduced equations.
        inputs: m pairs of a name and k components along the frame.
        arithmetic: where components are computed.

    Attributes:
        frame: X_i, along the coordinates.
        inputs: as given, along the frame.
    """

    def __init__(
        self, equations: ReducedEquations, inputs: Sequence[tuple[str, Sequence[sp.Expr]]], arithmetic: Algebra | Taylor
    ) -> None:
        self.arithmetic: Any = arithmetic
        self.coordinates = equations.coordinates
        convert: Callable[[sp.Expr], Number] = arithmetic.convert
        gamma, size = equations.christoffel, range(equations.frame.shape[1])
        self.frame = [
            Field(f"X{i + 1}", _unit(i, len(size)), tuple(map(convert, equations.frame[:, i])), ("frame", i))
            for i in size
        ]
        self.inputs = [
            Field(name, _unit(a, len(inputs)), tuple(map(convert, components)), ("inputs", a))
            for a, (name, components) in enumerate(inputs)
        ]
        # Γ̃^k_ij + Γ̃^k_ji: a symmetric product needs no more
        self._sums = [
            [[convert(gamma[up, i, j]) + convert(gamma[up, j, i]) for j in size] for i in size] for up in size
        ]
        self._again: dict[tuple[Any, ...], Field] = {}

    def in_coordinates(self, field: Field) -> Field:
        """A field in D, along the coordinates."""
        pairs = [(y, x.components) for y, x in zip(field.components, self.frame, strict=True) if y]
        components = (self._sum(y * x[a] for y, x in pairs if x[a]) for a in range(len(self.coordinates)))
        return Field(field.name, field.counts, tuple(components), ("in_coordinates", field))

    def symmetric_product(self, a: Field, b: Field) -> Field:
        """<a:b> = ∇̃_a b + ∇̃_b a of two fields in D."""
        along, (to_a, to_b) = self.arithmetic.along, (self._direction(self.in_coordinates(field)) for field in (a, b))
        pairs = product(enumerate(a.components), enumerate(b.components))
        products = [(i, j, left * right) for (i, left), (j, right) in pairs if left and right]
        turns = (self._sum(rows[i][j] * both for i, j, both in products if rows[i][j]) for rows in self._sums)
        components = tuple(
            along(right, to_a) + along(left, to_b) + turn
            for left, right, turn in zip(a.components, b.components, turns, strict=True)
        )
        return Field(f"<{a.name}:{b.name}>", _add(a.counts, b.counts), components, ("symmetric_product", a, b))

    def lie_bracket(self, a: Field, b: Field) -> Field:
        """[a, b]^c = a(b^c) - b(a^c) of two fields along the coordinates."""
        along, to_a, to_b = self.arithmetic.along, self._direction(a), self._direction(b)
        pairs = zip(a.components, b.components, strict=True)
        components = tuple(along(right, to_a) - along(left, to_b) for left, right in pairs)
        return Field(f"[{a.name},{b.name}]", _add(a.counts, b.counts), components, ("lie_bracket", a, b))

    def again(self, field: Field) -> Field:
        """The same field in this arithmetic, of a field in another one."""
        method, *arguments = field.recipe
        key = (method, field.name)
        if key not in self._again:
            made = getattr(self, method)
            self._again[key] = made(*map(self.again, arguments)) if callable(made) else made[arguments[0]]
        return self._again[key]

    def _direction(self, field: Field) -> list[tuple[sp.Symbol, Number]]:
        return [(s, e) for s, e in zip(self.coordinates, field.components, strict=True) if e]

    def _sum(self, terms: Iterable[Number]) -> Number:
        return sum(terms, self.arithmetic.zero)


class SymmetricProducts:
    """Symmetric products of the input fields, made when they are asked for."""

    def __init__(self, calculus: Calculus) -> None:
        self._calculus = calculus
        self._made: dict[tuple[Field, Field], Field] = {}
        self._degrees: list[list[Field]] = [[], [field for field in calculus.inputs if field]]

    def of_degree(self, degree: int) -> list[Field]:
        """All products of so many factors that are not zero nearby."""
        while len(self._degrees) <= degree:
            total, found = len(self._degrees), []
            for low in range(1, total // 2 + 1):
                left, right = self._degrees[low], self._degrees[total - low]
                pairs = combinations_with_replacement(left, 2) if 2 * low == total else product(left, right)
                found += [made for a, b in pairs if (made := self._make(a, b))]
            self._degrees.append(found)
        return self._degrees[degree]

    def basis(self, degree: int) -> tuple[list[Field], bool]:
        """Products of lowest degree that span all others over the functions of q, and whether they are known to.

        As <f Y:Z> = f <Y:Z> + Z(f) Y, they do if they span the products of each other.

        Args:
            degree: products of more factors are not tried.
        """
        space = self._calculus.arithmetic
        span = space.span()
        basis = [field for field in self._degrees[1] if span.add(space.column(field.components))]
        pending = list(combinations_with_replacement(basis, 2))
        while pending and span.rank < len(self._calculus.frame):
            pair = min(pending, key=lambda pair: pair[0].degree + pair[1].degree)
            pending.remove(pair)
            if pair[0].degree + pair[1].degree > degree:
                return basis, False
            if span.add(space.column((made := self._make(*pair)).components)):
                basis.append(made)
                pending += [(other, made) for other in basis]
        return basis, True

    def _make(self, a: Field, b: Field) -> Field:
        pair = (a, b) if a.degree <= b.degree else (b, a)
        if pair not in self._made:
            self._made[pair] = self._calculus.symmetric_product(*pair)
        return self._made[pair]


class Brackets:
    """Iterated Lie brackets [Z_a, [Z_b, ... Z_c]], made when they are asked for.

    By Jacobi's identity they span the involutive closure of the fields Z.

    Args:
        calculus: of the mechanism.
        fields: Z, along the coordinates.
    """

    def __init__(self, calculus: Calculus, fields: Sequence[Field]) -> None:
        self._calculus, self.fields = calculus, fields
        self._made: dict[tuple[Field, Field], Field] = {}

    def of_degree(self, degree: int) -> list[Field]:
        """All brackets of so many factors that are not zero nearby, and the fields that count as so many."""
        found = [z for z in self.fields if z.degree == degree]
        for z in self.fields:
            if z.degree < degree:
                found += [made for b in self.of_degree(degree - z.degree) if (made := self._make(z, b))]
        return found

    def basis(self, degree: int) -> tuple[list[Field], bool]:
        """Brackets that span all others over the functions of q, and whether they are known to.

        As [Z, f B] = f [Z, B] + Z(f) B, they do if they span their brackets with the fields.

        Args:
            degree: brackets of more factors are not tried.
        """
        space, full, known = self._calculus.arithmetic, len(self._calculus.coordinates), True
        span = space.span()
        basis = [z for z in self.fields if span.add(space.column(z.components))]
        for b in basis:  # which grows meanwhile
            for z in self.fields:
                if span.rank == full:
                    return basis, True
                if z.degree + b.degree > degree:
                    known = False
                elif (made := self._make(z, b)) and span.add(space.column(made.components)):
                    basis.append(made)
        return basis, known

    def _make(self, a: Field, b: Field) -> Field | None:
        """[a, b]; None if it is another one but for its sign."""
        if a is b or (b in self.fields and self.fields.index(b) < self.fields.index(a)):
            return None
        if (a, b) not in self._made:
            self._made[a, b] = self._calculus.lie_bracket(a, b)
        return self._made[a, b]


def _unit(index: int, size: int) -> tuple[int, ...]:
    return tuple(int(i == index) for i in range(size))


def _add(a: Sequence[int], b: Sequence[int]) -> tuple[int, ...]:
    return tuple(map(sum, zip(a, b, strict=True)))

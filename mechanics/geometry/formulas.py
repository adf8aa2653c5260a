"""Symmetric products and Lie brackets as formulas, and the configurations at which they span everything."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from itertools import combinations

import sympy as sp

from mechanics.geometry.algebra import Algebra, Element, TooLong
from mechanics.geometry.closures import Calculus, Field, SymmetricProducts
from mechanics.geometry.compact import Writer
from mechanics.geometry.reduction import ReducedEquations
from mechanics.geometry.samples import sample_points
from mechanics.mechanism import MechanismError

__all__ = ["Formulas"]


class Formulas:
    """The fields as formulas, in exact normal form: a field that vanishes is seen to vanish.

    Args:
        equations: the reduced equations.
        inputs: names of the input fields, and their components along the frame.
    """

    def __init__(self, equations: ReducedEquations, inputs: Sequence[tuple[str, Sequence[sp.Expr]]]) -> None:
        e, m = equations, equations.mechanism
        self._name, self._frame = m.name, e.frame
        with self._not_too_long():
            scope = m.scope()
            definitions = [scope[name] for name in m.definitions]
            masses = [m.symbolic(row[a]) for a, row in enumerate(m.inertia)]
            entries = [*e.frame, *sp.flatten(e.christoffel), *(y for _, field in inputs for y in field)]
            samples = sample_points(m, m.coordinates)
            algebra = self._algebra = Algebra([*definitions, *entries, *e.squared_norms, *masses], samples)
            self._writer = Writer(algebra, definitions, [*e.frame, *masses], e.coordinates)
            self._calculus = Calculus(e, inputs, algebra)
            # Factors of the norms, of the inertia tensor's diagonal (both are positive) and of the frame's
            # denominators vanish nowhere where there is a frame.
            positive, frame = (
                [self._writer.product(algebra.convert(entry)).factors for entry in entries]
                for entries in ([*e.squared_norms, *masses], e.frame)
            )
            self._nonzero = frozenset(b for f in positive for b in f) | {b for f in frame for b in f if f[b] < 0}

    def written(self, fields: Sequence[Field]) -> dict[str, tuple[sp.Expr, ...]]:
        """Components of fields, by name; those of the frame as they were given."""
        with self._not_too_long():
            return {field.name: self._written(field) for field in fields}

    def _written(self, field: Field) -> tuple[sp.Expr, ...]:
        if field.recipe[0] == "frame":
            return tuple(self._frame[:, field.recipe[1]])
        return tuple(map(self._writer.expression, self._calculus.again(field).components))

    def products(self, degree: int) -> list[Field]:
        """Symmetric products of so many factors."""
        with self._not_too_long():
            return SymmetricProducts(self._calculus).of_degree(degree)

    def conditions(self, fields: Sequence[Field]) -> tuple[sp.Expr, ...]:
        """Factors of the determinant of some fields that may vanish."""
        with self._not_too_long():
            columns = [self._calculus.again(field).components for field in fields]
            return self._vanishing_factors(_determinant(self._algebra, columns))

    def _vanishing_factors(self, element: Element) -> tuple[sp.Expr, ...]:
        factors = self._writer.product(element).factors
        return tuple(base for base, power in factors.items() if power > 0 and base not in self._nonzero)

    @contextmanager
    def _not_too_long(self) -> Iterator[None]:
        try:
            yield
        except TooLong:
            raise MechanismError(
                f"{self._name}: the formulas are too long to write down; `generic` and `at` do without"
            ) from None


def _determinant(algebra: Algebra, columns: Sequence[Sequence[Element]]) -> Element:
    """Determinant of a square matrix, from the minors of its first one, two, ... columns."""
    minors: dict[tuple[int, ...], Element] = {(): algebra.one}
    for size, column in enumerate(columns):
        larger = {}
        for rows in combinations(range(len(columns)), size + 1):
            total = algebra.zero
            for place, row in enumerate(rows):
                if column[row] and (minor := minors[rows[:place] + rows[place + 1 :]]):
                    term = column[row] * minor
                    total = total - term if (size - place) % 2 else total + term
            larger[rows] = total
        minors = larger
    return minors[tuple(range(len(columns)))]

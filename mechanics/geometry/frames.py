"""A smooth frame of the velocities that the constraints allow, and its orthogonalisation.

`null_frame` finds vector fields that span D = {q̇ : omega q̇ = 0} and are independent wherever D is
smooth, not only where some chosen pivot does not vanish: the knife edge (sinθ, -cosθ) gets
(cosθ, sinθ), never (1, tanθ) with its pole at θ = π/2. It goes through the one-forms as Gaussian
elimination does, on columns, but a pivot may be

* an entry that vanishes nowhere (a wheel's distance from its hitch);
* a pair of entries a, b that never vanish together, such as a sine and a cosine: the columns are
  turned by the matrix of (a, b), whose determinant a² + b² vanishes nowhere;
* where one direction is left, the cross product of the rows, free of common factors. There D goes on
  smoothly through configurations at which the one-forms become dependent (the snakeboard's φ = π/2).

If none of these is there (a distribution over a curved space need have no global frame), the entry
that stays farthest from zero is taken, and the frame has a pole where that entry vanishes.

`orthogonalise` is eq. (9) of Bullo and Zefran, row after row.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import combinations
from typing import Any

import numpy as np
import sympy as sp

__all__ = ["null_frame", "orthogonalise"]

Number = Any  # `Element` or `Value`
Vector = list[Number]

# A function counts as vanishing nowhere if its smallest size is at least this share of its
# largest, over a search that comes within 1e-3 rad of a zero: the roller racer's sin²ψ + c² has
# 0.04, a touching zero such as 1 + cosψ less than 1e-6.
AWAY_FROM_ZERO = 1e-3
ROUNDS, SHRINK = 6, 0.25
# A function that comes no nearer to zero at the sample points needs no search: parameters alone.
PLAIN = 0.5


def null_frame(
    algebra: Any, forms: Sequence[Vector], coordinates: Sequence[sp.Symbol], kept: Sequence[int] = ()
) -> list[Vector]:
    """Vector fields that span the null space of the one-forms.

    Args:
        algebra: where the entries live, an `Algebra` or a `Tape`.
        forms: [c, n] rows of the one-forms.
        coordinates: (n,) symbols.
        kept: coordinates that should be moved by one field each (joints with stops): no pivot is
            taken there as long as there is another.

    Returns:
        [n - c, n] rows. Fields that move a kept coordinate come last, short ones first.
    """
    return _Elimination(algebra, forms, coordinates, kept).fields()


def orthogonalise(fields: Sequence[Vector], inner: Callable[[Vector, Vector], Number]) -> list[Vector]:
    """Gram-Schmidt without normalisation: X_i - sum_l <<X_i, X_l>>/|X_l|^2 X_l over the rows before."""
    result: list[Vector] = []
    norms: list[Number] = []
    for field in fields:
        row = list(field)
        for other, norm in zip(result, norms, strict=True):
            if product := inner(field, other):
                factor = product / norm
                row = [a - factor * b if b else a for a, b in zip(row, other, strict=True)]
        result.append(row)
        norms.append(inner(row, row))
    return result


class _Elimination:
    """Columns that span what the forms treated so far allow, and the other forms in terms of them."""

    def __init__(
        self, algebra: Any, forms: Sequence[Vector], coordinates: Sequence[sp.Symbol], kept: Sequence[int]
    ) -> None:
        self.algebra = algebra
        names = {symbol.name for symbol in coordinates}
        self.origin = {s: 0 * x[:1] if s in names else x[:1] for s, x in algebra.samples.items()}
        one, zero, n = algebra.one, algebra.zero, len(coordinates)
        self.columns: list[Vector] = [[one if a == j else zero for a in range(n)] for j in range(n)]
        self.rows = [self._content_free(row) for row in forms]
        self.kept = frozenset(kept)
        self._away: dict[Number, float] = {}
        while self.rows:
            self._step()

    def fields(self) -> list[Vector]:
        """The columns left, free of common factors, in an order that suits `orthogonalise`."""
        fields = [self._forward(self.algebra.primitive(column)[1]) for column in self.columns]

        def key(field: Vector) -> tuple[bool, int]:
            return any(field[j] for j in self.kept), sum(1 + e.size for e in field if e)

        return sorted(fields, key=key)

    def _forward(self, field: Vector) -> Vector:
        """The field or its negative, so that its largest component at q = 0 is positive."""
        values = [float(self.algebra.values(e, self.origin)[0]) if e else 0.0 for e in field]
        return [-e for e in field] if max(values, key=abs) < 0 else field

    # -- one step ------------------------------------------------------------------------------

    def _step(self) -> None:
        """Treat one form, by the simplest pivot there is."""
        active = [j for j in range(len(self.columns)) if any(row[j] for row in self.rows)]
        if len(active) == len(self.rows) + 1:
            self._cross_product(active)
            return
        singles = [(r, j) for r, row in enumerate(self.rows) for j in active if row[j]]
        pairs = [(r, i, j) for r, row in enumerate(self.rows) for i, j in combinations(active, 2) if row[i] and row[j]]
        for moved in (False, True):
            if found := self._first(singles, lambda r, j: self.rows[r][j], moved):
                self._eliminate(*found)
                return
            if found := self._first(pairs, lambda r, i, j: self.rows[r][i] ** 2 + self.rows[r][j] ** 2, moved):
                self._turn(*found)
                self._eliminate(*found[:2])
                return
        self._eliminate(*max(singles, key=lambda place: self._distance(self.rows[place[0]][place[1]])))

    def _first(
        self, places: Sequence[tuple[int, ...]], value: Callable[..., Number], moved: bool
    ) -> tuple[int, ...] | None:
        """Shortest place whose value vanishes nowhere, among those that do or do not move kept coordinates."""

        def key(place: tuple[int, ...]) -> tuple[int, int]:
            return value(*place).size, sum(bool(e) for e in self.rows[place[0]])

        chosen = [place for place in places if self._moves(place[1:]) == moved]
        return next((p for p in sorted(chosen, key=key) if self._distance(value(*p)) > AWAY_FROM_ZERO), None)

    def _moves(self, columns: Sequence[int]) -> bool:
        return any(self.columns[j][a] for j in columns for a in self.kept)

    def _eliminate(self, r: int, j: int) -> None:
        """Row r fixes column j in terms of the others."""
        row, column = self.rows.pop(r), self.columns.pop(j)
        pivot = row.pop(j)
        rest = [other.pop(j) for other in self.rows]
        for l, entry in enumerate(row):
            if entry:
                factor = entry / pivot
                self.columns[l] = [a - factor * b if b else a for a, b in zip(self.columns[l], column, strict=True)]
                for other, e in zip(self.rows, rest, strict=True):
                    if e:
                        other[l] = other[l] - factor * e
        self.rows = [self._content_free(other) for other in self.rows]

    def _turn(self, r: int, i: int, j: int) -> None:
        """Replace columns i, j by a i + b j and -b i + a j, where (a, b) are the entries of row r."""
        a, b = self.rows[r][i], self.rows[r][j]
        first, second = self.columns[i], self.columns[j]
        self.columns[i] = [a * x + b * y for x, y in zip(first, second, strict=True)]
        self.columns[j] = [a * y - b * x for x, y in zip(first, second, strict=True)]
        for row in self.rows:
            row[i], row[j] = a * row[i] + b * row[j], a * row[j] - b * row[i]

    def _cross_product(self, active: list[int]) -> None:
        """The one direction among the active columns that all rows allow."""
        minors = [self._determinant([[row[l] for l in active if l != j] for row in self.rows]) for j in active]
        signed = [minor if place % 2 == 0 else -minor for place, minor in enumerate(minors)]
        _, weights = self.algebra.primitive(signed)
        direction = [self.algebra.zero] * len(self.columns[0])
        for weight, j in zip(weights, active, strict=True):
            if weight:
                direction = [a + weight * b if b else a for a, b in zip(direction, self.columns[j], strict=True)]
        self.columns = [column for j, column in enumerate(self.columns) if j not in active] + [direction]
        self.rows = []

    def _determinant(self, matrix: list[Vector]) -> Number:
        """By expansion along the first row: there are few rows left."""
        if not matrix:
            return self.algebra.one
        total = self.algebra.zero
        for j, entry in enumerate(matrix[0]):
            if entry:
                minor = entry * self._determinant([row[:j] + row[j + 1 :] for row in matrix[1:]])
                total = total + minor if j % 2 == 0 else total - minor
        return total

    def _content_free(self, row: Vector) -> Vector:
        return self.algebra.primitive(row)[1] if any(row) else row

    # -- zeros ---------------------------------------------------------------------------------

    def _distance(self, element: Number) -> float:
        """Smallest size of a function over its largest, searched over the configuration space."""
        if element not in self._away:
            self._away[element] = self._search(element)
        return self._away[element]

    def _search(self, element: Number) -> float:
        algebra = self.algebra
        values = np.abs(algebra.values(element))
        if not np.isfinite(values).all():
            return 0.0
        largest, points = values.max(), algebra.samples
        smallest, center = values.min(), int(values.argmin())
        if smallest > PLAIN * largest:
            return float(smallest / largest)
        # Around the smallest value so far, in ever smaller boxes.
        rng, width = np.random.default_rng(5), 1.0
        for _ in range(ROUNDS):
            steps = {name: rng.permutation(x - x.mean()) for name, x in algebra.samples.items()}
            points = {name: x[center] + width * steps[name] for name, x in points.items()}
            width *= SHRINK
            values = np.abs(algebra.values(element, points))
            center = int(values.argmin())
            smallest = min(smallest, values[center])
        return float(smallest / largest) if largest else 0.0

"""The conditions of Lewis and Murray at one configuration, in numbers. `controllability` says what they are."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import sympy as sp

from mechanics.geometry.closures import Brackets, Calculus, Field, SymmetricProducts
from mechanics.geometry.jets import PoleError, Taylor
from mechanics.geometry.reduction import ReducedEquations
from mechanics.mechanism import MechanismError

__all__ = ["LargestRanks", "Point", "Report", "examine"]


@dataclass(frozen=True)
class Report:
    """What can be said of one configuration q. None is "not decided by these conditions".

    Attributes:
        mechanism: its name.
        dimension: n, of the configuration manifold.
        rank: k, of the distribution D.
        degree: largest number of factors that was allowed.
        rank_symmetric: of Sym at q, or of what its products of so many factors span.
        rank_closure: of Lie(Sym) at q, or of what brackets of those products with so many factors span.
        symmetric: names of products that span Sym at q.
        closure: names of brackets that span Lie(Sym) at q; of the frame's X_i where Sym spans D.
        accessible: locally configuration accessible.
        controllable: locally configuration controllable, by bounded forces.
        state_controllable: locally controllable among the states (q, q̇) with q̇ in D, from (q, 0).
        obstruction: name of the first bad product that good ones of fewer factors do not span, if any.
        reason: why `controllable` is what it is.
    """

    mechanism: str
    dimension: int
    rank: int
    degree: int
    rank_symmetric: int
    rank_closure: int
    symmetric: tuple[str, ...]
    closure: tuple[str, ...]
    accessible: bool | None
    controllable: bool | None
    state_controllable: bool | None
    obstruction: str | None
    reason: str

    def __str__(self) -> str:
        answer = {True: "yes", False: "no", None: "not decided"}
        lines = (
            f"{self.mechanism} from rest, products of up to {self.degree} factors",
            f"Sym has rank {self.rank_symmetric} of {self.rank}: {', '.join(self.symmetric)}",
            f"Lie(Sym) has rank {self.rank_closure} of {self.dimension}: {', '.join(self.closure)}",
            f"locally configuration accessible: {answer[self.accessible]}",
            f"locally configuration controllable: {answer[self.controllable]} ({self.reason})",
            f"locally controllable in configuration and velocity: {answer[self.state_controllable]}",
        )
        return "\n  ".join(lines)


@dataclass(frozen=True)
class LargestRanks:
    """Ranks that no configuration exceeds, whatever the number of factors; None where that is not known."""

    symmetric: int | None = None
    closure: int | None = None


class Point:
    """Fields near a configuration.

    Args:
        equations: the reduced equations.
        inputs: names of the input fields, and their components along the frame.
        values: numbers for coordinates and parameters, by name.
        degree: largest number of factors.
        resolution: how closely the numbers are known.

    Raises:
        MechanismError: where the frame has a pole or does not span D.
    """

    def __init__(
        self,
        equations: ReducedEquations,
        inputs: Sequence[tuple[str, Sequence[sp.Expr]]],
        values: Mapping[str, Any],
        degree: int,
        resolution: float,
    ) -> None:
        self.mechanism, self.degree, self.rank = equations.mechanism, degree, equations.frame.shape[1]
        entries = [*equations.frame, *equations.input_coefficients, *sp.flatten(equations.christoffel)]
        occurring = set().union(*(e.free_symbols for e in entries))
        # As many derivatives as factors: a product takes one less, one more tells its size nearby.
        self.space = Taylor(values, [s.name for s in equations.coordinates if s in occurring], degree, resolution)
        try:
            self.calculus = Calculus(equations, inputs, self.space)
            if len(self.independent(self.calculus.frame)) < self.rank:
                raise PoleError("its vector fields are not independent")
        except PoleError as error:
            q = ", ".join(f"{name} = {float(values[name]):.6g}" for name in self.mechanism.coordinates)
            raise MechanismError(
                f"{self.mechanism.name}: the frame is singular at {q} ({error}); give another one to `analyse`, "
                f"the mechanism has {', '.join(map(repr, self.mechanism.frames)) or 'none of its own'}"
            ) from None
        self.products = SymmetricProducts(self.calculus)

    def independent(self, fields: Iterable[Field]) -> list[Field]:
        """Those of the fields that are here no linear combinations of the ones before them."""
        span = self.space.span()
        return [field for field in fields if span.add(self.space.column(field.components))]

    def brackets(self, fields: Sequence[Field]) -> Brackets:
        """Brackets of fields in D, or of the frame X_i where they span D: that has the same closure."""
        spans = len(self.independent(fields)) == self.rank
        generators = self.calculus.frame if spans else [self.calculus.in_coordinates(field) for field in fields]
        return Brackets(self.calculus, generators)


def examine(point: Point, largest: LargestRanks) -> Report:
    """Report on a configuration, given what is known of all of them."""
    n, space = point.mechanism.n, point.space
    span = space.span()
    symmetric: list[Field] = []
    obstruction: Field | None = None
    for degree in range(1, point.degree + 1):
        fields = [(field, space.column(field.components)) for field in point.products.of_degree(degree)]
        # Up to the first such product, bad ones add nothing to the span of the good ones.
        if not obstruction:
            obstruction = next((field for field, column in fields if field.bad and column not in span), None)
        symmetric += [field for field, column in fields if span.add(column)]
        # Products that span as much as any do have all others as combinations with smooth coefficients.
        full = span.rank in (largest.symmetric, point.rank)
        if full:
            break
    closure = _closure(point, symmetric, n if largest.closure is None else largest.closure)

    accessible = True if len(closure) == n else None if largest.closure in (None, n) else False
    one_control = len(point.mechanism.controls) == 1
    controllable: bool | None
    if accessible is False:
        controllable, reason = False, "it is not accessible"
    elif obstruction and one_control and [symmetric[0].degree, obstruction.degree] == [1, 2]:
        controllable, reason = False, f"the one control pushes one way only along {obstruction.name}"
    elif obstruction:
        controllable, reason = None, f"good products of fewer factors do not make up for the bad one {obstruction.name}"
    elif not full:
        controllable, reason = None, f"products of up to {point.degree} factors do not span Sym"
    elif accessible is None:
        controllable, reason = None, "accessibility is not decided"
    else:
        controllable, reason = True, "good products of fewer factors make up for every bad one"
    state = controllable
    if span.rank < point.rank and controllable is not False:
        state = None if largest.symmetric in (None, point.rank) else False
    return Report(
        mechanism=point.mechanism.name,
        dimension=n,
        rank=point.rank,
        degree=point.degree,
        rank_symmetric=span.rank,
        rank_closure=len(closure),
        symmetric=tuple(field.name for field in symmetric),
        closure=tuple(field.name for field in closure),
        accessible=accessible,
        controllable=controllable,
        state_controllable=state,
        obstruction=obstruction.name if obstruction else None,
        reason=reason,
    )


def _closure(point: Point, fields: Sequence[Field], rank: int) -> list[Field]:
    """Brackets that span as much as possible at the point, or the given rank."""
    found: list[Field] = []
    brackets, span = point.brackets(fields), point.space.span()
    for degree in range(1, point.degree + 1):
        for field in brackets.of_degree(degree):
            if span.rank == rank:
                return found
            if span.add(point.space.column(field.components)):
                found.append(field)
    return found

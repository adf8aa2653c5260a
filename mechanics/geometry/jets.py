"""Functions near a point: Taylor polynomials in many digits, and the span of vectors made of them.

A `Taylor` space answers to the calls of `algebra.Algebra`, so that one derivation runs on both: for all
configurations at once, or in numbers at one of them, however long the formulas would be.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from itertools import combinations_with_replacement
from typing import Any

import mpmath
import sympy as sp

__all__ = ["DIGITS", "Jet", "PoleError", "Span", "Taylor"]

DIGITS = 60  # working precision
# A coefficient below this is zero: terms of up to a million cancel to 1e-54, and what is asked is
# whether numbers of order one are told from zero at a resolution of at least 1e-30.
ZERO = mpmath.mpf(10) ** -45
# A vector of length one depends on others if it leaves their span by less than this many
# resolutions; more than one, because the others are as uncertain as it is.
MARGIN = 100
MESSAGE = 200  # characters of an expression that an error shows


class PoleError(ArithmeticError):
    """A function is not smooth at the point."""


class Taylor:
    """Taylor polynomials at a point.

    Args:
        values: numbers for all symbols, by name.
        variables: names of the symbols that vary.
        order: of the polynomials; a derivative has one less.
        resolution: points that are closer than this are not told apart.
    """

    def __init__(self, values: Mapping[str, Any], variables: Sequence[str], order: int, resolution: Any) -> None:
        self.values, self.order, self.resolution = values, order, resolution
        size = range(len(variables))
        # Monomials as sorted tuples of variables, lower degrees first.
        monomials = [m for degree in range(order + 1) for m in combinations_with_replacement(size, degree)]
        place = {m: i for i, m in enumerate(monomials)}
        self._degrees = [len(m) for m in monomials]
        self.counts = [sum(len(m) <= degree for m in monomials) for degree in range(order + 1)]
        self._products = [
            [place[tuple(sorted(a + b))] for b in monomials if len(a) + len(b) <= order] for a in monomials
        ]
        self._raised = {  # variable -> place and exponent in it of each monomial times that variable
            name: [(place[tuple(sorted((*m, s)))], m.count(s) + 1) for m in monomials if len(m) < order]
            for s, name in enumerate(variables)
        }
        self.zero, self.one = self._number(0), self._number(1)
        self._converted: dict[sp.Expr, Jet] = {}
        for s, name in enumerate(variables):
            terms = self._number(values[name]).terms
            if order:
                terms[place[s,]] = mpmath.mpf(1)
            self._converted[sp.Symbol(name)] = Jet(self, order, terms)

    def convert(self, expression: sp.Expr) -> Jet:
        """Taylor polynomial of a SymPy expression."""
        e = sp.sympify(expression)
        if e not in self._converted:
            self._converted[e] = self._convert(e)
        return self._converted[e]

    def along(self, function: Jet, direction: Iterable[tuple[sp.Symbol, Jet]]) -> Jet:
        """Derivative of a function along sum_s w_s ∂_s, given as (symbol, weight) pairs."""
        total = Jet(self, function.order - 1, self.zero.terms[: self.counts[function.order - 1]])
        for symbol, weight in direction:
            if symbol.name in self._raised:
                total = total + weight * self._diff(function, symbol.name)
        return total

    def span(self) -> Span:
        """Empty span of vectors at the point."""
        return Span(MARGIN * self.resolution)

    def column(self, components: Sequence[Jet]) -> list[Any]:
        """Values of a vector field over its size nearby: where the point is uncertain, they are so by no more."""
        values = [e.terms[0] for e in components]
        slopes = (t for e in components for t in e.terms[1 : self.counts[min(e.order, 1)]])
        scale = mpmath.norm([*values, *slopes])
        return [value / scale for value in values] if scale > ZERO else [mpmath.mpf(0)] * len(values)

    def multiply(self, a: Jet, b: Jet) -> Jet:
        """Product, of the lower of both orders."""
        order = min(a.order, b.order)
        terms = [mpmath.mpf(0)] * self.counts[order]
        for i, x in enumerate(a.terms[: len(terms)]):
            if x:
                below = self.counts[order - self._degrees[i]]
                for place, y in zip(self._products[i], b.terms[:below], strict=False):
                    terms[place] += x * y
        return Jet(self, order, terms)

    def _diff(self, function: Jet, name: str) -> Jet:
        order = function.order - 1
        raised = self._raised[name][: self.counts[order]]
        return Jet(self, order, [exponent * function.terms[place] for place, exponent in raised])

    def _number(self, value: Any) -> Jet:
        return Jet(self, self.order, [mpmath.mpf(value)] + [mpmath.mpf(0)] * (self.counts[self.order] - 1))

    def _convert(self, e: sp.Expr) -> Jet:
        if e.is_Symbol:
            return self._number(self.values[e.name])
        if e.is_Add or e.is_Mul:
            first, *rest = map(self.convert, e.args)
            for other in rest:
                first = first + other if e.is_Add else first * other
            return first
        if e.is_number:
            return self._number(sp.lambdify((), e, "mpmath")())
        if e.is_Pow and e.exp.is_Integer and e.exp > 0:
            return self.convert(e.base) * self.convert(e.base ** (e.exp - 1))
        if e.is_Pow and e.exp.is_Rational:
            power = mpmath.mpf(int(e.exp.p)) / int(e.exp.q)
            return self._compose(e, lambda x: x**power, self._not_zero(e.base))
        if e.func in (sp.tan, sp.cot):
            sine, cosine = sp.sin(e.args[0]), sp.cos(e.args[0])
            return self.convert(sine / cosine if e.func is sp.tan else cosine / sine)
        if e.func is sp.atan2:  # as the angle from its value here, which is the atan of something small
            y, x = map(self.convert, e.args)
            c, s = self._number(x.terms[0]), self._number(y.terms[0])
            ahead = self._compose(e, lambda r: 1 / r, self._not_zero(e, c * x + s * y))
            angle = self._compose(e, mpmath.atan, (c * y - s * x) * ahead)
            return angle + self._number(mpmath.atan2(y.terms[0], x.terms[0]))
        singular = e.func in (sp.Abs, sp.sign, sp.log)
        argument = self._not_zero(e.args[0]) if singular else self.convert(e.args[0])
        return self._compose(e, getattr(mpmath, "fabs" if e.func is sp.Abs else e.func.__name__), argument)

    def _not_zero(self, expression: sp.Expr, value: Jet | None = None) -> Jet:
        """An expression, or its value, by which is divided or which has to stay away from zero for another reason."""
        jet = self.convert(expression) if value is None else value
        if abs(self.column([jet])[0]) <= MARGIN * self.resolution:
            raise PoleError(f"{expression} = 0"[:MESSAGE])
        return jet

    def _compose(self, e: sp.Expr, function: Callable[[Any], Any], inner: Jet) -> Jet:
        """f(x) = sum_r f^(r)(x0)/r! (x - x0)^r, the value of e."""
        start = inner.terms[0]
        coefficients = mpmath.taylor(function, start, inner.order)
        if not all(isinstance(c, mpmath.mpf) and mpmath.isfinite(c) for c in coefficients):
            raise PoleError(f"{e} is not real"[:MESSAGE])
        change = inner - self._number(start)
        result = self._number(coefficients[-1])
        for coefficient in reversed(coefficients[:-1]):
            result = result * change + self._number(coefficient)
        return result


class Jet:
    """A Taylor polynomial; immutable.

    Attributes:
        space: where it lives.
        order: of the highest terms that are known.
        terms: coefficients of the space's monomials up to that order.
    """

    __slots__ = ("order", "space", "terms")

    def __init__(self, space: Taylor, order: int, terms: list[Any]) -> None:
        self.space, self.order, self.terms = space, order, terms

    def __add__(self, other: Jet) -> Jet:
        terms = [a + b for a, b in zip(self.terms, other.terms, strict=False)]
        return Jet(self.space, min(self.order, other.order), terms)

    def __sub__(self, other: Jet) -> Jet:
        return self + (-other)

    def __neg__(self) -> Jet:
        return Jet(self.space, self.order, [-t for t in self.terms])

    def __mul__(self, other: Jet) -> Jet:
        return self.space.multiply(self, other)

    def __bool__(self) -> bool:
        return any(abs(t) > ZERO for t in self.terms)


class Span:
    """Span of vectors of length one or less.

    Args:
        tolerance: how far a vector must leave the span of those before it to count as independent.
    """

    def __init__(self, tolerance: Any) -> None:
        self.tolerance = tolerance
        self._basis: list[list[Any]] = []  # orthonormal

    @property
    def rank(self) -> int:
        """Dimension."""
        return len(self._basis)

    def __contains__(self, vector: Sequence[Any]) -> bool:
        return mpmath.norm(self._outside(vector)) <= self.tolerance

    def add(self, vector: Sequence[Any]) -> bool:
        """Enlarge the span by a vector; False if that is in it already."""
        outside = self._outside(vector)
        if (size := mpmath.norm(outside)) <= self.tolerance:
            return False
        self._basis.append([e / size for e in outside])
        return True

    def _outside(self, vector: Sequence[Any]) -> list[Any]:
        rest = list(vector)
        for unit in self._basis:
            along = mpmath.fdot(rest, unit)
            rest = [e - along * u for e, u in zip(rest, unit, strict=True)]
        return rest

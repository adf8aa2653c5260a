"""Arithmetic that names what it computes instead of multiplying it out.

The exact normal form of `algebra` grows beyond use for some mechanisms (a snake of three links). A
`Tape` answers to the same calls, so that the same derivation runs on it, and keeps every sum as a
named step of a program: short, with shared steps shared, and differentiated by the chain rule. It
does not cancel fractions, and sees zero in a weaker way: a sum is zero if its terms cancel at every
one of a few random points, as the terms of an identity between analytic functions do and others do not.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from fractions import Fraction
from typing import Any

import numpy as np
import sympy as sp

from mechanics.geometry.algebra import partials
from mechanics.geometry.compact import Product, nested_sum

__all__ = ["Tape", "Value"]

# Rounding of a sum of some thousand terms is below 1e-12 of their size; terms that do not cancel
# identically leave the order of their size.
CANCELS = 1e-10


class Value:
    """A product of functions and steps on a `Tape`; immutable.

    Attributes:
        tape: where the steps are.
        product: coefficient * prod(base**exponent), a base being a step, a function or a symbol.
        numbers: [p] values at the tape's sample points.
    """

    __slots__ = ("numbers", "product", "tape")

    def __init__(self, tape: Tape, product: Product, numbers: Any) -> None:
        self.tape, self.product, self.numbers = tape, product, numbers

    def __add__(self, other: Value) -> Value:
        return self.tape.add(self, other)

    def __sub__(self, other: Value) -> Value:
        return self.tape.add(self, -other)

    def __neg__(self) -> Value:
        return Value(self.tape, self.product * Product(Fraction(-1)), -self.numbers)

    def __mul__(self, other: Value) -> Value:
        if not (self and other):
            return self.tape.zero
        return Value(self.tape, self.product * other.product, self.numbers * other.numbers)

    def __truediv__(self, other: Value) -> Value:
        if not other:
            raise ZeroDivisionError("division by zero in a mechanism's expressions")
        return self * other**-1

    def __pow__(self, exponent: int | Fraction) -> Value:
        with np.errstate(all="ignore"):
            return Value(self.tape, self.product.power(Fraction(exponent)), self.numbers ** float(exponent))

    @property
    def size(self) -> int:
        """How long it is: number of factors."""
        return len(self.product.factors)

    def __bool__(self) -> bool:
        return bool(self.product.coefficient)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Value) and self.product == other.product

    def __hash__(self) -> int:
        return hash((self.product.coefficient, frozenset(self.product.factors.items())))


Direction = tuple[tuple[sp.Symbol, Value], ...]  # (symbol, weight) pairs


class Tape:
    """Steps of a program that computes with the functions in some expressions.

    Args:
        samples: symbol name -> [p] values at p points.
        fixed: symbols that do not change during a motion (parameters); sums of these alone are
            not made steps, because they are computed once.
    """

    def __init__(self, samples: Mapping[str, Any], fixed: frozenset[sp.Symbol]) -> None:
        self.samples = {name: np.asarray(values, dtype=float) for name, values in samples.items()}
        self._fixed = fixed
        self._terms: dict[sp.Symbol, tuple[Value, ...]] = {}  # step -> what it adds up
        self._known: dict[frozenset[Value], Value] = {}
        self._bases: dict[sp.Expr, Value] = {}  # steps, functions and symbols by themselves
        self._rates: dict[tuple[sp.Expr, Direction], Value] = {}
        self._functions: dict[sp.Expr, Any] = {}  # function or symbol -> NumPy function of the symbols
        ones = np.ones(len(next(iter(self.samples.values()))))
        self.one = Value(self, Product(), ones)
        self.zero = Value(self, Product(Fraction(0)), 0 * ones)

    # -- arithmetic ----------------------------------------------------------------------------

    def convert(self, expression: sp.Expr) -> Value:
        """Value of a SymPy expression."""
        e = sp.sympify(expression)
        if e.is_Rational:
            return Value(self, Product(Fraction(int(e.p), int(e.q))), float(e) * self.one.numbers)
        if e.is_Add:
            return sum(map(self.convert, e.args), self.zero)
        if e.is_Mul:
            return math.prod(map(self.convert, e.args), start=self.one)
        if e.is_Pow and e.exp.is_Rational and e.exp.q <= 2:
            base = self.convert(e.base)
            return (base if e.exp.q == 1 else self._named([base])) ** Fraction(int(e.exp.p), int(e.exp.q))
        if e not in self._bases:
            self._bases[e] = Value(self, Product(factors={e: Fraction(1)}), self._evaluate(e, self.samples))
        return self._bases[e]

    def add(self, a: Value, b: Value) -> Value:
        """Sum of two values; a sum on the left goes on growing rather than being named again."""
        if not (a and b):
            return a or b
        terms = self._added(a)
        for place, term in enumerate(terms):
            if term.product.factors == b.product.factors:
                coefficient = term.product.coefficient + b.product.coefficient
                both = Value(self, Product(coefficient, b.product.factors), term.numbers + b.numbers)
                terms = [*terms[:place], *([both] if coefficient else []), *terms[place + 1 :]]
                break
        else:
            terms = [*terms, b]
        with np.errstate(all="ignore"):
            size = sum((abs(term.numbers) for term in terms), 0 * self.one.numbers)
            total = abs(sum((term.numbers for term in terms), 0 * self.one.numbers))
        if not terms or (total <= CANCELS * size).all():
            return self.zero
        return terms[0] if len(terms) == 1 else self._named(terms)

    def _added(self, value: Value) -> list[Value]:
        """Terms of a value that is one step and nothing more, else the value alone."""
        if value.product.coefficient == 1 and len(value.product.factors) == 1:
            ((base, exponent),) = value.product.factors.items()
            if exponent == 1 and base in self._terms:
                return list(self._terms[base])
        return [value]

    def _named(self, terms: Sequence[Value]) -> Value:
        """The step that adds up some terms."""
        key = frozenset(terms)
        if key not in self._known:
            with np.errstate(all="ignore"):
                numbers = sum((term.numbers for term in terms), 0 * self.one.numbers)
            base = sp.Symbol(f"_d{len(self._terms)}")
            if all(factor.free_symbols <= self._fixed for term in terms for factor in term.product.factors):
                base = nested_sum([term.product for term in terms])
            else:
                self._terms[base] = tuple(terms)
            self._known[key] = self._bases[base] = Value(self, Product(factors={base: Fraction(1)}), numbers)
        return self._known[key]

    def primitive(self, field: Sequence[Value]) -> tuple[Value, list[Value]]:
        """(g, N) of a vector field g N: common factors are not sought."""
        return self.one, list(field)

    # -- calculus ------------------------------------------------------------------------------

    def along(self, value: Value, direction: Direction) -> Value:
        """Derivative along sum_s w_s ∂_s, by the product rule and the chain rule."""
        total = self.zero
        for base, exponent in value.product.factors.items():
            if rate := self._rate(base, direction):
                total = total + self.convert(sp.Rational(exponent)) * value / self._bases[base] * rate
        return total

    def _rate(self, base: sp.Expr, direction: Direction) -> Value:
        key = (base, direction)
        if key not in self._rates:
            rate = self.zero
            if base in self._terms:
                for term in self._terms[base]:
                    rate = rate + self.along(term, direction)
            elif base.is_Symbol:
                rate = dict(direction).get(base, rate)
            elif not base.free_symbols <= self._fixed:
                for partial, argument in zip(partials(base), base.args, strict=True):
                    if change := self.along(self.convert(argument), direction):
                        rate = rate + self.convert(partial) * change
            self._rates[key] = rate
        return self._rates[key]

    # -- numbers -------------------------------------------------------------------------------

    def values(self, value: Value, points: Mapping[str, Any] | None = None) -> Any:
        """Values [p] at points (symbol name -> [p]), by default at the sample points."""
        return value.numbers if points is None else self._product(value, points, {})

    def _product(self, value: Value, points: Mapping[str, Any], done: dict[sp.Expr, Any]) -> Any:
        result = float(value.product.coefficient) * np.ones(np.shape(next(iter(points.values()))))
        with np.errstate(all="ignore"):
            for base, exponent in value.product.factors.items():
                result = result * self._factor(base, points, done) ** float(exponent)
        return result

    def _factor(self, base: sp.Expr, points: Mapping[str, Any], done: dict[sp.Expr, Any]) -> Any:
        if base not in done:
            if base in self._terms:
                done[base] = sum(self._product(term, points, done) for term in self._terms[base])
            else:
                done[base] = self._evaluate(base, points)
        return done[base]

    def _evaluate(self, expression: sp.Expr, points: Mapping[str, Any]) -> Any:
        if expression not in self._functions:
            symbols = [sp.Symbol(name) for name in self.samples]
            self._functions[expression] = sp.lambdify(symbols, expression, "numpy")
        with np.errstate(all="ignore"):
            values = self._functions[expression](*(points[name] for name in self.samples))
            return values * np.ones(np.shape(next(iter(points.values()))))

    # -- writing -------------------------------------------------------------------------------

    def product(self, value: Value) -> Product:
        """What is multiplied, in terms of steps."""
        return value.product

    def definitions(self) -> dict[sp.Symbol, sp.Expr]:
        """Step -> its expression in terms of steps before it."""
        return {step: nested_sum([term.product for term in terms]) for step, terms in self._terms.items()}

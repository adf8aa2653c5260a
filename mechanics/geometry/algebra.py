"""Exact arithmetic with the functions that occur in equations of motion.

Entries of inertia tensors and vector fields are rational functions of parameters, coordinates,
sines, cosines and square roots. As a field that is the rational functions in generators
(one for each parameter, cosine, sine, root) modulo sin^2 = 1 - cos^2 and root^2 = radicand. An
`Element` is kept in the normal form N/D with N linear in every sine and root, D free of them, and no
common factor, so that equal elements are equal objects and zero is seen at once. This is what makes
the derivation take a fraction of a second where `trigsimp` needs minutes. Long fractions are left
uncancelled (see `polynomials`): zero is still seen, equality is not. Where products would become
very long, `TooLong` says so, and `tape` has another arithmetic.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import sympy as sp
from sympy.polys.domains import ZZ
from sympy.polys.rings import PolyElement, PolyRing

from mechanics.geometry.polynomials import cancel, factor_list, lower, split_parity

__all__ = ["Algebra", "Element", "TooLong", "partials"]

# Products of terms that a derivation may multiply out in all. The snakeboard takes a hundred, the
# roller racer six thousand; one with a massive link takes 120 thousand and a second, and ends with
# a third of the operations that it has otherwise; a snake of three links would take minutes.
WORK_LIMIT = 200_000

# Longest denominator that is made free of sines and roots (its length is squared by that).
CONJUGATE_LIMIT = 8

# Largest multiple or fraction of an angle whose sine is written in the angle's own: sin(1.37 x) would be a
# polynomial of degree 137 in sin(x/100).
MULTIPLES = 16

# Derivatives of the functions that are not rational in sines and cosines: f(args) -> df/d(arg) for
# each argument. SymPy's own rules for abs and sign speak of complex arguments.
_PARTIALS: dict[Any, Any] = {
    sp.exp: lambda x: (sp.exp(x),),
    sp.log: lambda x: (1 / x,),
    sp.asin: lambda x: (1 / sp.sqrt(1 - x**2),),
    sp.acos: lambda x: (-1 / sp.sqrt(1 - x**2),),
    sp.atan: lambda x: (1 / (1 + x**2),),
    sp.sinh: lambda x: (sp.cosh(x),),
    sp.cosh: lambda x: (sp.sinh(x),),
    sp.tanh: lambda x: (1 - sp.tanh(x) ** 2,),
    sp.Abs: lambda x: (sp.sign(x),),
    sp.sign: lambda x: (sp.S.Zero,),
    sp.atan2: lambda y, x: (x / (x**2 + y**2), -y / (x**2 + y**2)),
}


class TooLong(ArithmeticError):
    """The products of a derivation have too many terms to be multiplied out."""


class Element:
    """An element N/D of an `Algebra`, in normal form and immutable."""

    __slots__ = ("algebra", "den", "num")

    def __init__(self, algebra: Algebra, num: PolyElement, den: PolyElement) -> None:
        self.algebra, self.num, self.den = algebra, num, den

    def __add__(self, other: Element) -> Element:
        if self.den == other.den:
            return self.algebra.ratio(self.num + other.num, self.den)
        self.algebra.check_length((self.num, other.den), (other.num, self.den), (self.den, other.den))
        return self.algebra.ratio(self.num * other.den + other.num * self.den, self.den * other.den)

    def __sub__(self, other: Element) -> Element:
        return self + (-other)

    def __neg__(self) -> Element:
        return Element(self.algebra, -self.num, self.den)

    def __mul__(self, other: Element) -> Element:
        if not self.num or not other.num:
            return self.algebra.zero
        self.algebra.check_length((self.num, other.num), (self.den, other.den))
        return self.algebra.ratio(self.num * other.num, self.den * other.den)

    def __truediv__(self, other: Element) -> Element:
        self.algebra.check_length((self.num, other.den), (self.den, other.num))
        return self.algebra.ratio(self.num * other.den, self.den * other.num)

    def __pow__(self, exponent: int) -> Element:
        if exponent < 0:
            return (self.algebra.one / self) ** -exponent
        return self.algebra.ratio(self.num**exponent, self.den**exponent)

    def __bool__(self) -> bool:
        return bool(self.num)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Element) and self.num == other.num and self.den == other.den

    def __hash__(self) -> int:
        return hash((self.num, self.den))

    @property
    def size(self) -> int:
        """How long it is: number of terms; 0 for a number."""
        return 0 if self.num.is_ground and self.den.is_ground else len(self.num) + len(self.den)

    @property
    def is_polynomial(self) -> bool:
        """True if the denominator is 1."""
        return self.den == 1


class Algebra:
    """The field that contains some expressions and their derivatives.

    Args:
        expressions: SymPy expressions that will be converted later, over plain symbols.
        samples: symbol name -> [p] values at p points, at which the expressions are real. A factor
            of a radicand that is positive at all of them gets a root of its own, so that
            sqrt(a/b) = sqrt(a)/sqrt(b).
    """

    def __init__(self, expressions: Iterable[sp.Expr], samples: Mapping[str, Any]) -> None:
        self.samples = {name: np.asarray(values, dtype=float) for name, values in samples.items()}
        self.work = 0  # what was multiplied out so far
        self._sampled: dict[sp.Expr, Any] = {}  # generator -> its values at the sample points
        self._functions: dict[sp.Expr, Any] = {}  # generator -> NumPy function of the symbols
        self._units: dict[sp.Expr, int] = {}  # argument of sines -> common denominator of its multiples
        leaves: dict[sp.Expr, None] = {}
        radicands: dict[sp.Expr, None] = {}
        self._collect(list(expressions), leaves, radicands)
        # Multiples of pi are numbers, not angles.
        self.angles = {a: (sp.cos(a / unit), sp.sin(a / unit)) for a, unit in self._units.items() if a is not sp.pi}
        self.generators = [*leaves, *(c for c, _ in self.angles.values()), *(s for _, s in self.angles.values())]
        self.roots: dict[PolyElement, sp.Expr] = {}  # radicand -> generator
        self._extend()
        for radicand in sorted(radicands, key=sp.count_ops):  # an inner root is shorter than its outer one
            self._declare_root(self.convert(radicand))

    # -- generators ----------------------------------------------------------------------------

    def _collect(self, pending: list[sp.Expr], leaves: dict[sp.Expr, None], radicands: dict[sp.Expr, None]) -> None:
        """Find symbols, angles, roots and other functions in the expressions and their derivatives."""
        seen = set()
        while pending:
            e = pending.pop()
            if e in seen:
                continue
            seen.add(e)
            if e.is_Rational:
                continue
            if e.func in (sp.sin, sp.cos, sp.tan):
                for term in sp.Add.make_args(sp.expand(e.args[0])):
                    factor, core = _multiple(term)
                    self._units[core] = math.lcm(self._units.get(core, 1), factor.q)
                    if core is sp.pi:
                        pending.extend((sp.cos(term), sp.sin(term), sp.cos(core / self._units[core])))
                    elif not core.is_Symbol:
                        pending.extend((core, *(sp.diff(core, s) for s in core.free_symbols)))
            elif e.is_Add or e.is_Mul:
                pending.extend(e.args)
            elif e.is_Pow and e.exp.is_Rational and e.exp.q <= 2:
                pending.append(e.base)
                if e.exp.q == 2:
                    radicands[e.base] = None
            else:
                leaves[e] = None
                if e.args:
                    pending.extend((*e.args, *partials(e)))

    def _extend(self) -> None:
        """Make the ring anew after a generator was added."""
        self.ring = PolyRing(self.generators, ZZ)
        self._gens = dict(zip(self.generators, self.ring.gens, strict=True))
        self.one = Element(self, self.ring.one, self.ring.one)
        self.zero = Element(self, self.ring.zero, self.ring.one)
        self.roots = {radicand.set_ring(self.ring): g for radicand, g in self.roots.items()}
        self.radicands = {g: radicand for radicand, g in self.roots.items()}
        self.circles = [(self._gens[c], self._gens[s]) for c, s in self.angles.values()]
        # (index of a generator, its square), outermost root first, for `_reduce`
        self._squares = [(self.ring.index(self._gens[g]), radicand) for radicand, g in reversed(self.roots.items())]
        self._squares += [(self.ring.index(s), 1 - c**2) for c, s in self.circles]
        self._converted: dict[sp.Expr, Element] = {}
        self._rates: dict[tuple[sp.Expr, sp.Symbol], Element] = {}

    def _declare_root(self, radicand: Element) -> None:
        """Add the generators whose product is the root of `radicand`."""
        for factor, _ in self._split_radicand(radicand):
            if factor not in self.roots:
                # A name of its own: sqrt of an expression could simplify to something else.
                generator = sp.Symbol(f"root({factor})")
                self.roots[factor] = generator
                self.generators.append(generator)
                self._extend()

    def _split_radicand(self, radicand: Element) -> list[tuple[PolyElement, int]]:
        """Write a radicand as a product of powers of positive factors, and at most one more factor."""
        content, factors = factor_list(radicand.num)
        below, divisors = factor_list(radicand.den)
        rational = sp.Rational(int(content), int(below))
        positive: dict[PolyElement, int] = {}
        rest = self.ring.one
        sign = 1
        for factor, power in [*factors, *((f, -p) for f, p in divisors)]:
            side = self.sign(factor)
            if side:
                positive[factor * side] = power
                sign *= side ** abs(power)
            else:
                rest *= factor ** abs(power)
                if power < 0:  # a/b = a b / b^2, with |b| outside: only even powers of |b| stay exact
                    positive[factor**2] = positive.get(factor**2, 0) - abs(power)
        rational *= sign
        if rational < 0 or rest != 1:
            rest *= -1 if rational < 0 else 1
            rational = abs(rational)
        parts = [*positive.items()]
        parts += [(self.ring(p), k) for p, k in sp.factorint(rational.p).items() if p > 1]
        parts += [(self.ring(p), -k) for p, k in sp.factorint(rational.q).items() if p > 1]
        if rest != 1:
            parts.append((rest, 1))
        return [(f.set_ring(self.ring), k) for f, k in parts]

    def sign(self, poly: PolyElement) -> int:
        """1 or -1 if `poly` has that sign at every sample point, else 0."""
        values = self._values(poly)
        return 1 if (values > 0).all() else -1 if (values < 0).all() else 0

    def values(self, element: Element, points: Mapping[str, Any] | None = None) -> Any:
        """Values [p] of an element at points (symbol name -> [p]), by default at the sample points."""
        with np.errstate(all="ignore"):
            return self._values(element.num, points) / self._values(element.den, points)

    def _values(self, poly: PolyElement, points: Mapping[str, Any] | None = None) -> Any:
        """Values [p] of a polynomial."""
        total = np.zeros(np.shape(next(iter((points or self.samples).values()))))
        for monomial, coefficient in poly.terms():
            term = float(coefficient)
            for generator, exponent in zip(self.generators, monomial, strict=True):
                if exponent:
                    term = term * self._generator_values(generator, points) ** exponent
            total = total + term
        return total

    def _generator_values(self, generator: sp.Expr, points: Mapping[str, Any] | None) -> Any:
        if points is None:
            if generator not in self._sampled:
                self._sampled[generator] = self._generator_values(generator, self.samples)
            return self._sampled[generator]
        with np.errstate(all="ignore"):
            if generator in self.radicands:
                return np.sqrt(self._values(self.radicands[generator], points))
            if generator not in self._functions:
                symbols = [sp.Symbol(name) for name in self.samples]
                self._functions[generator] = sp.lambdify(symbols, generator, "numpy")
            return self._functions[generator](*(points[name] for name in self.samples))

    def check_length(self, *pairs: tuple[PolyElement, PolyElement]) -> None:
        """Refuse products that would take long to multiply out."""
        self.work += sum(len(a) * len(b) for a, b in pairs)
        if self.work > WORK_LIMIT:
            raise TooLong

    # -- normal form ---------------------------------------------------------------------------

    def ratio(self, num: PolyElement, den: PolyElement) -> Element:
        """Normal form of num/den."""
        num = self._reduce(num)
        if den == 1:
            return Element(self, num, den)
        den = self._reduce(den)
        if not den:
            raise ZeroDivisionError("division by zero in a mechanism's expressions")
        for index, square in self._squares:
            even, odd = split_parity(den, index)
            if not odd or len(den) > CONJUGATE_LIMIT:
                continue
            g = self.ring.gens[index]
            if even:
                num, den = self._reduce(num * (even - g * odd)), self._reduce(even**2 - square * odd**2)
            else:
                num, den = self._reduce(num * g), self._reduce(odd * square)
        num, den = cancel(num, den)
        if den.LC < 0:
            num, den = -num, -den
        return Element(self, num, den)

    def _reduce(self, poly: PolyElement) -> PolyElement:
        """Remainder that is linear in every sine and root."""
        for index, square in self._squares:
            poly = lower(poly, index, square)
        return poly

    def without_square(self, poly: PolyElement, cosine: PolyElement, sine: PolyElement) -> PolyElement:
        """Form of `poly` that is linear in the cosine and has powers of the sine instead."""
        return lower(poly, self.ring.index(cosine), 1 - sine**2)

    def convert(self, expression: sp.Expr) -> Element:
        """Element that a SymPy expression stands for."""
        e = sp.sympify(expression)
        if e not in self._converted:
            self._converted[e] = self._convert(e)
        return self._converted[e]

    def _convert(self, e: sp.Expr) -> Element:
        if e in self._gens:
            return Element(self, self._gens[e], self.ring.one)
        if e.is_Rational:
            return Element(self, self.ring(int(e.p)), self.ring(int(e.q)))
        if e.is_Add:
            return sum(map(self.convert, e.args), self.zero)
        if e.is_Mul:
            return math.prod(map(self.convert, e.args), start=self.one)
        if e.is_Pow and e.exp.is_Integer:
            return self.convert(e.base) ** int(e.exp)
        if e.is_Pow and e.exp.is_Rational and e.exp.q == 2:
            return self._root(self.convert(e.base)) ** int(2 * e.exp)
        if e.func in (sp.sin, sp.cos, sp.tan):
            cosine, sine = self._circle(e.args[0])
            return cosine if e.func is sp.cos else sine if e.func is sp.sin else sine / cosine
        raise ValueError(f"{e} is not made of rational functions, sines, cosines and square roots")

    def _root(self, radicand: Element) -> Element:
        root = self.one
        for factor, power in self._split_radicand(radicand):
            root = root * Element(self, self._gens[self.roots[factor]], self.ring.one) ** power
        return root

    def _circle(self, argument: sp.Expr) -> tuple[Element, Element]:
        """(cos, sin) of a sum of multiples of angles, by the addition theorems."""
        cosine, sine = self.one, self.zero
        for term in sp.Add.make_args(sp.expand(argument)):
            factor, core = _multiple(term)
            count = int(factor * self._units[core])
            c, s = (self.convert(f(core / self._units[core])) for f in (sp.cos, sp.sin))
            if count < 0:
                s = -s
            for _ in range(abs(count)):
                cosine, sine = cosine * c - sine * s, sine * c + cosine * s
        return cosine, sine

    def primitive(self, field: Sequence[Element]) -> tuple[Element, list[Element]]:
        """Function g and polynomial components N without common factor of a vector field X = g N."""
        ring = self.ring
        entries = [e for e in field if e]
        den = ring.one
        for e in entries:
            den = den.lcm(e.den)
        nums = [e.num * den.exquo(e.den) for e in entries]
        gcd = ring.zero
        for num in nums:
            gcd = gcd.gcd(num)
        rest = iter(nums)
        return self.ratio(gcd, den), [Element(self, next(rest).exquo(gcd), ring.one) if e else self.zero for e in field]

    # -- calculus ------------------------------------------------------------------------------

    def along(self, element: Element, direction: Iterable[tuple[sp.Symbol, Element]]) -> Element:
        """Derivative of an element along sum_s w_s ∂_s, given as (symbol, weight) pairs."""
        total = self.zero
        for symbol, weight in direction:
            if rate := self.diff(element, symbol):
                total = total + weight * rate
        return total

    def diff(self, element: Element, symbol: sp.Symbol) -> Element:
        """Partial derivative of an element with respect to a symbol."""
        num = self._diff(element.num, symbol)
        if element.is_polynomial:
            return num
        den = Element(self, element.den, self.ring.one)
        return (num - element * self._diff(element.den, symbol)) / den

    def _diff(self, poly: PolyElement, symbol: sp.Symbol) -> Element:
        total = self.zero
        for generator, degree in zip(self.generators, poly.degrees() if poly else (), strict=False):
            if degree > 0 and (rate := self._rate(generator, symbol)):
                total = total + Element(self, poly.diff(self._gens[generator]), self.ring.one) * rate
        return total

    def _rate(self, generator: sp.Expr, symbol: sp.Symbol) -> Element:
        """Derivative of a generator."""
        key = (generator, symbol)
        if key not in self._rates:
            self._rates[key] = self._derive(generator, symbol)
        return self._rates[key]

    def _derive(self, g: sp.Expr, symbol: sp.Symbol) -> Element:
        for radicand, root in self.roots.items():
            if root == g:
                rate = self._diff(radicand, symbol)
                return rate * self.convert(g) / Element(self, 2 * radicand, self.ring.one) if rate else rate
        for core, (c, s) in self.angles.items():
            if g in (c, s):
                rate = self.convert(sp.diff(core, symbol)) / self.convert(sp.Integer(self._units[core]))
                return -self.convert(s) * rate if g == c else self.convert(c) * rate
        if g.is_Symbol or not g.args:
            return self.one if g == symbol else self.zero
        total = self.zero
        for partial, argument in zip(partials(g), g.args, strict=True):
            total = total + self.convert(partial) * self.diff(self.convert(argument), symbol)
        return total


def _multiple(term: sp.Expr) -> tuple[sp.Rational, sp.Expr]:
    """(factor, angle) of a term in the argument of a sine; a multiple that is long to expand is an angle itself."""
    factor, core = term.as_coeff_Mul()
    if factor.is_Rational and max(abs(factor.p), factor.q) <= MULTIPLES:
        return factor, core
    return (sp.S.NegativeOne, -term) if factor < 0 else (sp.S.One, term)


def partials(function: sp.Expr) -> tuple[sp.Expr, ...]:
    """Derivatives of f(args) with respect to each argument."""
    if function.func in (sp.sin, sp.cos, sp.tan):
        return (function.fdiff(),)
    if function.func not in _PARTIALS:
        raise ValueError(f"no derivative is known for {function}")
    return tuple(_PARTIALS[function.func](*function.args))

"""From normal form to short expressions: products of named factors, nested sums.

The normal form of `algebra` is expanded, which decides equality but is long. Here an element is
written as a product of powers of irreducible factors. A factor that the mechanism's author wrote
somewhere (a shorthand such as f_1, an entry of a vector field) is printed as the author wrote it,
any other in the shorter of its forms with sin^2 or cos^2 eliminated.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from itertools import product as cartesian
from typing import Any

import sympy as sp
from sympy.polys.rings import PolyElement

from mechanics.geometry.algebra import Algebra, Element
from mechanics.geometry.polynomials import exact_quotient, factor_list

__all__ = ["Product", "Writer", "cost", "nested_sum"]

# A subexpression of parameters alone is computed once, before the first step.
PARAMETER_WEIGHT = Fraction(1, 16)

# Longest polynomial, in terms, that is factored; a longer one is printed as one factor.
FACTOR_LIMIT = 100


@dataclass(frozen=True)
class Product:
    """coefficient * prod base**exponent, with bases that share no factor.

    Attributes:
        coefficient: rational number.
        factors: base -> integer or half-integer exponent, not zero. Python's fractions, because
            comparing SymPy's numbers costs more than the rest of the derivation.
    """

    coefficient: Fraction = Fraction(1)
    factors: dict[sp.Expr, Fraction] = field(default_factory=dict)

    def __mul__(self, other: Product) -> Product:
        factors = dict(self.factors)
        for base, exponent in other.factors.items():
            factors[base] = factors.get(base, 0) + exponent
        return Product(self.coefficient * other.coefficient, {b: e for b, e in factors.items() if e})

    def power(self, exponent: Fraction) -> Product:
        """Power of the product; a coefficient other than 1 takes integer exponents only."""
        coefficient = self.coefficient ** int(exponent) if exponent.denominator == 1 else self.coefficient
        return Product(coefficient, {base: e * exponent for base, e in self.factors.items()})

    def expression(self) -> sp.Expr:
        """SymPy expression of the product."""
        if not self.coefficient:
            return sp.S.Zero
        coefficient = sp.Rational(self.coefficient)
        powers = [base ** sp.Rational(exponent) for base, exponent in self.factors.items()]
        if coefficient != 1 and len(powers) == 1 and powers[0].is_Add:
            # SymPy would multiply the number into the sum and hide the factor.
            return sp.Mul(coefficient, powers[0], evaluate=False)
        return sp.Mul(coefficient, *powers)


class Writer:
    """Writes elements of an algebra as compact SymPy expressions.

    Args:
        algebra: where the elements live.
        definitions: expressions whose irreducible sums are printed as they stand.
        entries: expressions whose irreducible sums are printed as they stand where that is short.
        varying: symbols that change during a motion (coordinates), which tell the cost of a form.
    """

    def __init__(
        self,
        algebra: Algebra,
        definitions: Iterable[sp.Expr],
        entries: Iterable[sp.Expr],
        varying: Iterable[sp.Symbol],
    ) -> None:
        self.algebra = algebra
        self.varying = frozenset(varying)
        self._factored: dict[PolyElement, tuple[int, list[tuple[PolyElement, int]]]] = {}
        self._forms: dict[PolyElement, tuple[int, sp.Expr]] = {}  # primitive factor -> sign, expression
        for expressions, named in ((definitions, True), (entries, False)):
            for node in (node for expression in expressions for node in _sums(expression)):
                self._learn(node, named)
        for radicand in algebra.roots:  # positive: print it, not its negative
            key = radicand if radicand.LC > 0 else -radicand
            if not radicand.is_ground:
                sign, form = self._forms.get(key) or (1, self._shortest(key))
                flip = sign * (1 if key == radicand else -1)
                self._forms[key] = (sign * flip, form if flip > 0 else -form)

    def _learn(self, node: sp.Expr, named: bool) -> None:
        """Print the irreducible polynomial `node` as it stands, but for an overall sign.

        A sum without a name must be as short as what this class would write.
        """
        if all(term.as_coeff_Mul()[0] < 0 for term in node.args):
            node = -node
        element = self.algebra.convert(node)
        if not element.is_polynomial or not element:
            return
        content, factors = factor_list(element.num)
        if len(factors) != 1 or factors[0][1] != 1 or abs(content) != 1 or factors[0][0] in self._forms:
            return
        if not named:
            shortest = self._shortest(factors[0][0])
            if cost(shortest, self.varying) < cost(node, self.varying):
                return
        self._forms[factors[0][0]] = (int(content), node)

    def product(self, element: Element) -> Product:
        """Element as a product of irreducible factors."""
        if not element:
            return Product(Fraction(0))
        return self._product(element.num, 1) * self._product(element.den, -1)

    def expression(self, element: Element) -> sp.Expr:
        """Element as a compact SymPy expression."""
        return self.product(element).expression()

    def _product(self, poly: PolyElement, power: int) -> Product:
        content, factors = self._factor(poly)
        result = Product(Fraction(content) ** power)
        for factor, multiplicity in factors:
            result = result * self._base(factor, Fraction(power * multiplicity))
        return result

    def _base(self, factor: PolyElement, exponent: Fraction) -> Product:
        """Power of an irreducible factor; the root of a radicand is a half power of the radicand."""
        whole = exponent.denominator == 1
        if factor.LC < 0:
            # Half powers are of radicands only, whose printed form is the positive one of the two.
            return Product(Fraction(-1) ** int(exponent) if whole else Fraction(1)) * self._base(-factor, exponent)
        # A generator; under a root, the sign of its form matters.
        if len(factor) == 1 and sum(factor.LM) == 1 and (whole or factor not in self._forms):
            generator = self.algebra.generators[next(iter(factor)).index(1)]
            if generator in self.algebra.radicands:
                return self._base(self.algebra.radicands[generator], exponent / 2)
            return Product(factors={generator: exponent})
        if factor not in self._forms:
            sign = self.algebra.sign(factor) or 1
            self._forms[factor] = (sign, self._shortest(factor * sign))
        sign, form = self._forms[factor]
        if form.is_Integer and whole:
            return Product(Fraction(int(form)) ** int(exponent))
        return Product(Fraction(sign) ** int(exponent) if whole else Fraction(1), {form: exponent})

    def _factor(self, poly: PolyElement) -> tuple[int, list[tuple[PolyElement, int]]]:
        """Content and irreducible factors; 1 - cos^2 is counted as sin^2."""
        if poly in self._factored:
            return self._factored[poly]
        gens = self.algebra.ring.gens
        monomial = tuple(map(min, zip(*poly, strict=True)))
        content, rest = poly.quo_term((monomial, poly.ring.domain.one)).primitive()
        powers = {g: e for g, e in zip(gens, monomial, strict=True) if e}
        if rest.LC < 0:
            content, rest = -content, -rest
        for known in self._forms:
            while len(rest) > 1 and (quotient := exact_quotient(rest, known)) is not None:
                powers[known], rest = powers.get(known, 0) + 1, quotient
        if len(rest) > FACTOR_LIMIT:
            powers[rest] = powers.get(rest, 0) + 1
        elif len(rest) > 1:
            factor_content, factors = factor_list(rest)
            content *= factor_content
            for factor, power in factors:
                powers[factor] = powers.get(factor, 0) + power
        else:
            content *= rest.LC
            for g, e in zip(gens, rest.LM, strict=True):
                if e:
                    powers[g] = powers.get(g, 0) + e
        for cosine, sine in self.algebra.circles:
            both = min(powers.get(cosine - 1, 0), powers.get(cosine + 1, 0))
            if both:
                content *= (-1) ** both
                powers[sine] = powers.get(sine, 0) + 2 * both
                for factor in (cosine - 1, cosine + 1):
                    powers[factor] -= both
        self._factored[poly] = (int(content), [(f, p) for f, p in powers.items() if p])
        return self._factored[poly]

    def _shortest(self, factor: PolyElement) -> sp.Expr:
        """Cheapest nested form of an irreducible polynomial, over the choices of eliminated squares."""
        if factor.is_ground:
            return sp.Integer(int(factor.LC))
        circles = [(c, s) for c, s in self.algebra.circles if factor.degree(c) > 1]
        circles = circles[:3] if len(factor) <= FACTOR_LIMIT // 2 else []
        forms = []
        for chosen in cartesian((False, True), repeat=len(circles)):
            poly = factor
            for (cosine, sine), swap in zip(circles, chosen, strict=True):
                if swap:
                    poly = self.algebra.without_square(poly, cosine, sine)
            forms.append(self._nest(poly))
        return min(forms, key=lambda form: cost(form, self.varying))

    def _nest(self, poly: PolyElement) -> sp.Expr:
        """Polynomial in the varying generators with nested sums, its coefficients nested too."""
        fixed = [not (g.free_symbols & self.varying) and g not in self.algebra.radicands
                 for g in self.algebra.generators]  # fmt: skip
        groups: dict[tuple[int, ...], list[Product]] = defaultdict(list)
        for monomial, coefficient in poly.terms():
            outer = tuple(0 if f else e for f, e in zip(fixed, monomial, strict=True))
            inner = tuple(e if f else 0 for f, e in zip(fixed, monomial, strict=True))
            groups[outer].append(Product(Fraction(int(coefficient))) * self._monomial(inner))
        terms = []
        for outer, inner_terms in groups.items():
            coefficient = split(nested_sum(inner_terms, self.varying))
            terms.append(coefficient * self._monomial(outer))
        return nested_sum(terms, self.varying)

    def _monomial(self, exponents: Sequence[int]) -> Product:
        result = Product()
        for generator, exponent in zip(self.algebra.generators, exponents, strict=True):
            if exponent and generator in self.algebra.radicands:
                result = result * self._base(self.algebra.radicands[generator], Fraction(exponent, 2))
            elif exponent:
                result = result * Product(factors={generator: Fraction(exponent)})
        return result


def _sums(expression: sp.Expr) -> Iterator[sp.Expr]:
    """Sums in an expression, outermost first; not those inside functions."""
    if expression.is_Add:
        yield expression
    if expression.is_Add or expression.is_Mul or expression.is_Pow:
        for argument in expression.args:
            yield from _sums(argument)


def split(expression: sp.Expr) -> Product:
    """Product of the factors that an expression shows."""
    coefficient, rest = expression.as_coeff_Mul()
    result = Product(Fraction(int(coefficient.p), int(coefficient.q)))
    for term in sp.Mul.make_args(rest):
        base, exponent = term.as_base_exp()
        if not (exponent.is_Rational and exponent.q <= 2):
            base, exponent = term, sp.S.One
        if base != 1:
            result = result * Product(factors={base: Fraction(int(exponent.p), int(exponent.q))})
    return result


def nested_sum(terms: Iterable[Product], varying: Iterable[sp.Symbol] = ()) -> sp.Expr:
    """Sum of products with common factors taken out, again and again (multivariate Horner)."""
    return _nested([term for term in terms if term.coefficient], frozenset(varying)).expression()


def _nested(terms: Sequence[Product], varying: frozenset[Any]) -> Product:
    if not terms:
        return Product(Fraction(0))
    common = _common(terms)
    rest = [_divide(term, common) for term in terms]
    if len(rest) == 1:
        return common * rest[0]
    shared = _most_shared(rest, varying)
    if shared is None:
        total = sp.Add(*(term.expression() for term in rest))
        return common * split(total)
    base, exponent = shared
    factor = Product(factors={base: exponent})
    inside = [t for t in rest if _shares(t, base, exponent)]
    outside = [t for t in rest if not _shares(t, base, exponent)]
    # `_nested` of the rest as one term of a shorter sum
    group = factor * _nested([_divide(t, factor) for t in inside], varying)
    return common * _nested([group, *outside], varying)


def _common(terms: Sequence[Product]) -> Product:
    """Factors and positive number that all terms share."""
    numbers = [t.coefficient for t in terms]
    number = Fraction(math.gcd(*(n.numerator for n in numbers)), math.lcm(*(n.denominator for n in numbers)))
    if all(n < 0 for n in numbers):
        number = -number
    factors: dict[sp.Expr, Fraction] = {}
    for base in terms[0].factors:
        exponents = [t.factors.get(base, Fraction(0)) for t in terms]
        if all(e > 0 for e in exponents):
            factors[base] = min(exponents)
        elif all(e < 0 for e in exponents):
            factors[base] = max(exponents)
    return Product(number, factors)


def _divide(term: Product, by: Product) -> Product:
    return term * Product(1 / by.coefficient, {b: -e for b, e in by.factors.items()})


def _shares(term: Product, base: sp.Expr, exponent: Fraction) -> bool:
    own = term.factors.get(base, Fraction(0))
    return own >= exponent > 0 or own <= exponent < 0


def _most_shared(terms: Sequence[Product], varying: frozenset[Any]) -> tuple[sp.Expr, Fraction] | None:
    """Factor whose extraction saves most: shared by at least two terms, dear to compute."""
    best: tuple[Any, ...] | None = None
    for base in dict.fromkeys(b for t in terms for b in t.factors):
        for sign in (1, -1):
            exponents = [e for t in terms if (e := t.factors.get(base, 0)) * sign > 0]
            if len(exponents) < 2 or len(exponents) == len(terms):
                continue
            weight = (len(exponents) - 1) * (1 if base.free_symbols & varying or not varying else PARAMETER_WEIGHT)
            exponent = Fraction(sign * min(abs(Fraction(e)) for e in exponents))
            if best is None or weight > best[0]:
                best = (weight, base, exponent)
    return None if best is None else (best[1], best[2])


def cost(expression: sp.Expr, varying: Iterable[sp.Symbol]) -> Any:
    """Operations of an expression, those on parameters alone counted little."""
    varying = frozenset(varying)

    def visit(e: sp.Expr) -> Any:
        if not e.args:
            return 0
        if not e.free_symbols & varying:
            return int(sp.count_ops(e)) * PARAMETER_WEIGHT
        if e.is_Add or e.is_Mul:
            moving = [a for a in e.args if a.free_symbols & varying]
            own = len(moving) - 1 + (len(moving) < len(e.args))
        else:
            own = 1
        return own + sum(visit(a) for a in e.args)

    return visit(expression)

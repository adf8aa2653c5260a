"""Polynomials over the integers: what SymPy's rings lack, or take long for."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Sequence
from heapq import heapify, heappop, heappush
from operator import add, ge, neg, sub

import numpy as np
from sympy.polys.domains import ZZ
from sympy.polys.rings import PolyElement

__all__ = ["cancel", "exact_quotient", "factor_list", "lower", "split_parity"]

# Largest product of the numbers of terms for which a greatest common divisor is sought (0.1 s or
# so). Beyond it a fraction stays as it is: longer than need be, still exact, and zero is still zero.
GCD_LIMIT = 6_000


def cancel(num: PolyElement, den: PolyElement) -> tuple[PolyElement, PolyElement]:
    """num/den without common factors, or if they are long without common integers and powers of generators."""
    if len(num) * len(den) <= GCD_LIMIT:
        return num.cancel(den)
    if (quotient := exact_quotient(num, den)) is not None:
        return quotient, den.ring.one
    content = math.gcd(int(num.content()), int(den.content()))
    monomial = tuple(map(min, zip(*num, *den, strict=True)))
    return num.quo_term((monomial, ZZ(content))), den.quo_term((monomial, ZZ(content)))


def factor_list(poly: PolyElement) -> tuple[int, list[tuple[PolyElement, int]]]:
    """Content and irreducible factors, their leading coefficients positive, with their multiplicities.

    A polynomial a x + b without a factor common to a and b is irreducible, and so is a x² + b x + c whose
    discriminant is not a square; nearly always some parameter or cosine occurs so, and greatest common
    divisors are all that is needed. SymPy's own method for several variables draws random numbers, and
    for some of them takes minutes where others take milliseconds.
    """
    content, rest = poly.primitive()
    counts: dict[PolyElement, int] = defaultdict(int)
    monomial = tuple(map(min, zip(*rest, strict=True)))
    for generator, exponent in zip(poly.ring.gens, monomial, strict=True):
        if exponent:
            counts[generator] += exponent
    rest = rest.quo_term((monomial, poly.ring.domain.one))
    while not rest.is_ground:
        degree, index = min((degree, i) for i, degree in enumerate(rest.degrees()) if degree)
        parts = _coefficients(rest, index)
        common = poly.ring.zero
        for part in parts:
            common = common.gcd(part)
        part, rest = rest.exquo(common), common
        if part.LC < 0:
            part, content = -part, -content
        if degree == 1 or (degree == 2 and not _may_split(_coefficients(part, index))):
            counts[part] += 1
        else:
            factor_content, factors = part.factor_list()
            content *= factor_content
            for factor, multiplicity in factors:
                counts[factor] += multiplicity
    return int(content) * int(rest.LC), list(counts.items())


def _coefficients(poly: PolyElement, index: int) -> list[PolyElement]:
    """Coefficients of poly as a polynomial in generator `index`, from the constant one upwards."""
    parts = [poly.ring.zero.copy() for _ in range(poly.degree(poly.ring.gens[index]) + 1)]
    for monomial, coefficient in poly.items():
        parts[monomial[index]][(*monomial[:index], 0, *monomial[index + 1 :])] = coefficient
    return parts


def _may_split(coefficients: Sequence[PolyElement]) -> bool:
    """Whether a quadratic's discriminant is a square at some points, as that of a product is at all points."""
    rng = np.random.default_rng(6)
    for _ in range(10):
        point = [int(x) for x in rng.integers(2, 1000, len(coefficients[0].ring.gens))]
        c, b, a = (
            sum(int(number) * math.prod(map(pow, point, monomial)) for monomial, number in poly.items())
            for poly in coefficients
        )
        discriminant = b * b - 4 * a * c
        if discriminant < 0 or math.isqrt(discriminant) ** 2 != discriminant:
            return False
    return True


def exact_quotient(num: PolyElement, den: PolyElement) -> PolyElement | None:
    """num/den if that is a polynomial, else None, usually at once: SymPy's `div` goes on to the remainder."""
    ring = num.ring
    if len(den) > len(num) or not all(map(ge, num.degrees(), den.degrees())):
        return None
    lead, lead_coefficient = den.LT
    quotient, rest = ring.zero.copy(), num.copy()
    # Leading monomials first, in lexicographic order; one that has cancelled since is passed over.
    heap = [tuple(map(neg, monomial)) for monomial in rest]
    heapify(heap)
    while heap:
        monomial = tuple(map(neg, heappop(heap)))
        if (coefficient := rest.get(monomial, 0)) == 0:
            continue
        if coefficient % lead_coefficient or not all(map(ge, monomial, lead)):
            return None
        step = tuple(map(sub, monomial, lead))
        factor = coefficient // lead_coefficient
        quotient[step] = factor
        for m, c in den.items():
            key = tuple(map(add, m, step))
            if key not in rest:
                heappush(heap, tuple(map(neg, key)))
            if value := rest.get(key, 0) - factor * c:
                rest[key] = value
            else:
                del rest[key]
    return quotient


def lower(poly: PolyElement, index: int, square: PolyElement) -> PolyElement:
    """Replace even powers of generator `index` by powers of `square`."""
    if all(monomial[index] < 2 for monomial in poly):
        return poly
    parts: dict[int, PolyElement] = defaultdict(poly.ring.zero.copy)
    for monomial, coefficient in poly.items():
        half, odd = divmod(monomial[index], 2)
        parts[half][(*monomial[:index], odd, *monomial[index + 1 :])] = coefficient
    return sum((part * square**half for half, part in parts.items()), poly.ring.zero)


def split_parity(poly: PolyElement, index: int) -> tuple[PolyElement, PolyElement]:
    """(A, B) of poly = A + g B, for poly at most linear in generator `index`."""
    even, odd = poly.ring.zero.copy(), poly.ring.zero.copy()
    for monomial, coefficient in poly.items():
        if monomial[index]:
            odd[(*monomial[:index], 0, *monomial[index + 1 :])] = coefficient
        else:
            even[monomial] = coefficient
    return even, odd

"""Factors of polynomials, against SymPy's own."""

import random

import pytest
from sympy import ZZ
from sympy.polys.rings import PolyElement, ring

from mechanics.geometry.polynomials import factor_list

R, x, y, z, w = ring("x y z w", ZZ)


def random_polynomial(rng):
    return sum(
        (
            rng.randint(-3, 3) * x ** rng.randint(0, 1) * y ** rng.randint(0, 2) * z ** rng.randint(0, 3) * w
            for _ in range(3)
        ),
        R(rng.randint(-2, 2)),
    )


@pytest.mark.parametrize("seed", range(40))
def test_factors_multiply_to_the_polynomial_and_are_those_of_sympy(seed):
    rng = random.Random(seed)
    factors = [random_polynomial(rng), random_polynomial(rng) ** rng.randint(1, 2), 1 - x**2, x**2 - 4 * y**2 * z**2]
    poly = factors[0] * factors[1] * factors[2 + seed % 2]
    if not poly:
        pytest.skip("the product is zero")
    content, found = factor_list(poly)
    product = R(content)
    for factor, multiplicity in found:
        product *= factor**multiplicity
    assert product == poly

    assert (content, sorted(found, key=str)) == (poly.factor_list()[0], sorted(poly.factor_list()[1], key=str))


def test_an_irreducible_quadratic_needs_no_random_numbers(monkeypatch):
    """SymPy's own method, which draws them and then may take minutes, is not asked."""
    monkeypatch.setattr(PolyElement, "factor_list", None)
    poly = x**2 * y**2 + z**2 * w**2 + x**2 + 1
    assert factor_list(-3 * poly) == (-3, [(poly, 1)])

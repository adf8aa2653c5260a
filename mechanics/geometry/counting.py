"""How many operations some expressions take: the measure of how compact a derivation is."""

from __future__ import annotations

from collections.abc import Iterable
from functools import cache
from typing import Any

import sympy as sp

__all__ = ["count_operations"]


def count_operations(expressions: Iterable[Any], constants: Iterable[sp.Symbol]) -> int:
    """Operations of one evaluation, common subexpressions shared.

    A sine or a root counts as one operation, as a product does. What depends on `constants` alone
    (parameters) is computed once, before, and does not count.

    Every subexpression is visited once: the solution of a linear system repeats them so often that,
    written out, it would have no end.
    """
    constants = frozenset(constants)
    names: dict[sp.Expr, sp.Symbol] = {}

    @cache
    def fixed(e: sp.Expr) -> bool:
        return all(map(fixed, e.args)) if e.args else not e.is_Symbol or e in constants

    @cache
    def hoist(e: sp.Expr) -> sp.Expr:
        if not e.args or e.is_number:
            return e
        if fixed(e):
            return names.setdefault(e, sp.Dummy())
        if e.is_Add or e.is_Mul:
            constant = e.func(*filter(fixed, e.args))
            return e.func(hoist(constant), *(hoist(a) for a in e.args if not fixed(a)))
        return e.func(*map(hoist, e.args))

    replacements, outputs = sp.cse([hoist(sp.sympify(e)) for e in expressions], order="none")
    return int(sp.count_ops([value for _, value in replacements]) + sp.count_ops(outputs))

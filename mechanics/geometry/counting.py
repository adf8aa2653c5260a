"""How many operations some expressions take: the measure of how compact a derivation is."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import sympy as sp

__all__ = ["count_operations"]


def count_operations(expressions: Iterable[Any], constants: Iterable[sp.Symbol]) -> int:
    """Operations of one evaluation, common subexpressions shared.

    A sine or a root counts as one operation, as a product does. What depends on `constants` alone
    (parameters) is computed once, before, and does not count.
    """
    constants = frozenset(constants)
    names: dict[sp.Expr, sp.Symbol] = {}

    def hoist(e: sp.Expr) -> sp.Expr:
        if not e.args or e.is_number:
            return e
        if e.free_symbols <= constants:
            return names.setdefault(e, sp.Dummy())
        if e.is_Add or e.is_Mul:
            fixed = e.func(*(a for a in e.args if a.free_symbols <= constants))
            return e.func(hoist(fixed), *(hoist(a) for a in e.args if not a.free_symbols <= constants))
        return e.func(*map(hoist, e.args))

    replacements, outputs = sp.cse([hoist(sp.sympify(e)) for e in expressions])
    return int(sp.count_ops([value for _, value in replacements]) + sp.count_ops(outputs))

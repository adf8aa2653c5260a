"""What differs between the targets of code generation: imports, decorators, and how a sum is written."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import sympy as sp
from sympy.printing.pycode import PythonCodePrinter

__all__ = ["BACKENDS", "Backend"]


@dataclass(frozen=True)
class Backend:
    """A target.

    Attributes:
        name: as users call it.
        header: imports of a generated module.
        decorator: what stands before a function.
        inline: the same for a function that becomes part of whatever calls it.
        fused: whether a product is added with a single rounding, by `fma`.
    """

    name: str
    header: str
    decorator: str
    inline: str
    fused: bool

    def inlined(self) -> Backend:
        """The same target, every function a part of whatever calls it."""
        return dataclasses.replace(self, decorator=self.inline)

    def write(self, expression: sp.Expr) -> str:
        """Source of a lowered expression."""
        return (_FusedPrinter() if self.fused else _Printer()).doprint(expression)

    def sum_of_products(self, products: Sequence[tuple[str, str]], rest: str = "") -> str:
        """Source of rest + sum of a*b, for factors that are names or numbers."""
        if not self.fused:
            return " + ".join([rest] * bool(rest) + [f"{a}*{b}" for a, b in products])
        total = rest
        for a, b in products:
            total = f"fma({a}, {b}, {total})" if total else f"{a}*{b}"
        return total


class _Printer(PythonCodePrinter):
    """Python source of a lowered expression; powers as products, rationals as decimals."""

    def __init__(self) -> None:
        super().__init__({"fully_qualified_modules": False, "precision": 17})

    def _print_Pow(self, expr: sp.Pow, rational: bool = False) -> str:
        if expr.exp.is_Integer and 2 <= expr.exp <= 4:
            base = self.parenthesize(expr.base, 60)
            return f"({'*'.join([base] * int(expr.exp))})"
        return super()._print_Pow(expr, rational=rational)

    def _print_Rational(self, expr: sp.Rational) -> str:
        return repr(float(expr))

    def _print_Exp1(self, expr: sp.Expr) -> str:
        return repr(float(expr))

    def _print_Function(self, expr: sp.Function) -> str:
        name = {"Abs": "abs"}.get(expr.func.__name__, expr.func.__name__)
        return f"{name}({', '.join(self._print(argument) for argument in expr.args)})"

    _print_Abs = _print_sign = _print_Function


class _FusedPrinter(_Printer):
    """Sums of products as nested `fma`: the compiler, which would choose by itself what to fuse, is left no choice."""

    def _print_Add(self, expr: sp.Add, order: str | None = None) -> str:
        terms = self._as_ordered_terms(expr, order=order)
        products = [term for term in terms if _is_product(term)]
        total = " + ".join(self.parenthesize(term, 50) for term in terms if not _is_product(term))
        for term in products:
            if total:
                first, second = _halves(term)
                total = f"fma({self._print(first)}, {self._print(second)}, {total})"
            else:
                total = self._print(term)
        return total


def _is_product(term: sp.Expr) -> bool:
    if term.is_Mul:
        return len(term.args) > 2 or term.args[0] != -1 or _is_product(term.args[1])
    return bool(term.is_Pow and term.exp.is_Integer and term.exp >= 2)


def _halves(term: sp.Expr) -> tuple[sp.Expr, sp.Expr]:
    """Two factors of a product, the sign with the first."""
    if term.is_Pow:
        return term.base ** (term.exp - 1), term.base
    factors = list(term.args)
    last = factors.pop()
    if last.is_Pow and last.exp.is_Integer and last.exp >= 2:  # one of its factors is enough
        factors.append(last.base ** (last.exp - 1))
        last = last.base
    return sp.Mul(*factors, evaluate=False), last


BACKENDS = {
    # Scalars or arrays of any shape, no compiler.
    "numpy": Backend(
        "numpy",
        "from numpy import abs as fabs\nfrom numpy import arccos as acos\nfrom numpy import arcsin as asin\n"
        "from numpy import arctan as atan\nfrom numpy import arctan2 as atan2\nfrom numpy import copysign, cos, cosh\n"
        "from numpy import exp, inf, isfinite, log, nan, pi, sign, sin, sinh, sqrt, tan, tanh\n\n\n"
        "def clip(x, low, high):\n    return min(max(x, low), high)\n\n\n"
        "def align_stack():\n    pass\n\n\n"
        "def either(given, otherwise):\n    return otherwise if given != given else given\n",
        decorator="",
        inline="",
        fused=False,
    ),
    # Scalars, or rows of many in a loop that LLVM vectorises: hence no fastmath, which would round
    # the two differently, and what it would gain is written out instead.
    "numba": Backend(
        "numba",
        "from math import acos, asin, atan, atan2, copysign, cosh, exp, fabs, inf, isfinite, log, nan, pi\n"
        "from math import sinh, sqrt, tan, tanh\n\n"
        "from numba import njit\n\n"
        "from mechanics.compiler.elementary import align_stack, clip, cos, either, fma, sign, sin\n",
        decorator='@njit(error_model="numpy")\n',
        inline='@njit(error_model="numpy", forceinline=True)\n',
        fused=True,
    ),
}

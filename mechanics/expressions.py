"""The one language in which mechanisms and tasks are written, and its safe parser.

An expression is arithmetic over named quantities: ``+ - * /``, powers with a literal integer
or half-integer exponent, and the functions in `FUNCTIONS`. It is read as a Python syntax tree,
checked node by node against a whitelist, and only then given a meaning: a number (NumPy) or a
symbolic expression (SymPy). Nothing is executed before the check, so a text from a stranger can
at worst be refused.
"""

from __future__ import annotations

import ast
import builtins
import difflib
import keyword
from collections.abc import Iterable, Mapping
from fractions import Fraction
from functools import cache
from types import CodeType
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    import sympy as sp

__all__ = [
    "CONSTANTS",
    "FUNCTIONS",
    "MAX_EXPONENT",
    "ExpressionError",
    "check_name",
    "evaluate",
    "names_in",
    "parse",
    "to_sympy",
    "unknown_name",
]

MAX_LENGTH = 20_000  # characters: the longest inertia entry in use has fewer than 500
MAX_DEPTH = 400  # nested operations: a sum of 400 terms, within every recursion limit
MAX_EXPONENT = 16

# name -> (fewest arguments, most arguments, NumPy function)
FUNCTIONS: dict[str, tuple[int, int, Any]] = {
    "sin": (1, 1, np.sin),
    "cos": (1, 1, np.cos),
    "tan": (1, 1, np.tan),
    "sqrt": (1, 1, np.sqrt),
    "exp": (1, 1, np.exp),
    "abs": (1, 1, np.abs),
    "sign": (1, 1, np.sign),
    "atan2": (2, 2, np.arctan2),
}
CONSTANTS: dict[str, float] = {"pi": np.pi}

_OPERATORS = (ast.Add, ast.Sub, ast.Mult, ast.Div)


class ExpressionError(ValueError):
    """A text is not an expression of this language, or uses a name that is not defined."""


def unknown_name(kind: str, given: str, known: Iterable[str]) -> str:
    """Say what was given, what is known and what was probably meant."""
    known = tuple(known)
    close = difflib.get_close_matches(given, known, n=1)
    hint = f" Did you mean {close[0]!r}?" if close else ""
    return f"unknown {kind} {given!r}; known: {', '.join(known) or 'none'}.{hint}"


def check_name(name: str, kind: str) -> str:
    """Return `name` if it can stand for a quantity, else raise `ExpressionError`."""
    if not isinstance(name, str) or not name.isascii() or not name.isidentifier():
        raise ExpressionError(f"{kind} {name!r} is not a plain ASCII identifier")
    if name.startswith("_") or "__" in name:
        raise ExpressionError(f"{kind} {name!r}: underscores at the beginning or in a row are kept for generated names")
    if keyword.iskeyword(name) or hasattr(builtins, name) or name in FUNCTIONS or name in CONSTANTS:
        raise ExpressionError(f"{kind} {name!r} is a reserved word; choose another name")
    if len(name) > 40:
        raise ExpressionError(f"{kind} {name[:40]!r}... is longer than 40 characters")
    return name


@cache
def parse(text: str) -> ast.expr:
    """Read `text` and check every node of it; raise `ExpressionError` if one is not allowed."""
    if not isinstance(text, str):
        raise ExpressionError(f"an expression must be a string, not {type(text).__name__}: {text!r}")
    if len(text) > MAX_LENGTH:
        raise ExpressionError(f"expression of {len(text)} characters; at most {MAX_LENGTH} are read")
    try:
        tree = ast.parse(text.strip(), mode="eval").body
    except (SyntaxError, ValueError, RecursionError, MemoryError) as error:
        raise ExpressionError(f"cannot read {_short(text)}: {error}") from None
    stack = [(tree, 0)]
    while stack:
        node, depth = stack.pop()
        if depth > MAX_DEPTH:
            raise ExpressionError(f"{_short(text)} nests deeper than {MAX_DEPTH} operations")
        stack.extend((child, depth + 1) for child in _operands(node, text))
    return tree


def names_in(text: str) -> frozenset[str]:
    """Names of the quantities that `text` uses (functions and constants left out)."""
    nodes = ast.walk(parse(text))
    return frozenset(
        node.id
        for node in nodes
        if isinstance(node, ast.Name) and node.id not in FUNCTIONS and node.id not in CONSTANTS
    )


def evaluate(text: str, values: Mapping[str, Any]) -> Any:
    """Number (or array) that `text` stands for, with each name taken from `values`.

    Division by zero and the like give inf or nan, as in NumPy: callers check what they need.
    """
    for name in names_in(text):
        if name not in values:
            raise ExpressionError(f"in {_short(text)}: {unknown_name('name', name, values)}")
    try:
        return eval(_compiled(text), {"__builtins__": {}, **_NUMERIC, **values})  # noqa: S307 (checked by parse)
    except (ZeroDivisionError, OverflowError):  # Python's own numbers raise where NumPy's do not
        return np.nan


def to_sympy(text: str, symbols: Mapping[str, Any]) -> sp.Expr:
    """Exact SymPy expression of `text` (decimals become rationals), names taken from `symbols`."""
    import sympy as sp

    def convert(node: ast.expr) -> sp.Expr:
        match node:
            case ast.Constant(value=value):
                return sp.Integer(value) if isinstance(value, int) else sp.Rational(repr(value))
            case ast.Name(id=name):
                if name in CONSTANTS:
                    return getattr(sp, name)
                if name not in symbols:
                    raise ExpressionError(f"in {_short(text)}: {unknown_name('name', name, symbols)}")
                return sp.sympify(symbols[name])
            case ast.UnaryOp(op=ast.USub(), operand=operand):
                return -convert(operand)
            case ast.UnaryOp(operand=operand):
                return convert(operand)
            case ast.BinOp(left=left, op=ast.Pow(), right=right):
                exponent = _exponent(right, text)
                return convert(left) ** sp.Rational(exponent.numerator, exponent.denominator)
            case ast.BinOp(left=left, op=operator, right=right):
                a, b = convert(left), convert(right)
                if isinstance(operator, ast.Add):
                    return a + b
                if isinstance(operator, ast.Sub):
                    return a - b
                return a * b if isinstance(operator, ast.Mult) else a / b
            case ast.Call(func=ast.Name(id=name), args=args):
                return getattr(sp, {"abs": "Abs"}.get(name, name))(*map(convert, args))
        raise AssertionError(ast.dump(node))  # parse lets nothing else through

    return convert(parse(text))


_NUMERIC = {name: row[2] for name, row in FUNCTIONS.items()} | CONSTANTS


@cache
def _compiled(text: str) -> CodeType:
    return compile(ast.Expression(parse(text)), "<expression>", "eval")


def _operands(node: ast.expr, text: str) -> list[ast.expr]:
    """Operands of a node that the language allows."""
    match node:
        case ast.Constant(value=bool()):
            pass
        case ast.Constant(value=int() | float() as value) if abs(value) < 1e300:
            return []
        case ast.Name():
            return []
        case ast.UnaryOp(op=ast.USub() | ast.UAdd(), operand=operand):
            return [operand]
        case ast.BinOp(left=left, op=ast.Pow(), right=right):
            _exponent(right, text)
            return [left]
        case ast.BinOp(left=left, op=operator, right=right) if isinstance(operator, _OPERATORS):
            return [left, right]
        case ast.Call(func=ast.Name(id=name), args=args, keywords=[]):
            if name not in FUNCTIONS:
                raise ExpressionError(f"in {_short(text)}: {unknown_name('function', name, FUNCTIONS)}")
            fewest, most, _ = FUNCTIONS[name]
            if not fewest <= len(args) <= most or any(isinstance(a, ast.Starred) for a in args):
                raise ExpressionError(f"in {_short(text)}: {name} takes {fewest} argument(s)")
            return args
    raise ExpressionError(
        f"in {_short(text)}: {_short(ast.unparse(node))} is not allowed; an expression is made of numbers, "
        f"names, + - * / ** and {', '.join(FUNCTIONS)}"
    )


def _exponent(node: ast.expr, text: str) -> Fraction:
    """Literal exponent: an integer or half-integer of modest size, perhaps with a sign."""
    sign = 1
    while isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub | ast.UAdd):
        sign = -sign if isinstance(node.op, ast.USub) else sign
        node = node.operand
    match node:
        case ast.BinOp(left=ast.Constant(value=int() as p), op=ast.Div(), right=ast.Constant(value=2)):
            exponent = Fraction(p, 2)
        case ast.Constant(value=int() | float() as value) if abs(value) <= MAX_EXPONENT:
            exponent = Fraction(value)
        case _:
            exponent = Fraction(MAX_EXPONENT + 1)
    if abs(exponent) > MAX_EXPONENT or exponent.denominator > 2:
        raise ExpressionError(
            f"in {_short(text)}: an exponent must be a literal integer or half-integer "
            f"of at most {MAX_EXPONENT} in size"
        )
    return sign * exponent


def _short(text: str) -> str:
    return repr(text if len(text) <= 80 else f"{text[:77]}...")

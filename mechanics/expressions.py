"""The one language in which mechanisms and tasks are written, and its safe parser.

An expression is arithmetic over named quantities: ``+ - * /``, powers with a literal integer
or half-integer exponent, and the functions in `FUNCTIONS`. It is read as a Python syntax tree,
checked node by node against a whitelist, and only then given a meaning: a number (NumPy) or a
symbolic expression (SymPy). Nothing is executed before the check, so a text from a stranger can
at worst be refused. Characters that arithmetic does not need are refused even before: a text may
end up in the source of a generated module, where a quote or a # could begin something else.
"""

from __future__ import annotations

import ast
import builtins
import difflib
import keyword
import re
import warnings
from collections.abc import Callable, Iterable, Mapping
from fractions import Fraction
from functools import lru_cache
from types import CodeType
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

import numpy as np

if TYPE_CHECKING:
    import sympy as sp

__all__ = [
    "CONSTANTS",
    "FUNCTIONS",
    "MAX_EXPONENT",
    "QUANTITY",
    "ExpressionError",
    "Extent",
    "check_name",
    "evaluate",
    "extent",
    "names_in",
    "parse",
    "to_sympy",
    "unknown_name",
    "wrong_keys",
]

T = TypeVar("T")

MAX_LENGTH = 20_000  # characters: the longest in use, R of a snake of ten links, has 2,900
MAX_DEPTH = 400  # nested operations: a sum of 400 terms, within every recursion limit
MAX_EXPONENT = 16
MAX_NUMBER = 1e100  # beyond any quantity of physics; SymPy stumbles over what is much larger
CACHED = 10_000  # texts remembered: more than the largest mechanism has, but not all of a stranger's

# Bounds on an expression with its definitions written out, which is what a derivation works on.
# Definitions that use one another twice each double it, and 40 lines make 10^12 terms. In the
# catalogue no entry exceeds size 160, degree 11 and nesting 10; a frame orthogonalised by hand and
# not simplified (the Chaplygin beanie's) had size 1100, degree 79 and nesting 22.
MAX_SIZE = 100_000  # operations and operands
MAX_DEGREE = 1_000  # of numerator or denominator when multiplied out
MAX_NESTING = 100  # the derivation recurses some five calls a level, and Python allows 1000

# name -> (fewest arguments, most arguments, NumPy function)
FUNCTIONS: dict[str, tuple[int, int, Any]] = {
    "sin": (1, 1, np.sin),
    "cos": (1, 1, np.cos),
    "tan": (1, 1, np.tan),
    "asin": (1, 1, np.arcsin),
    "acos": (1, 1, np.arccos),
    "atan": (1, 1, np.arctan),
    "atan2": (2, 2, np.arctan2),
    "sinh": (1, 1, np.sinh),
    "cosh": (1, 1, np.cosh),
    "tanh": (1, 1, np.tanh),
    "exp": (1, 1, np.exp),
    "log": (1, 1, np.log),
    "sqrt": (1, 1, np.sqrt),
    "abs": (1, 1, np.abs),
    "sign": (1, 1, np.sign),
}
CONSTANTS: dict[str, np.float64] = {"pi": np.float64(np.pi)}

_OPERATORS: dict[type[ast.operator], str] = {ast.Add: "+", ast.Sub: "-", ast.Mult: "*", ast.Div: "/"}
_STRANGE = re.compile(r"[^A-Za-z0-9_.,+*/()\s-]", re.ASCII)
# What generated functions call besides those of the language; their arguments have the names that users chose.
_CALLED = ("either", "fabs", "fma")
# Generated code and SymPy's own call the functions of the language by NumPy's names.
_RESERVED = {*FUNCTIONS, *CONSTANTS, *(row[2].__name__ for row in FUNCTIONS.values()), *_CALLED}
_MADE_OF = f"an expression is made of numbers, names, + - * / ** and {', '.join(FUNCTIONS)}"


class ExpressionError(ValueError):
    """A text is not an expression of this language, or uses a name that is not defined."""


def unknown_name(kind: str, given: str, known: Iterable[str]) -> str:
    """Say what was given, what is known and what was probably meant."""
    known = tuple(known)
    close = difflib.get_close_matches(given, known, n=1)
    hint = f" Did you mean {close[0]!r}?" if close else ""
    return f"unknown {kind} {_short(given)}; known: {', '.join(known) or 'none'}.{hint}"


def wrong_keys(data: Mapping[Any, Any], known: Iterable[str], required: Iterable[str], what: str) -> str | None:
    """Say what is wrong with the keys of plain data, `what` they are; None if nothing is."""
    known = tuple(known)
    for key in data:
        if key not in known:
            return f"{what}: {unknown_name('key', str(key), known)}"
    for key in required:
        if key not in data:
            return f"{what} lacks {key!r}; it has {', '.join(map(str, data)) or 'nothing'}"
    return None


def check_name(name: str, kind: str) -> str:
    """Return `name` if it can stand for a quantity, else raise `ExpressionError`."""
    if not isinstance(name, str):
        raise ExpressionError(f"a {kind} must be a string, not {type(name).__name__}")
    if len(name) > 40:
        raise ExpressionError(f"{kind} {name[:40]!r}... is longer than 40 characters")
    if not name.isascii() or not name.isidentifier():
        raise ExpressionError(f"{kind} {name!r} is not a plain ASCII identifier")
    if name.startswith("_") or "__" in name:
        raise ExpressionError(f"{kind} {name!r}: underscores at the beginning or in a row are kept for generated names")
    if keyword.iskeyword(name) or hasattr(builtins, name) or name in _RESERVED:
        raise ExpressionError(f"{kind} {name!r} is a reserved word; choose another name")
    return name


def parse(text: str) -> ast.expr:
    """Read `text` and check every node of it; raise `ExpressionError` if one is not allowed."""
    if not isinstance(text, str):
        raise ExpressionError(f"an expression must be a string, not {type(text).__name__}")
    if len(text) > MAX_LENGTH:
        raise ExpressionError(f"expression of {len(text)} characters; at most {MAX_LENGTH} are read")
    return _read(text)[0]


@lru_cache(CACHED)
def _read(text: str) -> tuple[ast.expr, frozenset[str]]:
    """Checked tree of `text`, and the names of the quantities in it."""
    if found := _STRANGE.search(text):
        raise ExpressionError(f"in {_short(text)}: {found[0]!r} is not allowed; {_MADE_OF}")
    line = " ".join(text.split())
    try:
        with warnings.catch_warnings():  # such as Python's about 1if, which is refused below
            warnings.simplefilter("ignore")
            tree = ast.parse(line, mode="eval").body
    except (SyntaxError, ValueError, RecursionError, MemoryError) as error:
        raise ExpressionError(f"cannot read {_short(text)}: {getattr(error, 'msg', error)}") from None
    names = set()
    stack = [(tree, 0)]
    while stack:
        node, depth = stack.pop()
        if depth > MAX_DEPTH:
            raise ExpressionError(f"{_short(text)} nests deeper than {MAX_DEPTH} operations")
        if isinstance(node, ast.Name):
            names.add(node.id)
        stack.extend((child, depth + 1) for child in _operands(node, line))
    return tree, frozenset(names - CONSTANTS.keys())


def names_in(text: str) -> frozenset[str]:
    """Names of the quantities that `text` uses (functions and constants left out)."""
    parse(text)
    return _read(text)[1]


def evaluate(text: str, values: Mapping[str, Any]) -> Any:
    """Number (or array) that `text` stands for, with each name taken from `values`.

    Division by zero and the like give inf or nan, as in NumPy but silently: callers check what they need.
    """
    scope = {}
    for name in names_in(text):
        if name not in values:
            raise ExpressionError(f"in {_short(text)}: {unknown_name('name', name, values)}")
        scope[name] = np.float64(values[name])
    code, meaning = _compiled(text)
    with np.errstate(all="ignore"):
        return eval(code, meaning, scope)  # noqa: S307 (checked by parse)


def to_sympy(text: str, symbols: Mapping[str, Any]) -> sp.Expr:
    """Exact SymPy expression of `text` (decimals become rationals), names taken from `symbols`."""
    import sympy as sp

    undefined = (sp.nan, sp.zoo, sp.oo, -sp.oo, sp.I)

    def number(value: int | float) -> sp.Expr:
        return sp.Integer(value) if isinstance(value, int) else sp.Rational(repr(value))

    def name(name: str) -> sp.Expr:
        if name in CONSTANTS:
            return getattr(sp, name)
        if name not in symbols:
            raise ExpressionError(f"in {_short(text)}: {unknown_name('name', name, symbols)}")
        return sp.sympify(symbols[name])

    def join(operation: str, *parts: Any) -> sp.Expr:
        match operation, parts:
            case "negative", (a,):
                return -a
            case "+", (a, b):
                return a + b
            case "-", (a, b):
                return a - b
            case "*", (a, b):
                return a * b
            case "/", (a, b):
                value = a / b if b != 0 else sp.nan
            case "**", (a, exponent):
                value = a ** sp.Rational(exponent.numerator, exponent.denominator)
            case "exp", (a,):
                # exp(n*log(x)) becomes x**n, and if x is a number all its digits are worked out.
                if any(term.is_number and abs(term.evalf(5)) > 700 for term in sp.Add.make_args(a)):
                    raise ExpressionError(
                        f"in {_short(text)}: exp of a number beyond 700 is beyond the range of floats"
                    )
                value = sp.exp(a)
                powers = [factor.exp for factor in sp.Mul.make_args(value) if factor.is_Pow and factor.exp.is_Rational]
                if any(abs(power) > MAX_DEGREE for power in powers):
                    raise ExpressionError(f"in {_short(text)}: a power of degree beyond {MAX_DEGREE}")
            case _:
                value = getattr(sp, {"abs": "Abs"}.get(operation, operation))(*parts)
        if any(_is_root_of_a_root(factor) for factor in sp.Mul.make_args(value)):
            raise ExpressionError(
                f"in {_short(text)}: {operation!r} gives a root of a root there, or another power whose exponent is "
                "neither an integer nor a half-integer; only such powers can be worked with"
            )
        if value.is_number and value.has(*undefined):
            raise ExpressionError(f"in {_short(text)}: {operation!r} gives no real number there")
        return value

    return _fold(text, number, name, join)


def _is_root_of_a_root(e: sp.Expr) -> bool:
    """Whether this is a power beyond the half-integers, as it stands or once its base is multiplied out of it."""
    if not (e.is_Pow and e.exp.is_Rational and e.exp.q > 1):
        return False
    factors = e.base.args if e.base.is_Mul else (e.base,)
    return e.exp.q > 2 or any(f.is_Pow and f.exp.is_Rational and f.exp.q > 1 for f in factors)


class Extent(NamedTuple):
    """How large an expression is with its definitions written out.

    Attributes:
        size: operations and operands.
        above: degree of its numerator when multiplied out.
        below: degree of its denominator.
        nesting: levels of its tree, the terms of a sum (or the factors of a product) on one level.
        kind: "+", "*" or another operation at the top of the tree, "" for an operand.
    """

    size: int = 1
    above: int = 1
    below: int = 0
    nesting: int = 0
    kind: str = ""


QUANTITY = Extent()  # of a coordinate or a parameter


def extent(text: str, known: Mapping[str, Extent]) -> Extent:
    """Size of `text`, whose names have the extents in `known`; raise `ExpressionError` beyond the bounds."""

    def name(name: str) -> Extent:
        if name in CONSTANTS:
            return QUANTITY
        if name not in known:
            raise ExpressionError(unknown_name("name", name, sorted(known)))
        return known[name]

    def join(operation: str, first: Extent, second: Any = None) -> Extent:
        parts = [part for part in (first, second) if isinstance(part, Extent)]
        kind = {"-": "+", "/": "*", "negative": first.kind}.get(operation, operation)
        above, below = 1, 0  # of a function: it counts as one more quantity
        match operation, second:
            case "negative", _:
                above, below = first.above, first.below
            case "**", Fraction(numerator=p, denominator=q):
                above, below = (first.above * abs(p), first.below * abs(p)) if q == 1 else (abs(p), 0)
                if p < 0:
                    above, below = below, above
            case "*", Extent():
                above, below = first.above + second.above, first.below + second.below
            case "/", Extent():
                above, below = first.above + second.below, first.below + second.above
            case "+" | "-", Extent():
                above = max(first.above + second.below, second.above + first.below)
                below = first.below + second.below
        size = 1 + sum(part.size for part in parts)
        flat = (kind,) if kind in ("+", "*") or operation == "negative" else ()
        nesting = max(part.nesting + (part.kind not in flat) for part in parts)
        for what, value, most in (
            ("size", size, MAX_SIZE),
            ("degree", max(above, below), MAX_DEGREE),
            ("nesting", nesting, MAX_NESTING),
        ):
            if value > most:
                raise ExpressionError(
                    f"{_short(text)} is too large: with its definitions written out it has {what} {value}, "
                    f"and {most} is the most that can be worked with"
                )
        return Extent(size, above, below, nesting, kind)

    return _fold(text, lambda _: QUANTITY, name, join)


def _fold(text: str, number: Callable[[Any], T], name: Callable[[str], T], join: Callable[..., T]) -> T:
    """Give every node of `text` a meaning, from its operands up.

    Args:
        text: an expression.
        number: meaning of a literal.
        name: meaning of a name.
        join: meaning of an operation or function on the meanings of its operands; "**" gets its exponent as a Fraction.
    """

    def visit(node: ast.expr) -> T:
        match node:
            case ast.Constant(value=value):
                return number(value)
            case ast.Name(id=word):
                return name(word)
            case ast.UnaryOp(op=ast.USub(), operand=operand):
                return join("negative", visit(operand))
            case ast.UnaryOp(operand=operand):
                return visit(operand)
            case ast.BinOp(left=left, op=ast.Pow(), right=right):
                return join("**", visit(left), _exponent(right, text))
            case ast.BinOp(left=left, op=operator, right=right):
                return join(_OPERATORS[type(operator)], visit(left), visit(right))
            case ast.Call(func=ast.Name(id=function), args=args):
                return join(function, *map(visit, args))
        raise AssertionError(ast.dump(node))  # parse lets nothing else through

    return visit(parse(text))


_HERE: dict[str, Any] = {"lineno": 1, "col_offset": 0}  # Python wants to know where a node stood
_SYNTAX: dict[str, Callable[..., ast.expr]] = {
    "negative": lambda a: ast.UnaryOp(ast.USub(), a, **_HERE),
    "**": lambda a, exponent: ast.BinOp(a, ast.Pow(), ast.Constant(float(exponent), **_HERE), **_HERE),
    **{sign: lambda a, b, op=op: ast.BinOp(a, op(), b, **_HERE) for op, sign in _OPERATORS.items()},
    **{name: lambda *args, name=name: ast.Call(_load(name), list(args), [], **_HERE) for name in FUNCTIONS},
}


@lru_cache(CACHED)
def _compiled(text: str) -> tuple[CodeType, dict[str, Any]]:
    """Code of `text`, and the meaning of the names in it that are not quantities.

    Numbers are among them, as NumPy's: with Python's own, 1/0 raises, (-1)**0.5 is complex, and powers of
    integers take all the memory there is.
    """
    meaning: dict[str, Any] = {"__builtins__": {}, **{name: row[2] for name, row in FUNCTIONS.items()}, **CONSTANTS}

    def number(value: int | float) -> ast.expr:
        name = f"_{len(meaning)}"
        meaning[name] = np.float64(value)
        return _load(name)

    tree = ast.Expression(_fold(text, number, _load, lambda operation, *parts: _SYNTAX[operation](*parts)))
    return compile(tree, "<expression>", "eval"), meaning


def _load(name: str) -> ast.expr:
    return ast.Name(name, ast.Load(), **_HERE)


def _operands(node: ast.expr, line: str) -> list[ast.expr]:
    """Operands of a node that the language allows."""
    match node:
        case ast.Constant(value=bool()):
            pass
        case ast.Constant(value=int() | float() as value) if abs(value) < MAX_NUMBER:
            return []
        case ast.Name(id=name):
            if name not in FUNCTIONS:
                return []
        case ast.UnaryOp(op=ast.USub() | ast.UAdd(), operand=operand):
            return [operand]
        case ast.BinOp(left=left, op=ast.Pow(), right=right):
            _exponent(right, line)
            return [left]
        case ast.BinOp(left=left, op=operator, right=right) if type(operator) in _OPERATORS:
            return [left, right]
        case ast.Call(func=ast.Name(id=name), args=args, keywords=[]):
            if name not in FUNCTIONS:
                raise ExpressionError(f"in {_short(line)}: {unknown_name('function', name, FUNCTIONS)}")
            fewest, most, _ = FUNCTIONS[name]
            if not fewest <= len(args) <= most or any(isinstance(a, ast.Starred) for a in args):
                raise ExpressionError(f"in {_short(line)}: {name} takes {fewest} argument(s)")
            return args
    part = line[node.col_offset : node.end_col_offset]
    raise ExpressionError(f"in {_short(line)}: {_short(part)} is not allowed; {_MADE_OF}")


def _exponent(node: ast.expr, text: str) -> Fraction:
    """Literal exponent: an integer or half-integer of modest size, perhaps with a sign."""
    sign, number = _unsigned(node)
    half = Fraction(1)
    match number:
        case ast.BinOp(left=left, op=ast.Div(), right=ast.Constant(value=2)):
            half = Fraction(1, 2)
            inner, number = _unsigned(left)
            sign *= inner
    match number:
        case ast.Constant(value=int() | float() as value) if not isinstance(value, bool) and abs(value) < 1e9:
            exponent = sign * half * Fraction(value)
            if abs(exponent) <= MAX_EXPONENT and exponent.denominator <= 2:
                return exponent
    raise ExpressionError(
        f"in {_short(text)}: an exponent must be a literal integer or half-integer of at most {MAX_EXPONENT} in size"
    )


def _unsigned(node: ast.expr) -> tuple[int, ast.expr]:
    """Sign and rest of a literal."""
    sign = 1
    while isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub | ast.UAdd):
        sign = -sign if isinstance(node.op, ast.USub) else sign
        node = node.operand
    return sign, node


def _short(text: str) -> str:
    return repr(text if len(text) <= 80 else f"{text[:77]}...")

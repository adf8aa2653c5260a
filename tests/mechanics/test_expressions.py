"""The expression language: exact where it can be, and harmless whatever it is given."""

import ast
import sys

import numpy as np
import pytest
import sympy as sp
from hypothesis import given
from hypothesis import strategies as st

from mechanics.expressions import (
    CONSTANTS,
    FUNCTIONS,
    MAX_EXPONENT,
    ExpressionError,
    check_name,
    evaluate,
    names_in,
    parse,
    to_sympy,
)

HOSTILE = [
    "__import__('os').system('true')",
    "().__class__.__bases__[0].__subclasses__()",
    "x.real",
    "x[0]",
    "'text'",
    "b'text'",
    "[x for x in (1, 2)]",
    "(lambda: 1)()",
    "x if y else 1",
    "x < y",
    "x and y",
    "not x",
    "~x",
    "x // y",
    "x % 2",
    "x @ y",
    "x << 2",
    "(x := 2)",
    "f'{x}'",
    "eval(x)",
    "open('/etc/passwd')",
    "getattr(x, 'real')",
    "sin(*x)",
    "sin(**x)",
    "sin(x=1)",
    "sin()",
    "sin(x, y)",
    "atan2(x)",
    "np.sin(x)",
    "sin.__call__(x)",
    "True",
    "None",
    "...",
    "1j",
    "1e999",
    "",
    "   ",
    "x;y",
    "x\ny",
    "import os",
    "x = 1",
    "(x",
    "\x00",
    "x, y",
    "{x}",
    "x**y",
    "x**(1/3)",
    "x**0.3",
    "x**17",
    "x**-17",
    "9**9**9**9",
    "x**99999999999999999999",
    "x**1e300",
    "await x",
    "yield",
]


@pytest.mark.parametrize("text", HOSTILE)
def test_refuses_what_is_not_arithmetic(text):
    with pytest.raises(ExpressionError):
        parse(text)
    for use in (lambda: evaluate(text, {"x": 1.0, "y": 2.0}), lambda: to_sympy(text, {"x": sp.Symbol("x")})):
        with pytest.raises(ExpressionError):
            use()


@pytest.mark.parametrize("value", [None, 1, 2.5, b"x", ["x"], object()])
def test_refuses_what_is_not_text(value):
    with pytest.raises((ExpressionError, TypeError)):  # a list has no hash, which the cache needs
        parse(value)


@pytest.mark.parametrize(
    "text",
    [
        "(" * 5000 + "x" + ")" * 5000,
        "-" * 5000 + "x",
        "+".join(["x"] * 3000),
        "+".join(["x"] * 1000),
        "sin(" * 500 + "x" + ")" * 500,
        "x" * 30_000,
    ],
    ids=["brackets", "signs", "terms", "fewer terms", "calls", "long"],
)
def test_refuses_depth_and_length_without_running_out_of_stack(text):
    limit = sys.getrecursionlimit()
    with pytest.raises(ExpressionError):
        parse(text)
    assert sys.getrecursionlimit() == limit


def test_long_sums_that_are_allowed_are_evaluated():
    text = "+".join(["x"] * 390)
    assert evaluate(text, {"x": 1.0}) == 390
    assert to_sympy(text, {"x": sp.Symbol("x")}) == 390 * sp.Symbol("x")


def test_nothing_is_executed(monkeypatch):
    """The check comes first: with eval out of reach, a hostile text still ends in a refusal."""
    monkeypatch.setattr("builtins.eval", lambda *args: pytest.fail("evaluated"))
    for text in HOSTILE:
        with pytest.raises(ExpressionError):
            evaluate(text, {"x": 1.0, "y": 2.0})


@given(st.text(max_size=60))
def test_any_text_is_read_or_refused(text):
    try:
        tree = parse(text)
    except ExpressionError:
        return
    allowed = (ast.Constant, ast.Name, ast.UnaryOp, ast.BinOp, ast.Call, ast.operator, ast.unaryop, ast.expr_context)
    assert all(isinstance(node, allowed) for node in ast.walk(tree))


def expressions():
    leaves = st.sampled_from(["x", "y", "2", "0.5", "pi"])

    def grow(inner):
        return st.one_of(
            st.tuples(inner, st.sampled_from("+-*"), inner).map(lambda t: f"({t[0]} {t[1]} {t[2]})"),
            inner.map(lambda e: f"sin({e})"),
            inner.map(lambda e: f"cos({e})"),
            inner.map(lambda e: f"-({e})"),
            inner.map(lambda e: f"({e})**2"),
        )

    return st.recursive(leaves, grow, max_leaves=8)


@given(expressions(), st.floats(-2, 2), st.floats(-2, 2))
def test_numbers_and_symbols_mean_the_same(text, x, y):
    number = evaluate(text, {"x": x, "y": y})
    exact = to_sympy(text, {"x": sp.Float(x, 40), "y": sp.Float(y, 40)}).evalf(30)
    # Nested squares of sums reach 1e6 and lose what their terms cancel; sines of such numbers lose as many digits.
    assert float(exact) == pytest.approx(number, rel=1e-6, abs=1e-6)


def test_precedence_is_pythons():
    x = sp.Symbol("x")
    assert to_sympy("-x**2", {"x": x}) == -(x**2)
    assert to_sympy("2/x/3", {"x": x}) == sp.Rational(2, 3) / x
    assert to_sympy("x**-2", {"x": x}) == x**-2
    assert to_sympy("x**(1/2)", {"x": x}) == sp.sqrt(x)
    assert to_sympy("x**0.5", {"x": x}) == sp.sqrt(x)
    assert to_sympy(f"x**{MAX_EXPONENT}", {"x": x}) == x**MAX_EXPONENT


def test_decimals_are_exact():
    assert to_sympy("0.1 + 0.2", {}) == sp.Rational(3, 10)


def test_functions_agree_with_numpy():
    for name, (fewest, _, function) in FUNCTIONS.items():
        arguments = (0.3, 0.7)[:fewest]
        text = f"{name}({', '.join(map(str, arguments))})"
        assert evaluate(text, {}) == function(*arguments)
        # One rounding each.
        assert float(to_sympy(text, {})) == pytest.approx(float(function(*arguments)), rel=1e-15)


def test_arrays_go_through():
    np.testing.assert_array_equal(evaluate("2*x", {"x": np.arange(3)}), [0, 2, 4])


def test_names():
    assert names_in("sin(x) + pi*y_1") == {"x", "y_1"}


def test_an_unknown_name_is_named_with_a_suggestion():
    with pytest.raises(ExpressionError, match="unknown name 'thta'.*Did you mean 'theta'"):
        evaluate("sin(thta)", {"theta": 1.0})
    with pytest.raises(ExpressionError, match="unknown name 'thta'.*Did you mean 'theta'"):
        to_sympy("sin(thta)", {"theta": sp.Symbol("theta")})
    with pytest.raises(ExpressionError, match="unknown function 'sine'.*Did you mean 'sin'"):
        parse("sine(x)")


@pytest.mark.parametrize(
    "name", ["", "1x", "x y", "x.y", "θ", "lambda", "None", "__x", "a__b", "x" * 41, None, 3, *FUNCTIONS, *CONSTANTS]
)
def test_refuses_names_that_cannot_stand_for_a_quantity(name):
    with pytest.raises(ExpressionError):
        check_name(name, "parameter")

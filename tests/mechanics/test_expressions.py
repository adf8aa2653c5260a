"""The expression language: exact where it can be, and harmless whatever it is given."""

import ast
import sys
import time
import warnings

import numpy as np
import pytest
import sympy as sp
from hypothesis import given
from hypothesis import strategies as st
from oracles import multiplier_acceleration

from mechanics import Mechanism, Model
from mechanics.compiler.backends import BACKENDS
from mechanics.compiler.codegen import Program
from mechanics.expressions import (
    CONSTANTS,
    FUNCTIONS,
    MAX_DEGREE,
    MAX_EXPONENT,
    MAX_NESTING,
    QUANTITY,
    ExpressionError,
    check_name,
    evaluate,
    extent,
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
    "x**True",
    "x**(True/2)",
    "x**(1/2/2)",
    "x**(0.5/2)",
    "x**-" + "-" * 500 + "x",
    "await x",
    "yield",
    # A function is no quantity.
    "sin",
    "x + atan2",
    # Python warns about the first of these, and would read the other two as sin(x).
    "1if x else y",
    "\u017fin(x)",
    "\uff53\uff49\uff4e(x)",
    # Comments and other characters that could mean something in the source of a generated module.
    "x # y",
    "x\\\n+ y",
    "x + '' y",
    "$x",
    "x!",
    "x?",
    "`x`",
    "x \u00a0+ y",
    "1e101",
    "9" * 101,
]


@pytest.mark.parametrize("text", HOSTILE)
def test_refuses_what_is_not_arithmetic(text):
    with pytest.raises(ExpressionError):
        parse(text)
    for use in (lambda: evaluate(text, {"x": 1.0, "y": 2.0}), lambda: to_sympy(text, {"x": sp.Symbol("x")})):
        with pytest.raises(ExpressionError):
            use()


@pytest.mark.parametrize("value", [None, 1, 2.5, b"x", ["x"], {}, object()])
def test_refuses_what_is_not_text(value):
    with pytest.raises(ExpressionError, match="must be a string"):
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
        "not " * 900 + "x",
        "lambda:" * 900 + "x",
        "x if x else " * 900 + "x",
        "x." * 9_000 + "x",
        "x**" * 6_000 + "x",
        "x(" * 150 + ")" * 150,
        "[" * 150 + "]" * 150,
    ],
    ids=["brackets", "signs", "terms", "fewer terms", "calls", "long", "not", "lambda", "if", "dots", "powers",
         "strange calls", "square"],
)  # fmt: skip
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


def test_the_reader_does_not_warn():
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        for text in ("1if x else y", "0x1for x in y", "1e5or x"):
            with pytest.raises(ExpressionError):
                parse(text)
    assert not caught


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


@pytest.mark.parametrize(
    "text",
    ["sqrt(sqrt(x))", "sqrt(2*sqrt(y))", "(x*sqrt(1 + y**2))**0.5", "sqrt(x**1.5)", "sqrt(sqrt(2))", "exp(log(x)/3)"],
)
def test_roots_of_roots_are_refused_with_a_reason(text):
    """Not so sums under a root: those have no power beyond the half-integers."""
    x, y = sp.symbols("x y")
    with pytest.raises(ExpressionError, match="root of a root") as error:
        to_sympy(text, {"x": x, "y": y})
    assert repr(text) in str(error.value)
    assert to_sympy("sqrt(1 + sqrt(x)) + sqrt(x)*sqrt(y)", {"x": x, "y": y}) == sp.sqrt(1 + sp.sqrt(x)) + sp.sqrt(
        x
    ) * sp.sqrt(y)


def test_lines_may_be_broken():
    x, y = sp.symbols("x y")
    assert to_sympy(" x +\n\ty\n", {"x": x, "y": y}) == x + y
    assert evaluate("x\n* y", {"x": 2, "y": 3}) == 6


def test_precedence_is_pythons():
    x = sp.Symbol("x")
    assert to_sympy("-x**2", {"x": x}) == -(x**2)
    assert to_sympy("2/x/3", {"x": x}) == sp.Rational(2, 3) / x
    assert to_sympy("x**-2", {"x": x}) == x**-2
    assert to_sympy("x**(1/2)", {"x": x}) == sp.sqrt(x)
    assert to_sympy("x**0.5", {"x": x}) == sp.sqrt(x)
    for text in ("x**(-1/2)", "x**-(1/2)", "x**(-(1/2))", "x**-0.5", "x**(+(-1)/2)"):
        assert to_sympy(text, {"x": x}) == 1 / sp.sqrt(x)
        assert evaluate(text, {"x": 4.0}) == 0.5
    assert to_sympy(f"x**{MAX_EXPONENT}", {"x": x}) == x**MAX_EXPONENT


def test_decimals_are_exact():
    assert to_sympy("0.1 + 0.2", {}) == sp.Rational(3, 10)


# -- functions ---------------------------------------------------------------------------------

# Within the domain of every function, for x in (-pi, pi).
ARGUMENTS = {"atan2": "(x + 4)/8, y + 5"}


def call(name, argument="(x + 4)/8"):
    return f"{name}({ARGUMENTS.get(name, argument)})"


def test_functions_agree_with_numpy():
    for name, (fewest, _, function) in FUNCTIONS.items():
        arguments = (0.3, 0.7)[:fewest]
        text = f"{name}({', '.join(map(str, arguments))})"
        assert evaluate(text, {}) == function(*arguments)
        # One rounding each.
        assert float(to_sympy(text, {})) == pytest.approx(float(function(*arguments)), rel=1e-15)


@pytest.mark.parametrize("name", FUNCTIONS)
def test_functions_go_through_the_derivation(name):
    """Inertia, force and potential with each function, against multipliers and SymPy's own derivatives."""
    f, g = call(name), call(name, "(y + 4)/8") if name != "atan2" else "atan2(y, 5)"

    def wired(f, g):
        return Mechanism.from_dict(
            {
                "name": "wired",
                "coordinates": ["x", "y", "z"],
                "parameters": {"m": 1.3},
                "inertia": [[f"m + ({f})**2", "0", "0"], ["0", "2", "0"], ["0", "0", f"1 + ({g})**2"]],
                "one_forms": [["-y", "0", "1"]],  # Heisenberg's
                "forces": {"u": [f, "1", g]},
                "potential": f"m*x*({f}) + ({g})*({f})",
                "frame": [["1", "0", "y"], ["0", "1", "0"]],
            }
        )

    # SymPy differentiates sign to a distribution; here it is 1, and so is its stranger.
    model, stranger = Model(wired(f, g)), wired("1", "1") if name == "sign" else wired(f, g)
    rng = np.random.default_rng(0)
    for _ in range(4):
        q, (vx, vy), u = rng.uniform(-3, 3, 3), rng.uniform(-2, 2, 2), rng.uniform(-2, 2, 1)
        qdot = np.array([vx, vy, q[1] * vx])
        expected = multiplier_acceleration(stranger, dict(zip("xyz", q, strict=True)) | {"m": 1.3}, qdot, u)
        # A few hundred roundings of terms of order ten.
        np.testing.assert_allclose(model.acceleration(q, model.feasible(q, qdot), u), expected, rtol=1e-11, atol=1e-11)


@pytest.mark.parametrize("backend", BACKENDS)
def test_functions_are_generated_for_every_backend(backend):
    x, y = sp.symbols("x y")
    texts = {name: call(name) for name in FUNCTIONS}
    # Of parameters alone they go into the function of the constants, which is not compiled.
    program = Program({name: to_sympy(text, {"x": x, "y": y}) for name, text in texts.items()}, [])
    source = BACKENDS[backend].header + program.function("f", [x, y], list(texts), BACKENDS[backend])
    namespace = {}
    exec(source, namespace)
    point = {"x": 0.7, "y": -0.4}
    values = namespace["f"](*point.values(), np.empty(0))
    for (name, text), value in zip(texts.items(), values, strict=True):
        # Two libraries, each good to a rounding or two.
        assert value == pytest.approx(evaluate(text, point), rel=1e-14), name


# -- numbers -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("1/0", np.inf),
        ("-1/0", -np.inf),
        ("x/(y - y)", np.inf),
        ("0/0", np.nan),
        ("(-1)**0.5", np.nan),  # Python's would be complex
        ("(-x)**(1/2)", np.nan),
        ("(pi - pi)**-1", np.inf),  # Python's would raise
        ("((9**16)**16)**16", np.inf),  # Python's would have 3909 digits, the next one 62,000
        ("(((9.5**16)**16)**16)**16", np.inf),
        ("log(0)", -np.inf),
        ("log(-1)", np.nan),
        ("asin(2)", np.nan),
        ("exp(1000)", np.inf),
        ("exp(-exp(1000))", 0.0),
    ],
)
def test_numbers_are_ieees_and_silent(text, value):
    """No exception and, since warnings are errors here, no warning."""
    np.testing.assert_equal(float(evaluate(text, {"x": 1.0, "y": 2.0})), value)
    np.testing.assert_equal(evaluate(text, {"x": np.ones(3), "y": np.ones(3)}) + np.zeros(3), np.full(3, value))


@pytest.mark.parametrize(
    "text",
    ["1/0", "0/0", "x/0", "1/(x - x)", "0**-1", "sqrt(-2)", "(-2)**(1/2)", "log(0)", "log(-1)", "tan(pi/2)",
     "atan2(0, 0)", "x*log(-1)"],
)  # fmt: skip
def test_symbols_are_real_and_finite(text):
    with pytest.raises(ExpressionError, match="no real number"):
        to_sympy(text, {"x": sp.Symbol("x")})


@pytest.mark.parametrize(
    "text",
    ["exp(1e9*log(9))", "exp(-1e9*log(9))", "exp(x + 1e9*log(9))", "exp(1e9*log(x))", "exp(x - 1e9*log(x))",
     "exp(1000)", "exp(16*log(exp(16*log(exp(16*log(exp(16*log(9))))))))",
     "exp(16*log(exp(16*log(exp(16*log(exp(16*log(x))))))))"],
)  # fmt: skip
def test_powers_in_disguise_are_not_worked_out(text):
    start = time.process_time()
    with pytest.raises(ExpressionError, match="exp of a number|a power of degree"):
        to_sympy(text, {"x": sp.Symbol("x")})
    assert time.process_time() - start < 1


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


# -- extents -----------------------------------------------------------------------------------


def rationals():
    """Rational expressions in x and y."""
    leaves = st.sampled_from(["x", "y", "2"])

    def grow(inner):
        both = st.tuples(inner, st.sampled_from("+-*/"), inner).map(lambda t: f"({t[0]} {t[1]} {t[2]})")
        return both | st.tuples(inner, st.sampled_from(["2", "3", "-1", "-2"])).map(lambda t: f"({t[0]})**{t[1]}")

    return st.recursive(leaves, grow, max_leaves=6)


@given(rationals())
def test_no_expression_is_larger_than_its_extent(text):
    x, y = sp.symbols("x y")
    try:
        expression = to_sympy(text, {"x": x, "y": y})
    except ExpressionError:  # a division by zero
        return
    bound = extent(text, {"x": QUANTITY, "y": QUANTITY})
    above, below = (sp.Poly(part, x, y).total_degree() for part in sp.fraction(sp.together(expression)))
    assert above <= bound.above
    assert below <= bound.below
    names = sum(isinstance(node, ast.Name) for node in ast.walk(parse(text)))
    assert bound.size >= names


def test_extents_of_definitions_are_written_out():
    known = {"x": QUANTITY}
    known["d"] = extent("x*x + 1", known)
    assert known["d"] == extent("x*x + 1", known)
    for text in ("d*d", "d/d", "d + 1/d", "d**3", "d**-3", "sin(d)", "-d", "sqrt(d)*d", "atan2(d, x)", "1 + d - d"):
        assert extent(text, known) == extent(text.replace("d", "(x*x + 1)"), known)
    # Terms and factors of one sum or product are on one level.
    assert extent("x + x - d", known).nesting == 2
    assert extent("+".join(["x"] * 300), known).nesting == 1
    assert extent("sin(sin(x))", known).nesting == 2
    assert extent("-sin(x)", known).nesting == 1


@pytest.mark.parametrize(
    ("inside", "beyond"),
    [("degree", f"d**{MAX_EXPONENT}*d"), ("nesting", "s + sin(s)*x"), ("size", "+".join(["b"] * 60))],
)
def test_extents_have_bounds(inside, beyond):
    known = {"x": QUANTITY}
    known["d"] = extent("*".join(["x"] * (MAX_DEGREE // MAX_EXPONENT)), known)
    known["s"] = extent("sin(" * (MAX_NESTING - 2) + "x" + ")" * (MAX_NESTING - 2), known)
    known["b"] = extent("+".join(["c"] * 10), known | {"c": extent("+".join(["x"] * 100), known)})
    for text in (f"d**{MAX_EXPONENT}", "s + sin(s)", "+".join(["b"] * 40)):
        extent(text, known)
    with pytest.raises(ExpressionError, match=f"{inside} .* is the most"):
        extent(beyond, known)

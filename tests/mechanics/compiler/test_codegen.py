"""Expressions to source: what is printed, what it computes, and what a held torque must conserve."""

import ast
import builtins
import math
import re

import numpy as np
import pytest
import sympy as sp

from mechanics.compiler.backends import BACKENDS
from mechanics.compiler.codegen import LARGEST_TURN, Program, integrated, operation_count
from mechanics.compiler.dataflow import analyse
from mechanics.compiler.integrators import method
from mechanics.expressions import ExpressionError, check_name
from mechanics.model import Model

NUMPY = BACKENDS["numpy"]
x, y, z, a, b = sp.symbols("x y z a b")


@pytest.fixture
def build(execute):
    """Source of a function of x, y, z with parameters a, b, and the function itself."""

    def make(*expressions):
        names = [f"e{i}" for i in range(len(expressions))]
        program = Program(dict(zip(names, expressions, strict=True)), [a, b])
        text = program.function("f", [x, y, z], names, NUMPY)
        functions = execute(text + "\n\n" + program.constants_function("constants", [a, b]))
        return text, lambda xyz, ab: functions["f"](*xyz, np.array(functions["constants"](ab)))

    return make


def _calls(text):
    """Names of the functions called in the body of generated source."""
    return [node.func.id for node in ast.walk(ast.parse(text)) if isinstance(node, ast.Call)]


# -- what is computed ---------------------------------------------------------------------------

FORMS = {
    "powers": x**2 + 3 * y**3 - z**4 + x**5 + (x + y) ** 7,
    "negative powers": 1 / x + 2 / y**2 - z**-3 + 1 / (x + a) ** 2,
    "roots": sp.sqrt(x + y) + (x + y) ** sp.Rational(3, 2) + (x + y) ** 2,
    "inverse roots": 1 / sp.sqrt(x * y + 1) - (x * y + 1) ** sp.Rational(-3, 2) + 1 / (x * y + 1),
    "roots of parameters": sp.sqrt(a) * x + y / sp.sqrt(b) + (a + b) ** sp.Rational(3, 2),
    "parameters": a * x + b * y - a * b * z + a / b + 3 * a * (x * b + 2 * a),
    "negative constants": -a * x - b * y + (-a) * (-b) * z,
    "functions": sp.sin(x) * sp.cos(y) + sp.tan(z) + sp.exp(-x) + sp.atan2(x, y) + sp.Abs(-x) + sp.sign(y - 9),
    "functions of parameters": sp.sin(a) * x + sp.cos(a * b) + sp.Abs(a - 10) * y,
    "shared": sp.sin(x + y) ** 2 + sp.sin(x + y) * sp.cos(x + y) / (1 + sp.sin(x + y)),
    "numbers": x / 3 + sp.Rational(7, 11) * y - sp.pi * z + sp.Float("0.1"),
    "constant": sp.Integer(3),
    "zero": sp.Integer(0),
    "parameter alone": a,
    "argument alone": x,
    "nothing but parameters": a**2 / b + sp.sqrt(a * b),
}


@pytest.mark.parametrize("form", FORMS.values(), ids=FORMS)
def test_generated_functions_compute_the_expression(form, build):
    _, function = build(form, 2 * form + 1)
    plain = sp.lambdify([(x, y, z), (a, b)], form, "math" if form.is_number else "numpy")
    rng = np.random.default_rng(0)
    for _ in range(5):
        xyz, ab = rng.uniform(0.3, 2, 3), rng.uniform(0.3, 2, 2)
        expected = plain(xyz, ab)
        # Another order of at most 20 operations.
        assert function(xyz, ab) == pytest.approx((expected, 2 * expected + 1), rel=1e-13)


def test_generated_functions_take_arrays(build):
    _, function = build(x * a + sp.sqrt(y) * sp.sin(z), sp.Abs(x) + sp.sign(y))
    columns = np.random.default_rng(0).uniform(0.3, 2, (3, 4, 2))
    values = function(columns, (0.7, 1.3))
    assert [value.shape for value in values] == [(4, 2)] * 2
    single = function(columns[:, 1, 1], (0.7, 1.3))
    # Vectorised sine may round otherwise.
    assert [value[1, 1] for value in values] == pytest.approx(single, rel=1e-15)


@pytest.mark.parametrize("power", [sp.Rational(1, 3), sp.Rational(5, 4), sp.Symbol("n"), sp.Float(0.3)])
def test_other_powers_are_refused(power):
    with pytest.raises(ValueError, match="cannot generate code for the power"):
        Program({"e": (x + y) ** power}, [])


# -- what is printed ----------------------------------------------------------------------------


def test_small_powers_are_products(build):
    text, _ = build(x**2 + y**3 + z**4, (x + y) ** 2, 1 / x**2, 1 / (y + z) ** 3)
    assert "**" not in text
    assert "pow" not in text
    for product in ("x*x", "y*y*y", "z*z*z*z"):
        assert product in text


def test_one_root_serves_every_power_of_its_base(build):
    base = x * y + a
    half = sp.Rational(1, 2)
    text, _ = build(base**half, base**-half, base ** (3 * half), base ** (-3 * half), base, 1 / base, base**-2)
    assert _calls(text) == ["sqrt"]
    assert text.count("1/") == 1
    assert "**" not in text


def test_functions_and_divisions_are_computed_once(build):
    text, _ = build(sp.sin(x) / (1 + y), sp.sin(x) ** 2, sp.cos(sp.sin(x)) / (1 + y) ** 2)
    assert sorted(_calls(text)) == ["cos", "sin"]
    assert text.count("/") == 1


def test_what_depends_on_parameters_alone_is_hoisted(build):
    """The function sees numbers worked out once: neither a parameter nor a function of one."""
    text, _ = build(sp.sin(a) * x + y * sp.sqrt(a / b) + a * b * z + (x + a**2 * b) / (a + b))
    assert not re.search(r"\b[ab]\b", text)
    assert _calls(text) == []
    assert "/" not in text
    # One constant for each coefficient of x, y, z and the one left over.
    assert text.count("_k[") <= 5


def test_a_function_unpacks_only_what_it_needs(build):
    program = Program({"first": a * x, "second": sp.sin(b) * sp.cos(y)}, [a, b])
    first = program.function("f", [x], ["first"], NUMPY)
    assert first.count("_k[") == 1
    assert "cos" not in first


def test_rationals_are_exact_decimals(build):
    text, function = build(x / 3 + sp.Rational(1, 10) * y)
    assert repr(1 / 3) in text
    assert function((3.0, 0.0, 0.0), (1, 1)) == (1.0,)


def test_operations_are_counted():
    assert operation_count(Program({"e": x * y + z}, [])) == 2
    assert operation_count(Program({"e": a * b * x}, [a, b])) == 1


def test_an_unknown_symbol_is_an_error():
    program = Program({"e": x + y}, [])
    with pytest.raises(KeyError, match="y is neither an argument nor computed"):
        program.function("f", [x], ["e"], NUMPY)


# -- names --------------------------------------------------------------------------------------


def test_the_generators_own_names_are_out_of_reach(equations, rates_of, stepper):
    """Names that the generator makes up begin with an underscore or have two inside; users get neither."""
    for name in ("_k0", "_s1", "_f2", "_h", "_tau", "phi__1", "_r_x__2", "x__new", "_a_u_psi"):
        with pytest.raises(ExpressionError, match="kept for generated names"):
            check_name(name, "coordinate")
    rates = rates_of(equations)
    values = dict(zip(equations.parameters, equations.mechanism.parameters.values(), strict=True))
    name = "dop853" if analyse(rates, list(rates)).core else "gauss4"
    _, step = stepper(rates, list(rates), name, held=equations.controls, parameters=values)
    users = {s.name for s in (*rates, *equations.controls, *equations.parameters)}
    functions = {node.name for node in ast.walk(ast.parse(step.source)) if isinstance(node, ast.FunctionDef)}
    names = {node.id for node in ast.walk(ast.parse(step.source)) if isinstance(node, ast.Name)}
    invented = names - users - functions - set(_calls(step.source)) - set(dir(builtins))
    assert invented
    assert {name for name in invented if "__" not in name and not name.startswith("_")} == set()


HOSTILE = ("h", "k", "s", "f", "p", "e", "inf", "floor", "copysign", "isfinite", "constants", "step", "new")


def test_hostile_names_change_nothing(build, stepper):
    """States and parameters may have the names that a careless generator would use itself."""
    for name in HOSTILE:
        check_name(name, "coordinate")
    h, k, s, f, p, inf, floor = sp.symbols("h k s f p inf floor")
    hostile = {h: k, k: -sp.sin(h) * p, s: sp.Abs(h) * inf + floor * sp.cos(f), f: h * p}
    tame = {old: sp.Symbol(f"t{i}") for i, old in enumerate((h, k, s, f, p, inf, floor))}
    plain = {tame[state]: rate.xreplace(tame) for state, rate in hostile.items()}
    values = (0.7, 1.3, 0.9)
    start = dict(zip(hostile, (0.4, 0.1, -0.3, 0.8), strict=True))
    _, one = stepper(hostile, list(hostile), "rk4", parameters=dict(zip((p, inf, floor), values, strict=True)))
    _, two = stepper(
        plain, list(plain), "rk4", parameters=dict(zip((tame[p], tame[inf], tame[floor]), values, strict=True))
    )
    first = one(0.1, start)
    second = two(0.1, {tame[state]: value for state, value in start.items()})
    # Terms are ordered by name, and so may be added in another order.
    assert [first[state] for state in hostile] == pytest.approx([second[tame[s]] for s in hostile], rel=1e-15)


# -- the mechanisms' own steps ------------------------------------------------------------------


@pytest.fixture
def whole_step(equations, rates_of, stepper):
    """One default step of the whole state of a mechanism, with its model."""
    rates = rates_of(equations)
    values = dict(zip(equations.parameters, equations.mechanism.parameters.values(), strict=True))
    name, substeps = ("dop853", 2) if analyse(rates, list(rates)).core else ("gauss4", 1)

    def make(output_names=None, method_name=name):
        outputs = [s for s in rates if output_names is None or s.name in output_names]
        return stepper(rates, outputs, method_name, substeps=substeps, held=equations.controls, parameters=values)

    return make


def test_energy_over_a_hold(equations, whole_step):
    """E + V - sum u_a phi_a is constant while the torques are held: they act on angles, F_a = d phi_a."""
    mechanism, model = equations.mechanism, Model(equations.mechanism)
    forces = mechanism.numeric(
        mechanism.forces.values(), {**mechanism.parameters, **dict.fromkeys(mechanism.coordinates, 0.0)}
    )
    _, step = whole_step()
    rng = np.random.default_rng(0)
    names = (*equations.coordinates, *equations.pseudo_velocities)
    worst = 0.0
    for _ in range(200):
        q, v = rng.uniform(-1.1, 1.1, mechanism.n), rng.uniform(-2, 2, mechanism.rank)
        u = rng.uniform(-1, 1, len(mechanism.forces)) * list(mechanism.torque_limits.values())
        end = step(0.05, dict(zip(names, (*q, *v), strict=True)), u)
        q1, v1 = (np.array([end[s] for s in group]) for group in (equations.coordinates, equations.pseudo_velocities))
        change = model.energy(q1, v1) - model.energy(q, v) - u @ forces @ (q1 - q)
        worst = max(worst, abs(change))
    # Snakeboard: rounding of energies of 2 J. Racer: its method's error at up to 20 rad/s.
    assert worst < {"snakeboard": 1e-13, "roller_racer": 1e-9}[mechanism.name]


def test_a_pruned_state_leaves_no_trace(equations, whole_step):
    """Neither y nor, on the snakeboard, psi occurs in the step of a task that wants x and the velocities."""
    wanted = {"x", *(v.name for v in equations.pseudo_velocities)}
    flow, step = whole_step(wanted)
    assert flow.pruned
    words = set(re.findall(r"[A-Za-z0-9]+(?:_[A-Za-z0-9]+)*", step.source.replace("__", " ")))
    assert not words & {state.name for state in flow.pruned}
    assert {state.name for state in flow.states} <= words


def test_pruning_does_not_change_what_is_left(equations, whole_step):
    """Bit for bit the numbers that the whole step gives."""
    flow, pruned = whole_step({"x", *(v.name for v in equations.pseudo_velocities)})
    _, whole = whole_step()
    rng = np.random.default_rng(1)
    names = (*equations.coordinates, *equations.pseudo_velocities)
    state = dict(zip(names, rng.uniform(-1, 1, len(names)), strict=True))
    u = rng.uniform(-0.4, 0.4, len(equations.controls))
    all_of_it, part = whole(0.05, state, u), pruned(0.05, state, u)
    # Common subexpressions may be shared otherwise, which reorders products.
    assert [part[s] for s in flow.states] == pytest.approx([all_of_it[s] for s in flow.states], rel=1e-14)


def test_steps_are_straight_lines_of_products(equations, whole_step):
    """No power, and no function but the sines, cosines and roots that the equations have at each stage."""
    flow, step = whole_step()
    body = step.source[: step.source.index("def constants")]
    assert "**" not in body
    assert set(_calls(body)) <= {"sin", "cos", "sqrt", "range"}
    for parameter in equations.parameters:
        assert not re.search(rf"\b{parameter.name}\b", body)


def test_a_stage_costs_two_angles_at_most(equations, whole_step):
    """Sine and cosine of the joint angle and of the heading at each stage at most, and the flat frame's one root."""
    _, step = whole_step()
    calls = _calls(step.source)
    stages = method({"snakeboard": "gauss4", "roller_racer": "dop853"}[equations.mechanism.name]).stages
    assert max(calls.count("sin"), calls.count("cos")) <= 2 * stages
    assert calls.count("sqrt") == (stages if equations.mechanism.name == "snakeboard" else 0)


# -- sums with one rounding, several streams, what is carried --------------------------------------


def test_sums_of_products_are_fused_and_right(execute):
    """The compiler is left nothing to contract, so that vectors and scalars round alike."""
    a, b, c, d = sp.symbols("a b c d")
    texts = {"e": a * b + c, "f": -a * d - c * d, "g": a**2 - 3 * b * c + d, "h": (a + b) * (c - d**3)}
    arguments = (a, b, c, d)
    source = Program(texts, []).function("f", arguments, list(texts), BACKENDS["numba"])
    assert source.count("fma(") == 5
    assert not re.search(r"\w\*\w+ [+-] |[+-] \w+\*", source.partition("return")[2])
    values = (1.25, -0.7, 3.1, 0.3)
    ours = execute(source, "numba")["f"](*values, np.zeros(0))
    exact = [float(text.subs(dict(zip(arguments, values, strict=True)))) for text in texts.values()]
    assert ours == pytest.approx(exact, rel=4e-16, abs=4e-16)


@pytest.mark.parametrize("name", ["rk4", "verner9"])
def test_two_streams_are_twice_one(equations, name, two_streams):
    """To the last bit, and the same is true of what is carried from the step before."""
    rates = dict(zip(equations.coordinates, equations.velocity, strict=True))
    rates |= dict(zip(equations.pseudo_velocities, equations.acceleration, strict=True))
    flow = analyse(rates, list(rates))
    program = Program(integrated(flow), [sp.Symbol(p) for p in equations.mechanism.parameters])
    two_streams(equations, program, flow, method(name))


def test_nothing_is_carried_where_a_step_does_not_begin_with_a_stage(equations):
    rates = dict(zip(equations.pseudo_velocities, equations.acceleration, strict=True))
    rates |= dict(zip(equations.coordinates, equations.velocity, strict=True))
    flow = analyse(rates, list(rates))
    program = Program(integrated(flow), [sp.Symbol(p) for p in equations.mechanism.parameters])
    assert program.carried(flow, method("gauss4")) == {}


# -- whether a step is right ----------------------------------------------------------------------

PENDULUM = {x: y, y: -sp.sin(x)}


@pytest.fixture
def flight(execute):
    """Generate a step with a tolerance: source, and function (h, *states) -> (*states, right), of each stream."""

    def make(rates, name, tolerance, *, outputs=None, backend="numpy", **options):
        flow = analyse(rates, outputs or list(rates))
        source = Program(integrated(flow), []).step_function(
            "step",
            flow,
            method(name),
            options.pop("substeps", 1),
            (),
            BACKENDS[backend],
            tolerance=tolerance,
            **options,
        )
        step = execute(source, backend)["step"]
        order = {state: i for i, state in enumerate(state for state in rates if state in flow.states)}
        places = [order[state] for state in flow.states]

        def call(*streams):
            return step(*(number for h, *state in streams for number in (h, *(state[i] for i in places))), np.zeros(0))

        return source, call

    return make


def _by_hand(name, h, start):
    """The estimates of both states of Duffing's oscillator, each in proportion to one more than its size."""
    row = method(name)
    a, b, d = np.array(row.a), np.array(row.b), np.array([weights for weights, _ in row.estimates])
    rates = np.zeros((row.stages, 2))
    for i in range(row.stages):
        place, speed = start + h * a[i] @ rates
        rates[i] = speed, -(place**3)
    return np.abs(h * d @ rates) / (1 + np.abs(start + h * b @ rates))


@pytest.mark.parametrize("backend", ["numpy", "numba"])
@pytest.mark.parametrize(("name", "tolerance"), [("rk4", 1e-6), ("dop853", 1e-10), ("verner9", 1e-10)])
def test_a_step_is_right_if_the_estimates_of_all_states_are_small(name, tolerance, backend, flight):
    """By hand, from the tableau."""
    thresholds = np.array(method(name).thresholds(tolerance))[:, None]
    _, step = flight({x: y, y: -(x**3)}, name, tolerance, backend=backend)
    rng, decided = np.random.default_rng(0), {(False, False): 0, (False, True): 0, (True, False): 0, (True, True): 0}
    for _ in range(800):
        start = rng.uniform(-3, 3, 2) * 10 ** rng.uniform(-1, 1.5, 2)
        h = 10 ** rng.uniform(-2.5, 0.2) / np.abs(start).max()
        small = tuple((_by_hand(name, h, start) <= thresholds).all(axis=0).tolist())
        assert step((h, *start))[-1] == all(small)
        decided[small] += 1
    # Each has its say on its own.
    assert min(decided.values()) >= 1


@pytest.mark.parametrize("name", ["rk4", "verner9", "gauss4", "lobatto6"])
def test_each_integrated_state_has_its_say(name, flight):
    """Of two states that know nothing of one another, either one makes a step wrong."""
    forms = {x: sp.Integer(1), y: sp.exp(-(x**2)), z: sp.exp(-((x - 10) ** 2))}  # steep near x = 0, and near x = 10
    for rates in (forms, {x: forms[x], z: forms[z], y: forms[y]}):
        _, step = flight(rates, name, 1e-8)
        for begin, right in ((-30.0, True), (-0.7, False), (9.3, False), (30.0, True)):
            assert step((2.0, begin, 0.0, 0.0))[-1] == right
    # What is pruned has none.
    _, step = flight(forms, name, 1e-8, outputs=[y])
    assert step((2.0, 9.3, 0.0))[-1]


@pytest.mark.parametrize("name", ["rk4", "lobatto6"])
def test_every_substep_must_be_right(name, flight):
    """The one in which something happens may be the first, the last or one between."""
    rates = {x: sp.Integer(1), y: sp.exp(-100 * x**2)}
    _, whole = flight(rates, name, 1e-6)
    _, split = flight(rates, name, 1e-6, substeps=4)
    for begin in (0.0, -1.0, -2.0, -3.0, -4.0):
        assert not split((4.0, begin, 0.0))[-1]
    for begin in (-9.0, 5.0):
        assert split((4.0, begin, 0.0))[-1]
    # Short ones are right where a long one is not.
    _, split = flight(rates, name, 1e-6, substeps=64)
    assert not whole((0.5, 0.0, 0.0))[-1]
    assert split((0.5, 0.0, 0.0))[-1]


@pytest.mark.parametrize("name", ["rk4", "lobatto6"])
@pytest.mark.parametrize("side", [1, -1])
def test_a_step_turns_angles_only_so_far(name, side, flight):
    """Even where the estimate sees nothing wrong. What is no angle may go as far as it likes."""
    _, step = flight({x: sp.Integer(side), y: 1e-12 * sp.cos(x) + z, z: sp.Integer(0)}, name, 1e-3)
    assert step((0.999 * LARGEST_TURN, 0.2, 0.0, 100.0))[-1]
    assert not step((1.001 * LARGEST_TURN, 0.2, 0.0, 0.0))[-1]


@pytest.mark.parametrize("name", ["rk4", "lobatto6"])
def test_what_is_no_number_is_not_right(name, flight):
    rates = {x: y**2, y: sp.cos(z), z: sp.Integer(1)}
    _, step = flight(rates, name, 1e-6)
    assert step((0.01, 0.1, 0.2, 0.3))[-1]
    for place in range(2):
        state = [0.1, 0.2, 0.3]
        state[place] = math.nan
        assert not step((0.01, *state))[-1]


@pytest.mark.parametrize("backend", ["numpy", "numba"])
def test_each_stream_is_right_or_not(backend, flight):
    """And what it says is what one stream says."""
    _, one = flight(PENDULUM, "rk4", 1e-6, backend=backend)
    _, two = flight(PENDULUM, "rk4", 1e-6, backend=backend, streams=2)
    good, bad = (0.01, 0.4, 0.9), (0.9, 0.4, 0.9)
    assert (one(good)[-1], one(bad)[-1]) == (True, False)
    for pair in ((good, bad), (bad, good), (good, good), (bad, bad)):
        assert two(*pair) == (*one(pair[0]), *one(pair[1]))


@pytest.mark.parametrize("streams", [1, 2])
@pytest.mark.parametrize("name", ["rk4", "lobatto6"])
def test_without_a_tolerance_a_step_bears_no_trace_of_one(name, streams, flight):
    """Neither weights of an estimate nor a comparison, and the same numbers as with one."""
    rates = {x: sp.Integer(1), y: sp.sin(x), z: sp.cos(x) * y}
    plain, step = flight(rates, name, math.inf, streams=streams)
    checked, other = flight(rates, name, 1e-3, streams=streams)
    traces = ("_d_", "fabs(", "<=", repr(LARGEST_TURN))
    assert not any(trace in plain for trace in traces)
    assert all(trace in checked for trace in traces[1:])
    arguments = [(0.1, 0.2, 0.3, 0.4)] * streams
    assert step(*arguments) == other(*arguments)
    assert plain.count("True") == streams

"""The dependency graph: what is pruned, what is layered, and which kind each layer is."""

import itertools

import pytest
import sympy as sp

from mechanics.compiler.dataflow import MAX_DEGREE, TAU, analyse, initial

a, b, c, d, e, f = sp.symbols("a b c d e f")
u = sp.Symbol("u")  # held over a step


def _layers(flow):
    return [(layer.kind, [state.name for state in layer.states]) for layer in flow.layers]


# -- small graphs -------------------------------------------------------------------------------


def test_what_no_output_reaches_is_pruned():
    flow = analyse({a: u, b: a, c: sp.sin(b), d: c * a}, [b + 1])
    assert flow.pruned == (c, d)
    assert set(flow.rates) == set(flow.states) == {a, b}


def test_outputs_reach_through_rates_of_rates():
    flow = analyse({a: sp.sin(b), b: sp.sin(c), c: sp.sin(d), d: d, e: a}, [a])
    assert flow.pruned == (e,)
    assert flow.states == (d, c, b, a)


def test_nothing_is_wanted():
    flow = analyse({a: b, b: a}, [u, sp.Integer(1)])
    assert flow.states == flow.layers == ()
    assert flow.pruned == (a, b)


def test_each_layer_uses_earlier_ones_only():
    """Whatever the order in which the states are given, layers come after what they use."""
    rates = {a: u, b: sp.cos(a), c: sp.sin(b) * a, d: e + c, e: -d, f: d * e}
    for order in itertools.permutations(rates):
        flow = analyse({state: rates[state] for state in order}, [f])
        known = set()
        for layer in flow.layers:
            for state in layer.states:
                uses = rates[state].free_symbols & set(rates)
                assert uses <= known | (set(layer.states) if layer.kind == "core" else set())
            known |= set(layer.states)
        assert {layer.kind: set(layer.states) for layer in flow.layers if layer.kind == "core"} == {"core": {d, e}}
        assert set(flow.core) == {d, e}


def test_a_state_that_uses_itself_is_a_core():
    flow = analyse({a: -a, b: a}, [b])
    assert _layers(flow) == [("core", ["a"]), ("quadrature", ["b"])]
    assert flow.core == (a,)


def test_two_cores_stay_apart():
    flow = analyse({a: b, b: a, c: d + a, d: c}, [c])
    assert _layers(flow) == [("core", ["a", "b"]), ("core", ["c", "d"])]


def test_polynomials_in_time_are_exact():
    """A chain of integrators is exact up to the degree at which a quadrature is cheaper, and not beyond."""
    chain = sp.symbols("q0:8")
    rates = {chain[0]: u, **{state: before for before, state in itertools.pairwise(chain)}}
    flow = analyse(rates, [chain[-1]])
    kinds = [layer.kind for layer in flow.layers]
    assert kinds == ["exact"] * MAX_DEGREE + ["quadrature"] * (len(chain) - MAX_DEGREE)
    for state in chain[:MAX_DEGREE]:
        solution = flow.solutions[state]
        assert solution.xreplace({TAU: sp.S.Zero}) == initial(state)
        # Its derivative is the rate, with the states as they are then.
        rate = rates[state].xreplace(flow.solutions)
        assert sp.expand(sp.diff(solution, TAU) - rate) == 0


def test_products_of_exact_states_are_exact():
    flow = analyse({a: u, b: a**2 + u, c: b * sp.sin(u)}, [c])
    assert [layer.kind for layer in flow.layers] == ["exact", "exact", "exact"]
    assert sp.expand(sp.diff(flow.solutions[b], TAU) - (initial(a) + u * TAU) ** 2 - u) == 0


def test_functions_and_quotients_of_time_are_quadratures():
    flow = analyse({a: u, b: sp.sin(a), c: 1 / (1 + a), d: b, e: sp.sqrt(a)}, [b, c, d, e])
    assert dict((s, kind) for kind, [s] in _layers(flow)) == {
        "a": "exact",
        "b": "quadrature",
        "c": "quadrature",
        "d": "quadrature",
        "e": "quadrature",
    }


# -- the mechanisms -----------------------------------------------------------------------------


@pytest.fixture
def flow_of(equations, rates_of):
    """Dataflow of a mechanism for outputs given by name."""

    def analysed(names):
        rates = rates_of(equations)
        return analyse(rates, [state for state in rates if state.name in names])

    return analysed


def test_layers_of_a_forward_task(flow_of, equations):
    """x, the heading and all velocities are wanted: y is not, nor the snakeboard's rotor angle."""
    pseudo = [v.name for v in equations.pseudo_velocities]
    flow = flow_of(["x", "theta", *pseudo])
    kinds = {state.name: layer.kind for layer in flow.layers for state in layer.states}
    order = [state.name for state in flow.states]
    if equations.mechanism.name == "snakeboard":
        assert [state.name for state in flow.pruned] == ["y", "psi"]
        # c1, phi' and phi exact in time, then c2, then theta, then x: no core at all in the flat frame.
        assert {name for name, kind in kinds.items() if kind == "exact"} == {"v1", "v3", "phi"}
        assert order[3:] == ["v2", "theta", "x"]
        assert set(kinds.values()) == {"exact", "quadrature"}
    else:
        assert [state.name for state in flow.pruned] == ["y"]
        assert {name for name, kind in kinds.items() if kind == "core"} == {"psi", "v1", "v2"}
        assert order[3:] == ["theta", "x"]
        assert set(kinds.values()) == {"core", "quadrature"}


def test_a_velocity_task_never_integrates_the_pose(flow_of, equations):
    flow = flow_of([v.name for v in equations.pseudo_velocities])
    assert {"x", "y", "theta"} <= {state.name for state in flow.pruned}


def test_what_the_position_needs(flow_of, equations):
    """The snakeboard's rotor moves it by its torque alone: neither its angle nor its speed matters."""
    pruned = {"snakeboard": ["psi", "v1"], "roller_racer": []}[equations.mechanism.name]
    assert [state.name for state in flow_of(["x", "y"]).pruned] == pruned

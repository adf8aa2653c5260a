"""`Mechanism` proves its own data: what cannot be a mechanism is refused with a reason."""

import copy
import dataclasses
import json
import math

import numpy as np
import pytest
import sympy as sp

import mechanics
from mechanics import Mechanism, Model
from mechanics.expressions import ExpressionError, to_sympy
from mechanics.mechanism import MechanismError

SLEIGH = {
    "name": "sleigh",
    "coordinates": ["x", "y", "theta"],
    "parameters": {"m": 2.0, "J": 0.5},
    "inertia": [["m", "0", "0"], ["0", "m", "0"], ["0", "0", "J"]],
    "one_forms": [["-sin(theta)", "cos(theta)", "0"]],
    "forces": {"F": ["cos(theta)", "sin(theta)", "0"]},
    "frame": [["cos(theta)", "sin(theta)", "0"], ["0", "0", "1"]],
}


def sleigh(**changes):
    return copy.deepcopy(SLEIGH) | changes


BROKEN = {
    "a key that does not exist": (sleigh(inertai=[]), "unknown key 'inertai'.*Did you mean 'inertia'"),
    "an unknown name": (
        sleigh(inertia=[["M", "0", "0"], ["0", "m", "0"], ["0", "0", "J"]]),
        "in inertia: unknown name 'M'; known: .*m",
    ),
    "inertia of the wrong size": (sleigh(inertia=[["m", "0"], ["0", "m"]]), "inertia must be 3 x 3"),
    "inertia not symmetric": (sleigh(inertia=[["m", "1", "0"], ["0", "m", "0"], ["0", "0", "J"]]), "not symmetric"),
    "inertia indefinite": (sleigh(parameters={"m": 2.0, "J": -0.5}), "not positive definite"),
    "inertia indefinite by coupling": (
        sleigh(inertia=[["m", "0", "0"], ["0", "m", "2*m"], ["0", "2*m", "J"]]),
        "not positive definite",
    ),
    "inertia singular": (sleigh(inertia=[["m", "m", "0"], ["m", "m", "0"], ["0", "0", "J"]]), "not positive definite"),
    "a one-form of the wrong size": (sleigh(one_forms=[["1", "0"]]), "one_forms must be"),
    "as many one-forms as coordinates": (sleigh(one_forms=[["1", "0", "0"]] * 3), "one_forms must be"),
    "dependent one-forms": (
        sleigh(
            one_forms=[["-sin(theta)", "cos(theta)", "0"], ["-2*sin(theta)", "2*cos(theta)", "0"]],
            frame=[["0", "0", "1"]],
        ),
        "not independent",
    ),
    "a force of the wrong size": (sleigh(forces={"F": ["1"]}), "force 'F' must have 3 components"),
    "a frame of too few fields": (sleigh(frame=[["0", "0", "1"]]), "must be 2 vector fields of 3"),
    "a frame outside D": (sleigh(frame=[["1", "0", "0"], ["0", "0", "1"]]), "field 1 violates constraint one-form 1"),
    "a frame of dependent fields": (
        sleigh(frame=[["cos(theta)", "sin(theta)", "1"], ["-2*cos(theta)", "-2*sin(theta)", "-2"]]),
        "its 2 vector fields are not independent",
    ),
    "a frame that is zero": (sleigh(frame=[["cos(theta)", "sin(theta)", "0"], ["0", "0", "0"]]), "field 2 is zero"),
    "a frame that is not finite": (
        sleigh(frame=[["cos(theta)", "sin(theta)", "0"], ["0", "0", "1/(m - m)"]]),
        "not finite",
    ),
    "no coordinates": (
        sleigh(coordinates=[], inertia=[], one_forms=[], forces={}, frame=[]),
        "at least one coordinate",
    ),
    "a name used twice": (sleigh(parameters={"m": 2.0, "J": 0.5, "x": 1.0}), "both a coordinate and a parameter"),
    "a name kept for pseudo-velocities": (
        sleigh(parameters={"m": 2.0, "J": 0.5, "v1": 1.0}),
        "kept for the pseudo-velocities",
    ),
    "a reserved word": (sleigh(parameters={"m": 2.0, "J": 0.5, "lambda": 1.0}), "reserved word"),
    "a parameter that is not finite": (sleigh(parameters={"m": 2.0, "J": math.inf}), "not finite"),
    "attribute access": (sleigh(potential="m.__class__"), "not allowed"),
    "a call": (sleigh(potential="__import__(x)"), "unknown function '__import__'"),
    "a huge exponent": (sleigh(potential="m**1000000"), "exponent"),
    "deep nesting": (sleigh(potential="-" * 3000 + "m"), "nests|cannot read"),
    "a text for a row": (sleigh(one_forms=["abc"]), "must be a list of strings"),
    "a limit of zero": (sleigh(joint_limits={"theta": 0.0}), "positive and finite"),
    "a limit of an unknown joint": (sleigh(joint_limits={"thetta": 1.0}), "Did you mean 'theta'"),
    "a fibre of two": (sleigh(fibre=["x", "y"]), "fibre names"),
}


@pytest.mark.parametrize("case", BROKEN)
def test_refuses(case):
    spec, reason = BROKEN[case]
    with pytest.raises(MechanismError, match=reason):
        Mechanism.from_dict(spec)


def test_both_errors_are_value_errors():
    assert issubclass(MechanismError, ValueError)
    assert issubclass(ExpressionError, ValueError)


@pytest.mark.parametrize("key", ["name", "coordinates", "parameters", "inertia", "one_forms", "forces"])
def test_names_the_key_that_is_missing(key):
    with pytest.raises(MechanismError, match=f"lacks '{key}'"):
        Mechanism.from_dict({k: v for k, v in SLEIGH.items() if k != key})


@pytest.mark.parametrize("spec", [None, [], "sleigh", 3])
def test_refuses_what_is_not_a_mapping(spec):
    with pytest.raises(MechanismError, match="must be a mapping"):
        Mechanism.from_dict(spec)


def test_a_frame_may_be_oblique_or_left_out():
    oblique = [["cos(theta)", "sin(theta)", "1"], ["0", "0", "1"]]
    assert Mechanism.from_dict(sleigh(frame=oblique)).frame_rows() == tuple(map(tuple, oblique))
    assert Mechanism.from_dict({key: value for key, value in SLEIGH.items() if key != "frame"}).frame_rows() is None


@pytest.mark.parametrize("scale", ["1e-99", "1e90**3", "m"])
def test_constraints_and_frames_may_have_any_scale(scale):
    """Only directions matter; a square of such a number would be zero or infinite."""
    forms = [["-sin(theta)", "cos(theta)", "0"], ["0", "0", scale]]
    frame = [[f"{scale}*cos(theta)", f"{scale}*sin(theta)", "0"]]
    assert Mechanism.from_dict(sleigh(one_forms=forms, frame=frame)).rank == 1
    with pytest.raises(MechanismError, match="violates constraint one-form 2"):
        Mechanism.from_dict(sleigh(one_forms=forms, frame=[["cos(theta)", "sin(theta)", "1"]]))


def test_a_limit_may_be_as_large_as_a_number():
    """Twice as much, the width of the range, is none."""
    assert Mechanism.from_dict(sleigh(joint_limits={"theta": 1e308})).joint_limits == {"theta": 1e308}


def test_definitions_of_a_mechanism_come_in_order():
    """A spec may have them in any order (test_spec.py); the class itself does not sort."""
    whole = Mechanism.from_dict(sleigh(definitions={"a": "m", "b": "a*J"}))
    assert dataclasses.replace(whole, definitions={"a": "m", "b": "a*x"}).definitions["b"] == "a*x"
    with pytest.raises(MechanismError, match="in definition 'b': 'a' is used before it is defined"):
        dataclasses.replace(whole, definitions={"b": "a*J", "a": "m"})


def test_a_logarithm_may_lack_a_value_somewhere():
    Mechanism.from_dict(sleigh(potential="log(x)", forces={"F": ["sqrt(x)", "0", "0"]}))


@pytest.mark.parametrize("name", mechanics.names())
def test_survives_json(name):
    mechanism = mechanics.get(name)
    assert Mechanism.from_dict(json.loads(json.dumps(mechanism.to_dict()))) == mechanism


@pytest.mark.parametrize("name", mechanics.names())
def test_catalogue_entries_know_their_name_and_source(name):
    mechanism = mechanics.get(name)
    assert mechanism.name == name
    assert mechanism.citation
    assert set(mechanism.torque_limits) <= set(mechanism.controls)


def test_unknown_names_come_with_a_suggestion():
    with pytest.raises(MechanismError, match="Did you mean 'snakeboard'"):
        mechanics.get("snakebord")
    board = mechanics.get("snakeboard")
    with pytest.raises(MechanismError, match="Did you mean 'flat'"):
        board.frame_rows("falt")
    with pytest.raises(MechanismError, match="Did you mean 'J_r'"):
        board.resolve({"Jr": 1.0})


def test_parameters_that_cannot_be_are_refused():
    board = mechanics.get("snakeboard")
    edge = board.parameters["m"] * board.parameters["l"] ** 2
    with pytest.raises(MechanismError, match="not positive definite"):
        board.resolve({"J_r": edge * 1.01})
    # Just inside: a rotor whose inertia is nearly that of the whole.
    assert board.resolve({"J_r": edge * (1 - 1e-9)})["J_r"] < edge
    for bad in (math.nan, math.inf, "heavy", None):
        with pytest.raises(MechanismError):
            board.resolve({"m": bad})
    with pytest.raises(MechanismError, match="not positive definite"):
        board.resolve({"m": 0.0})


def test_a_frame_given_by_hand_is_checked():
    board = mechanics.get("snakeboard")
    rows = board.frames["paper"]
    assert board.frame_rows([list(row) for row in rows]) == rows
    with pytest.raises(MechanismError, match="violates"):
        board.frame_rows([["1", "0", "0", "0", "0"], *rows[1:]])


def test_numbers_and_symbols_are_of_the_same_expressions():
    racer = mechanics.get("roller_racer")
    values = dict(racer.parameters) | {"x": 0.1, "y": 0.2, "theta": 0.3, "psi": 0.4}
    symbols = {sp.Symbol(name): value for name, value in values.items()}
    for rows in (racer.inertia, racer.one_forms, *racer.frames.values()):
        exact = [[float(racer.symbolic(text).subs(symbols)) for text in row] for row in rows]
        # A few dozen roundings of numbers of order one to ten.
        np.testing.assert_allclose(racer.numeric(rows, values), exact, rtol=1e-12, atol=1e-14)


@pytest.mark.parametrize("name", mechanics.names())
def test_numbers_come_in_arrays_too(name):
    """One array of points gives what the points give one by one."""
    mechanism = mechanics.get(name)
    rng = np.random.default_rng(0)
    points = {q: rng.uniform(-1, 1, (2, 3)) for q in mechanism.coordinates} | dict(
        mechanism.parameters | mechanism.drag
    )
    single = [{**points, **{q: points[q][i] for q in mechanism.coordinates}} for i in np.ndindex(2, 3)]
    entries = [mechanism.inertia, mechanism.one_forms, tuple(mechanism.forces.values()), *mechanism.frames.values()]
    for rows in filter(None, entries):
        together = mechanism.numeric(rows, points)
        assert together.shape == (2, 3, len(rows), mechanism.n)
        # NumPy's functions of arrays may round otherwise than those of numbers.
        np.testing.assert_allclose(
            together.reshape(6, len(rows), -1), [mechanism.numeric(rows, p) for p in single], rtol=1e-13, atol=1e-13
        )
    assert mechanism.numeric((mechanism.potential,), points).shape == (2, 3, 1)
    tensor = mechanism.drag_tensor(points)
    assert tensor.shape == (2, 3, mechanism.n, mechanism.n)
    np.testing.assert_allclose(
        tensor.reshape(6, mechanism.n, -1), [mechanism.drag_tensor(p) for p in single], rtol=1e-13, atol=1e-13
    )


def test_the_drag_tensor_is_the_hessian():
    """Second derivatives by SymPy, at a point."""
    snake = mechanics.get("snake")
    rates = {name: sp.Symbol(name) for name in snake.rates}
    values = {q: 0.1 * (i + 1) for i, q in enumerate(snake.coordinates)} | dict(snake.parameters) | dict(snake.drag)
    function = to_sympy(snake.rayleigh, snake.scope() | rates).subs({sp.Symbol(k): v for k, v in values.items()})
    exact = np.array(sp.hessian(function, list(rates.values())), dtype=float)
    # A dozen roundings.
    np.testing.assert_allclose(snake.drag_tensor(values), exact, rtol=1e-12, atol=1e-14)


def test_drag_coefficients():
    spec = sleigh(rayleigh="(a*x_dot**2 + b*(y_dot - x_dot)**2)/2", drag={"a": 0.1, "b": 0})
    mechanism = Mechanism.from_dict(spec)
    for none in (None, False, np.False_):
        assert mechanism.drag_coefficients(none) is None
    assert mechanism.drag_coefficients(True) == mechanism.drag_coefficients(np.True_) == mechanism.drag_coefficients({})
    assert mechanism.drag_coefficients(True) == {"a": 0.1, "b": 0.0}
    assert mechanism.drag_coefficients({"b": 2}) == {"a": 0.1, "b": 2.0}
    for given, reason in (
        ({"c": 1.0}, "unknown drag coefficient 'c'"),
        ({"a": -1.0}, "at least 0"),
        ({"a": math.nan}, "not finite"),
        ({"a": "1"}, "must be a number"),
        (3.0, "must be True"),
    ):
        with pytest.raises(MechanismError, match=reason):
            mechanism.drag_coefficients(given)
    with pytest.raises(MechanismError, match=r"has no drag.* as these do: snakeboard, roller_racer") as error:
        Mechanism.from_dict(SLEIGH).drag_coefficients(True)
    assert "suslov" not in str(error.value)


def test_drag_without_coefficients_acts_too():
    """Whether drag acts and which coefficients it has are two questions."""
    mechanism = Mechanism.from_dict(sleigh(rayleigh="x_dot**2"))
    assert mechanism.drag_coefficients(True) == {}
    q, v = np.zeros(mechanism.n), np.ones(mechanism.rank)
    u = np.zeros(len(mechanism.controls))
    rates = [Model(mechanism, drag=drag).rates(q, v, u) for drag in (True, False)]
    assert np.abs(rates[0] - rates[1]).max() > 0.1


def test_a_mechanism_without_its_drag_is_one_that_never_had_any():
    spec = sleigh(rayleigh="a*x_dot**2", drag={"a": 0.1})
    assert Mechanism.from_dict(spec).without_drag() == Mechanism.from_dict(SLEIGH)

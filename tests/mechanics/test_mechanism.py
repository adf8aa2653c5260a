"""`Mechanism` proves its own data: what cannot be a mechanism is refused with a reason."""

import contextlib
import copy
import json
import math

import numpy as np
import pytest
import sympy as sp
from hypothesis import given, settings
from hypothesis import strategies as st

import mechanics
from mechanics import Mechanism
from mechanics.expressions import ExpressionError
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
    "a frame not orthogonal": (
        sleigh(frame=[["cos(theta)", "sin(theta)", "1"], ["0", "0", "1"]]),
        "fields 1 and 2 are not orthogonal",
    ),
    "a frame that is zero": (sleigh(frame=[["cos(theta)", "sin(theta)", "0"], ["0", "0", "0"]]), "field 2 is zero"),
    "a frame that is not finite": (
        sleigh(frame=[["cos(theta)", "sin(theta)", "0"], ["0", "0", "1/(m - m)"]]),
        "not finite",
    ),
    "no frame": ({key: value for key, value in SLEIGH.items() if key != "frame"}, "at least one frame"),
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
    "a call": (sleigh(potential="__import__('os').getcwd()"), "not allowed|unknown function"),
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
    with pytest.raises((MechanismError, ExpressionError), match=reason):
        Mechanism.from_dict(spec)


@pytest.mark.parametrize("key", ["name", "coordinates", "parameters", "inertia", "one_forms", "forces"])
def test_names_the_key_that_is_missing(key):
    with pytest.raises(MechanismError, match=f"lacks '{key}'"):
        Mechanism.from_dict({k: v for k, v in SLEIGH.items() if k != key})


@pytest.mark.parametrize("spec", [None, [], "sleigh", 3])
def test_refuses_what_is_not_a_mapping(spec):
    with pytest.raises(MechanismError, match="must be a mapping"):
        Mechanism.from_dict(spec)


@given(
    st.dictionaries(
        st.sampled_from(list(SLEIGH)),
        st.recursive(st.none() | st.integers() | st.text(max_size=5), st.lists),
        min_size=1,
    )
)
@settings(max_examples=200, deadline=None)
def test_any_json_is_read_or_refused_with_a_reason(changes):
    """Whatever a file holds, the answer is a mechanism or one of the two documented errors."""
    with contextlib.suppress(MechanismError, ExpressionError):
        Mechanism.from_dict(sleigh(**changes))


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

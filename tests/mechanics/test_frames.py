"""The frame that is found when none is given: what it looks like, and where it is smooth.

That it spans D, is orthogonal, and has no pole where the forms are independent, is asked of every mechanism
in test_every_mechanism.py.
"""

import dataclasses

import numpy as np
import pytest
import sympy as sp

import mechanics
from mechanics import Mechanism, Model
from mechanics.geometry import reduce
from mechanics.geometry.reduction import derive

theta, phi, l, m, J_r = sp.symbols("theta phi l m J_r")


def frame_of(one_forms, coordinates, parameters=None, joint_limits=None, fibre=()):
    """Rows of the frame found with unit masses."""
    n = len(coordinates)
    mechanism = Mechanism.from_dict(
        {
            "name": "test",
            "coordinates": coordinates,
            "parameters": parameters or {},
            "inertia": [["1" if a == b else "0" for b in range(n)] for a in range(n)],
            "one_forms": one_forms,
            "forces": {},
            "joint_limits": joint_limits or {},
            "fibre": fibre,
        }
    )
    return reduce(mechanism).frame.T.tolist()


def test_a_knife_edge_gets_its_sine_and_cosine():
    """Not (1, tanθ), whose pole at π/2 is the pivot's."""
    rows = frame_of([["sin(theta)", "-cos(theta)", "0"]], ["x", "b", "theta"])  # no pose in the plane to help
    assert rows == [[0, 0, 1], [sp.cos(theta), sp.sin(theta), 0]]


def test_without_constraints_the_coordinate_fields_are_orthogonalised():
    assert frame_of([], ["a", "b"]) == [[1, 0], [0, 1]]


def test_a_constant_is_a_better_pivot_than_a_function():
    rows = frame_of([["cos(a)", "2", "1 + a**2"]], ["a", "b", "c"])
    assert rows[0] == [2, -sp.cos(sp.Symbol("a")), 0]


def test_the_snakeboard_is_steered_through_the_right_angle():
    """D's smooth extension at φ = π/2, where the forms are dependent; and no Γ̃ but those of one length."""
    board = dataclasses.replace(mechanics.get("snakeboard"), frames={})
    e = reduce(board)
    expected = [l * sp.cos(phi) * sp.cos(theta), l * sp.cos(phi) * sp.sin(theta), -sp.sin(phi), sp.sin(phi), 0]
    fields = e.frame.T.tolist()
    assert [0, 0, 0, 1, 0] in fields
    assert any([a - b for a, b in zip(field, expected, strict=True)] == [0] * 5 for field in fields)
    assert fields[-1] == [0, 0, 0, 0, 1]  # the steering has stops: its field is the last
    model = Model(board)
    q = np.array([0.3, 0.1, 0.7, 0.2, np.pi / 2])
    assert np.linalg.matrix_rank(np.array([model.velocity(q, row) for row in np.eye(3)])) == 3


def test_a_joint_with_a_stop_is_moved_by_one_field():
    """So that an inelastic impact is a clamp; without the stop the racer gets the frame without any singularity."""
    racer = dataclasses.replace(mechanics.get("roller_racer"), frames={})
    assert [entry == 0 for entry in reduce(racer).frame.row(3)] == [True, False]
    free = dataclasses.replace(racer, joint_limits={}, parameters={**racer.parameters, "l_2": 0.3})
    model = Model(free)
    at_the_worst = np.array([0.0, 0.0, 0.4, np.pi])  # ℓ1 = ℓ2, ψ = π
    frame = np.array([model.velocity(at_the_worst, row) for row in np.eye(2)])
    assert np.linalg.svd(frame, compute_uv=False)[-1] > 0.1


@pytest.mark.parametrize("steering", [0.0, np.pi / 2, np.pi])
def test_a_car_drives_straight_and_turns_on_the_spot(steering):
    car = dataclasses.replace(mechanics.get("car"), frames={})
    model = Model(car)
    frame = np.array([model.velocity([0.1, 0.2, 0.3, steering], row) for row in np.eye(2)])
    assert np.linalg.matrix_rank(frame, tol=1e-6) == 2


def test_three_entries_none_of_which_stays_away_from_zero():
    """On a sphere's tangent planes no global frame exists; away from a pole there is one."""
    rows = frame_of([["sin(a)*cos(b)", "sin(a)*sin(b)", "cos(a)"]], ["a", "b", "c"])
    normal = np.array([0.6 * 0.8, 0.6 * 0.6, 0.8])
    values = {"a": np.arcsin(0.6), "b": np.arcsin(0.6)}
    fields = np.array([[float(e.subs(values)) for e in row] for row in rows])
    # A dozen operations.
    np.testing.assert_allclose(fields @ normal, 0, atol=1e-14)
    assert np.linalg.matrix_rank(fields) == 2


def test_a_given_frame_is_orthogonalised_as_in_eq_9():
    """The paper's X2 from X1, ∂ψ and ∂φ."""
    board = mechanics.get("snakeboard")
    rows = [
        ["l*cos(phi)*cos(theta)", "l*cos(phi)*sin(theta)", "-sin(phi)", "0", "0"],
        ["0", "0", "0", "1", "0"],
        ["0", "0", "0", "0", "1"],
    ]
    natural, paper = reduce(board, rows), reduce(board, "paper")
    difference = natural.frame - paper.frame
    assert difference.applyfunc(sp.expand) == sp.zeros(5, 3)
    assert natural.christoffel == paper.christoffel


@pytest.mark.parametrize("links", [4, pytest.param(8, marks=pytest.mark.slow)])
def test_long_snakes_are_derived_in_named_steps(links):
    """The exact algebra would take hours; every step is short, and no formula uses a step before it is defined."""
    from mechanics.catalog.snake import n_link_snake

    e = derive(n_link_snake(links))
    known = {*e.coordinates, *e.parameters, *e.pseudo_velocities, *e.controls}
    for symbol, expression in e.definitions:
        assert expression.free_symbols <= known
        known.add(symbol)
    assert set().union(*(rate.free_symbols for rate in e.acceleration)) <= known
    assert not reduce(n_link_snake(3)).definitions

"""Trailers against their positions, against the equation of their common motion, and which way they follow."""

import numpy as np
import pytest
import sympy as sp

import mechanics
from mechanics.catalog.trailer import n_trailer
from mechanics.geometry import reduce
from mechanics.mechanism import MechanismError
from mechanics.model import Model


def axles(mechanism, n):
    """Position and heading of each axle."""
    s = mechanism.symbols
    x, y = s["x"], s["y"]
    headings = [s["theta"], *(s[f"theta_{i}"] for i in range(1, n + 1))]
    result = [(x, y, headings[0])]
    for i in range(1, n + 1):
        x, y = x - s[f"d_{i}"] * sp.cos(headings[i]), y - s[f"d_{i}"] * sp.sin(headings[i])
        result.append((x, y, headings[i]))
    return result


@pytest.mark.parametrize("n", [1, 2, 3])
def test_inertia_and_constraints_follow_from_the_positions(n):
    mechanism = n_trailer(n)
    s = mechanism.symbols
    q = sp.Matrix([s[name] for name in mechanism.coordinates])
    inertia = sp.zeros(mechanism.n, mechanism.n)
    forms = []
    for i, (x, y, heading) in enumerate(axles(mechanism, n)):
        dx, dy, turn = (sp.Matrix([e]).jacobian(q) for e in (x, y, heading))
        inertia += s[f"m_{i}"] * (dx.T * dx + dy.T * dy) + s[f"J_{i}"] * turn.T * turn
        forms.append(sp.cos(heading) * dy - sp.sin(heading) * dx)
    for text, expected in zip(mechanism.inertia, inertia.tolist(), strict=True):
        assert [sp.simplify(mechanism.symbolic(t) - e) for t, e in zip(text, expected, strict=True)] == [
            0
        ] * mechanism.n
    for text, expected in zip(mechanism.one_forms, forms, strict=True):
        assert [sp.simplify(mechanism.symbolic(t) - e) for t, e in zip(text, expected, strict=True)] == [
            0
        ] * mechanism.n


def common_inertia(mechanism, n, q):
    """N of the docstring, from the angles."""
    p, angles, values = 1.0, q[2:], mechanism.parameters
    N = values["m_0"]
    for i in range(1, n + 1):
        hitch = angles[i - 1] - angles[i]
        w, p = p * np.sin(hitch) / values[f"d_{i}"], p * np.cos(hitch)
        N += values[f"m_{i}"] * p**2 + values[f"J_{i}"] * w**2
    return N


@pytest.mark.parametrize("n", [1, 2, pytest.param(3, marks=pytest.mark.slow)])
def test_what_is_pulled_counts_as_inertia_of_the_tractor(n):
    mechanism = n_trailer(n)
    model, rng = Model(mechanism), np.random.default_rng(4)
    for _ in range(3):
        q, u = rng.uniform(-1, 1, mechanism.n), rng.normal(size=2)
        qdot = model.velocity(q, rng.normal(size=2))
        qddot = model.acceleration(q, model.project(q, qdot), u)
        along = np.array([np.cos(q[2]), np.sin(q[2])])
        v, v_dot = along @ qdot[:2], along @ qddot[:2]
        h = 1e-4
        N_dot = (common_inertia(mechanism, n, q + h * qdot) - common_inertia(mechanism, n, q - h * qdot)) / (2 * h)
        # The central difference is good to h^2 and third derivatives of order 10 to 100.
        assert common_inertia(mechanism, n, q) * v_dot + N_dot * v / 2 == pytest.approx(u[0], abs=1e-5)
        assert mechanism.parameters["J_0"] * qddot[2] == pytest.approx(u[1], rel=1e-12)


def test_flat_frame():
    e = reduce(n_trailer(2), "flat")
    assert set(sp.flatten(e.christoffel)) == {0}
    assert list(e.squared_norms) == [1, sp.Symbol("J_0")]


@pytest.mark.parametrize("speed", [0.6, -0.6])
def test_pulled_a_trailer_follows_and_pushed_it_jackknifes(speed):
    mechanism, angle, time = n_trailer(1), 1e-4, 1.0
    run = mechanics.simulate(mechanism, [0, time], [0, 0, 0, angle], v0=[speed, 0], frame="tractor")
    # Angle and speed change by the square of the small angle.
    expected = angle * np.exp(-speed * time / mechanism.parameters["d_1"])
    assert run.q[-1, 3] == pytest.approx(expected, rel=1e-6)


def test_the_catalogue_has_two():
    assert mechanics.get("trailer").to_dict() == n_trailer(2, "trailer").to_dict()


@pytest.mark.parametrize("n", [0, -1, 1.5, True, "2"])
def test_there_is_at_least_one(n):
    with pytest.raises(MechanismError, match=r"at least 1 trailer.*got"):
        n_trailer(n)

"""The hovercraft against Euler and Poincaré, and against what symmetric products predict."""

import numpy as np
import pytest
import sympy as sp

import mechanics

BODY = mechanics.get("planar_rigid_body")


def test_equations_of_euler_and_poincare():
    m, J, h, u_1, u_2, v_x, v_y, w = sp.symbols("m J h u_1 u_2 v1 v2 v3")
    expected = [u_1 / m + w * v_y, u_2 / m - w * v_x, -h * u_2 / J]
    assert [sp.cancel(a - b) for a, b in zip(mechanics.reduce(BODY).acceleration, expected, strict=True)] == [0] * 3


def test_the_axes_of_the_plane_are_flat():
    assert set(sp.flatten(mechanics.reduce(BODY, "flat").christoffel)) == {0}


def test_thrown_it_spins_about_a_point_that_moves_straight_on():
    t = np.linspace(0, 5, 6)
    run = mechanics.simulate(BODY, t, [1, 2, 0.3], qdot0=[0.5, -0.2, 3.0])
    # The solver's own accuracy.
    np.testing.assert_allclose(run.q, [1, 2, 0.3] + np.outer(t, [0.5, -0.2, 3.0]), rtol=0, atol=1e-9)


def test_a_vibrating_side_thruster_drives_it_backward():
    """For u_2 = A w cos(w t) the mean acceleration is -A^2/4 <Y_2:Y_2> = -A^2 h/(2 m J) along the heading."""
    amplitude, w = 0.2, 200.0
    t = np.array([0.0, 64 * np.pi / w])  # whole periods, about a second
    run = mechanics.simulate(BODY, t, [0, 0, 0], controls=lambda s: [0, amplitude * w * np.cos(w * s)])
    p = BODY.parameters
    mean = -(amplitude**2) * p["h"] / (2 * p["m"] * p["J"])
    # Averaging is right to the order of 1/w over the time of one second.
    assert run.q[-1, 0] == pytest.approx(mean * t[-1] ** 2 / 2, rel=0.02)

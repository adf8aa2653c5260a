"""The balancing robot against the textbook's pendulum on a cart, and the geometry of its three bodies."""

import numpy as np
import pytest
from rigid import assert_inertia_is_that_of, rotation

import mechanics
from mechanics.model import Model

ROBOT = mechanics.get("wheeled_inverted_pendulum")
P = ROBOT.parameters


def test_inertia_tensor():
    def bodies(v):
        heading = rotation(2, v["theta"])
        body = heading @ rotation(1, v["alpha"])
        middle = np.array([v["x"], v["y"], v["r"]])
        yield v["m_b"], np.diag([v["I_x"], v["I_y"], v["I_z"]]), middle + body @ [0, 0, v["l"]], body
        for side, angle in ((-1, v["psi_r"]), (1, v["psi_l"])):
            centre = middle + heading @ [0, side * v["b"], 0]
            yield v["m_w"], np.diag([v["J_d"], v["J_w"], v["J_d"]]), centre, body @ rotation(1, angle)

    assert_inertia_is_that_of(ROBOT, bodies)


def test_straight_on_it_is_a_pendulum_on_a_cart():
    """Newton and Euler for the body and the wheels, whose spin adds J_w/r^2 each to the mass of the cart."""
    rng = np.random.default_rng(6)
    inertia = P["I_y"] + P["m_b"] * P["l"] ** 2
    mass = P["m_b"] + 2 * P["m_w"] + 2 * P["J_w"] / P["r"] ** 2
    for _ in range(5):
        alpha, rate, speed, u_r = rng.normal(size=4)
        q = [0, 0, 0, alpha, 0, 0]
        v = Model(ROBOT).project(q, [speed, 0, 0, rate, *[speed / P["r"] - rate] * 2])
        coupling = P["m_b"] * P["l"] * np.cos(alpha)
        moment = P["m_b"] * P["g"] * P["l"] * np.sin(alpha) - 2 * u_r
        force = 2 * u_r / P["r"] + P["m_b"] * P["l"] * np.sin(alpha) * rate**2
        expected = np.linalg.solve([[mass, coupling], [coupling, inertia]], [force, moment])
        qddot = Model(ROBOT).acceleration(q, v, [u_r, u_r])
        np.testing.assert_allclose(qddot[[0, 3]], expected, rtol=1e-12)  # some dozen operations


def test_to_stay_at_a_lean_it_accelerates():
    """At a constant lean the torque that holds the body up drives the wheels."""
    alpha = 0.2
    inertia = P["m_b"] * P["l"] * np.cos(alpha)
    mass = P["m_b"] + 2 * P["m_w"] + 2 * P["J_w"] / P["r"] ** 2
    acceleration = P["m_b"] * P["g"] * P["l"] * np.sin(alpha) / (mass * P["r"] + inertia)
    u = mass * P["r"] * acceleration / 2
    run = mechanics.simulate(ROBOT, [0, 0.3], [0, 0, 0, alpha, 0, 0], controls=lambda t: [u, u])
    assert acceleration > 0
    # Unstable: an error of the solver grows e^4 times in this time.
    assert run.q[-1, 3] == pytest.approx(alpha, abs=1e-8)
    assert run.q[-1, 0] == pytest.approx(acceleration * 0.3**2 / 2, abs=1e-8)


def test_opposite_torques_turn_it_on_the_spot():
    run = mechanics.simulate(ROBOT, [0, 0.5], [0] * 6, controls=lambda t: [0.02, -0.02])
    x, y, theta, alpha, psi_r, psi_l = run.q[-1]
    assert (x, y, alpha) == pytest.approx((0, 0, 0), abs=1e-12)  # exactly zero but for rounding
    assert theta > 0.1
    assert psi_r == pytest.approx(P["b"] / P["r"] * theta, rel=1e-10)
    assert psi_l == pytest.approx(-psi_r, rel=1e-10)


def test_left_alone_it_falls_the_way_it_leans():
    # For no longer than it takes to lie on the ground.
    run = mechanics.simulate(ROBOT, [0, 0.3], [0, 0, 0, 0.1, 0, 0])
    assert run.q[-1, 3] > 0.2
    assert run.q[-1, 0] < 0  # the axle recedes, as nothing pushes the whole along the ground but the wheels

"""The sleigh with an arm against Newton and Euler for its two bodies, and its limit, the beanie."""

import numpy as np
import pytest
from rigid import assert_inertia_is_that_of, rotation

import mechanics
from mechanics.geometry import reduce
from mechanics.model import Model

SLEIGH = mechanics.get("sleigh_with_arm")
P = SLEIGH.parameters


def test_inertia_tensor():
    def bodies(v):
        body, arm = rotation(2, v["theta"]), rotation(2, v["theta"] + v["phi"])
        edge = np.array([v["x"], v["y"], 0])
        yield v["m"], np.diag([0, 0, v["I_c"]]), edge + body @ [v["a"], 0, 0], body
        yield v["m_a"], np.diag([0, 0, v["J_a"]]), edge + arm @ [v["l"], 0, 0], arm

    assert_inertia_is_that_of(SLEIGH, bodies)


def test_equations_of_the_two_bodies():
    m, a, l, m_a = (P[name] for name in ("m", "a", "l", "m_a"))
    model, rng = Model(SLEIGH), np.random.default_rng(5)
    for _ in range(10):
        q, pseudo, (tau,) = rng.uniform(-3, 3, 4), rng.normal(size=3), rng.normal(size=1)
        qdot, qddot = model.velocity(q, pseudo), model.acceleration(q, pseudo, [tau])
        theta, phi = q[2:]
        along = np.array([np.cos(theta), np.sin(theta), 0, 0])
        v, v_dot = along @ qdot, along @ qddot
        w, W = qdot[2], qdot[2] + qdot[3]
        w_dot, W_dot = qddot[2], qddot[2] + qddot[3]
        force = (m + m_a) * v_dot - m * a * w**2 - m_a * l * (W**2 * np.cos(phi) + W_dot * np.sin(phi))
        body = (P["I_c"] + m * a**2) * w_dot + m * a * v * w + tau
        arm = (P["J_a"] + m_a * l**2) * W_dot - m_a * l * (v_dot * np.sin(phi) - v * w * np.cos(phi)) - tau
        # A few dozen operations on accelerations of up to 100.
        np.testing.assert_allclose([force, body, arm], 0, atol=1e-12)


def test_first_pseudo_velocity_is_the_momentum_along_the_heading():
    model, rng = Model(SLEIGH), np.random.default_rng(6)
    q, v = rng.uniform(-3, 3, 4), rng.normal(size=3)
    momentum = SLEIGH.numeric(SLEIGH.inertia, P | dict(zip(SLEIGH.coordinates, q, strict=True))) @ model.velocity(q, v)
    along = np.cos(q[2]) * momentum[0] + np.sin(q[2]) * momentum[1]
    assert along == pytest.approx((P["m"] + P["m_a"]) * v[0], rel=1e-12)
    assert list(reduce(SLEIGH).frame.row(3)) == [0, -1, 1]


def test_without_a_lever_it_is_the_beanie():
    """Whose mass and centre of mass are those of the whole."""
    whole = P["m"] + P["m_a"]
    a = P["m"] * P["a"] / whole
    I_c = P["I_c"] + P["m"] * P["a"] ** 2 - whole * a**2
    rng = np.random.default_rng(7)
    q, v, u = rng.uniform(-3, 3, (10, 4)), rng.normal(size=(10, 3)), rng.normal(size=(10, 1))
    short = Model(SLEIGH, {"l": 0.0})
    beanie = Model(mechanics.get("chaplygin_beanie"), {"m": whole, "a": a, "I_c": I_c, "B": P["J_a"]})
    for name, arguments in (("velocity", (q, v)), ("rates", (q, v, u)), ("energy", (q, v))):
        # The same formulas in another order.
        np.testing.assert_allclose(getattr(short, name)(*arguments), getattr(beanie, name)(*arguments), rtol=1e-12)


def test_swinging_the_arm_drives_it_and_can_slow_it_down():
    t = np.linspace(0, 10, 101)
    run = mechanics.simulate(SLEIGH, t, [0, 0, 0, np.pi], controls=lambda t: [0.1 * np.cos(4 * t)])
    theta = run.q[:, 2]
    speed = np.cos(theta) * run.qdot[:, 0] + np.sin(theta) * run.qdot[:, 1]
    assert speed[-1] > 0.5
    assert np.diff(speed).min() < -0.01

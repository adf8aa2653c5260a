"""The car against the textbook's dynamic bicycle model, and its flat frame."""

import numpy as np
import pytest
import sympy as sp

import mechanics
from mechanics.geometry import reduce
from mechanics.model import Model

CAR = mechanics.get("car")
P = CAR.parameters
I_t = P["I_c"] + P["m"] * P["a"] ** 2 + P["J"]


def test_equations_of_the_dynamic_bicycle():
    rng = np.random.default_rng(2)
    model = Model(CAR)
    for _ in range(10):
        q, v, u = rng.uniform(-1, 1, 4), rng.normal(size=2), rng.normal(size=2)
        theta, delta = q[2:]
        qdot, qddot = model.velocity(q, v), model.acceleration(q, v, u)
        along = np.array([np.cos(theta), np.sin(theta), 0, 0])
        V, V_dot = along @ qdot, along @ qddot  # the rate of `along` is across the motion
        assert qdot[2] == pytest.approx(V * np.tan(delta) / P["L"], rel=1e-12)
        drive = (
            (P["m"] + I_t * np.tan(delta) ** 2 / P["L"] ** 2) * V_dot
            + I_t / P["L"] ** 2 * np.tan(delta) / np.cos(delta) ** 2 * qdot[3] * V
            + P["J"] / P["L"] * np.tan(delta) * qddot[3]
        )
        # A few dozen operations; the terms are of order 1 to 100.
        assert drive == pytest.approx(u[0], abs=1e-11)
        assert P["J"] * (qddot[2] + qddot[3]) == pytest.approx(u[1], abs=1e-11)


def test_flat_frame():
    """Without forces the steering's rate in space and the speed of all else in the inertia tensor are constant."""
    e = reduce(CAR, "flat")
    assert set(sp.flatten(e.christoffel)) == {0}
    assert list(e.squared_norms) == [sp.Symbol("J"), 1]
    run = mechanics.simulate(CAR, np.linspace(0, 2, 9), [0, 0, 0, 0.4], v0=[0.5, 1.0], frame="flat")
    assert np.ptp(run.q[:, 3]) > 0.2
    np.testing.assert_allclose(run.v, [[0.5, 1.0]] * 9, rtol=0, atol=1e-13)


def test_only_one_vector_field_moves_the_steering():
    """As its stops need it."""
    assert list(reduce(CAR).frame.row(3)) == [0, 1]
    assert CAR.joint_limits.keys() == {"delta"}


def test_at_right_angles_it_turns_about_the_rear_axle():
    """Regular there, as V and tan(delta) are not."""
    model = Model(CAR)
    q, near = [0, 0, 0, np.pi / 2], [0, 0, 0, np.pi / 2 - 1e-6]
    # 6e-17, the cosine of the rounded angle, is all that is left of the speed.
    np.testing.assert_allclose(model.velocity(q, [2.0, 0]), [0, 0, 2.0, 0], atol=1e-15)
    there, beside = (model.acceleration(point, [2.0, 1.0], [0.3, 0.1]) for point in (q, near))
    np.testing.assert_allclose(there, beside, rtol=0, atol=1e-4)  # 1e-6 times a derivative of order 10

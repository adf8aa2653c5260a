"""Chaplygin's sphere: its angular momentum about the contact is constant in space."""

import numpy as np
import pytest
from rigid import assert_inertia_is_that_of, rotation

import mechanics
from mechanics.model import Model

SPHERE = mechanics.get("chaplygin_sphere")
P = SPHERE.parameters


def attitude(v):
    return rotation(2, v["theta"]) @ rotation(0, v["phi"]) @ rotation(1, v["psi"])


def test_inertia_tensor():
    def bodies(v):
        yield v["m"], np.diag([v["I_1"], v["I_2"], v["I_3"]]), np.array([v["x"], v["y"], v["r"]]), attitude(v)

    assert_inertia_is_that_of(SPHERE, bodies)


def angular_velocity(q, qdot):
    """In the axes of space, by a difference of attitudes (fourth order, h^4 = 1e-12)."""
    h = 1e-3
    at = [attitude(dict(zip(SPHERE.coordinates, q + k * h * qdot, strict=True))) for k in (-2, -1, 1, 2, 0)]
    spin = (at[0] - 8 * at[1] + 8 * at[2] - at[3]) / (12 * h) @ at[4].T
    return np.array([spin[2, 1], spin[0, 2], spin[1, 0]]), at[4]


def test_it_rolls_without_slipping():
    rng = np.random.default_rng(2)
    q, v = rng.uniform(-1, 1, 5), rng.normal(size=3)
    qdot = Model(SPHERE).velocity(q, v)
    omega, _ = angular_velocity(q, qdot)
    contact = np.array([*qdot[:2], 0]) + np.cross(omega, [0, 0, -P["r"]])
    np.testing.assert_allclose(contact, 0, rtol=0, atol=1e-11)


def test_chaplygins_integrals():
    q0, v0 = [0, 0, 0.2, 0.3, -0.4], [1.0, 2.0, 1.5]
    run = mechanics.simulate(SPHERE, np.linspace(0, 3, 6), q0, v0=v0)
    momenta, spins = [], []
    for q, qdot in zip(run.q, run.qdot, strict=True):
        omega, R = angular_velocity(q, qdot)
        up = np.array([0, 0, P["r"]])
        momenta.append(
            R @ np.diag([P["I_1"], P["I_2"], P["I_3"]]) @ R.T @ omega + P["m"] * np.cross(up, [*qdot[:2], 0])
        )
        spins.append(omega)
    # The differences above are good to about 1e-10 of it.
    np.testing.assert_allclose(momenta, [momenta[0]] * 6, rtol=0, atol=1e-9 * np.linalg.norm(momenta[0]))
    assert np.ptp(spins, axis=0).min() > 0.1  # while the angular velocity is not


def test_a_homogeneous_ball_rolls_straight_on():
    params = {"I_1": 0.004, "I_2": 0.004, "I_3": 0.004}
    q0 = [0.5, 0.1, 0.2, 0.3, -0.4]
    run = mechanics.simulate(SPHERE, [0, 1, 2], q0, v0=[1.0, 2.0, 0.5], params=params)
    line = np.array(q0[:2]) + np.outer(run.t, run.qdot[0, :2])
    np.testing.assert_allclose(run.q[:, :2], line, rtol=0, atol=1e-9)  # the solver's own accuracy


def test_torques_about_the_principal_axes():
    """Their power is u . omega in the body's axes."""
    rng = np.random.default_rng(4)
    q, v, u = rng.uniform(-1, 1, 5), rng.normal(size=3), rng.normal(size=3)
    model = Model(SPHERE)
    omega, R = angular_velocity(q, model.velocity(q, v))
    assert model.power(q, v, u) == pytest.approx(u @ R.T @ omega, rel=1e-9)  # the difference

"""The racer with a heavy link: its limit without mass, its drive, and the geometry of two bodies."""

import numpy as np
import pytest
from rigid import assert_inertia_is_that_of, rotation

import mechanics
from mechanics.expressions import evaluate
from mechanics.model import Model

RACER = mechanics.get("roller_racer_massive")
P = RACER.parameters


def test_inertia_tensor():
    def bodies(v):
        body, link = rotation(2, v["theta"]), rotation(2, v["theta"] + v["psi"])
        axle = np.array([v["x"], v["y"], 0])
        centre = axle + body @ [v["l_1"], 0, 0] + link @ [v["d"], 0, 0]
        yield v["m"], np.diag([0, 0, v["I_1"]]), axle, body
        yield v["m_2"], np.diag([0, 0, v["I_2"]]), centre, link

    assert_inertia_is_that_of(RACER, bodies)


def test_without_the_links_mass_it_is_the_roller_racer():
    rng = np.random.default_rng(3)
    q, v, u = rng.uniform(-2, 2, (20, 4)), rng.normal(size=(20, 2)), rng.normal(size=(20, 1))
    racer = mechanics.get("roller_racer")
    light = Model(RACER, {**racer.parameters, "m_2": 0.0})
    for name, arguments in (("rates", (q, v, u)), ("velocity", (q, v)), ("energy", (q, v))):
        # Another way of writing the same hundred operations.
        expected = getattr(Model(racer), name)(*arguments)
        np.testing.assert_allclose(getattr(light, name)(*arguments), expected, rtol=1e-11, atol=1e-11)


def test_the_mass_over_the_axle_does_not_change_the_direction_of_the_drive():
    directions = [
        evaluate(RACER.forward, {**P, "d": P["l_2"], "m_2": m_2, "I_2": factor * P["l_2"] * P["I_1"] / P["l_1"]})
        for m_2 in (0.0, 1.0, 10.0)
        for factor in (0.5, 2.0)
    ]
    assert np.sign(directions).tolist() == [-1, 1] * 3


@pytest.mark.parametrize("d", [-0.3, 0.05, 0.1, 0.2])
def test_swinging_drives_it_forward(d):
    """The force along the axis at psi = 0 in the formula of `forward`, and the way it goes in a simulation."""
    params = P | {"d": d, "I_2": 0.01}
    c, swing = P["l_1"] + P["l_2"], 2.0
    predicted = swing**2 * evaluate(RACER.forward, params) / (c**3 * (P["m"] + P["m_2"]))
    assert Model(RACER, params).rates([0, 0, 0, 0], [0, swing], [0])[0] == pytest.approx(predicted, rel=1e-12)
    controls = lambda t: [0.02 * np.cos(8 * t)]  # noqa: E731
    run = mechanics.simulate(RACER, np.linspace(0, 5, 11), [0, 0, 0, 0], controls=controls, params=params)
    assert np.abs(run.q[:, 3]).max() < 0.3
    assert np.sign(run.q[-1, 0]) == np.sign(predicted)


def test_it_passes_the_angle_at_which_rolling_straight_on_is_impossible():
    singular = np.arccos(-P["l_2"] / P["l_1"])
    run = mechanics.simulate(RACER, np.linspace(0, 1, 11), [0, 0, 0, singular - 0.5], v0=[0.5, 1.0])
    assert run.q[0, 3] < singular < run.q[-1, 3]
    np.testing.assert_allclose(run.energy, run.energy[0], rtol=1e-9)  # the solver's own accuracy


def test_friction_of_the_wheels_acts_at_the_speeds_of_both_axles():
    """Neither axle slips, so its speed is the whole speed of its middle."""
    rng = np.random.default_rng(8)
    q, v = rng.uniform(-1, 1, 4), rng.normal(size=2)
    qdot = Model(RACER).velocity(q, v)
    _, _, theta, psi = q
    spins = P["l_1"] * qdot[2], P["l_2"] * (qdot[2] + qdot[3])
    across = np.array([[-np.sin(a), np.cos(a)] for a in (theta, theta + psi)])
    rear, front = qdot[:2], qdot[:2] + spins @ across
    values = P | dict(zip(RACER.coordinates, q, strict=True)) | {"c_w": 0.3, "c_psi": 0.2}
    expected = 0.3 * (rear @ rear + front @ front) + 0.2 * qdot[3] ** 2
    assert qdot @ RACER.drag_tensor(values) @ qdot == pytest.approx(expected, rel=1e-12)

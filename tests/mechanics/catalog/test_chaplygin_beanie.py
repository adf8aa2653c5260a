"""The beanie of Kelly et al., and the growth of its speed that Bizyaev et al. prove."""

import numpy as np
import pytest
import sympy as sp

import mechanics
from mechanics.geometry import reduce

BEANIE = mechanics.get("chaplygin_beanie")
P = BEANIE.parameters


def test_equations():
    """v3 is the rotor's rate in space."""
    m, a, I_c, B, v, w, tau = sp.symbols("m a I_c B v1 v2 tau_rotor")
    e = reduce(BEANIE)
    expected = a * w**2, -(m * a * v * w + tau) / (I_c + m * a**2), tau / B
    for actual, formula in zip(e.acceleration, expected, strict=True):
        assert sp.simplify(actual - formula) == 0
    assert sp.simplify(e.velocity[2] + e.velocity[3] - e.pseudo_velocities[2]) == 0


def test_a_swinging_rotor_drives_it_straight_on():
    """After some turning at the start the heading swings about a constant, in which it goes."""
    periods, samples = 12, 20
    t = np.linspace(0, periods * 2 * np.pi / 3, periods * samples + 1)
    run = mechanics.simulate(BEANIE, t, np.zeros(4), controls=lambda t: [0.2 * np.cos(3 * t)])
    assert (np.diff(run.v[:, 0]) > 0).all()
    assert run.v[-1, 0] > 1.5
    headings = run.q[1:, 2].reshape(periods, samples).mean(axis=1)
    assert np.ptp(headings) > 0.05
    assert np.ptp(headings[periods // 2 :]) < 0.005
    x, y = run.q[-1, :2] - run.q[len(t) // 2, :2]
    assert np.arctan2(y, x) == pytest.approx(headings[-1], abs=0.01)


def test_its_speed_grows_as_the_third_root_of_time():
    """v^3 grows by 3 <tau^2> t/(m^2 a), once w follows the torque: k = m a v/I is 30 times the torque's frequency."""
    amplitude, v0 = 0.2, 5.0
    t = np.array([0, 10 * np.pi])
    run = mechanics.simulate(BEANIE, t, np.zeros(4), v0=[v0, 0, 0], controls=lambda t: [amplitude * np.cos(t)])
    growth = 3 * amplitude**2 / 2 * t[1] / (P["m"] ** 2 * P["a"])
    # The turning rate begins at zero instead of following the torque, for 1/k of these five periods.
    assert run.v[-1, 0] ** 3 - v0**3 == pytest.approx(growth, rel=0.01)

"""The robot of Sarkar, Yun and Kumar, and on which side of the axle its centre of mass belongs."""

import numpy as np
import pytest
import sympy as sp

import mechanics
from mechanics.geometry import reduce

ROBOT = mechanics.get("differential_drive")
P = ROBOT.parameters


def test_equations():
    m, a, I_c, I_w, b, r, v, w, tau_r, tau_l = sp.symbols("m a I_c I_w b r v1 v2 tau_r tau_l")
    expected = (
        (m * a * w**2 + (tau_r + tau_l) / r) / (m + 2 * I_w / r**2),
        (-m * a * v * w + b * (tau_r - tau_l) / r) / (I_c + m * a**2 + 2 * I_w * b**2 / r**2),
    )
    for actual, formula in zip(reduce(ROBOT).acceleration, expected, strict=True):
        assert sp.simplify(actual - formula) == 0


@pytest.mark.parametrize("a", [0.05, -0.05])
def test_it_runs_straight_only_with_the_centre_of_mass_in_front(a):
    speed, turning, time = 1.5, 1e-5, 0.8
    inertia = P["I_c"] + P["m"] * a**2 + 2 * P["I_w"] * (P["b"] / P["r"]) ** 2
    rate = P["m"] * a * speed / inertia
    run = mechanics.simulate(ROBOT, [0, time], np.zeros(5), v0=[speed, turning], params={"a": a})
    # The speed changes by the square of the turning rate.
    assert run.v[-1, 1] == pytest.approx(turning * np.exp(-rate * time), rel=1e-6)
    assert (abs(run.v[-1, 1]) < turning / 5) == (a > 0)


def test_wheels_turn_as_they_roll():
    run = mechanics.simulate(ROBOT, [0, 1], np.zeros(5), v0=[0.4, 1.0], controls=lambda t: [0.03, -0.02])
    theta, phi_r, phi_l = run.q[-1, 2:]
    assert theta == pytest.approx((phi_r - phi_l) * P["r"] / (2 * P["b"]), rel=1e-12)

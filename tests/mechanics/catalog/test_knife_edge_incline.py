"""The knife edge of Neimark and Fufaev on its cycloid, and what the environment's push can do."""

import numpy as np
import pytest
import sympy as sp

import mechanics
from mechanics.geometry import reduce

EDGE = mechanics.get("knife_edge_incline")
P = EDGE.parameters
SLOPE = P["g"] * np.sin(P["alpha"])


def test_equations():
    m, J, g, alpha, theta, F, tau = sp.symbols("m J g alpha theta F_long tau")
    expected = g * sp.sin(alpha) * sp.cos(theta) + F / m, tau / J
    for actual, formula in zip(reduce(EDGE).acceleration, expected, strict=True):
        assert sp.simplify(actual - formula) == 0


def test_spinning_it_drifts_across_the_slope_on_a_cycloid():
    w = 1.3
    t = np.linspace(0, 10, 41)
    run = mechanics.simulate(EDGE, t, [0, 0, 0], v0=[0, w])
    height = SLOPE / (2 * w**2)
    # The solver is asked for 1e-10.
    np.testing.assert_allclose(run.q[:, 0], height * np.sin(w * t) ** 2, rtol=0, atol=1e-9)
    np.testing.assert_allclose(run.q[:, 1], height * (w * t - np.sin(2 * w * t) / 2), rtol=0, atol=1e-9)


@pytest.mark.parametrize(("askew", "climbs"), [(0.0, False), (np.arccos(0.25), True)])
def test_the_largest_push_climbs_askew_and_not_straight(askew, climbs):
    push = EDGE.torque_limits["F_long"]
    run = mechanics.simulate(EDGE, [0, 2], [0, 0, np.pi - askew], controls=lambda t: [push, 0])
    along = push / P["m"] - SLOPE * np.cos(askew)
    assert run.q[-1, 0] == pytest.approx(-np.cos(askew) * along * 2**2 / 2, rel=1e-9)
    assert (run.q[-1, 0] < 0) == climbs
    assert EDGE.forward == "-1"  # up

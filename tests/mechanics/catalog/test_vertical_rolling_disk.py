"""Bloch's disk: no symbols, and circles."""

import numpy as np
import sympy as sp

import mechanics
from mechanics.geometry import reduce

DISK = mechanics.get("vertical_rolling_disk")


def test_all_generalized_christoffel_symbols_vanish():
    e = reduce(DISK)
    assert set(sp.flatten(e.christoffel)) == {0}
    m, R, I_c, J, u_roll, u_steer = sp.symbols("m R I_c J u_roll u_steer")
    expected = u_roll / (I_c + m * R**2), u_steer / J
    for actual, formula in zip(e.acceleration, expected, strict=True):
        assert sp.simplify(actual - formula) == 0


def test_left_alone_it_rolls_on_a_circle():
    rolling, turning = 4.0, 1.5
    radius = DISK.parameters["R"] * rolling / turning
    run = mechanics.simulate(DISK, np.linspace(0, 5, 21), [0, 0, 0, 0], v0=[rolling, turning])
    x, y, theta, phi = run.q.T
    np.testing.assert_allclose(np.hypot(x, y - radius), radius, rtol=1e-9)  # the solver is asked for 1e-10
    np.testing.assert_allclose(theta * rolling, phi * turning, rtol=1e-12)

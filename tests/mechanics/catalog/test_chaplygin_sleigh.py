"""The sleigh of Neimark and Fufaev, with its solution in closed form."""

import numpy as np
import pytest
import sympy as sp

import mechanics
from mechanics.geometry import reduce

SLEIGH = mechanics.get("chaplygin_sleigh")
P = SLEIGH.parameters
I = P["I_c"] + P["m"] * P["a"] ** 2


def test_equations_of_neimark_and_fufaev():
    m, a, I_c, v, w, F, tau = sp.symbols("m a I_c v1 v2 F_long tau")
    expected = a * w**2 + F / m, (tau - m * a * v * w) / (I_c + m * a**2)
    for actual, formula in zip(reduce(SLEIGH).acceleration, expected, strict=True):
        assert sp.simplify(actual - formula) == 0


def test_left_alone_it_moves_as_tanh_and_sech():
    v_m = 0.8
    k = P["m"] * P["a"] * v_m / I
    w_m = v_m * np.sqrt(P["m"] / I)
    t = np.linspace(-3, 3, 25)
    run = mechanics.simulate(SLEIGH, t, [0, 0, 0], v0=[v_m * np.tanh(k * t[0]), w_m / np.cosh(k * t[0])])
    # The solver is asked for 1e-10.
    np.testing.assert_allclose(run.v[:, 0], v_m * np.tanh(k * t), rtol=0, atol=1e-9)
    np.testing.assert_allclose(run.v[:, 1], w_m / np.cosh(k * t), rtol=0, atol=1e-9)
    gudermannian = 2 * np.arctan(np.tanh(k * t / 2))
    turned = np.sqrt(I / (P["m"] * P["a"] ** 2)) * gudermannian
    np.testing.assert_allclose(run.q[:, 2], turned - turned[0], rtol=0, atol=1e-9)


def test_sliding_backwards_it_turns_by_a_known_angle_and_goes_on_forwards():
    run = mechanics.simulate(SLEIGH, [0, 60], [0, 0, 0], v0=[-0.5, 1e-3])
    # What is missing from infinity on both sides is the order of 1e-3/k, k = 2/s.
    assert run.q[-1, 2] == pytest.approx(np.pi * np.sqrt(I / (P["m"] * P["a"] ** 2)), abs=2e-3)
    assert run.v[-1, 0] == pytest.approx(0.5, rel=1e-5)  # of the energy 1e-6 was in the turning
    assert abs(run.v[-1, 1]) < 1e-9


def test_drag_of_the_edge():
    m, a, I_c, c_w, c_theta, v, w = sp.symbols("m a I_c c_w c_theta v1 v2")
    with_drag, without = (reduce(SLEIGH, drag=drag).acceleration for drag in (True, False))
    assert sp.simplify(with_drag[0] - without[0] + c_w * v / m) == 0
    assert sp.simplify(with_drag[1] - without[1] + c_theta * w / (I_c + m * a**2)) == 0

"""Suslov's problem against its equations and closed solution in the textbooks."""

import numpy as np
import pytest
from rigid import assert_inertia_is_that_of, rotation

import mechanics
from mechanics.model import Model

SUSLOV = mechanics.get("suslov")
P = SUSLOV.parameters
LINE = np.array([-P["I_23"], P["I_13"]])  # axis of the steady rotations: I_13 w_1 + I_23 w_2 = 0


def attitude(v):
    return rotation(0, v["alpha"]) @ rotation(1, v["beta"]) @ rotation(2, v["gamma"])


def tensor(v):
    return [
        [v["I_11"], 0, v["I_13"]],
        [0, v["I_22"], v["I_23"]],
        [v["I_13"], v["I_23"], v["I_33"]],
    ]


def test_inertia_tensor():
    assert_inertia_is_that_of(SUSLOV, lambda v: [(0.0, tensor(v), np.zeros(3), attitude(v))])


def test_pseudo_velocities_are_the_angular_velocity_in_the_body():
    q, v, h = np.array([0.4, -0.7, 1.1]), np.array([1.3, -0.8]), 1e-5
    qdot = Model(SUSLOV).velocity(q, v)
    R, before, after = (attitude(dict(zip(SUSLOV.coordinates, q + t * qdot, strict=True))) for t in (0, -h, h))
    spin = R.T @ (after - before) / (2 * h)
    # Second-order difference: h^2 times third derivatives of order 10.
    np.testing.assert_allclose([spin[2, 1], spin[0, 2], spin[1, 0]], [*v, 0], rtol=0, atol=1e-8)


def test_equations_of_the_textbook():
    (w_1, w_2), u = np.random.default_rng(0).normal(size=(2, 20)), np.random.default_rng(1).normal(size=(20, 2))
    K_3 = P["I_13"] * w_1 + P["I_23"] * w_2
    expected = [(u[:, 0] - w_2 * K_3) / P["I_11"], (u[:, 1] + w_1 * K_3) / P["I_22"]]
    rates = Model(SUSLOV).rates(np.full((20, 3), 0.3), np.stack([w_1, w_2], axis=-1), u)
    np.testing.assert_allclose(rates.T, expected, rtol=1e-12, atol=1e-12)  # a dozen operations


def test_closed_solution():
    """On the ellipse of constant energy the angle chi obeys chi' = kappa cos(chi - chi_0): a Gudermannian."""
    roots = np.sqrt([P["I_11"], P["I_22"]])
    w = np.array([0.9, -1.4])
    radius, chi = np.hypot(*(roots * w)), np.arctan2(*(roots * w)[::-1])
    slope = np.array([P["I_13"], P["I_23"]]) / roots
    kappa, chi_0 = radius / roots.prod() * np.hypot(*slope), np.arctan2(*slope[::-1])
    t = np.linspace(0, 3, 7)
    # |chi - chi_0| < pi/2 at the start: the branch on which chi grows.
    start = np.arctanh(np.sin(chi - chi_0))
    assert np.cos(chi - chi_0) > 0
    angle = chi_0 + np.arcsin(np.tanh(kappa * t + start))
    expected = radius * np.stack([np.cos(angle), np.sin(angle)], axis=-1) / roots
    run = mechanics.simulate(SUSLOV, t, [0, 0, 0], v0=w)
    np.testing.assert_allclose(run.v, expected, rtol=0, atol=1e-9)  # the solver's own accuracy


@pytest.mark.parametrize("start", [LINE, -LINE, [1.0, 2.0], [-1.0, 0.5]])
def test_every_motion_tends_to_the_same_steady_rotation(start):
    w = np.array(start) / np.hypot(*start) + [1e-3, 1e-3]  # beside the line: one of its two ends is unstable
    run = mechanics.simulate(SUSLOV, [0.0, 100.0], [0.1, 0.2, 0.3], v0=w)
    end = LINE * np.sqrt((P["I_11"] * w[0] ** 2 + P["I_22"] * w[1] ** 2) / ([P["I_11"], P["I_22"]] @ LINE**2))
    # The distance decays as exp(-kappa t), kappa of order 0.3/s: nothing of it is left.
    np.testing.assert_allclose(run.v[-1], end, rtol=0, atol=1e-8)

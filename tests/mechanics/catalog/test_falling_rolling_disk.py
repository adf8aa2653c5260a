"""The falling disk against Neimark and Fufaev's stability bound, steady circles, and the geometry of a disk."""

import numpy as np
import pytest
from rigid import assert_inertia_is_that_of, rotation

import mechanics
from mechanics.model import Model

DISK = mechanics.get("falling_rolling_disk")
P = DISK.parameters
m, r, I, J, g = (P[name] for name in ("m", "r", "I", "J", "g"))


def test_inertia_tensor():
    def bodies(v):
        frame = rotation(2, v["theta"]) @ rotation(0, v["phi"])
        centre = np.array([v["x"], v["y"], 0]) + frame @ [0, 0, v["r"]]
        return [(v["m"], np.diag([v["I"], v["J"], v["I"]]), centre, frame @ rotation(1, v["psi"]))]

    assert_inertia_is_that_of(DISK, bodies)


def test_the_material_point_at_the_contact_is_at_rest():
    rng, h = np.random.default_rng(2), 1e-5
    q, v = rng.uniform(-1, 1, 5), rng.normal(size=3)
    qdot = Model(DISK).velocity(q, v)

    def mark(t):
        """Where the point of the rim that touches the ground at t = 0 is."""
        x, y, theta, phi, psi = q + t * qdot
        frame = rotation(2, theta) @ rotation(0, phi)
        return np.array([x, y, 0]) + frame @ ([0, 0, r] + rotation(1, psi - q[4]) @ [0, 0, -r])

    # Second-order difference: h^2 times third derivatives of order 10.
    np.testing.assert_allclose((mark(h) - mark(-h)) / (2 * h), 0, rtol=0, atol=1e-8)


def growth(w):
    """Largest growth rate of a small disturbance of rolling straight on with spin w."""
    model, h = Model(DISK), 1e-6

    def rates(s):  # phi, then the three pseudo-velocities
        q = [0, 0, 0, s[0], 0]
        return np.concatenate([model.velocity(q, s[1:])[3:4], model.rates(q, s[1:], [0, 0])])

    steady = np.array([0, 0, w, 0])
    A = np.stack([(rates(steady + h * e) - rates(steady - h * e)) / (2 * h) for e in np.eye(4)], axis=-1)
    return np.linalg.eigvals(A).real.max()


def test_rolling_straight_on_is_stable_above_the_critical_speed():
    assert (I, J) == pytest.approx((m * r**2 / 4, m * r**2 / 2))  # a thin uniform disk
    critical = np.sqrt(g * r / 3) / r
    assert critical == pytest.approx(np.sqrt(m * g * r * I / (J * (J + m * r**2))))
    # Next to the bound the rate is sqrt(2e-2) of that of falling, 6/s; beyond it, rounding of the difference.
    assert growth(0.99 * critical) > 0.5
    assert growth(1.01 * critical) < 1e-3


def test_slowly_it_falls_and_fast_it_wobbles():
    critical = np.sqrt(g * r / 3) / r
    t = np.linspace(0, 2, 41)
    slow, fast = (
        mechanics.simulate(DISK, t, [0, 0, 0, 0.01, 0], v0=[0, factor * critical, 0]).q[:, 3] for factor in (0.5, 2)
    )
    assert np.abs(slow).max() > 0.5
    assert np.abs(fast).max() < 0.02


def test_leaning_it_rolls_in_a_circle_toward_the_lean():
    """In steady motion gravity balances the gyroscopic moments; the contact goes round a circle to its right."""
    lean, turning = 0.3, -2.0  # right, about the vertical
    w_u = turning * np.cos(lean)
    w_a = (I * w_u**2 * np.tan(lean) - m * g * r * np.sin(lean)) / (w_u * (J + m * r**2))
    t = np.linspace(0, np.pi, 9)  # once around
    run = mechanics.simulate(DISK, t, [0, 0, 0, lean, 0], v0=[0, w_a, w_u])
    assert w_a > 0
    np.testing.assert_allclose(run.q[:, 3], lean, rtol=0, atol=1e-9)  # the solver's own accuracy
    radius = r * run.qdot[0, 4] / turning
    assert radius < 0
    circle = radius * np.stack([np.sin(turning * t), 1 - np.cos(turning * t)], axis=-1)
    np.testing.assert_allclose(run.q[:, :2], circle, rtol=0, atol=1e-8)

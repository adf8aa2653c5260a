"""A holonomic constraint in redundant coordinates: a pendulum in x and y, held by x dx + y dy = 0."""

import numpy as np
from scipy.special import ellipk

import mechanics
from mechanics import Mechanism

LENGTH, MASS, GRAVITY = 0.7, 1.3, 9.81
PENDULUM = Mechanism.from_dict(
    {
        "name": "redundant_pendulum",
        "coordinates": ["x", "y"],
        "parameters": {"m": MASS, "g": GRAVITY},
        "inertia": [["m", "0"], ["0", "m"]],
        "one_forms": [["x", "y"]],
        "forces": {},
        "potential": "m*g*y",
        "frame": [["-y", "x"]],
    }
)
HIGHEST = 2.0  # rad from the vertical
START = [LENGTH * np.sin(HIGHEST), -LENGTH * np.cos(HIGHEST)]


def test_it_is_back_after_the_period_of_a_pendulum():
    period = 4 * np.sqrt(LENGTH / GRAVITY) * ellipk(np.sin(HIGHEST / 2) ** 2)
    run = mechanics.simulate(PENDULUM, [0, period / 4, period / 2, period], START)
    # The solver's own accuracy.
    np.testing.assert_allclose(run.q[1:], [[0, -LENGTH], [-START[0], START[1]], START], rtol=0, atol=1e-9)


def test_the_length_stays_what_it_was():
    run = mechanics.simulate(PENDULUM, np.linspace(0, 5, 21), START)
    np.testing.assert_allclose(np.linalg.norm(run.q, axis=1), LENGTH, rtol=0, atol=1e-10)

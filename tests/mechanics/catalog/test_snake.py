"""The snake for any number of links: test vectors for three, geometry for more."""

import numpy as np
import pytest
import zoo
from oracles import multiplier_acceleration
from rigid import assert_inertia_is_that_of, rotation

import mechanics
from mechanics import MechanismError
from mechanics.catalog.snake import n_link_snake

SNAKE = mechanics.get("snake")
ZOO = zoo.read("snake_3link")


def point(mechanism, rng):
    angles = rng.uniform(-np.pi, np.pi, mechanism.n)
    return mechanism.parameters | dict(zip(mechanism.coordinates, angles, strict=True))


@pytest.mark.parametrize("vector", ZOO["test_vectors"])
def test_vectors_for_three_links(vector):
    values = vector["params"] | dict(zip(SNAKE.coordinates, vector["q"], strict=True))
    (frame,) = (SNAKE.numeric(rows, values) for rows in SNAKE.frames.values())
    qdot = np.array(vector["v"]) @ frame
    # Stored with 16 digits, computed with a dozen operations.
    np.testing.assert_allclose(qdot, vector["qdot"], rtol=1e-12)
    energy = 0.5 * qdot @ SNAKE.numeric(SNAKE.inertia, values) @ qdot
    assert energy == pytest.approx(vector["energy"], rel=1e-12)
    qddot = multiplier_acceleration(SNAKE, values, qdot, vector["u"])
    np.testing.assert_allclose(qddot, vector["qddot"], rtol=0, atol=1e-12 * np.abs(vector["qddot"]).max())


@pytest.mark.parametrize("n", [2, 3, 5])
def test_inertia_tensor(n):
    def bodies(v):
        angles = [v["theta"], *(v[f"theta{i}"] for i in range(2, n + 1))]
        half = [rotation(2, a) @ [v["L"] / 2, 0, 0] for a in angles]
        centre = np.array([v["x"], v["y"], 0])
        for i, angle in enumerate(angles):
            centre = centre + (half[i - 1] + half[i] if i else 0)
            yield v["m"], np.diag([0, 0, v["J"]]), centre, rotation(2, angle)

    assert_inertia_is_that_of(n_link_snake(n), bodies)


@pytest.mark.parametrize("n", [2, 3, 8])
def test_every_joint_moves_at_the_same_speed(n):
    """A wheel at the centre gives both ends of its link one speed; so one speed goes through the whole snake."""
    mechanism, rng = n_link_snake(n), np.random.default_rng(n)
    values = point(mechanism, rng)
    x_dot, y_dot, *spins = rng.normal(size=2) @ mechanism.numeric(mechanism.frames["last_link"], values)
    angles = np.array([values[name] for name in mechanism.coordinates[2:]])
    across = values["L"] * np.array(spins) * [-np.sin(angles), np.cos(angles)]  # of each link's ends, from end to end
    ends = np.array([x_dot, y_dot]) - across[:, 0] / 2 + np.hstack([np.zeros((2, 1)), np.cumsum(across, axis=1)]).T
    np.testing.assert_allclose(np.linalg.norm(ends, axis=1), np.linalg.norm(ends[0]), rtol=1e-12)


def test_links_with_their_mass_at_the_ends_make_a_flat_snake():
    """With J = m L^2/4 the energy counts that one speed, in every shape: n m/2 (V^2 + (L/2 theta')^2)."""
    mechanism = n_link_snake(6)
    values = point(mechanism, np.random.default_rng(0)) | {"m": 0.7, "L": 0.6, "J": 0.7 * 0.6**2 / 4}
    frame = mechanism.numeric(mechanism.frames["last_link"], values)
    metric = frame @ mechanism.numeric(mechanism.inertia, values) @ frame.T
    np.testing.assert_allclose(metric, 6 * 0.7 * np.diag([1, 0.3**2]), rtol=0, atol=1e-12)


def test_three_links_are_kinematic_but_where_the_joint_angles_are_equal():
    """The determinant of d(alpha')/d(V, theta') is 8/L sin((alpha2 - alpha1)/2) cos(alpha1/2) cos(alpha2/2)."""
    rng = np.random.default_rng(1)
    L = SNAKE.parameters["L"]
    for alpha in [*rng.uniform(-3, 3, (5, 2)), (0.0, 0.0), (0.8, 0.8)]:
        theta = rng.uniform(-3, 3)
        values = SNAKE.parameters | {"theta": theta, "theta2": theta + alpha[0], "theta3": theta + sum(alpha)}
        values |= {"x": 0.0, "y": 0.0}
        spins = SNAKE.numeric(SNAKE.frames["last_link"], values)[:, 2:]
        determinant = np.linalg.det(np.diff(spins, axis=1))
        expected = 8 / L * np.sin((alpha[1] - alpha[0]) / 2) * np.cos(alpha[0] / 2) * np.cos(alpha[1] / 2)
        assert determinant == pytest.approx(expected, abs=1e-12 * 8 / L)


@pytest.mark.parametrize("n", [1, 2.0, True, "3"])
def test_bad_number_of_links(n):
    with pytest.raises(MechanismError, match="at least 2 links"):
        n_link_snake(n)


def test_friction_brakes_wheels_and_joints():
    """Rayleigh's function is that of the speeds of the wheels along their links and of the joints."""
    values = point(SNAKE, np.random.default_rng(3)) | {"c_w": 1.0, "c_j": 0.0}
    frame = SNAKE.numeric(SNAKE.frames["last_link"], values)
    V, turning = 0.8, -1.1
    qdot = np.array([V, turning]) @ frame
    s2 = V**2 + (values["L"] / 2 * turning) ** 2  # the speed of every end of a link
    along = s2 - (values["L"] / 2 * qdot[2:]) ** 2
    assert qdot @ SNAKE.drag_tensor(values) @ qdot == pytest.approx(along.sum(), rel=1e-12)
    joints = SNAKE.drag_tensor(values | {"c_w": 0.0, "c_j": 1.0})
    assert qdot @ joints @ qdot == pytest.approx((np.diff(qdot[2:]) ** 2).sum(), rel=1e-12)

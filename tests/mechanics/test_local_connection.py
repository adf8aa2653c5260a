"""The local connection against what moving along it does."""

import numpy as np
import pytest

import mechanics
from mechanics import MechanismError
from mechanics.geometry.local_connection import height_functions, local_connection, shape_coordinates


def test_the_snakeboard_by_hand():
    """With no momentum along the turning that the wheels allow: X2 of section 4.1 of the paper, with phi held."""
    board = mechanics.get("snakeboard")
    m, l, J = (board.parameters[name] for name in ("m", "l", "J_r"))
    phi = np.linspace(-1.2, 1.2, 7)
    A = local_connection(board, np.stack([0 * phi + 0.3, phi], axis=-1))
    expected = np.stack([J / (m * l) * np.cos(phi) * np.sin(phi), 0 * phi, -J / (m * l**2) * np.sin(phi) ** 2], axis=-1)
    np.testing.assert_allclose(A[..., 0], -expected, rtol=0, atol=1e-14)
    np.testing.assert_allclose(A[..., 1], 0, atol=1e-14)
    # Hence the heights, but for the bracket, which vanishes with the second column.
    slope = np.stack([J / (m * l) * np.cos(2 * phi), 0 * phi, -J / (m * l**2) * np.sin(2 * phi)], axis=-1)
    heights = height_functions(board, np.stack([0 * phi, phi], axis=-1))
    np.testing.assert_allclose(heights, slope, rtol=0, atol=1e-11)


WITH_A_SHAPE = ("snakeboard", "roller_racer", "roller_racer_massive", "sleigh_with_arm", "chaplygin_beanie", "car")


@pytest.mark.parametrize("name", WITH_A_SHAPE)
def test_it_has_the_least_energy(name):
    """Among the velocities that the constraints allow at that rate of the shape; the stranger is the null space."""
    mechanism, rng = mechanics.get(name), np.random.default_rng(0)
    shape = shape_coordinates(mechanism)
    r, rate = rng.uniform(-1, 1, (2, len(shape)))
    q = dict.fromkeys(mechanism.coordinates, 0.0) | dict(zip(shape, r, strict=True))
    values = mechanism.parameters | q
    forms, inertia = mechanism.numeric(mechanism.one_forms, values), mechanism.numeric(mechanism.inertia, values)
    qdot = np.zeros(mechanism.n)
    at = [mechanism.coordinates.index(c) for c in shape]
    qdot[at] = rate
    qdot[[mechanism.coordinates.index(c) for c in mechanism.fibre]] = -local_connection(mechanism, r) @ rate
    np.testing.assert_allclose(forms @ qdot, 0, atol=1e-12)
    held = np.linalg.svd(np.vstack([forms, np.eye(mechanism.n)[at]]))[2][len(forms) + len(at) :]
    np.testing.assert_allclose(held @ inertia @ qdot, 0, atol=1e-12)


STEPS = 50  # errors of 1e-7 of a loop


def in_space(g, xi):
    """Rates of a pose (3,) with this body velocity (3,)."""
    cos, sin = np.cos(g[2]), np.sin(g[2])
    return np.array([cos * xi[0] - sin * xi[1], sin * xi[0] + cos * xi[1], xi[2]])


# Two rotors on a body that may slide: made up, so that the connection has every component and a bracket.
SWIMMER = {
    "name": "swimmer",
    "coordinates": ["x", "y", "theta", "a", "b"],
    "parameters": {"m": 1.0},
    "inertia": [
        ["m + 1", "0", "-sin(theta + a)", "-sin(theta + a)", "0"],
        ["0", "m + 1", "cos(theta + a)", "cos(theta + a)", "0"],
        ["-sin(theta + a)", "cos(theta + a)", "4", "1", "cos(b)/2"],
        ["-sin(theta + a)", "cos(theta + a)", "1", "2", "0"],
        ["0", "0", "cos(b)/2", "0", "1"],
    ],
    "one_forms": [["-sin(theta)", "cos(theta)", "sin(b)", "0", "cos(a)"]],
    "forces": {"u": ["0", "0", "0", "1", "0"]},
    "fibre": ["x", "y", "theta"],
}


@pytest.mark.parametrize("mechanism", ["snakeboard", "swimmer"])
def test_a_small_loop_moves_it_by_the_height_times_the_area(mechanism):
    """And the error is of the next order: half of the size, an eighth of the error, seen from the loop's middle."""
    of = mechanics.Mechanism.from_dict(SWIMMER) if mechanism == "swimmer" else mechanics.get(mechanism)
    middle = np.array([0.3, 0.5])
    height = height_functions(of, middle)
    errors = []
    for radius in (0.1, 0.05):
        angles = np.linspace(0, 2 * np.pi, 2 * STEPS + 1)
        circle = radius * np.stack([np.cos(angles), np.sin(angles)], axis=-1)
        turned = np.stack([-circle[:, 1], circle[:, 0]], axis=-1)
        xi = -np.einsum("tis,ts->ti", local_connection(of, middle + circle), turned)
        moved = np.zeros(3)
        for start, half, end in zip(xi[:-2:2], xi[1:-1:2], xi[2::2], strict=True):  # Runge and Kutta's method
            h = 2 * np.pi / STEPS
            k1 = in_space(moved, start)
            k2 = in_space(moved + h / 2 * k1, half)
            k3 = in_space(moved + h / 2 * k2, half)
            moved = moved + h / 6 * (k1 + 2 * k2 + 2 * k3 + in_space(moved + h * k3, end))
        expected = -height * np.pi * radius**2
        assert np.abs(moved - expected).max() < 0.2 * np.abs(expected).max()
        errors.append(np.abs(moved - expected).max())
    assert errors[1] < errors[0] / 6


def test_where_there_is_none():
    for name in ("snake", "trailer", "suslov"):
        with pytest.raises(MechanismError, match="has no local connection"):
            local_connection(mechanics.get(name), np.zeros(2))
    drive = mechanics.get("differential_drive").to_dict()
    held = drive | {"one_forms": [*drive["one_forms"], ["0", "0", "0", "1", "-1"]], "frames": {}}
    with pytest.raises(MechanismError, match="do not let each of phi_r, phi_l move on its own"):
        local_connection(mechanics.Mechanism.from_dict(held), [0.1, 0.2])
    with pytest.raises(MechanismError, match=r"of two shape coordinates, not of \('psi',\)"):
        height_functions(mechanics.get("roller_racer"), [0.1])
    with pytest.raises(MechanismError, match="unknown shape coordinate 'phy'"):
        height_functions(mechanics.get("snakeboard"), [0.1, 0.2], pair=("psi", "phy"))

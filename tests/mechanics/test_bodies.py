"""What is drawn of a mechanism, held against its physics."""

import dataclasses
import json
import re

import numpy as np
import pytest
import zoo

import mechanics
from mechanics import Body, Mechanism, MechanismError, Model
from mechanics.bodies import COLOURS, SHAPES
from mechanics.catalog.snake import n_link_snake
from mechanics.catalog.trailer import n_trailer
from mechanics.placing import default_bodies, place

MECHANISMS = {
    **{name: mechanics.get(name) for name in mechanics.names(in_the_plane=True)},
    "snake of 6": n_link_snake(6),
    "4 trailers": n_trailer(4),
}
every_mechanism = pytest.mark.parametrize("name", MECHANISMS)
STEP = 1e-4


def random_state(mechanism, rng):
    """Parameters, coordinates, and velocities that the one-forms allow."""
    params = {name: value * rng.uniform(0.8, 1.2) for name, value in mechanism.parameters.items()}
    q = rng.uniform(-1, 1, mechanism.n)
    values = params | dict(zip(mechanism.coordinates, q, strict=True))
    forms = mechanism.numeric(mechanism.one_forms, values)
    free = np.linalg.svd(forms)[2][len(forms) :] if len(forms) else np.eye(mechanism.n)
    return params, q, rng.normal(size=len(free)) @ free


def wheels(mechanism, q, params):
    """Names of all wheels, those of axles too, with their places (w, 2) and angles (w,)."""
    names, places, angles = [], [], []
    for placed in place(mechanism, q, params):
        x, y, angle = placed.pose
        across = np.array([-np.sin(angle), np.cos(angle)])
        sides = {"wheel": (0.0,), "axle": (-0.5 * placed.size[0], 0.5 * placed.size[0])}
        for side in sides.get(placed.body.shape, ()):
            names.append(placed.name)
            places.append([x, y] + side * across)
            angles.append(angle)
    return names, np.array(places).reshape(-1, 2), np.array(angles)


@every_mechanism
def test_wheels_roll_along_their_direction(name):
    """Drawing and constraints were written down apart from one another: here they meet, at any size of the bodies."""
    mechanism, rng = MECHANISMS[name], np.random.default_rng(0)
    for _ in range(10):
        params, q, qdot = random_state(mechanism, rng)
        names, _, angles = wheels(mechanism, q, params)
        ahead, behind = (wheels(mechanism, q + sign * STEP * qdot, params)[1] for sign in (1, -1))
        velocity = (ahead - behind) / (2 * STEP)
        slip = -np.sin(angles) * velocity[:, 0] + np.cos(angles) * velocity[:, 1]
        # Central differences: STEP² = 1e-8 times a third derivative, of the order of the speed cubed.
        bound = 1e-7 * max(1.0, np.abs(qdot).max() ** 3)
        assert np.abs(slip).max(initial=0) < bound, dict(zip(names, slip, strict=True))


@every_mechanism
def test_what_may_not_slip_has_a_wheel(name):
    """No wheel more, either: in a velocity that the constraints forbid, some wheel slips, unless it only spins."""
    mechanism, rng = MECHANISMS[name], np.random.default_rng(1)
    params, q, _ = random_state(mechanism, rng)
    _, _, angles = wheels(mechanism, q, params)
    forms = mechanism.numeric(mechanism.one_forms, params | dict(zip(mechanism.coordinates, q, strict=True)))
    covectors = []
    for unit in np.eye(mechanism.n):
        ahead, behind = (wheels(mechanism, q + sign * STEP * unit, params)[1] for sign in (1, -1))
        moved = (ahead - behind) / (2 * STEP)
        covectors.append(-np.sin(angles) * moved[:, 0] + np.cos(angles) * moved[:, 1])
    slips = np.array(covectors).T
    # Those that tie a rolling angle to the speed are not about slipping sideways: the angle moves no wheel.
    rolling = [
        i for i in range(mechanism.n) if len(slips) and np.abs(slips[:, i]).max() < 1e-6 < np.abs(forms[:, i]).max()
    ]
    ties = np.linalg.matrix_rank(forms[:, rolling], tol=1e-6) if rolling else 0
    assert np.linalg.matrix_rank(slips, tol=1e-6) == len(forms) - ties if len(slips) else not len(forms)


@every_mechanism
def test_bodies_go_where_the_mechanism_goes(name):
    """Equivariance: a mechanism displaced and turned as a whole looks the same from there."""
    mechanism, rng = MECHANISMS[name], np.random.default_rng(2)
    params, q, _ = random_state(mechanism, rng)
    dx, dy, turn = 3.0, -2.0, 0.7
    cos, sin = np.cos(turn), np.sin(turn)
    moved = q.copy()
    moved[:2] = [dx + cos * q[0] - sin * q[1], dy + sin * q[0] + cos * q[1]]
    moved[[i for i, c in enumerate(mechanism.coordinates) if c.startswith("theta")]] += turn
    for before, after in zip(place(mechanism, q, params), place(mechanism, moved, params), strict=True):
        x, y, angle = before.pose
        expected = [dx + cos * x - sin * y, dy + sin * x + cos * y, angle + turn]
        np.testing.assert_allclose(after.pose, expected, rtol=0, atol=1e-13)
        np.testing.assert_allclose(after.size, before.size, rtol=1e-13)


@every_mechanism
def test_every_coordinate_can_be_seen(name):
    mechanism = MECHANISMS[name]
    q = np.random.default_rng(3).uniform(0.1, 0.5, mechanism.n)
    before = place(mechanism, q)
    for i, coordinate in enumerate(mechanism.coordinates):
        after = place(mechanism, q + 0.3 * np.eye(mechanism.n)[i])
        change = [
            max(np.abs(a.pose - b.pose).max(), np.abs(a.size - b.size).max())
            for a, b in zip(after, before, strict=True)
        ]
        assert max(change) > 1e-3, coordinate


@every_mechanism
def test_sizes_are_sizes(name):
    """Of centimetres at least, so that they can be seen, and no larger than what they are part of."""
    mechanism = MECHANISMS[name]
    rng = np.random.default_rng(4)
    for _ in range(5):
        for placed in place(mechanism, rng.uniform(-0.5, 0.5, mechanism.n)):
            assert placed.size.shape == (len(SHAPES[placed.body.shape]),)
            assert (placed.size >= 0).all()
            assert 0.015 < placed.size.max() < 1


def test_many_configurations_at_once():
    snake = mechanics.get("snake")
    q = np.random.default_rng(5).uniform(-1, 1, (3, 2, snake.n))
    for together, *single in zip(place(snake, q), *(place(snake, row) for row in q.reshape(6, -1)), strict=True):
        np.testing.assert_allclose(together.pose.reshape(6, 3), [one.pose for one in single], rtol=0, atol=1e-14)


# -- data ---------------------------------------------------------------------------------------

SLEIGH = {
    "name": "sleigh",
    "coordinates": ["x", "y", "theta"],
    "parameters": {"m": 2.0, "J": 0.5},
    "inertia": [["m", 0, 0], [0, "m", 0], [0, 0, "J"]],
    "one_forms": [["-sin(theta)", "cos(theta)", 0]],
    "forces": {"F": ["cos(theta)", "sin(theta)", 0]},
    "fibre": ["x", "y", "theta"],
}
EDGE = {"shape": "wheel", "pose": ["x", "y", "theta"], "size": [0.2, "0.02*m"]}


def sleigh(**bodies):
    return Mechanism.from_dict({**SLEIGH, "bodies": bodies})


def test_a_spec_may_have_bodies():
    mechanism = sleigh(edge=EDGE, seat={"shape": "disc", "pose": [0.1, 0, 0], "size": [0.1, 0.1], "on": "edge"})
    assert mechanism.bodies["edge"] == Body("wheel", ("x", "y", "theta"), ("0.2", "0.02*m"))
    assert Mechanism.from_dict(json.loads(json.dumps(mechanism.to_dict()))) == mechanism
    edge, seat = place(mechanism, [1, 2, np.pi / 2])
    np.testing.assert_allclose(seat.pose, [1, 2.1, np.pi / 2], rtol=0, atol=1e-15)
    np.testing.assert_allclose(edge.size, [0.2, 0.04])


BROKEN = {
    "no mapping": ([], "bodies: edge must map shape, pose, size, on, colour to values"),
    "an unknown key": (EDGE | {"color": "blue"}, "unknown key 'color'.*Did you mean 'colour'"),
    "no pose": ({"shape": "wheel", "size": [1, 1]}, "edge lacks 'pose'"),
    "an unknown shape": (EDGE | {"shape": "weel"}, "unknown shape 'weel'.*Did you mean 'wheel'"),
    "an unknown colour": (EDGE | {"colour": "bleu"}, "unknown colour 'bleu'.*Did you mean 'blue'"),
    "a pose of two": (EDGE | {"pose": ["x", "y"]}, re.escape("pose must be (x, y, angle)")),
    "a size of one": (EDGE | {"size": ["1"]}, re.escape("size of a wheel must be (diameter, width)")),
    "an unknown name": (EDGE | {"pose": ["x", "y", "thetta"]}, "in body 'edge': unknown name 'thetta'"),
    "a rate": (EDGE | {"pose": ["x", "y", "theta_dot"]}, "unknown name 'theta_dot'"),
    "a call": (EDGE | {"pose": ["x", "y", "open(x)"]}, "unknown function 'open'"),
    "on nothing": (EDGE | {"on": "seat"}, "unknown body before it 'seat'; known: none"),
    "on itself": (EDGE | {"on": "edge"}, "unknown body before it 'edge'"),
    "no number": (EDGE | {"pose": ["x", "1/(m - m)", "0"]}, "pose of body 'edge' is not finite"),
    "a negative size": (EDGE | {"size": ["1", "-m"]}, "its width must be at least 0, but '-m' is -"),
    "a size that is not finite": (EDGE | {"size": ["1", "log(-m)"]}, "size of body 'edge' is not finite"),
}


@pytest.mark.parametrize("case", BROKEN)
def test_refuses(case):
    body, reason = BROKEN[case]
    with pytest.raises(MechanismError, match=reason):
        sleigh(edge=body)


def test_refuses_what_is_no_body():
    for bodies in ({"edge": EDGE}, {"": Body("wheel", ("x", "y", "0"), ("1", "1"))}):
        with pytest.raises(MechanismError, match=r"must be a mechanics\.Body with a name"):
            dataclasses.replace(sleigh(), bodies=bodies)


def test_there_are_at_most_so_many():
    body = Body("disc", ("x", "y", "0"), ("1", "1"))
    dataclasses.replace(sleigh(), bodies={f"b{i}": body for i in range(256)})
    with pytest.raises(MechanismError, match="257 bodies; at most 256"):
        dataclasses.replace(sleigh(), bodies={f"b{i}": body for i in range(257)})


def test_every_shape_is_used():
    """What no mechanism needs is not there. Colours are: green is a target's, purple a trail's."""
    bodies = [body for mechanism in MECHANISMS.values() for body in mechanism.bodies.values()]
    bodies += default_bodies(mechanics.get("snakeboard")).values()
    assert {body.shape for body in bodies} == set(SHAPES)
    assert {body.colour for body in bodies} == set(COLOURS) - {"green", "purple"}


@pytest.mark.parametrize("name", zoo.NAMES)
def test_without_bodies_there_is_a_marker(name):
    """It stands at the pose, points ahead, and shows the other coordinates by hands."""
    mechanism = zoo.load(name)
    q = np.random.default_rng(6).uniform(0.1, 0.5, mechanism.n)
    marker, nose, *hands = place(mechanism, q)
    fibre = [mechanism.coordinates.index(c) for c in mechanism.fibre]
    np.testing.assert_array_equal(marker.pose, q[fibre])
    np.testing.assert_array_equal(nose.pose, q[fibre])
    assert len(hands) == mechanism.n - 3


def test_what_has_no_place_in_the_plane_needs_bodies():
    with pytest.raises(ValueError, match="suslov cannot be drawn.*declare bodies"):
        place(mechanics.get("suslov"), np.zeros(3))


def test_no_equation_depends_on_the_drawing(monkeypatch):
    """Neither do the keys under which functions are kept: what is drawn otherwise is not derived again."""
    keys = []
    board = mechanics.get("snakeboard")
    functions = Model(board)._functions

    def load(name, specification, build):
        keys.append(json.dumps([name, specification], sort_keys=True))
        return functions

    monkeypatch.setattr("mechanics.model.kernels.load", load)
    for mechanism in (board, dataclasses.replace(board, bodies={})):
        Model(mechanism)
    assert keys[0] == keys[1]
    assert "truck" not in keys[0]
    assert board.to_dict(drawing=False) == {k: v for k, v in board.to_dict().items() if k != "bodies"}

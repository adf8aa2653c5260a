"""Lemma 3.3: what is found to be invariant, what is refused and why, and that the lemma then holds."""

import itertools
import time

import numpy as np
import pytest
import sympy as sp
import zoo
from oracles import frame_acceleration, multiplier_acceleration

import mechanics
from mechanics import Mechanism, MechanismError
from mechanics.catalog.snake import n_link_snake
from mechanics.geometry import reduce
from mechanics.geometry.symmetry import PlanarSymmetry, cyclic_coordinates, find_fibre, invariance, planar_symmetry

SE2 = {"x": "x*cos(s) - y*sin(s) + b_1", "y": "x*sin(s) + y*cos(s) + b_2", "theta": "theta + s"}
BOTH = ("snakeboard", "roller_racer")
CATALOGUE = {name: mechanics.get(name) for name in mechanics.names()}
ALL = CATALOGUE | {f"zoo/{name}": zoo.load(name) for name in zoo.NAMES}
FRAMES = [(name, frame) for name, m in CATALOGUE.items() for frame in m.frames]
# Mechanisms of which some part of the derivation takes seconds without the symmetry.
LONG = {"trailer", "snake", "roller_racer_massive", "wheeled_inverted_pendulum", "chaplygin_sphere", "sleigh_with_arm"}


def changed(mechanism, **spec):
    return Mechanism.from_dict({**mechanism.to_dict(), **spec})


def without_fibre(mechanism):
    return changed(mechanism, fibre=())


def reordered(mechanism, coordinates):
    """The same mechanism with its coordinates in another order."""
    order = [mechanism.coordinates.index(name) for name in coordinates]

    def columns(rows):
        return [[row[i] for i in order] for row in rows]

    return changed(
        mechanism,
        coordinates=coordinates,
        inertia=[columns(mechanism.inertia)[i] for i in order],
        one_forms=columns(mechanism.one_forms),
        forces={name: [row[i] for i in order] for name, row in mechanism.forces.items()},
        frames={name: columns(rows) for name, rows in mechanism.frames.items()},
    )


def agrees_with_multipliers(mechanism, equations, states=5):
    rng = np.random.default_rng(7)
    for _ in range(states):
        values = mechanism.parameters | dict(zip(mechanism.coordinates, rng.uniform(-1, 1, mechanism.n), strict=True))
        v, u = rng.normal(size=mechanism.rank), rng.normal(size=len(mechanism.forces))
        qdot, qddot = frame_acceleration(equations, values, v, u)
        expected = multiplier_acceleration(mechanism, values, qdot, u)
        # Rounding of some hundred operations and a linear system of condition below 1e3: 1e-15 is seen.
        np.testing.assert_allclose(qddot, expected, rtol=0, atol=1e-11 * np.abs(expected).max())


@pytest.fixture
def long_way(monkeypatch):
    """Derive without Lemma 3.3."""
    monkeypatch.setattr("mechanics.geometry.reduction.planar_symmetry", lambda *_: None)


# -- actions as data ---------------------------------------------------------------------------


@pytest.mark.parametrize(("name", "frame"), [(name, frame) for name, frame in FRAMES if name in BOTH])
def test_displacements_of_the_plane(name, frame):
    result = invariance(CATALOGUE[name], SE2, frame)
    assert result
    assert str(result) == "invariant"


def test_shifts_of_the_rotor():
    """The snakeboard's rotor is balanced; the racer's front link is not a rotor."""
    shift = {"psi": "psi + s"}
    for frame in CATALOGUE["snakeboard"].frames:
        assert invariance(CATALOGUE["snakeboard"], shift, frame)
    result = invariance(CATALOGUE["roller_racer"], shift)
    assert not result
    assert set(result.broken) == {"constraints", "drag"}
    result = invariance(CATALOGUE["roller_racer"], shift, "paper")
    assert set(result.broken) == {"constraints", "drag", "vector field 1", "vector field 2"}


BOARD = CATALOGUE["snakeboard"]
BREAKS = {
    "inertia": {"inertia": [["m + J_w", *BOARD.inertia[0][1:]], *BOARD.inertia[1:]]},
    "force 'u_phi'": {"forces": {**BOARD.forces, "u_phi": ["1", "0", "0", "0", "1"]}},
    "potential": {"potential": "m*x"},
    "constraints": {"one_forms": [BOARD.one_forms[0], ["1", "0", "0", "0", "0"]], "frames": {}},
    "drag": {"rayleigh": "c*x_dot**2", "drag": {"c": 1.0}},
}


@pytest.mark.parametrize("part", BREAKS)
def test_what_is_not_invariant_is_named(part):
    broken = changed(BOARD, **BREAKS[part])
    result = invariance(broken, SE2)
    assert set(result.broken) == {part}
    # By the order of the part, or of the share of it that was changed (J_w beside m).
    assert 1e-4 < result.broken[part] <= 2
    assert str(result).startswith(f"not invariant: {part} (changes by ")
    assert planar_symmetry(broken) is None


def test_a_vector_field_that_is_not_invariant_is_named():
    racer = CATALOGUE["roller_racer"]
    rows = [list(row) for row in racer.frames["regular"]]
    rows[1] = [f"(2 + sin(theta))*({entry})" for entry in rows[1]]
    assert set(invariance(racer, SE2, rows).broken) == {"vector field 2"}
    assert planar_symmetry(racer, rows) is None
    # It breaks the hypothesis of Lemma 3.3, not Theorem 3.2.
    agrees_with_multipliers(racer, reduce(racer, rows))


def test_constraints_are_invariant_as_a_whole():
    """One-forms that go over into combinations of each other annihilate the same velocities."""
    first, second = ([f"({e})" for e in row] for row in BOARD.one_forms)
    mixed = [
        [f"cos(x)*{a} + sin(x)*{b}" for a, b in zip(first, second, strict=True)],
        [f"cos(x)*{b} - sin(x)*{a}" for a, b in zip(first, second, strict=True)],
    ]
    assert invariance(changed(BOARD, one_forms=mixed), SE2)


def test_an_action_need_not_be_linear():
    """Polar coordinates: translations of the plane move r and the angle both."""
    spec = {"name": "polar", "coordinates": ["r", "a"], "parameters": {"m": 2.0}, "one_forms": [], "forces": {}}
    plane = Mechanism.from_dict({**spec, "inertia": [["m", "0"], ["0", "m*r**2"]]})
    x, y = "(r*cos(a) + 9*b)", "(r*sin(a) + c)"
    translation = {"r": f"sqrt({x}**2 + {y}**2)", "a": f"atan2({y}, {x})"}
    assert invariance(plane, translation)
    stretched = Mechanism.from_dict({**spec, "inertia": [["m", "0"], ["0", "2*m*r**2"]]})
    assert set(invariance(stretched, translation).broken) == {"inertia"}
    assert invariance(stretched, {"a": "a + s"})


@pytest.mark.parametrize(
    ("action", "message"),
    [
        ({"theta_": "theta_ + s"}, "unknown coordinate 'theta_'.*Did you mean 'theta'"),
        ({"x": "x +"}, "in the action on 'x'"),
        ({"psi": "psi + m"}, "no parameter of a group occurs.*give the group's parameters other names"),
        ({"psi": "s"}, "not invertible"),
    ],
)
def test_actions_that_say_nothing_are_refused(action, message):
    with pytest.raises(MechanismError, match=message):
        invariance(BOARD, action)


def test_small_units_hide_nothing():
    """A slope under a body of a nanogram, whose potential is 1e-12 J."""
    incline = zoo.load("knife_edge_incline")
    tiny = changed(incline, parameters={**incline.parameters, "m": 1e-12, "J": 1e-14})
    assert set(invariance(tiny, {"x": "x + s"}).broken) == {"potential"}
    assert planar_symmetry(tiny) is None
    # A light rotor that notices where it is, on a heavy body that does not.
    rotor = [*BOARD.inertia[:4], ["0", "0", "0", "0", "1e-12*J_w*(2 + sin(x))"]]
    assert set(invariance(changed(BOARD, inertia=rotor), {"x": "x + s"}).broken) == {"inertia"}


def test_a_symmetry_that_only_the_default_has_is_none():
    incline = zoo.load("knife_edge_incline")
    level = changed(incline, parameters={**incline.parameters, "alpha": 0.0})
    assert planar_symmetry(level) is None
    assert "x" not in cyclic_coordinates(level)


# -- the plane ---------------------------------------------------------------------------------


def by_trying(mechanism, frame):
    """`planar_symmetry` by trying all sets of turning angles, small ones first, through an action as text."""
    x, y, heading = mechanism.fibre
    others = [name for name in mechanism.coordinates if name not in mechanism.fibre]
    for turning in itertools.chain.from_iterable(itertools.combinations(others, k) for k in range(len(others) + 1)):
        action = {x: f"{x}*cos(_s) - {y}*sin(_s) + _b", y: f"{x}*sin(_s) + {y}*cos(_s) + _c"}
        if invariance(mechanism, action | {name: f"{name} + _s" for name in (heading, *turning)}, frame):
            return PlanarSymmetry(
                *map(mechanism.coordinates.index, mechanism.fibre), tuple(map(mechanism.coordinates.index, turning))
            )
    return None


@pytest.mark.parametrize("name", [name for name, m in ALL.items() if m.fibre])
def test_turning_angles_are_those_found_by_trying(name):
    mechanism = ALL[name]
    for frame in (None, *mechanism.frames):
        assert planar_symmetry(mechanism, frame) == by_trying(mechanism, frame)


def test_angles_measured_from_the_axis_turn_with_the_heading():
    assert planar_symmetry(zoo.load("trailer_1")) == PlanarSymmetry(0, 1, 2, (3,))
    assert planar_symmetry(zoo.load("snake_3link")) == PlanarSymmetry(0, 1, 2, (3, 4))


def test_no_symmetry_where_gravity_pulls():
    incline = zoo.load("knife_edge_incline")
    assert planar_symmetry(incline, incline.frame_rows()) is None
    e = reduce(incline)
    g, alpha, heading = sp.symbols("g alpha phi")
    assert e.potential_acceleration[0] == g * sp.sin(alpha) * sp.cos(heading)


def test_to_turn_about_one_point_is_not_enough():
    spring = changed(CATALOGUE["chaplygin_sleigh"], potential="(x**2 + y**2)/2")
    assert planar_symmetry(spring) is None
    assert planar_symmetry(changed(spring, potential="0")) == PlanarSymmetry(0, 1, 2)


def test_many_angles_are_no_burden():
    """Twelve links measured from the x axis: 2048 sets of angles might turn, one does."""
    snake = n_link_snake(12)
    start = time.process_time()
    symmetry = planar_symmetry(snake)
    # It takes 0.3 s; trying the sets one by one, at some 5 ms each, takes 11 s.
    assert time.process_time() - start < 4
    assert symmetry == PlanarSymmetry(0, 1, 2, tuple(range(3, 14)))


@pytest.mark.parametrize("name", [name for name, m in CATALOGUE.items() if m.fibre])
def test_the_fibre_need_not_be_declared(name):
    mechanism = CATALOGUE[name]
    plain = without_fibre(mechanism)
    expected = mechanism.fibre if planar_symmetry(mechanism) else ()
    assert find_fibre(plain) == expected
    assert planar_symmetry(plain) == planar_symmetry(mechanism)
    assert find_fibre(mechanism) == mechanism.fibre


def test_the_heading_is_what_has_to_turn():
    """Not the first coordinate that may: the rotor's angle occurs nowhere, the steering angle is relative."""
    board = without_fibre(BOARD)
    for coordinates in itertools.islice(itertools.permutations(board.coordinates), 0, None, 17):
        assert find_fibre(reordered(board, list(coordinates))) == ("x", "y", "theta")


def test_no_fibre_without_a_plane():
    assert find_fibre(CATALOGUE["suslov"]) == ()
    assert find_fibre(without_fibre(CATALOGUE["knife_edge_incline"])) == ()
    # The heading of a body on which nothing has a direction: the first coordinate that may turn.
    body = {"name": "puck", "coordinates": ["theta", "x", "y"], "parameters": {"m": 1.0, "J": 1.0}}
    inertia = [["J", "0", "0"], ["0", "m", "0"], ["0", "0", "m"]]
    assert find_fibre(Mechanism.from_dict({**body, "inertia": inertia, "one_forms": [], "forces": {}})) == (
        "x",
        "y",
        "theta",
    )


def skew_sleigh(fibre):
    """A sleigh whose blade is set at an angle beta, which slides ahead and sideways in its own axes."""
    return Mechanism.from_dict(
        {
            "name": "skew_sleigh",
            "coordinates": ["x", "y", "theta"],
            "parameters": {"m": 2.0, "J": 0.5, "a": 0.3, "beta": 0.4},
            "inertia": [
                ["m", "0", "-a*m*sin(theta)"],
                ["0", "m", "a*m*cos(theta)"],
                ["-a*m*sin(theta)", "a*m*cos(theta)", "J + a**2*m"],
            ],
            "one_forms": [["-sin(theta + beta)", "cos(theta + beta)", "0"]],
            "forces": {"tau": ["0", "0", "1"], "F": ["cos(theta)", "sin(theta)", "0"]},
            "frame": [["cos(theta + beta)", "sin(theta + beta)", "0"], ["0", "0", "1"]],
            "fibre": ["x", "y", "theta"] if fibre else [],
        }
    )


@pytest.mark.parametrize("fibre", [True, False])
def test_sideways_components_turn_too(fibre):
    """Both body axes matter; the mechanisms of the catalogue never slide sideways."""
    sleigh = skew_sleigh(fibre)
    assert planar_symmetry(sleigh, sleigh.frame_rows()) == PlanarSymmetry(0, 1, 2)
    agrees_with_multipliers(sleigh, reduce(sleigh))


@pytest.mark.usefixtures("long_way")
def test_sideways_components_without_the_symmetry():
    sleigh = skew_sleigh(False)
    agrees_with_multipliers(sleigh, reduce(sleigh))


def test_the_heading_may_stand_anywhere():
    """The order of the coordinates is the user's, and so is whether there is a fibre."""
    board = reordered(without_fibre(BOARD), ["phi", "y", "theta", "x", "psi"])
    for frame in (*board.frames, None):
        agrees_with_multipliers(board, reduce(board, frame))


# -- the lemma ---------------------------------------------------------------------------------


def parts(equations):
    """What Lemma 3.3 speaks of: Γ̃, Y, and the norms."""
    e = equations
    return [*sp.flatten(e.christoffel), *sp.flatten(e.input_coefficients), *sp.flatten(e.squared_norms)]


@pytest.mark.usefixtures("long_way")
@pytest.mark.parametrize(("name", "frame"), [(name, frame) for name, frame in FRAMES if name not in LONG])
def test_the_lemma_derived_without_using_it(name, frame):
    """Γ̃, Y and norms do not mention cyclic coordinates, nor the fibre in an invariant frame, although the data do."""
    mechanism = CATALOGUE[name]
    gone = set(cyclic_coordinates(mechanism, frame))
    symmetry = planar_symmetry(mechanism, frame)
    if symmetry and not symmetry.turning:
        gone |= {mechanism.coordinates[i] for i in (symmetry.x, symmetry.y, symmetry.heading)}
    assert gone
    seen = {symbol.name for e in parts(reduce(mechanism, frame)) for symbol in e.free_symbols}
    assert not gone & seen


@pytest.mark.usefixtures("long_way")
def test_an_entry_is_not_printed_as_written_where_that_is_longer():
    """An inertia may be written with the heading without depending on it; then the norm does not mention it."""
    sleigh = skew_sleigh(True)
    about_the_blade = "J + a**2*m*(sin(theta)**2 + cos(theta)**2)"
    inertia = [*sleigh.inertia[:2], [*sleigh.inertia[2][:2], about_the_blade]]
    e = reduce(changed(sleigh, inertia=inertia), sleigh.frame_rows()[::-1])
    a, m, J = sp.symbols("a m J")
    assert e.squared_norms[0] == J + a**2 * m


@pytest.mark.parametrize("mechanism", [*map(CATALOGUE.get, BOTH), skew_sleigh(True)], ids=lambda m: m.name)
def test_without_the_symmetry_nothing_changes(mechanism, monkeypatch):
    """Lemma 3.3 is a shortcut: the long way gives the same expressions."""
    short = [reduce(mechanism, frame) for frame in mechanism.frames]
    monkeypatch.setattr("mechanics.geometry.reduction.planar_symmetry", lambda *_: None)
    for e, frame in zip(short, mechanism.frames, strict=True):
        assert {a - b for a, b in zip(parts(e), parts(reduce(mechanism, frame)), strict=True)} == {0}


def test_invariants_see_turning_angles_from_the_heading():
    """Γ̃, Y and norms of the trailer are functions of theta1 - theta0: unchanged where both turn."""
    trailer = zoo.load("trailer_1")
    e = reduce(trailer)
    assert sp.Symbol("theta1") in set().union(*(entry.free_symbols for entry in parts(e)))
    function = sp.lambdify([*e.coordinates, *e.parameters], parts(e))
    params = list(trailer.parameters.values())
    here, there = function(1, 2, 0.3, 0.9, *params), function(5, -3, 0.3 + 0.8, 0.9 + 0.8, *params)
    # A few hundred operations on numbers of order one to a hundred.
    np.testing.assert_allclose(here, there, rtol=1e-12, atol=1e-12)


def test_cyclic_coordinates():
    expected = {
        "snakeboard": ("x", "y", "psi"),
        "roller_racer": ("x", "y"),
        "knife_edge_incline": ("y",),
        "suslov": ("alpha",),
        "vertical_rolling_disk": ("x", "y", "phi"),
    }
    assert {name: cyclic_coordinates(CATALOGUE[name]) for name in expected} == expected
    # Nothing but the frame depends on the heading of a body that slides freely.
    body = changed(CATALOGUE["planar_rigid_body"], forces={}, torque_limits={})
    assert cyclic_coordinates(body) == ("x", "y", "theta")
    assert cyclic_coordinates(body, "flat") == ("x", "y", "theta")
    assert cyclic_coordinates(body, "body") == ("x", "y")


WALL = "(abs({0} - 5) + {0} - 5)**2"  # flat where symmetries are tried, and a wall behind


@pytest.mark.parametrize("name", ["x", "y", "theta"])
def test_what_is_flat_nearby_and_a_wall_elsewhere_breaks_the_symmetry(name):
    sleigh = CATALOGUE["chaplygin_sleigh"]
    assert planar_symmetry(sleigh) is not None
    for spec in ({"potential": WALL.format(name)}, {"definitions": {"W": WALL.format(name)}, "potential": "3*W"}):
        walled = changed(sleigh, **spec)
        assert planar_symmetry(walled) is None
        assert name not in cyclic_coordinates(walled)
        motion = mechanics.simulate(walled, [0.0, 0.5], [5.5] * 3, qdot0=[0.0] * 3)
        assert np.abs(motion.qdot[-1]).max() > 0.1  # pushed away
        assert np.ptp(motion.energy) < 1e-9


@pytest.mark.parametrize("part", ["inertia", "forces", "rayleigh"])
def test_a_wall_in_another_part_breaks_it_too(part):
    spec, wall = CATALOGUE["chaplygin_sleigh"].to_dict(), WALL.format("x")
    if part == "inertia":
        spec[part] = [[f"({text})*(1 + {wall})" for text in row] for row in spec[part]]
    elif part == "forces":
        spec[part] = {name: [f"({text})*(1 + {wall})" for text in row] for name, row in spec[part].items()}
    else:
        spec[part] = f"({spec[part]})*(1 + {wall})"
    assert planar_symmetry(Mechanism.from_dict(spec)) is None


def test_a_wall_in_a_frame_breaks_it_too():
    sleigh, wall = CATALOGUE["chaplygin_sleigh"], WALL.format("x")
    rows = [[f"({text})*(1 + {wall})" for text in row] for row in sleigh.frame_rows(next(iter(sleigh.frames)))]
    assert planar_symmetry(sleigh, sleigh.frame_rows(next(iter(sleigh.frames)))) is not None
    assert planar_symmetry(sleigh, rows) is None

"""Section 6 with its errata, published results for other mechanisms, and products against a numerical stranger."""

import dataclasses
import functools
import math
from fractions import Fraction

import mpmath
import numpy as np
import pytest
import sympy as sp
import zoo
from paper import I_1, I_2, D, H, J_r, c, f_1, f_2, f_3, k, l, l_1, l_2, m, phi, psi, theta

import mechanics
from mechanics import Mechanism, MechanismError
from mechanics.geometry.algebra import TooLong
from mechanics.geometry.controllability import analyse
from mechanics.geometry.jets import DIGITS, PoleError, Span, Taylor
from mechanics.geometry.verdict import Point

SNAKEBOARD = mechanics.get("snakeboard")
RACER = mechanics.get("roller_racer")
ANYWHERE = (0.1, 0.2, 0.3, 0.4, 0.5)
# Racers whose <X2:X2> is a multiple of X2 at one angle: name -> (parameters, psi, zero of)
HEAVY_LINK = {"m": 3.0, "l_1": 0.1, "l_2": 0.05, "I_1": 0.12, "I_2": 0.1}  # k = 0 at cos(psi) = 0.6
LONG_LINK = {"m": 3.0, "l_1": 0.06, "l_2": 0.1, "I_1": 0.1, "I_2": 0.01}  # H = 0 at cos(psi) = -0.6
SIMPLE_ZEROS = [(HEAVY_LINK, math.acos(0.6)), (LONG_LINK, math.acos(-0.6))]
# k = l_2 I_1 (1 - cos(psi)) touches zero at psi = 0
BALANCED = {"m": 3, "l_1": Fraction(1, 5), "l_2": Fraction(1, 10), "I_1": Fraction(1, 50), "I_2": Fraction(1, 100)}


def exact_points():
    """Random rational values for parameters, sines and cosines."""
    rng = np.random.default_rng(12)
    for _ in range(3):
        values = {symbol: sp.Rational(*map(int, rng.integers(2, 30, 2))) for symbol in (m, l, J_r, l_1, l_2, I_1, I_2)}
        for angle in (theta, psi, phi):
            t = sp.Rational(*map(int, rng.integers(2, 30, 2)))
            values |= {sp.sin(angle): 2 * t / (1 + t**2), sp.cos(angle): (1 - t**2) / (1 + t**2)}
        yield values


def assert_equal(actual, expected):
    """Exactly equal at three random points, which rational functions are only if they are the same."""
    for values in exact_points():
        assert [sp.sympify(e).xreplace(values) for e in actual] == [sp.sympify(e).xreplace(values) for e in expected]


def assert_determinant(fields, expected):
    """The determinant but for its sign, at the same points."""
    for values in exact_points():
        matrix = sp.Matrix([[sp.sympify(e).xreplace(values) for e in field] for field in fields])
        assert abs(matrix.det()) == abs(sp.sympify(expected).xreplace(values))


def only(mechanism, *controls):
    """The mechanism with some of its controls."""
    forces = {name: mechanism.forces[name] for name in controls}
    return dataclasses.replace(mechanism, forces=forces, torque_limits={})


# -- section 6.1: the snakeboard ----------------------------------------------------------------


@functools.cache
def analysed(name, frame, degree=4):
    return analyse(mechanics.get(name), frame, degree)


@pytest.fixture
def snakeboard():
    return analysed("snakeboard", "paper")


@pytest.fixture
def racer():
    return analysed("roller_racer", "paper")


def test_the_symmetric_products_of_section_6_1(snakeboard):
    """<X2:X2> = <X3:X3> = 0, and <X2:X3> with mℓ² - J_r sin²φ below."""
    assert snakeboard.inputs == {"u_psi": "X2", "u_phi": "X3"}
    products = snakeboard.symmetric_products(2)
    assert list(products) == ["<X2:X3>"]
    co, s = sp.cos(phi), sp.sin(phi)
    assert_equal(products["<X2:X3>"], [J_r * co / (m * l**2), -J_r * co * s / D, 0])


def test_the_brackets_of_section_6_1(snakeboard):
    """[X1, X3] as printed, [X1, [X1, X3]] = -ℓ V_y, determinant ±ℓ²."""
    assert list(snakeboard.closure) == ["X1", "X2", "X3", "[X1,X3]", "[X1,[X1,X3]]"]
    V_x, V_y = (sp.cos(theta), sp.sin(theta)), (-sp.sin(theta), sp.cos(theta))
    first = [l * sp.sin(phi) * V_x[0], l * sp.sin(phi) * V_x[1], sp.cos(phi), 0, 0]
    assert_equal(snakeboard.closure["[X1,X3]"], first)
    assert_equal(snakeboard.closure["[X1,[X1,X3]]"], [-l * V_y[0], -l * V_y[1], 0, 0, 0])
    assert_determinant(snakeboard.closure.values(), l**2)


@pytest.mark.parametrize("frame", SNAKEBOARD.frames)
def test_the_condition_of_section_6_1(frame):
    analysis = analysed("snakeboard", frame)
    assert analysis.symmetric_conditions == (sp.cos(phi),)
    assert analysis.closure_conditions == ()
    assert analysis.conditions == (sp.cos(phi),)


@pytest.mark.parametrize("frame", SNAKEBOARD.frames)
def test_the_snakeboard_is_controllable_everywhere(frame):
    """At φ = ±π/2 too, where <X2:X3> vanishes: <X3:<X2:X3>> does not, and is good (three factors)."""
    analysis = analysed("snakeboard", frame)
    first, second = analysis.inputs.values()
    product = f"<{first}:{second}>"
    for angle, spanning in (
        (0.5, product),
        (0, product),
        (math.pi / 2, f"<{second}:{product}>"),
        (-math.pi / 2, f"<{second}:{product}>"),
        (math.pi / 2 - 1e-6, product),
    ):
        report = analysis.at((*ANYWHERE[:4], angle))
        assert report.symmetric == (first, second, spanning)
        assert (report.rank_symmetric, report.rank_closure) == (3, 5)
        assert report.accessible is report.controllable is report.state_controllable is True


def test_fewer_factors_decide_nothing_at_a_right_angle():
    """With two factors, section 6.1's argument is not there at φ = π/2: undecided, not false."""
    report = analyse(SNAKEBOARD, "paper", degree=2).at((*ANYWHERE[:4], math.pi / 2))
    assert report.rank_symmetric == 2
    assert report.accessible is report.controllable is report.state_controllable is None
    assert "not decided" in str(report)


def test_exact_numbers_are_told_apart_more_closely(snakeboard):
    """1e-12 beside a right angle is a right angle in floats, and is not in fractions."""
    params = {"m": 6, "l": Fraction(1, 5), "J_r": Fraction(9, 125), "J_w": Fraction(1, 100)}
    here = (0, 1, 2, sp.pi / 3)
    assert snakeboard.at((*here, sp.pi / 2), params).symmetric[-1] == "<X3:<X2:X3>>"
    assert snakeboard.at((*here, sp.pi / 2 - Fraction(1, 10**12)), params).symmetric[-1] == "<X2:X3>"
    assert snakeboard.at((*here, math.pi / 2 - 1e-12), params).symmetric[-1] == "<X3:<X2:X3>>"


# -- section 6.2: the roller racer --------------------------------------------------------------


def test_the_symmetric_product_of_section_6_2(racer):
    """<X2:X2> = 2 Γ̃¹₂₂ X1 + 2 Γ̃²₂₂ X2 with the corrected sign of Γ̃¹₂₂."""
    assert racer.inputs == {"u_psi": "X2"}
    product = racer.symmetric_products(2)["<X2:X2>"]
    assert_equal(product, [2 * m * H * c * k / f_1**2, 2 * m * k * sp.sin(psi) * f_3 / (f_1 * f_2)])


def test_the_brackets_of_section_6_2(racer):
    assert list(racer.closure) == ["X1", "X2", "[X1,X2]", "[X1,[X1,X2]]"]
    co, s = sp.cos(theta), sp.sin(theta)
    assert_equal(racer.closure["[X1,X2]"], [-l_2 / c * s, l_2 / c * co, -H / c**2, 0])
    along, across = -l_2 * sp.sin(psi) / c**2, H / c**2
    assert_equal(racer.closure["[X1,[X1,X2]]"], [along * co - across * s, along * s + across * co, 0, 0])
    assert_determinant(racer.closure.values(), (l_1**2 + l_2**2 + 2 * l_1 * l_2 * sp.cos(psi)) / c**4)


@pytest.mark.parametrize("frame", RACER.frames)
def test_the_conditions_of_section_6_2(frame):
    """K != 0 and H != 0, not the printed ℓ2 I1 cosψ != ℓ1 I2; the last is zero only where the racer is singular."""
    analysis = analysed("roller_racer", frame)
    assert set(analysis.symmetric_conditions) == {k, H}
    assert set(analysis.conditions) == {k, H, l_1**2 + 2 * l_1 * l_2 * sp.cos(psi) + l_2**2}


@pytest.mark.parametrize("frame", RACER.frames)
def test_the_racer_is_accessible_and_not_controllable(frame):
    report = analysed("roller_racer", frame).at(ANYWHERE[:4])
    (name,) = analysed("roller_racer", frame).inputs.values()
    assert report.symmetric == (name, f"<{name}:{name}>")
    assert report.obstruction == f"<{name}:{name}>"
    assert report.rank_closure == 4
    assert report.accessible is True
    assert report.controllable is report.state_controllable is False


def test_where_the_printed_condition_fails_nothing_happens(racer):
    """ℓ2 I1 cosψ = ℓ1 I2 at cosψ = 0.6: <X2:X2> is as independent as elsewhere."""
    params = {"m": 3.0, "l_1": 0.1, "l_2": 0.2, "I_1": 0.1, "I_2": 0.12}
    report = racer.at((0, 0, 0.3, math.acos(0.6)), params)
    assert report.symmetric == ("X2", "<X2:X2>")


@pytest.mark.parametrize(("params", "angle"), SIMPLE_ZEROS)
def test_at_a_simple_zero_the_next_product_restores_the_rank(racer, params, angle):
    """There <X2:X2> is a multiple of X2, so no obstruction; <X2:<X2:X2>> is good: the racer is controllable.

    The paper's "not locally controllable" is about all other angles.
    """
    report = racer.at((0, 0, 0.3, angle), params)
    assert report.symmetric == ("X2", "<X2:<X2:X2>>")
    assert report.obstruction is None
    assert report.accessible is report.controllable is report.state_controllable is True
    assert racer.at((0, 0, 0.3, angle + 0.01), params).controllable is False


@pytest.mark.parametrize(("params", "angle"), SIMPLE_ZEROS)
def test_the_racer_goes_both_ways_from_a_simple_zero_and_one_way_elsewhere(params, angle):
    """Swing the joint out and back, to either side, from rest: which way does the racer roll?"""
    t = np.array([0.0, 0.4])

    def speed(start, side):
        swing = 0.02 * side

        def torque(time):
            return [swing * np.sign(np.sin(2 * np.pi * time / t[-1] + np.pi / 2))]

        return mechanics.simulate(RACER, t, [0, 0, 0.3, start], controls=torque, params=params, rtol=1e-8).v[-1, 0]

    assert speed(angle, 1) * speed(angle, -1) < 0
    assert speed(angle + 0.3, 1) * speed(angle + 0.3, -1) > 0


def test_at_a_double_zero_the_rank_comes_back_with_a_bad_product(racer):
    """K >= 0 around: <X2:<X2:<X2:X2>>> has four factors, is bad, and nothing makes up for it."""
    report = racer.at((0, 0, 0, 0), BALANCED)
    assert report.symmetric == ("X2", report.obstruction)
    assert report.obstruction == "<X2:<X2:<X2:X2>>>"
    assert report.accessible is True
    assert report.controllable is None
    assert analyse(RACER, "paper", degree=3).at((0, 0, 0, 0), BALANCED).rank_symmetric == 1


def test_the_singular_angle_belongs_to_the_frame():
    """At c = 0 the paper's X1 has a pole; the racer is accessible there as elsewhere."""
    q, params = (0, 0, 0.3, 2 * math.pi / 3), {"m": 3.0, "l_1": 0.2, "l_2": 0.1, "I_1": 0.2, "I_2": 0.01}
    with pytest.raises(MechanismError, match=r"singular at .*psi = 2\.0944.*'regular'"):
        analysed("roller_racer", "paper").at(q, params)
    report = analysed("roller_racer", "regular").at(q, params)
    assert (report.accessible, report.controllable) == (True, False)


# -- published results --------------------------------------------------------------------------


def arm(n):
    """Uniform rods of length and mass one in a horizontal plane, absolute angles, torques t_i on the joints."""
    size = range(n)
    # Rod i is carried by all before it: inertia (n - 1 - max(i, j)) + 1/3 or 1/2.
    share = [[Fraction(n - 1 - max(i, j)) + (Fraction(1, 3) if i == j else Fraction(1, 2)) for j in size] for i in size]
    inertia = [[f"({share[i][j]})*cos(q_{i} - q_{j})" if i != j else f"{share[i][j]}" for j in size] for i in size]
    torques = {f"t_{i}": ["1" if j == i else "-1" if j == i - 1 else "0" for j in size] for i in size}
    return Mechanism.from_dict(
        {
            "name": f"arm_{n}",
            "coordinates": [f"q_{i}" for i in size],
            "parameters": {},
            "inertia": inertia,
            "one_forms": [],
            "forces": torques,
        }
    )


BODY = Mechanism.from_dict(
    {
        "name": "planar_body",
        "coordinates": ["x", "y", "theta"],
        "parameters": {"m": 2.0, "J": 0.3, "h": 0.1},
        "inertia": [["m", "0", "0"], ["0", "m", "0"], ["0", "0", "J"]],
        "one_forms": [],
        "forces": {
            "thrust": ["cos(theta)", "sin(theta)", "0"],
            "side": ["-sin(theta)", "cos(theta)", "-h"],
            "lateral": ["-sin(theta)", "cos(theta)", "0"],
            "torque": ["0", "0", "1"],
        },
        "frame": [["cos(theta)", "sin(theta)", "0"], ["-sin(theta)", "cos(theta)", "0"], ["0", "0", "1"]],
    }
)
LEG = Mechanism.from_dict(
    {
        "name": "robotic_leg",
        "coordinates": ["r", "theta", "psi"],
        "parameters": {"m": 1.0, "J": 0.5},
        "inertia": [["m", "0", "0"], ["0", "m*r**2", "0"], ["0", "0", "J"]],
        "one_forms": [],
        "forces": {"turn": ["0", "1", "-1"], "extend": ["1", "0", "0"]},
        "frame": [["1", "0", "0"], ["0", "1", "0"], ["0", "0", "1"]],
    }
)
# Its slide 100; the catalogue is also in Bullo, Lewis and Lynch, Controllable kinematic reductions, MTNS 2002.
CATALOG = "Workshop on Geometric Control of Mechanical Systems, IEEE CDC 2004, catalogue of example systems"

# mechanism, controls, (accessible, controllable, state_controllable), source or reason
PUBLISHED = {
    "2R arm, torque on the first joint": (lambda: arm(2), ("t_0",), (True, False, False), CATALOG),
    "2R arm, torque on the second joint": (lambda: arm(2), ("t_1",), (False, False, False), CATALOG),
    "planar body, one force through the centre": (lambda: BODY, ("thrust",), (False, False, False), CATALOG),
    "planar body, one force beside the centre": (lambda: BODY, ("side",), (True, False, False), CATALOG),
    "planar body, two forces": (lambda: BODY, ("thrust", "side"), (True, True, True), CATALOG),
    "planar body, thrust and torque": (lambda: BODY, ("thrust", "torque"), (True, True, True), "it steers its thrust"),
    # The angular momentum stays zero: all configurations, not all velocities.
    "robotic leg": (lambda: LEG, ("turn", "extend"), (True, True, False), CATALOG),
    "robotic leg, extended only": (lambda: LEG, ("extend",), (False, False, False), "it stays on its line"),
    "robotic leg, turned only": (lambda: LEG, ("turn",), (True, False, False), "the leg is drawn out, never in"),
    "rolling disk": (lambda: zoo.load("vertical_rolling_disk"), ("u_roll", "u_steer"), (True, True, True), CATALOG),
    "rolling disk, rolled only": (
        lambda: zoo.load("vertical_rolling_disk"), ("u_roll",), (False, False, False), "it stays on its line",
    ),
    "rolling disk, steered only": (
        lambda: zoo.load("vertical_rolling_disk"), ("u_steer",), (False, False, False), "it spins on the spot",
    ),
    "Chaplygin sleigh": (lambda: zoo.load("chaplygin_sleigh"), ("F_long", "tau"), (True, True, True), "all is driven"),
    "Chaplygin sleigh, turned only": (
        lambda: zoo.load("chaplygin_sleigh"), ("tau",), (True, False, False), "v' = a w^2: it never backs up",
    ),
    "Chaplygin beanie": (
        lambda: zoo.load("chaplygin_beanie"), ("tau_rotor",), (True, False, False),
        "v' = a w^2 (Kelly, Fairchild, Hassanpour, Tallapragada, ACC 2012)",
    ),
    "car": (lambda: zoo.load("car_dynamic"), ("F_rear", "tau_steer"), (True, True, True), "Murray and Sastry 1993"),
    "tractor with a trailer": (
        lambda: zoo.load("trailer_1"), ("F_drive", "tau_tractor"), (True, True, True), "Laumond 1991",
    ),
    "tractor with a trailer, driven only": (
        lambda: zoo.load("trailer_1"), ("F_drive",), (False, False, False), "without steering it stays on one curve",
    ),
    # r (phi_r - phi_l) - 2 b theta is constant: one of the three constraints is holonomic.
    "differential drive": (
        lambda: zoo.load("differential_drive"), ("tau_r", "tau_l"), (False, False, False), "odometry",
    ),
}  # fmt: skip


@pytest.mark.parametrize("what", PUBLISHED)
def test_published_result(what):
    load, controls, expected, source = PUBLISHED[what]
    report = analyse(only(load(), *controls)).generic
    assert (report.accessible, report.controllable, report.state_controllable) == expected, source


@pytest.mark.slow  # the frame and the inertia of three joints: 10 s
def test_a_3r_arm_without_its_first_motor():
    """Zero angular momentum, two of three velocities, all configurations (catalogue: (0, 1, 1) is KC)."""
    report = analyse(only(arm(3), "t_1", "t_2")).generic
    assert (report.rank_symmetric, report.rank_closure) == (2, 3)
    assert (report.accessible, report.controllable, report.state_controllable) == (True, True, False)


def test_the_sufficient_condition_depends_on_the_choice_of_controls():
    """A sideways force beside the centre and a torque do what one through the centre and a torque do."""
    beside = analyse(only(BODY, "side", "torque")).generic
    assert (beside.accessible, beside.controllable, beside.obstruction) == (True, None, "<Y1:Y1>")
    assert analyse(only(BODY, "lateral", "torque")).generic.controllable is True


def test_conditions_name_what_a_mechanism_needs():
    """Neither can a beanie move whose mass is over its wheel, nor a body turn without a lever."""
    assert analyse(zoo.load("chaplygin_beanie")).conditions == (sp.Symbol("a"),)
    assert analyse(only(BODY, "thrust", "side")).conditions == (sp.Symbol("h"),)
    # What shows in the inertia tensor's diagonal (m r^2) cannot vanish.
    assert analyse(only(LEG, "turn")).conditions == ()
    assert analyse(only(LEG, "extend")).conditions is None


def test_special_parameters_are_special_everywhere():
    """Over its wheel, a beanie stays where it is: not only undecided, as at a special configuration."""
    beanie = analyse(zoo.load("chaplygin_beanie"))
    report = beanie.at((0, 0, 0.3, 0.4), {"a": 0.0})
    assert (report.rank_symmetric, report.rank_closure, report.accessible) == (1, 1, False)
    assert beanie.at((0, 0, 0.3, 0.4)).accessible is True


def particle(coordinates, **forces):
    """A particle of mass one in a space of any dimension."""
    size = range(len(coordinates))
    return Mechanism.from_dict(
        {
            "name": "particle",
            "coordinates": coordinates,
            "parameters": {},
            "inertia": [["1" if i == j else "0" for j in size] for i in size],
            "one_forms": [],
            "forces": forces,
            "frame": [["1" if i == j else "0" for j in size] for i in size],
        }
    )


def test_accessible_is_not_controllable_before_all_products_are_known():
    """Y1 = ∂x + y ∂z and Y2 = ∂y + x ∂w: <Y1:Y2> = ∂z + ∂w ends Sym, [Y1,Y2] = ∂w - ∂z completes Lie(Sym)."""
    mechanism = particle(["x", "y", "z", "w"], u_1=["1", "0", "y", "0"], u_2=["0", "1", "0", "x"])
    two, four = analyse(mechanism, degree=2).generic, analyse(mechanism).generic
    assert (two.rank_symmetric, two.rank_closure, two.accessible) == (3, 4, True)
    assert two.controllable is two.state_controllable is None
    assert (four.controllable, four.state_controllable) == (True, False)


def test_where_a_force_has_no_grip():
    """The input field sin(x) ∂x is not the frame's ∂x: at x = 0 it vanishes."""
    analysis = analyse(particle(["x"], u=["sin(x)"]))
    assert analysis.inputs == {"u": "Y1"}
    assert analysis.generic.controllable is True
    report = analysis.at((0,))
    assert (report.rank_symmetric, report.rank_closure) == (0, 0)
    assert report.accessible is report.controllable is None


def test_a_weak_force_is_a_force():
    assert analyse(particle(["x"], u=["1e-12*sin(x)"])).generic.controllable is True


def test_a_frame_that_does_not_span_is_refused():
    """At y = 0 the field y ∂y has no pole; it vanishes."""
    mechanism = dataclasses.replace(particle(["x", "y"], u=["1", "0"]), frames={"radial": (("1", "0"), ("0", "y"))})
    assert analyse(mechanism).at((0, 1)).rank_symmetric == 1
    with pytest.raises(MechanismError, match="particle: the frame is singular at x = 0, y = 0 .*not independent"):
        analyse(mechanism).at((0, 0))


def test_two_trailers_at_right_angles():
    """A tractor with two trailers needs four factors, and five where it stands across its first trailer.

    F. Jean, The car with N trailers: characterization of the singular configurations, ESAIM: COCV 1,
    1996: the growth of D is 2, 3, 4, 5 but there, where it is 2, 3, 4, 4, 5. The second hitch does not matter.
    """
    hitch = "cos(a - b)"
    train = Mechanism.from_dict(
        {
            "name": "two_trailers",
            "coordinates": ["x", "y", "a", "b", "c"],
            "parameters": {"d": 1.0},
            "inertia": [["1" if i == j else "0" for j in range(5)] for i in range(5)],
            "one_forms": [
                ["sin(a)", "-cos(a)", "0", "0", "0"],
                ["sin(b)", "-cos(b)", "0", "d", "0"],
                ["sin(c)", "-cos(c)", "0", "d*cos(b - c)", "d"],
            ],
            "forces": {"drive": ["cos(a)", "sin(a)", "0", "0", "0"], "steer": ["0", "0", "1", "0", "0"]},
            "frame": [
                ["cos(a)", "sin(a)", "0", "sin(a - b)/d", f"{hitch}*sin(b - c)/d"],
                ["0", "0", "1", "0", "0"],
            ],
        }
    )
    across, straight, folded = (0, 0, math.pi / 2, 0, 0), (0, 0, 0, 0, 0), (0, 0, 0, 0, math.pi / 2)
    four, five = analyse(train, degree=4), analyse(train, degree=5)
    assert [four.at(q).rank_closure for q in (straight, folded, across)] == [5, 5, 4]
    assert four.at(across).accessible is four.at(across).controllable is None
    assert five.at(across).rank_closure == 5
    assert five.at(across).controllable is True


# -- a numerical stranger -----------------------------------------------------------------------

# Central differences of step h at 60 digits, nested two deep: relative errors of the order of h^2 = 1e-32 and
# 1e-60/h^2 = 1e-28; 1e-25 is seen.
STEP = mpmath.mpf(10) ** -16
STRANGER = mpmath.mpf(10) ** -20


class Stranger:
    """Symmetric products and brackets as functions of q: M^-1, Levi-Civita symbols, projection, all by differences."""

    def __init__(self, mechanism, values):
        self.n = mechanism.n
        symbols = [mechanism.symbols[name] for name in (*mechanism.coordinates, *mechanism.parameters)]
        rest = [values[name] for name in mechanism.parameters]

        def read(rows):
            entries = [[mechanism.symbolic(text) for text in row] for row in rows]
            function = sp.lambdify(symbols, entries, "mpmath")
            return lambda q: mpmath.matrix(function(*q, *rest)) if entries else None

        self.inertia, self.forms = read(mechanism.inertia), read(mechanism.one_forms)
        self.forces = read(mechanism.forces.values())

    def derivative(self, function, q, direction):
        ahead, behind = ([a + side * STEP * b for a, b in zip(q, direction, strict=True)] for side in (1, -1))
        return (function(ahead) - function(behind)) / (2 * STEP)

    def project(self, q, vector):
        forms = self.forms(q)
        if forms is None:
            return vector
        raised = mpmath.inverse(self.inertia(q)) * forms.T
        return vector - raised * mpmath.lu_solve(forms * raised, forms * vector)

    def covariant(self, X, Y, q):
        """∇_X Y: directional derivative, and 2 M Γ(X, Y) = (X M) Y + (Y M) X - d<MX, Y>."""
        x, y = X(q), Y(q)
        lowered = self.derivative(self.inertia, q, x) * y + self.derivative(self.inertia, q, y) * x
        for a in range(self.n):
            axis = [int(a == b) for b in range(self.n)]
            lowered[a] -= (x.T * self.derivative(self.inertia, q, axis) * y)[0]
        return self.derivative(Y, q, x) + mpmath.lu_solve(self.inertia(q), lowered) / 2

    def symmetric_product(self, X, Y):
        return lambda q: self.project(q, self.covariant(X, Y, q) + self.covariant(Y, X, q))

    def bracket(self, X, Y):
        return lambda q: self.derivative(Y, q, X(q)) - self.derivative(X, q, Y(q))

    def input(self, a):
        return lambda q: self.project(q, mpmath.lu_solve(self.inertia(q), self.forces(q)[a, :].T))


# name -> (mechanism, frame)
STRANGE = {
    "snakeboard": lambda: (SNAKEBOARD, "paper"),
    "roller_racer": lambda: (RACER, "regular"),
    "planar_body": lambda: (only(BODY, "thrust", "side"), None),
    "robotic_leg": lambda: (LEG, None),
    "arm_2": lambda: (arm(2), None),
    "chaplygin_beanie": lambda: (zoo.load("chaplygin_beanie"), None),
    "car_dynamic": lambda: (zoo.load("car_dynamic"), None),
}


@pytest.mark.parametrize("name", STRANGE)
def test_products_and_brackets_agree_with_differences(name):
    mechanism, frame = STRANGE[name]()
    equations = mechanics.reduce(mechanism, frame)
    with mpmath.workdps(DIGITS):
        rng = np.random.default_rng(20)
        q = [mpmath.mpf(value) for value in rng.uniform(0.3, 0.9, mechanism.n)]
        values = {key: mpmath.mpf(value) for key, value in mechanism.parameters.items()}
        values |= dict(zip(mechanism.coordinates, q, strict=True))
        # The input fields themselves, not those of the frame that stand for them.
        Y = equations.input_coefficients
        inputs = [(f"Y{a + 1}", tuple(Y[:, a])) for a in range(Y.cols)]
        calculus, stranger = Point(equations, inputs, values, 3, 1e-10).calculus, Stranger(mechanism, values)
        fields = {field: stranger.input(a) for a, field in enumerate(calculus.inputs)}

        def symmetric_product(a, b):
            field = calculus.symmetric_product(a, b)
            fields[field] = stranger.symmetric_product(fields[a], fields[b])
            return field

        first, last = calculus.inputs[0], calculus.inputs[-1]
        mixed = symmetric_product(first, last)
        for field in (last, mixed):
            symmetric_product(last, field)
        along_q = {field: calculus.in_coordinates(field) for field in fields}
        bracket = calculus.lie_bracket(along_q[last], along_q[mixed])
        functions = {along_q[field]: function for field, function in fields.items()}
        functions[bracket] = stranger.bracket(fields[last], fields[mixed])
        for field, function in functions.items():
            mine, theirs = mpmath.matrix([e.terms[0] for e in field.components]), function(q)
            assert mpmath.norm(mine - theirs) <= STRANGER * (1 + mpmath.norm(theirs)), field.name


# -- Taylor polynomials and spans ---------------------------------------------------------------

X, Y = sp.symbols("x y")


@pytest.mark.parametrize(
    "expression",
    [
        sp.sqrt(2 + sp.sin(X) * Y) / (1 + X**3), sp.atan2(X * Y, X - 2), sp.atan2(Y, X), sp.tan(X) * sp.exp(-Y),
        sp.Abs(X - 1) * sp.sign(Y), sp.log(3 + X) ** 2 + sp.asin(Y / 2) + sp.acos(X / 3) - sp.atan(X * Y),
        sp.cosh(X) - sp.sinh(Y) * sp.tanh(X), (X**2 + Y) ** sp.Rational(-3, 2) * sp.pi,
    ],
)  # fmt: skip
def test_taylor_polynomials_agree_with_symbolic_derivatives(expression):
    with mpmath.workdps(DIGITS):
        values = {"x": mpmath.mpf("0.6"), "y": mpmath.mpf("0.7")}
        space = Taylor(values, ["x", "y"], 3, 1e-10)
        jet = space.convert(expression)
        for a, b in ((0, 0), (1, 0), (0, 1), (2, 1), (0, 3)):
            rate = jet
            for symbol in [X] * a + [Y] * b:
                rate = space.along(rate, [(symbol, space.one)])
            # SymPy's own derivatives of abs and sign are of complex arguments: real symbols.
            real = {s: sp.Symbol(s.name, real=True) for s in (X, Y)}
            exact = expression.xreplace(real)
            for symbol, count in ((X, a), (Y, b)):
                exact = exact.diff(real[symbol], count) if count else exact
            number = sp.N(exact.subs({real[X]: sp.Rational(3, 5), real[Y]: sp.Rational(7, 10)}).doit(), 40)
            # mpmath's derivatives are good to half of the digits at least
            assert rate.terms[0] == pytest.approx(mpmath.mpf(number), rel=1e-25, abs=1e-25)


@pytest.mark.parametrize("expression", [1 / X, sp.sqrt(X), sp.Abs(X), sp.log(X), sp.tan(X + sp.pi / 2), 1 / (Y - Y**2)])
def test_poles_are_seen(expression):
    """At x = 0 and y = 1, exactly, or wrong by what a float's rounding is."""
    with mpmath.workdps(DIGITS):
        for error in (0, 1e-16):
            with pytest.raises(PoleError):
                Taylor({"x": mpmath.mpf(error), "y": 1 + mpmath.mpf(error)}, ["x", "y"], 2, 1e-10).convert(expression)


@pytest.mark.parametrize("expression", [sp.sqrt(X - 1), sp.asin(2 + X), sp.log(X - Y)])
def test_what_is_not_real_is_refused(expression):
    with mpmath.workdps(DIGITS), pytest.raises(PoleError, match="is not real"):
        Taylor({"x": mpmath.mpf(0), "y": mpmath.mpf(1)}, ["x", "y"], 2, 1e-10).convert(expression)


def test_a_span_counts_what_it_can_tell_apart():
    span = Span(1e-8)
    assert span.add([mpmath.mpf(1), mpmath.mpf(0)])
    assert not span.add([mpmath.mpf(1), mpmath.mpf("1e-9")])
    assert [mpmath.mpf("0.6"), mpmath.mpf("1e-9")] in span
    assert [mpmath.mpf(0), mpmath.mpf("1e-7")] not in span
    assert span.add([mpmath.mpf(1), mpmath.mpf("1e-7")])
    assert span.rank == 2


# -- what is refused ----------------------------------------------------------------------------


def test_a_potential_is_refused():
    incline = zoo.load("knife_edge_incline")
    with pytest.raises(MechanismError, match=r"knife_edge_incline: the potential .*replace\(mechanism, potential="):
        analyse(incline)
    assert analyse(dataclasses.replace(incline, potential="0")).generic.controllable is True
    # A potential that only the constraints carry moves nothing.
    assert analyse(dataclasses.replace(zoo.load("chaplygin_sleigh"), potential="m*9.81")).generic.controllable is True


def test_what_is_wrong_is_said(snakeboard):
    with pytest.raises(MechanismError, match="snakeboard: without controls it stays at rest"):
        analyse(only(SNAKEBOARD))
    for degree in (0, 9, True, 2.0):
        with pytest.raises(MechanismError, match=f"whole number from 1 to 8, got {degree}"):
            analyse(SNAKEBOARD, degree=degree)
    with pytest.raises(MechanismError, match="q must be 5 numbers, for x, y, theta, psi, phi"):
        snakeboard.at((0, 0, 0))
    with pytest.raises(MechanismError, match="q must be 5 numbers, for x, y, theta, psi, phi"):
        snakeboard.at({"x": 0, "y": 0, "theta": 0, "psi": 0, "chi": 0})
    for value in (math.nan, math.inf, "pi", None, sp.Symbol("z"), sp.I, 1j):
        with pytest.raises(MechanismError, match=r"snakeboard: phi must be a finite real number, got"):
            snakeboard.at((0, 0, 0, 0, value))
    with pytest.raises(MechanismError, match="not positive definite"):
        snakeboard.at(ANYWHERE, {"J_r": 1.0})
    with pytest.raises(MechanismError, match="unknown parameter"):
        snakeboard.at(ANYWHERE, {"mass": 1.0})


def test_long_formulas_are_refused_and_not_needed(monkeypatch):
    analysis = analyse(SNAKEBOARD, "paper")

    def refuse(*_):
        raise TooLong

    monkeypatch.setattr("mechanics.geometry.formulas.Algebra", refuse)
    assert analysis.at(ANYWHERE).controllable is True
    with pytest.raises(MechanismError, match="formulas are too long"):
        analysis.conditions  # noqa: B018
    assert "too long" in str(analysis)


# Its wheels' angles follow its pose up to a constant, so its configuration is not accessible; its pose is.
ONLY_THE_POSE = {"differential_drive"}


@pytest.mark.slow
def test_the_catalogue_says_what_comes_to_rest_in_any_pose():
    """What falls over does not come to rest; of the others the conditions of section 6 decide."""
    free = [m for name in mechanics.names(in_the_plane=True) if (m := mechanics.get(name)).potential == "0"]
    controllable = {m.name for m in free if analyse(m).generic.controllable}
    assert set(mechanics.names(any_pose=True)) == controllable | ONLY_THE_POSE


def test_the_printout(racer):
    text = str(racer)
    for part in ("u_psi acts along X2", "accessible where none of these is zero: ", "configuration accessible: yes"):
        assert part in text
    assert "locally configuration controllable: no (the one control pushes one way only along <X2:X2>)" in text

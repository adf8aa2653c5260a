"""The long way round, eqs. (1) to (7): against textbooks, against its own axioms, Theorem 3.2 and multipliers."""

from functools import cache

import numpy as np
import paper
import pytest
import sympy as sp
from oracles import multiplier_acceleration

import mechanics
from mechanics import Mechanism, MechanismError
from mechanics.geometry import reduce
from mechanics.geometry.connection import Connection


def unconstrained(name, coordinates, parameters, inertia, **more):
    spec = {"name": name, "coordinates": coordinates, "parameters": parameters, "inertia": inertia}
    return Mechanism.from_dict({**spec, "one_forms": [], "forces": {}, **more})


POLAR = unconstrained("polar", ["r", "theta"], {"m": 2.0}, [["m", "0"], ["0", "m*r**2"]])
PENDULUM = unconstrained(
    "double_pendulum",
    ["a", "b"],
    {"m_1": 1.0, "m_2": 0.6, "l_1": 0.7, "l_2": 0.4, "g": 9.81},
    [
        ["(m_1 + m_2)*l_1**2", "m_2*l_1*l_2*cos(a - b)"],
        ["m_2*l_1*l_2*cos(a - b)", "m_2*l_2**2"],
    ],
    forces={"u_a": ["1", "0"], "u_ab": ["-1", "1"]},
    potential="-(m_1 + m_2)*g*l_1*cos(a) - m_2*g*l_2*cos(b)",
)
# A rigid body about a fixed point, in the Cardan angles of `suslov`, and a weight above that point.
TOP = unconstrained(
    "top",
    ["alpha", "beta", "gamma"],
    {"I_1": 0.02, "I_2": 0.03, "I_3": 0.04, "w": 0.5},
    [
        [
            "I_1*(cos(beta)*cos(gamma))**2 + I_2*(cos(beta)*sin(gamma))**2 + I_3*sin(beta)**2",
            "(I_1 - I_2)*cos(beta)*cos(gamma)*sin(gamma)",
            "I_3*sin(beta)",
        ],
        ["(I_1 - I_2)*cos(beta)*cos(gamma)*sin(gamma)", "I_1*sin(gamma)**2 + I_2*cos(gamma)**2", "0"],
        ["I_3*sin(beta)", "0", "I_3"],
    ],
    potential="w*cos(alpha)*cos(beta)",
    frame=[
        ["cos(gamma)/cos(beta)", "sin(gamma)", "-cos(gamma)*tan(beta)"],
        ["-sin(gamma)/cos(beta)", "cos(gamma)", "sin(gamma)*tan(beta)"],
        ["0", "0", "1"],
    ],
)
# A skate on a surface whose inertia varies, pulled by a field and pushed along dϕ of a function.
SKATE = Mechanism.from_dict(
    {
        "name": "skate",
        "coordinates": ["x", "y", "a"],
        "parameters": {"m": 1.5, "k": 0.4},
        "inertia": [["2*m", "k*cos(y)", "0"], ["k*cos(y)", "m", "0"], ["0", "0", "1 + k"]],
        "one_forms": [["sin(a)", "-cos(a)", "0"]],
        "forces": {"u": ["cos(x)*y", "sin(x)", "k"]},  # d(y sin(x) + k a)
        "potential": "k*x*sin(y) + exp(-k*a)",
        "frame": [["cos(a)", "sin(a)", "0"], ["0", "0", "1"]],
    }
)

# The long way is too long: P or what follows from it runs into `TooLong`, or takes minutes.
LONG = {"trailer", "snake", "roller_racer_massive", "wheeled_inverted_pendulum", "chaplygin_sphere"}
MECHANISMS = {name: mechanics.get(name) for name in mechanics.names() if name not in LONG}
MECHANISMS |= {m.name: m for m in (POLAR, PENDULUM, TOP, SKATE)}
# Those that take seconds, most of it spent on factoring what is found.
SLOW = {"suslov", "sleigh_with_arm", "car", "falling_rolling_disk", "differential_drive", "top"}
EACH = [pytest.param(name, marks=pytest.mark.slow) if name in SLOW else name for name in MECHANISMS]
BOTH = ("snakeboard", "roller_racer")
FRAMES = [
    pytest.param(name, frame, marks=pytest.mark.slow) if frame == "orthonormal" else (name, frame)
    for name in BOTH
    for frame in mechanics.get(name).frames
]


@cache
def connection(name):
    return Connection(MECHANISMS[name])


def fields(name):
    """Two fields in D, of different kinds, and one outside that no symmetry of a mechanism knows."""
    c = connection(name)
    rows = c.mechanism.frame_rows() or sp.eye(c.mechanism.n).tolist()
    inside = [[c.mechanism.symbolic(str(e)) for e in row] for row in (rows[0], rows[-1])]
    q = c.coordinates
    outside = [q[-1], sp.sin(q[0]), *[1] * (len(q) - 2)]
    return inside[0], inside[1], outside


def random_values(mechanism, seed=5):
    """Numbers for all symbols but the rates; joints within 1 rad, away from poles."""
    rng = np.random.default_rng(seed)
    values = {name: value * rng.uniform(0.9, 1.1) for name, value in mechanism.parameters.items()}
    return values | dict(zip(mechanism.coordinates, rng.uniform(0.1, 1, mechanism.n).tolist(), strict=True))


def zero(expressions):
    return all(e == 0 for e in sp.flatten(expressions))


# -- section 2 ---------------------------------------------------------------------------------


def test_polar_coordinates():
    """Γ^r_θθ = -r, Γ^θ_rθ = Γ^θ_θr = 1/r; grad f = (f_r, f_θ/r²)/m; a straight line is a geodesic."""
    c = Connection(POLAR)
    r, theta = c.coordinates
    m = sp.Symbol("m")
    expected = {(0, 1, 1): -r, (1, 0, 1): 1 / r, (1, 1, 0): 1 / r}
    for index in np.ndindex(2, 2, 2):
        assert c.christoffel[index] == expected.get(index, 0)
    assert list(c.gradient(r**2 * sp.cos(theta))) == [2 * r * sp.cos(theta) / m, -sp.sin(theta) / m]
    straight = [sp.cos(theta), -sp.sin(theta) / r]  # ∂x
    assert zero(c.covariant(straight, straight))
    assert zero(c.covariant([1, 0], straight))


def test_double_pendulum():
    """Lagrange's equations as every textbook has them."""
    c = Connection(PENDULUM)
    a, b = c.coordinates
    da, db = c.rates
    m_1, m_2, l_1, l_2, g, u_a, u_ab = sp.symbols("m_1 m_2 l_1 l_2 g u_a u_ab")
    dda, ddb = c.acceleration
    cosine, sine = sp.cos(a - b), sp.sin(a - b)
    first = (m_1 + m_2) * l_1**2 * dda + m_2 * l_1 * l_2 * (ddb * cosine + db**2 * sine)
    second = m_2 * l_2**2 * ddb + m_2 * l_1 * l_2 * (dda * cosine - da**2 * sine)
    assert c.simplify(first + (m_1 + m_2) * g * l_1 * sp.sin(a) - (u_a - u_ab)) == 0
    assert c.simplify(second + m_2 * g * l_2 * sp.sin(b) - u_ab) == 0


@pytest.mark.parametrize("name", EACH)
def test_the_connection_is_metric(name):
    """L_X <<Y, Z>> = <<∇_X Y, Z>> + <<Y, ∇_X Z>>."""
    c = connection(name)
    X, Y, Z = fields(name)
    for along, one, other in ((X, Y, Z), (Z, X, Z), (Y, Z, Z)):
        left = c.lie_derivative(along, c.inner(one, other))
        right = c.inner(c.covariant(along, one), other) + c.inner(one, c.covariant(along, other))
        assert c.simplify(left - right) == 0


@pytest.mark.parametrize("name", EACH)
def test_the_connection_has_no_torsion(name):
    """∇_X Y - ∇_Y X = [X, Y]."""
    c = connection(name)
    X, Y, Z = fields(name)
    for one, other in ((X, Y), (Y, Z), (Z, X)):
        assert zero(c.simplify(c.covariant(one, other) - c.covariant(other, one) - c.bracket(one, other)))


@pytest.mark.parametrize("name", EACH)
def test_gradient_and_sharp(name):
    """<<grad f, X>> = L_X f and <<M^{-1} F, X>> = <F, X>."""
    c = connection(name)
    f = c.potential + sp.sin(c.coordinates[0]) * c.coordinates[-1]
    for X in fields(name):
        assert c.simplify(c.inner(c.gradient(f), X) - c.lie_derivative(X, f)) == 0
        for F in c.forces.tolist():
            assert c.simplify(c.inner(c.sharp(F), X) - c.pairing(F, X)) == 0


def test_brackets_against_the_definition():
    """[X, Y] f = X(Y f) - Y(X f)."""
    c = connection("snakeboard")
    X, Y, Z = fields("snakeboard")
    f = sp.sin(c.coordinates[0]) * c.coordinates[1] + sp.cos(c.coordinates[2]) * c.coordinates[-1]
    for one, other in ((X, Y), (Y, Z)):
        twice = c.lie_derivative(one, c.lie_derivative(other, f)) - c.lie_derivative(other, c.lie_derivative(one, f))
        assert c.simplify(c.lie_derivative(c.bracket(one, other), f) - twice) == 0


# -- section 3 ---------------------------------------------------------------------------------


@pytest.mark.parametrize("name", EACH)
def test_projection(name):
    """P² = P, <<P X, Y>> = <<X, P Y>>, ω P = 0, P M^{-1} ω = 0; P leaves D as it is."""
    c = connection(name)
    P, k = c.projection, c.mechanism.rank
    assert zero(c.simplify(P * P - P))
    assert zero(c.simplify(c.inertia * P - (c.inertia * P).T))
    assert zero(c.simplify(c.one_forms * P))
    assert zero(c.simplify(P * c.inverse_inertia * c.one_forms.T))
    assert c.simplify(P.trace()) == k
    for X in fields(name)[:2]:
        assert zero(c.simplify(P * sp.Matrix(X) - sp.Matrix(X)))


@pytest.mark.parametrize("name", EACH)
def test_equation_6_is_equation_7_on_D(name):
    """(∇_X P⊥)(Y) = -P⊥ ∇_X Y for Y in D and any X."""
    c = connection(name)
    first, last, outside = fields(name)
    for X in (first, last, outside):
        for Y in (first, last):
            assert zero(c.simplify(c.constrained(X, Y) - c.projected(X, Y)))


def test_equation_6_is_not_equation_7_outside():
    """∇ is flat here and ∂x constant, so that eq. (7) would give 0; eq. (6) sees D⊥ turn with φ."""
    c = connection("snakeboard")
    along, constant = [0, 0, 0, 0, 1], [1, 0, 0, 0, 0]
    assert zero(c.projected(along, constant))
    assert not zero(c.constrained(along, constant))


@pytest.mark.parametrize(("name", "frame"), FRAMES)
def test_equation_6_is_theorem_3_2(name, frame):
    """<<∇̃_Xi Xj, Xk>>/|Xk|² = Γ̃^k_ij, with ∇̃ by eq. (6), which no frame enters."""
    c, e = connection(name), reduce(MECHANISMS[name], frame)
    k = e.mechanism.rank
    X = [e.frame[:, i] for i in range(k)]
    for i in range(k):
        for j in range(k):
            derivative = c.constrained(X[i], X[j])
            for up in range(k):
                assert c.simplify(c.inner(derivative, X[up]) / e.squared_norms[up] - e.christoffel[up, i, j]) == 0


@pytest.mark.parametrize(("name", "frame"), FRAMES)
def test_control_forces_as_differentials(name, frame):
    """Y^k_a = F_a(X_k)/|X_k|² = L_Xk ϕ_a/|X_k|², with ϕ = psi, phi."""
    c, e = connection(name), reduce(MECHANISMS[name], frame)
    functions = [sp.Symbol(control.removeprefix("u_")) for control in e.mechanism.controls]
    for a, phi in enumerate(functions):
        assert c.differential(phi) == c.forces[a, :]
        for k in range(e.mechanism.rank):
            X = e.frame[:, k]
            by_function, by_form = c.lie_derivative(X, phi), c.pairing(c.forces[a, :], X)
            assert c.simplify(by_function / c.inner(X, X) - e.input_coefficients[k, a]) == 0
            assert by_form == by_function


def test_a_force_that_is_the_differential_of_a_function():
    c = connection("skate")
    x, y, a = c.coordinates
    phi = y * sp.sin(x) + sp.Symbol("k") * a
    assert zero(c.simplify(c.differential(phi) - c.forces))
    assert zero(c.simplify(c.projection * c.gradient(phi) - c.input_fields))


@pytest.mark.parametrize("name", EACH)
def test_acceleration_is_that_of_the_multiplier_formulation(name):
    """Eqs. (5) and (6), over the coordinates, against Lagrange-d'Alembert with multipliers."""
    c, mechanism = connection(name), MECHANISMS[name]
    symbols = [*mechanism.symbols, *mechanism.rates]
    function = sp.lambdify([sp.Symbol(s) for s in symbols], [list(c.acceleration), c.projection.tolist()], cse=True)
    for seed in range(3):
        rng = np.random.default_rng(seed)
        values = random_values(mechanism, seed) | dict.fromkeys(mechanism.drag, 0.0)
        u = rng.normal(size=len(mechanism.controls))
        values |= dict(zip(mechanism.controls, u.tolist(), strict=True)) | dict.fromkeys(mechanism.rates, 0.0)
        P = np.array(function(*(values[s] for s in symbols))[1], dtype=float)
        qdot = P @ rng.normal(size=mechanism.n)
        values |= dict(zip(mechanism.rates, qdot.tolist(), strict=True))
        actual = np.array(function(*(values[s] for s in symbols))[0], dtype=float)
        expected = multiplier_acceleration(mechanism, values, qdot, u)
        # Rounding of some thousand operations and a system of condition below 1e4: 2e-13 is seen.
        np.testing.assert_allclose(actual, expected, rtol=0, atol=1e-11 * max(1, np.abs(expected).max()))


# -- groups: the equations of Euler and Poincaré -----------------------------------------------


def test_planar_rigid_body_in_its_own_axes():
    """v̇_1 = w v_2, v̇_2 = -w v_1: ∇_X3 X1 = X2, ∇_X3 X2 = -X1, all else zero."""
    body = mechanics.get("planar_rigid_body")
    expected = {(1, 2, 0): 1, (0, 2, 1): -1}
    c, e = Connection(body), reduce(body, "body")
    X = [e.frame[:, i] for i in range(3)]
    for k, i, j in np.ndindex(3, 3, 3):
        assert e.christoffel[k, i, j] == expected.get((k, i, j), 0)
        assert c.simplify(c.inner(c.constrained(X[i], X[j]), X[k]) / c.inner(X[k], X[k])) == expected.get((k, i, j), 0)


def test_eulers_equations():
    """I_1 ẇ_1 = (I_2 - I_3) w_2 w_3 and cyclic; Koszul: Γ^k_ij = ε_ijk (I_k + I_j - I_i)/(2 I_k), constants."""
    c, e = connection("top"), reduce(TOP)
    inertias = [sp.Symbol(f"I_{i + 1}") for i in range(3)]
    w = e.pseudo_velocities
    assert list(e.squared_norms) == inertias
    X = [e.frame[:, i] for i in range(3)]
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):  # left-invariant fields of SO(3)
        assert c.simplify(c.bracket(X[i], X[j]) - X[k]) == sp.zeros(3, 1)
    for k, i, j in np.ndindex(3, 3, 3):
        koszul = sp.LeviCivita(i, j, k) * (inertias[k] + inertias[j] - inertias[i]) / (2 * inertias[k])
        assert c.simplify(e.christoffel[k, i, j] - koszul) == 0
        assert c.simplify(c.inner(c.covariant(X[i], X[j]), X[k]) / inertias[k] - koszul) == 0
    for k, (i, j) in enumerate(((1, 2), (2, 0), (0, 1))):
        euler = (inertias[i] - inertias[j]) / inertias[k] * w[i] * w[j] - c.lie_derivative(
            X[k], c.potential
        ) / inertias[k]
        assert c.simplify(e.acceleration[k] - euler) == 0


# -- section 6 ---------------------------------------------------------------------------------


def test_symmetric_products_and_brackets_of_section_6():
    """<X2 : X3> = J_r/(m l²) cosφ X1 - J_r cosφ sinφ/D X2 (D corrected), [X1, X3] and [X1, [X1, X3]]."""
    D, J_r, l, m, theta, phi = paper.D, paper.J_r, paper.l, paper.m, paper.theta, paper.phi
    c, e = connection("snakeboard"), reduce(MECHANISMS["snakeboard"], "paper")
    X1, X2, X3 = (e.frame[:, i] for i in range(3))
    product = J_r / (m * l**2) * sp.cos(phi) * X1 - J_r * sp.cos(phi) * sp.sin(phi) / D * X2
    assert zero(c.simplify(c.symmetric_product(X2, X3) - product))
    assert zero(c.symmetric_product(X2, X2))
    assert zero(c.symmetric_product(X3, X3))
    V_x, V_y = [sp.cos(theta), sp.sin(theta), 0, 0, 0], [-sp.sin(theta), sp.cos(theta), 0, 0, 0]
    X13 = c.bracket(X1, X3)
    assert zero(c.simplify(X13 - (l * sp.sin(phi) * sp.Matrix(V_x) + sp.cos(phi) * sp.Matrix([0, 0, 1, 0, 0]))))
    assert zero(c.simplify(c.bracket(X1, X13) + l * sp.Matrix(V_y)))


# -- arguments ---------------------------------------------------------------------------------


def test_fields_may_contain_what_the_mechanism_does_not():
    """Half angles, roots, exponentials and new symbols, one after the other: the algebra grows with them."""
    c = Connection(MECHANISMS["roller_racer"])
    psi, theta, new = *sp.symbols("psi theta"), sp.Symbol("new")
    values = random_values(c.mechanism) | {"new": 0.3}
    numbers = {sp.Symbol(name): value for name, value in values.items()}
    X = [sp.Symbol("x"), 1, sp.sin(psi / 2), sp.sqrt(3 + sp.cos(psi))]
    for f in (sp.sin(psi / 2), sp.sqrt(2 + new * sp.sin(psi)), sp.exp(new * theta) * psi, sp.atan2(psi, 2 + theta)):
        expected = sum(
            float((component * sp.diff(f, q)).subs(numbers)) for component, q in zip(X, c.coordinates, strict=True)
        )
        # A dozen operations on numbers of order one.
        assert float(c.lie_derivative(X, f).subs(numbers)) == pytest.approx(expected, rel=1e-12)


def test_a_field_of_the_wrong_length_is_refused():
    with pytest.raises(MechanismError, match="4 components, one for each of x, y, theta, psi; got 3"):
        connection("roller_racer").covariant([1, 0, 0], [1, 0, 0, 0])

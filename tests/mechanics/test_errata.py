"""Misprints of the paper: the printed form contradicts the multiplier equations, the corrected one agrees.

Each case writes the formula twice in the paper's basis and pseudo-velocities, and compares the
generalized acceleration with Lagrange-d'Alembert with multipliers, which knows no basis.
"""

import numpy as np
import pytest
import sympy as sp
from oracles import multiplier_acceleration
from paper import I_1, I_2, D, H, J_r, c, f_1, f_2, f_3, k, l, l_1, l_2, m, phi, psi, theta, u_psi, v1, v2, v3

import mechanics
from mechanics.geometry import reduce

# A corrected formula agrees to rounding (1e-15 is seen); the smallest misprint is a few per cent.
AGREES = 1e-11
MISPRINT = 1e-3

s, co = sp.sin(phi), sp.cos(phi)
D_PRINTED = m * l**2 + J_r * s**2


def state(mechanism, seed=11, **velocities):
    """Values of all symbols at a random state in the paper's frame, with given pseudo-velocities and controls."""
    rng = np.random.default_rng(seed)
    values = dict(mechanism.parameters) | dict(
        zip(mechanism.coordinates, rng.uniform(0.4, 1, mechanism.n), strict=True)
    )
    values |= {f"v{i + 1}": value for i, value in enumerate(rng.uniform(0.5, 1.5, mechanism.rank))}
    values |= dict(zip(mechanism.controls, rng.uniform(0.5, 1.5, len(mechanism.controls)), strict=True))
    return values | velocities


def true_rates(mechanism, values):
    """v̇ [k] in the paper's frame from the multiplier equations: v̇ = P (q̈ - Ẋ v), P X = 1."""
    q = [mechanism.symbols[name] for name in mechanism.coordinates]
    X = sp.Matrix([[mechanism.symbolic(e) for e in row] for row in mechanism.frames["paper"]]).T
    M = sp.Matrix([[mechanism.symbolic(e) for e in row] for row in mechanism.inertia])
    v = [values[f"v{i + 1}"] for i in range(mechanism.rank)]
    numbers = {sp.Symbol(name): value for name, value in values.items()}
    Xn, Mn = (np.array(matrix.subs(numbers), dtype=float) for matrix in (X, M))
    qdot = Xn @ v
    rate = sum(
        (np.array(X.diff(a).subs(numbers), dtype=float) * b for a, b in zip(q, qdot, strict=True)), np.zeros_like(Xn)
    )
    qddot = multiplier_acceleration(mechanism, values, qdot, [values[name] for name in mechanism.controls])
    return np.linalg.solve(Xn.T @ Mn @ Xn, Xn.T @ Mn @ (qddot - rate @ v))


def error(mechanism, values, component, expression):
    """Relative error of an expression for v̇^component (counted from one)."""
    numbers = {sp.Symbol(name): value for name, value in values.items()}
    true = true_rates(mechanism, values)[component - 1]
    return abs(float(sp.sympify(expression).subs(numbers)) - true) / abs(true)


# name: component of v̇, printed, corrected, and what is set to zero so that nothing else enters
SNAKEBOARD = {
    "Γ̃²₃₁ denominator": (2, m * l**2 * co / D_PRINTED * v1 * v3, m * l**2 * co / D * v1 * v3, ("v2", "u_psi")),
    "Γ̃²₃₂ denominator": (2, J_r * co * s / D_PRINTED * v3 * v2, J_r * co * s / D * v3 * v2, ("v1", "u_psi")),
    "input coefficient": (
        2,
        m * l**2 / (m * l**2 * J_r + J_r**2 * s**2) * u_psi,
        m * l**2 / (m * l**2 * J_r - J_r**2 * s**2) * u_psi,
        ("v1", "v2", "v3"),
    ),
    # The printed last term has v where the denominators are already corrected.
    "last term of the ψ̈ equation": (
        2,
        (m * l**2 * co * v1 * v3 + J_r * co * s * v1 * v2) / D,
        (m * l**2 * co * v1 * v3 + J_r * co * s * v3 * v2) / D,
        ("u_psi",),
    ),
}
ROLLER_RACER = {
    "sign of Γ̃¹₂₂": (1, m * H * c * k / f_1**2 * v2**2, -m * H * c * k / f_1**2 * v2**2, ("v1", "u_psi")),
}


ROWS = {
    **{("snakeboard", what): row for what, row in SNAKEBOARD.items()},
    **{("roller_racer", what): row for what, row in ROLLER_RACER.items()},
}


@pytest.mark.parametrize(("name", "what"), ROWS)
def test_the_printed_form_is_wrong_and_the_corrected_one_right(name, what):
    component, printed, corrected, zero = ROWS[name, what]
    mechanism = mechanics.get(name)
    values = state(mechanism, **dict.fromkeys(zero, 0.0))
    assert error(mechanism, values, component, corrected) < AGREES
    assert error(mechanism, values, component, printed) > MISPRINT


def test_the_rest_of_section_5_is_right():
    """f3 and Γ̃²₂₂ as printed, with the printed signs of the other two symbols."""
    racer = mechanics.get("roller_racer")
    first = -(H / c * (I_1 + I_2) * sp.sin(psi) / f_1 * v1 * v2 + m * H * c * k / f_1**2 * v2**2)
    second = H / c * m * k / f_2 * v1 * v2 - m * k * sp.sin(psi) * f_3 / (f_1 * f_2) * v2**2 + f_1 / f_2 * u_psi
    assert error(racer, state(racer), 1, first) < AGREES
    assert error(racer, state(racer), 2, second) < AGREES


def test_the_norm_of_X2():
    board = mechanics.get("snakeboard")
    values = state(board)
    numbers = {sp.Symbol(name): value for name, value in values.items()}
    X2 = board.numeric(board.frames["paper"], values)[1]
    true = X2 @ board.numeric(board.inertia, values) @ X2
    # A dozen operations on numbers of order 0.1.
    assert float((J_r - J_r**2 * s**2 / (m * l**2)).subs(numbers)) == pytest.approx(true, rel=1e-13)
    assert float((J_r + J_r**2 * s**2 / (m * l**2)).subs(numbers)) != pytest.approx(true, rel=MISPRINT)


def test_the_printed_pair_is_not_metric_compatible():
    """|X1|² Γ̃¹₂₂ + |X2|² Γ̃²₂₁ = X_2<<X_1, X_2>> = 0: the printed signs violate it."""
    printed_122, printed_221 = -m * H * c * k / f_1**2, -H / c * m * k / f_2
    assert sp.simplify(f_1 / c**2 * -printed_122 + f_2 / f_1 * printed_221) == 0
    assert sp.simplify(f_1 / c**2 * printed_122 + f_2 / f_1 * printed_221) != 0


def bracket(X, Y, q):
    return Y.jacobian(q) * X - X.jacobian(q) * Y


def fields(name):
    mechanism = mechanics.get(name)
    q = sp.Matrix([mechanism.symbols[a] for a in mechanism.coordinates])
    rows = mechanism.frames["paper"]
    return [sp.Matrix([mechanism.symbolic(e) for e in row]) for row in rows], q


def test_the_bracket_of_section_6_1():
    """[X1, [X1, X3]] = -ℓ V_y, not -ℓ sinφ V_y, and the printed determinant ℓ² needs this."""
    (X1, X2, X3), q = fields("snakeboard")
    X13 = bracket(X1, X3, q)
    V_y = sp.Matrix([-sp.sin(theta), sp.cos(theta), 0, 0, 0])
    X113 = bracket(X1, X13, q)
    assert sp.simplify(X113 + l * V_y) == sp.zeros(5, 1)
    assert sp.simplify(sp.Matrix.hstack(X1, X2, X3, X13, X113).det() ** 2) == l**4
    printed = sp.Matrix.hstack(X1, X2, X3, X13, -l * sp.sin(phi) * V_y).det()
    assert sp.simplify(printed**2 - l**4 * sp.sin(phi) ** 2) == 0


def test_the_condition_of_section_6_2():
    """<X2 : X2> leaves span{X2} where Γ̃¹₂₂ != 0: where ℓ2 I1 != ℓ1 I2 cosψ and H != 0."""
    e = reduce(mechanics.get("roller_racer"), "paper")
    gamma = e.christoffel[0, 1, 1]
    lengths = {l_1: sp.Rational(1, 10), l_2: sp.Rational(1, 20), m: 3}
    cosine = sp.Rational(3, 5)
    angle = {sp.cos(psi): cosine, sp.sin(psi): sp.Rational(4, 5)}
    # true condition violated: ℓ2 I1 = ℓ1 I2 cosψ
    true_zero = {I_2: sp.Rational(1, 10), I_1: sp.Rational(2) * cosine / 10}
    # printed condition violated: ℓ2 I1 cosψ = ℓ1 I2
    printed_zero = {I_1: sp.Rational(1, 10), I_2: cosine / 20}
    assert gamma.subs(angle).subs({**lengths, **true_zero}) == 0
    assert gamma.subs(angle).subs({**lengths, **printed_zero}) != 0
    # H = 0
    inertias = {
        I_1: sp.Rational(1, 10),
        I_2: sp.Rational(1, 100),
        m: 3,
        l_1: sp.Rational(3, 50),
        l_2: sp.Rational(1, 10),
    }
    behind = {sp.cos(psi): -cosine, sp.sin(psi): sp.Rational(4, 5)}
    assert gamma.subs(behind).subs(inertias) == 0


def test_at_the_singular_angle_the_racer_can_do_more_than_rotate():
    """At c = 0, D is span{∂θ, ℓ2 V_x + sinψ ∂ψ}: rank two, and ψ passes through with v_x = ℓ2 ψ̇/sinψ."""
    racer = mechanics.get("roller_racer")
    values = dict(racer.parameters) | {"l_1": 0.2, "l_2": 0.1, "x": 0.3, "y": 0.1, "theta": 0.7, "psi": 2 * np.pi / 3}
    forms = racer.numeric(racer.one_forms, values)
    assert np.linalg.matrix_rank(forms) == 2
    sine = np.sin(values["psi"])
    turn = np.array([0, 0, 1, 0])
    roll = np.array([0.1 * np.cos(0.7), 0.1 * np.sin(0.7), 0, sine])
    # Rounding of 0.1 + 0.2 cos(2π/3).
    np.testing.assert_allclose(forms @ np.column_stack([turn, roll]), 0, atol=1e-15)


def test_the_symmetric_product_of_section_6_1():
    """<X2 : X3> = Σ_k (Γ̃^k_23 + Γ̃^k_32) X_k has mℓ² - J_r sin²φ below, as the multipliers say of Γ̃²₃₂ above."""
    gamma = reduce(mechanics.get("snakeboard"), "paper").christoffel
    product = [gamma[up, 1, 2] + gamma[up, 2, 1] for up in range(3)]
    corrected, printed = -J_r * co * s / D, -J_r * co * s / D_PRINTED
    assert sp.simplify(product[0] - J_r / (m * l**2) * co) == 0
    assert sp.simplify(product[1] - corrected) == 0
    assert sp.simplify(product[1] - printed) != 0
    assert product[2] == 0


def test_the_steered_right_angle_that_section_6_1_leaves_out():
    """At φ = π/2, <X2 : X3> vanishes but <X3 : <X2 : X3>> does not, and X1, X2, X3 still span D's extension.

    There <X3 : f X1 + g X2> = X3(f) X1 + X3(g) X2, because f and g are zero.
    """
    board = mechanics.get("snakeboard")
    gamma = reduce(board, "paper").christoffel
    product = [gamma[up, 1, 2] + gamma[up, 2, 1] for up in range(2)]
    at = {phi: sp.pi / 2}
    assert [f.subs(at) for f in product] == [0, 0]
    assert sp.simplify(product[0].diff(phi).subs(at) + J_r / (m * l**2)) == 0
    values = {**board.parameters, "x": 0.1, "y": 0.2, "theta": 0.3, "psi": 0.4, "phi": np.pi / 2}
    assert np.linalg.matrix_rank(board.numeric(board.frames["paper"], values)) == 3
    assert (
        np.linalg.matrix_rank(board.numeric(board.one_forms, values), tol=1e-12) == 1
    )  # the rows lose rank, D does not

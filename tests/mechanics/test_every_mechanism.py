"""What holds for any mechanism: the catalogue, the zoo of test vectors, and specs that users might write.

Each is taken in all its frames and in the frame that is found when none is given.
"""

import dataclasses
import itertools
from pathlib import Path

import numpy as np
import pytest
import sympy as sp
import zoo
from oracles import multiplier_acceleration

import mechanics
from mechanics import Mechanism, Model
from mechanics.compiler.codegen import needed
from mechanics.geometry import reduce
from mechanics.geometry.reduction import derive

USER = Path(__file__).parents[1] / "data" / "user"

MECHANISMS = {
    **{name: mechanics.get(name) for name in mechanics.names()},
    **{f"zoo/{name}": zoo.load(name) for name in zoo.NAMES},
    **{f"user/{path.stem}": Mechanism.from_file(path) for path in sorted(USER.glob("*.toml"))},
}
FRAMES = [(name, frame) for name, m in MECHANISMS.items() for frame in (*m.frames, None)]


def in_frame(name, frame):
    """The mechanism with one of its frames as the only one, or with none."""
    mechanism = MECHANISMS[name]
    return dataclasses.replace(mechanism, frames={frame: mechanism.frames[frame]} if frame else {})


def random_states(mechanism, count=4):
    """Configurations with |q| < 1 rad, velocities and controls of order one, parameters near the defaults."""
    rng = np.random.default_rng(7)
    for _ in range(count):
        params = {name: value * rng.uniform(0.9, 1.1) for name, value in mechanism.parameters.items()}
        q = rng.uniform(0.05, 1, mechanism.n) * rng.choice([-1, 1], mechanism.n)
        yield params, q, rng.normal(size=mechanism.rank), rng.normal(size=len(mechanism.controls))


@pytest.mark.parametrize(("name", "frame"), FRAMES)
def test_accelerations_are_those_of_the_multiplier_formulation(name, frame):
    mechanism = in_frame(name, frame)
    for params, q, v, u in random_states(mechanism):
        model = Model(mechanism, params)
        qdot = model.velocity(q, v)
        values = params | dict(zip(mechanism.coordinates, q, strict=True))
        expected = multiplier_acceleration(mechanism, values, qdot, u)
        # Rounding of some hundred to thousand operations, and of a linear system of condition 1e4: 1e-14 is seen.
        scale = max(1.0, np.abs(expected).max())
        np.testing.assert_allclose(model.acceleration(q, v, u), expected, rtol=0, atol=1e-12 * scale)
        assert np.abs(model.constraint_residual(q, qdot)).max(initial=0) < 1e-13 * max(1.0, np.abs(qdot).max())
        np.testing.assert_allclose(model.project(q, qdot), v, rtol=0, atol=1e-12 * max(1.0, np.abs(v).max()))


@pytest.mark.parametrize("name", ["snakeboard", "roller_racer", "differential_drive"])
def test_controls_for_accelerations_give_them(name):
    mechanism = MECHANISMS[name]
    model, drawn = Model(mechanism, drag=True), [*random_states(mechanism, 6)]
    index = np.array([row.index("1") for row in mechanism.forces.values()])  # torques on single joints, all of them
    q, v, wanted = (np.array([state[i] for state in drawn]).reshape(2, 3, -1) for i in (1, 2, 3))
    u = model.controls_for(q, v, index, wanted)
    # Rounding of the products and of a linear system of condition 100.
    np.testing.assert_allclose(model.acceleration(q, v, u)[..., index], wanted, rtol=0, atol=1e-11)
    np.testing.assert_allclose(model.controls_for(q[1, 2], v[1, 2], index, wanted[1, 2]), u[1, 2], rtol=1e-12)


DRAGGED = [name for name, m in MECHANISMS.items() if m.rayleigh != "0"]


@pytest.mark.parametrize("name", DRAGGED)
def test_drag_is_minus_the_derivative_of_rayleighs_function(name):
    mechanism = MECHANISMS[name]
    for params, q, v, u in random_states(mechanism, 2):
        model = Model(mechanism, params, drag=True)
        values = params | dict(zip(mechanism.coordinates, q, strict=True))
        expected = multiplier_acceleration(mechanism, values, model.velocity(q, v), u, drag=mechanism.drag)
        scale = max(1.0, np.abs(expected).max())
        np.testing.assert_allclose(model.acceleration(q, v, u), expected, rtol=0, atol=1e-12 * scale)
        without = Model(mechanism, params).acceleration(q, v, u)
        assert np.abs(without - expected).max() > 1e-6 * scale


@pytest.mark.parametrize("name", DRAGGED)
def test_energy_only_falls_where_nothing_drives(name):
    mechanism = MECHANISMS[name]
    _, q, v, _ = next(random_states(mechanism))
    motion = mechanics.simulate(mechanism, np.linspace(0, 0.1, 6), 0.5 * q, v0=0.3 * v, drag=True)
    assert (np.diff(motion.energy) < 0).all()


@pytest.mark.parametrize("name", MECHANISMS)
def test_energy_changes_by_the_work_of_the_controls(name):
    mechanism = MECHANISMS[name]
    _, q, v, u = next(random_states(mechanism))
    controls = (lambda t: 0.1 * u * np.cos(3 * t)) if len(u) else None
    motion = mechanics.simulate(mechanism, np.linspace(0, 0.2, 5), 0.5 * q, v0=0.3 * v, controls=controls)
    # The solver's own accuracy, 1e-12 relative in each step.
    scale = max(1.0, np.abs(motion.energy).max())
    np.testing.assert_allclose(motion.energy - motion.work, motion.energy[0], rtol=0, atol=1e-9 * scale)


@pytest.mark.parametrize("name", MECHANISMS)
def test_the_frame_found_is_orthogonal_and_spans_d_wherever_the_forms_are_independent(name):
    """At right angles too, where frames found by solving for a coordinate have their poles."""
    mechanism = in_frame(name, None)
    model = Model(mechanism)
    rng = np.random.default_rng(8)
    corners = itertools.product((0.0, np.pi / 2, np.pi), repeat=min(mechanism.n, 5))
    points = [np.resize(corner, mechanism.n) for corner in corners] + list(
        rng.uniform(-np.pi, np.pi, (50, mechanism.n))
    )
    identity = np.eye(mechanism.rank)
    tested = 0
    for q in points:
        values = mechanism.parameters | dict(zip(mechanism.coordinates, q, strict=True))
        inertia = mechanism.numeric(mechanism.inertia, values)
        if mechanism.one_forms:
            forms = mechanism.numeric(mechanism.one_forms, values)
            if np.linalg.svd(forms, compute_uv=False)[-1] < 1e-6 or np.linalg.eigvalsh(inertia)[0] < 1e-9:
                continue
        tested += 1
        frame = np.array([model.velocity(q, row) for row in identity])
        gram = frame @ inertia @ frame.T
        length = np.sqrt(np.diag(gram))
        assert (length > 1e-6).all(), (q, frame)
        # Entries of order one to a hundred, some tens of operations each.
        np.testing.assert_allclose(gram / np.outer(length, length), identity, rtol=0, atol=1e-10, err_msg=str(q))
    assert tested > 50


@pytest.mark.parametrize("name", zoo.NAMES)
@pytest.mark.parametrize("frame", [True, False])
def test_zoo_vectors(name, frame):
    """Accelerations computed elsewhere to 40 digits, from the strings alone."""
    mechanism = zoo.load(name, frame=frame, fibre=False)
    for vector in zoo.read(name)["test_vectors"]:
        given = [vector[key] for key in ("q", "qdot", "u", "params")]
        expected = np.array(vector["qddot"])
        actual = mechanics.acceleration(mechanism, *given)
        # The vectors hold 16 digits, and so does the velocity they start from.
        np.testing.assert_allclose(actual, expected, rtol=0, atol=1e-12 * max(1.0, np.abs(expected).max()))
        model = Model(mechanism, vector["params"])
        v = model.feasible(vector["q"], vector["qdot"])
        assert model.energy(vector["q"], v) == pytest.approx(vector["energy"], rel=1e-12)


@pytest.mark.parametrize("name", ["snakeboard", "roller_racer", "zoo/car_dynamic", "zoo/trailer_1", "user/polar_arm"])
def test_both_arithmetics_give_the_same_equations(name, monkeypatch):
    """Where nothing may be multiplied out, every step is named; written out, it is the same function."""
    mechanism = MECHANISMS[name]
    with monkeypatch.context() as patch:
        patch.setattr("mechanics.geometry.algebra.WORK_LIMIT", 0)
        steps = reduce(mechanism)
    symbols = [*steps.coordinates, *steps.parameters, *steps.pseudo_velocities, *steps.controls]
    function = sp.lambdify(symbols, list(steps.acceleration), cse=True)
    for params, q, v, u in random_states(mechanism):
        model = Model(mechanism, params)
        np.testing.assert_allclose(function(*q, *params.values(), *v, *u), model.rates(q, v, u), rtol=1e-11, atol=1e-12)
    # Zeros are seen by both.
    pattern = [e == 0 for e in sp.flatten(steps.christoffel)]
    assert pattern == [e == 0 for e in sp.flatten(reduce(mechanism).christoffel)]


def derivative(function, q, direction):
    """Derivative of an array-valued function along a direction, by central differences of sixth order."""
    step, weights = 1e-2, {1: 3 / 4, 2: -3 / 20, 3: 1 / 60}
    ahead_minus_behind = (
        w * (function(q + k * step * direction) - function(q - k * step * direction)) for k, w in weights.items()
    )
    return sum(ahead_minus_behind) / step


class InNumbers:
    """Levi-Civita connection and projection of a mechanism at its default parameters, by differences."""

    def __init__(self, mechanism, q):
        self.mechanism, self.q, n = mechanism, q, mechanism.n
        dM = np.array([derivative(self.inertia, q, axis) for axis in np.eye(n)])  # [c, a, b] = ∂_c M_ab
        lowered = (np.einsum("kij->ijk", dM) + np.einsum("jik->ijk", dM) - dM) / 2
        self.christoffel = np.linalg.solve(self.inertia(q), lowered.reshape(n, n * n)).reshape(n, n, n)

    def numeric(self, rows, q):
        values = self.mechanism.parameters | dict(zip(self.mechanism.coordinates, q, strict=True))
        return self.mechanism.numeric(rows, values)

    def inertia(self, q):
        return self.numeric(self.mechanism.inertia, q)

    def complement(self, q):
        """P⊥."""
        if not self.mechanism.one_forms:
            return np.zeros((self.mechanism.n, self.mechanism.n))
        forms = self.numeric(self.mechanism.one_forms, q)
        raised = np.linalg.solve(self.inertia(q), forms.T)
        return raised @ np.linalg.solve(forms @ raised, forms)

    def nabla(self, X, Y):
        """∇_X Y at q, for a vector X and a field Y."""
        return derivative(Y, self.q, X) + np.einsum("ijk,j,k->i", self.christoffel, X, Y(self.q))

    def constrained(self, X, Y):
        """∇_X Y + (∇_X P⊥)(Y), eq. (6)."""
        nabla = self.nabla(X, Y)
        return nabla + self.nabla(X, lambda q: self.complement(q) @ Y(q)) - self.complement(self.q) @ nabla


@pytest.mark.parametrize("name", MECHANISMS)
def test_theorem_3_2_is_equation_6_metric_and_has_the_torsion_of_its_frame(name):
    """In numbers, so also where the formulas of eq. (6) are too long to be written."""
    mechanism = MECHANISMS[name]
    k, e, model = mechanism.rank, derive(mechanism), Model(mechanism)
    # The steps of long equations take the place of common subexpressions.
    steps = list(needed(sp.flatten(e.christoffel), e.definitions).items())
    symbols = [*e.coordinates, *e.parameters]
    function = sp.lambdify(symbols, e.christoffel.tolist(), cse=lambda written: (steps, written))
    _, q, _, _ = next(random_states(mechanism))
    gamma = np.array(function(*q, *mechanism.parameters.values()), dtype=float).reshape(k, k, k)
    connection = InNumbers(mechanism, q)
    inertia = connection.inertia(q)
    fields = [lambda q, unit=unit: model.velocity(q, unit) for unit in np.eye(k)]
    frame = np.array([field(q) for field in fields])
    norms = np.diag(frame @ inertia @ frame.T)
    # Differences over steps of 0.01 err by some 1e-12 of the seventh derivatives, which are large in long frames.
    tolerance = 1e-7 * max(1.0, np.abs(frame).max() ** 4)
    for i, X in enumerate(frame):
        for j, field in enumerate(fields):
            constrained = connection.constrained(X, field)
            np.testing.assert_allclose(gamma[:, i, j] @ frame, constrained, rtol=0, atol=tolerance)
            bracket = derivative(field, q, X) - derivative(fields[i], q, frame[j])
            torsion = (gamma[:, i, j] - gamma[:, j, i]) * norms
            np.testing.assert_allclose(torsion, frame @ inertia @ bracket, rtol=0, atol=tolerance)
        lowered = gamma[:, i, :] * norms[:, None]  # <<∇̃_X X_j, X_k>> at [k, j]
        rates = [derivative(lambda q, f=f: f(q) @ connection.inertia(q) @ f(q), q, X) for f in fields]
        np.testing.assert_allclose(lowered + lowered.T, np.diag(rates), rtol=0, atol=tolerance)

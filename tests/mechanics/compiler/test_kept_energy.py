"""Steps that keep the energy: a scaling of the velocities, of the size of the step's error, and nothing else."""

import numpy as np
import pytest
import sympy as sp

import mechanics
from mechanics.compiler.codegen import Program, integrated
from mechanics.compiler.dataflow import analyse
from mechanics.compiler.integrators import method
from mechanics.geometry.energy import conserved
from mechanics.model import Model

EPSILON = np.finfo(float).eps


class Steps:
    """Steps of a mechanism's whole state with and without kept energy, and its numbers."""

    def __init__(self, equations, rates_of, stepper):
        self.equations, self.rates, self._stepper = equations, rates_of(equations), stepper
        self.mechanism = mechanism = equations.mechanism
        self.model = Model(mechanism)
        self.names = (*equations.coordinates, *equations.pseudo_velocities)
        self.forces = mechanism.numeric(
            mechanism.forces.values(), {**mechanism.parameters, **dict.fromkeys(mechanism.coordinates, 0.0)}
        )
        self.energy = {f"energy:{part}": expression for part, expression in conserved(equations).items()}
        self.explicit = bool(analyse(self.rates, list(self.rates)).core)

    def step(self, name, kept=True, **options):
        values = dict(zip(self.equations.parameters, self.mechanism.parameters.values(), strict=True))
        kept = {"energy": self.energy, "speeds": self.equations.pseudo_velocities} if kept else {}
        controls = self.equations.controls
        _, step = self._stepper(self.rates, list(self.rates), name, held=controls, parameters=values, **kept, **options)

        def move(h, q, v, u):
            end = step(h, dict(zip(self.names, map(float, (*q, *v)), strict=True)), u)
            return tuple(np.array([end[s] for s in names], float) for names in self._groups)

        return move

    @property
    def _groups(self):
        return self.equations.coordinates, self.equations.pseudo_velocities

    def random(self, rng):
        mechanism = self.mechanism
        q, v = rng.uniform(-1.1, 1.1, mechanism.n), rng.uniform(-2, 2, mechanism.rank)
        return q, v, rng.uniform(-1, 1, len(mechanism.forces)) * list(mechanism.torque_limits.values())


@pytest.fixture
def steps(equations, rates_of, stepper):
    return Steps(equations, rates_of, stepper)


# Methods, and the number of steps in two seconds from which the order is read off.
METHODS = {"snakeboard": {"gauss2": 20, "lobatto3": 20}, "roller_racer": {"rk4": 80, "dop853": 40}}


def test_the_velocities_are_scaled_to_the_energy_that_the_work_leaves(steps):
    """Coordinates as without; one factor for all velocities, the one that the model's own energies give."""
    rng = np.random.default_rng(0)
    largest = 0.0
    for name in METHODS[steps.mechanism.name]:
        kept, plain = steps.step(name), steps.step(name, kept=False)
        for _ in range(50):
            q, v, u = steps.random(rng)
            q_kept, v_kept = kept(0.1, q, v, u)
            q_plain, v_plain = plain(0.1, q, v, u)
            assert q_kept.tolist() == q_plain.tolist()
            # Neither mechanism has a potential.
            energy, work = steps.model.energy(q, v), u @ steps.forces @ (q_plain - q)
            factor = np.sqrt((energy + work) / steps.model.energy(q_plain, v_plain))
            # Roundings of energies, of which the work may cancel nine tenths.
            np.testing.assert_allclose(v_kept, factor * v_plain, rtol=1e-14, atol=0)
            largest = max(largest, abs(factor - 1))
            change = steps.model.energy(q_kept, v_kept) - energy - work
            assert abs(change) < 20 * EPSILON * (energy + np.abs(u * (steps.forces @ q)).sum() + abs(work))
    assert largest > 1e-6  # there was something to correct


@pytest.mark.parametrize("which", [0, 1])
def test_the_order_is_that_of_the_method(steps, which):
    name, coarse = list(METHODS[steps.mechanism.name].items())[which]
    q0, v0 = np.full(steps.mechanism.n, 0.3), np.linspace(0.9, -0.7, steps.mechanism.rank)
    torque = 0.3 * np.array(list(steps.mechanism.torque_limits.values()))
    end = 2.0
    run = mechanics.simulate(steps.mechanism, [0.0, end], q0, v0=v0, controls=lambda t: torque, rtol=1e-13, atol=1e-14)
    reference = np.concatenate([run.q[-1], run.v[-1]])
    errors = {}
    for kept in (True, False):
        step = steps.step(name, kept)
        for n in (coarse, 2 * coarse):
            q, v = q0, v0
            for _ in range(n):
                q, v = step(end / n, q, v, torque)
            errors[kept, n] = np.abs(np.concatenate([q, v]) - reference).max()
    assert errors[True, 2 * coarse] > 1e-11  # above the reference's own error
    # Finite steps: the next term of the expansion shifts what is observed by a few tenths.
    assert np.log2(errors[True, coarse] / errors[True, 2 * coarse]) > method(name).order - 0.5
    assert errors[True, coarse] < 2 * errors[False, coarse]


def test_rest_stays_rest(steps):
    """No quotient of zeros, and no root of what a rounding makes negative."""
    step = steps.step(next(iter(METHODS[steps.mechanism.name])))
    q, zero, idle = np.full(steps.mechanism.n, 0.3), np.zeros(steps.mechanism.rank), np.zeros(len(steps.forces))
    q_end, v_end = step(0.05, q, zero, idle)
    assert q_end.tolist() == q.tolist()
    assert v_end.tolist() == zero.tolist()
    for size in (1e-200, 1e-160, 1e-150, 1e-20):  # squares of the first are zero or lose digits
        q_end, v_end = step(0.05, q, zero + size, idle)
        assert steps.model.energy(q_end, v_end / size) == pytest.approx(steps.model.energy(q, zero + 1), rel=1e-14)


def test_where_nothing_is_left_the_correction_is_bounded(stepper):
    """A rotor braked to a stand: far from its zero, the work's rounding is many times the energy that is left."""
    x, v, u = sp.symbols("x v u")
    energy = {"energy:kinetic": v**2 / 2, "energy:potential": -u * x}
    rates, far, rest = {x: v, v: u}, 1e6, 1e-7
    worst = {}
    for tolerance in (np.inf, 1e-12):
        _, step = stepper(rates, [x, v], "rk4", held=[u], energy=energy, speeds=[v], tolerance=tolerance)
        ends = [step(h, {x: far, v: 0.3 * h + rest}, [-0.3])[v] for h in np.linspace(0.01, 1, 500).tolist()]
        worst[tolerance] = np.abs(np.array(ends) - rest).max()  # no number if a root was of a negative one
    # Of the size of sqrt(ulp(0.3e6)) = 8e-6 without a bound; with it ten times the tolerance.
    assert 1e-6 < worst[np.inf] < 1e-4
    assert worst[1e-12] < 1.1e-11


def test_states_may_be_arrays(stepper, execute):
    """In the NumPy backend, as without kept energy."""
    x, v = sp.symbols("x v")
    energy = {"energy:kinetic": v**2 / 2, "energy:potential": 1 - sp.cos(x)}
    rates = {x: v, v: -sp.sin(x)}
    _, step = stepper(rates, [x], "rk4", energy=energy, speeds=[v], tolerance=1e-3)
    xs, vs = np.linspace(-1, 1, 5), np.linspace(0.2, 1, 5)
    x_end, v_end, right = execute(step.source)["step"](0.1, xs, vs, np.zeros(0))
    assert right.tolist() == [True] * 5
    # A few roundings of numbers of order one.
    np.testing.assert_allclose(v_end**2 / 2 - np.cos(x_end), vs**2 / 2 - np.cos(xs), rtol=0, atol=1e-15)


@pytest.mark.parametrize("tolerance", [np.inf, 1e-10])
def test_two_streams_are_twice_one(steps, tolerance, two_streams):
    """To the last bit, and the same is true of what is carried from the step before."""
    equations, flow = steps.equations, analyse(steps.rates, list(steps.rates))
    program = Program({**integrated(flow), **steps.energy}, equations.parameters)
    two_streams(equations, program, flow, method("rk4"), tolerance=tolerance, speeds=equations.pseudo_velocities)


def test_a_step_of_several_keeps_the_energy_in_each(steps):
    """`substeps=4` is four steps of a quarter, bit for bit."""
    name = next(iter(METHODS[steps.mechanism.name]))
    once, split = steps.step(name), steps.step(name, substeps=4)
    q, v, u = steps.random(np.random.default_rng(3))
    state = (q, v)
    for _ in range(4):
        state = once(0.1, *state, u)
    assert [part.tolist() for part in split(0.4, q, v, u)] == [part.tolist() for part in state]

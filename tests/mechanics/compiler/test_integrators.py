"""Methods as data: their tableaux, and what one generated step of each of them does."""

import dataclasses
import itertools

import numpy as np
import pytest
import sympy as sp
from scipy.integrate import solve_ivp

from mechanics.compiler import integrators
from mechanics.compiler.integrators import Method, method, method_names

GAUSS = [name for name in method_names() if name.startswith("gauss")]
LOBATTO = [name for name in method_names() if name.startswith("lobatto")]
COLLOCATION = GAUSS + LOBATTO
EXPLICIT = [name for name in method_names() if method(name).explicit]
ESTIMATING = [name for name in method_names() if name not in ("gauss1", "gauss2")]
# A threshold takes the trees of one order more: 12,486 for order 12.
THRESHOLDS = [pytest.param(name, marks=pytest.mark.slow) if method(name).order == 12 else name for name in ESTIMATING]

y1, y2, z1, z2 = sp.symbols("y1 y2 z1 z2")
# A pendulum (a core) and a quadrature behind it; a chain in which each rate uses what is before it.
COUPLED = {y1: y2, y2: -sp.sin(y1), z1: sp.cos(y1) * y2**2}
LAYERED = {y1: sp.Integer(1), y2: sp.cos(y1), z1: sp.sin(y2) * sp.cos(y1), z2: sp.cos(z1) * y2}
START = {y1: 0.4, y2: 0.9, z1: -0.2, z2: 0.3}


def _arrays(name):
    row = method(name)
    return np.array(row.a), np.array(row.b), np.array(row.c)


# -- tableaux -----------------------------------------------------------------------------------


def test_the_methods_are_those_of_the_documentation():
    orders = {name: method(name).order for name in method_names()}
    gauss = {f"gauss{s}": 2 * s for s in range(1, 7)}
    lobatto = {f"lobatto{s}": 2 * s - 2 for s in range(3, 8)}
    assert orders == {"rk4": 4, "dop853": 8, "verner9": 9, **gauss, **lobatto}
    assert set(EXPLICIT) == {"rk4", "dop853", "verner9"}
    assert all(method(name).source for name in method_names())


def test_an_unknown_method_is_refused_with_a_suggestion():
    with pytest.raises(ValueError, match="unknown integrator 'dopri853'.*known: auto, rk4, .*Did you mean 'dop853'"):
        method("dopri853")


def _trees(order):
    """Rooted trees of `order` nodes, each the sorted tuple of its root's branches."""
    return _forests(order - 1, order - 1)


def _forests(nodes, largest):
    if nodes == 0:
        return [()]
    found = []
    for size in range(min(nodes, largest), 0, -1):
        for count in range(1, nodes // size + 1):
            for branches in itertools.combinations_with_replacement(_trees(size), count):
                found += [(*branches, *rest) for rest in _forests(nodes - count * size, size - 1)]
    return found


def _size(tree):
    return 1 + sum(map(_size, tree))


def _density(tree):
    return _size(tree) * np.prod([_density(branch) for branch in tree], initial=1)


def _elementary(tree, a):
    """Of each stage, the product over the root's branches of sum_j a_ij (what the branch gives at j)."""
    return np.prod([a @ _elementary(branch, a) for branch in tree], axis=0, initial=1.0) * np.ones(len(a))


@pytest.mark.parametrize("name", method_names())
def test_order_conditions_of_rooted_trees(name):
    """Every condition up to the method's order, of which `Method` itself checks the bushy ones only."""
    a, b, _ = _arrays(name)
    # The numbers of rooted trees: OEIS A000081.
    counts = (1, 1, 2, 4, 9, 20, 48, 115, 286)
    assert tuple(len(_trees(order)) for order in range(1, 10)) == counts
    assert tuple(len(integrators._trees(order)) for order in range(1, 10)) == counts
    # With ten nodes and more there are thousands, and the simplifying assumptions below imply them all.
    for order in range(1, min(method(name).order, 9) + 1):
        for tree in _trees(order):
            # Weights up to 43 (Dormand-Prince 8) and 15 (Verner 9), whose roundings add up to 1e-14.
            assert b @ _elementary(tree, a) == pytest.approx(1 / _density(tree), rel=0, abs=1e-13)


@pytest.mark.parametrize("name", EXPLICIT)
def test_no_higher_order_is_claimed_than_the_trees_allow(name):
    """One order further, some condition fails."""
    a, b, _ = _arrays(name)
    misses = [abs(b @ _elementary(tree, a) - 1 / _density(tree)) for tree in _trees(method(name).order + 1)]
    assert max(misses) > 1e-6


@pytest.mark.parametrize("name", GAUSS)
def test_gauss_is_collocation_at_legendre_nodes(name):
    """B(2s), C(s) and D(s), and NumPy's own nodes and weights."""
    a, b, c = _arrays(name)
    s = len(b)
    nodes, weights = np.polynomial.legendre.leggauss(s)
    assert c == pytest.approx((1 + nodes) / 2, rel=0, abs=1e-15)  # eight digits of float64 after the first
    assert b == pytest.approx(weights / 2, rel=0, abs=1e-15)
    for k in range(1, 2 * s + 1):
        assert b @ c ** (k - 1) == pytest.approx(1 / k, rel=0, abs=1e-15)
    for k in range(1, s + 1):
        assert a @ c ** (k - 1) == pytest.approx(c**k / k, rel=0, abs=1e-15)
        assert (b * c ** (k - 1)) @ a == pytest.approx(b * (1 - c**k) / k, rel=0, abs=1e-15)
    # Symmetric and symplectic.
    assert a + a[::-1, ::-1] == pytest.approx(np.tile(b, (s, 1)), rel=0, abs=1e-15)
    assert b[:, None] * a + (b[:, None] * a).T == pytest.approx(np.outer(b, b), rel=0, abs=1e-15)


@pytest.mark.parametrize("name", LOBATTO)
def test_lobatto_is_collocation_with_both_ends(name):
    """B(2s - 2), C(s) and D(s - 2), NumPy's own nodes, and ends that are shared to the last bit."""
    row = method(name)
    a, b, c = _arrays(name)
    s = len(b)
    # The inner nodes are the extrema of the Legendre polynomial of degree s - 1.
    inner = np.polynomial.Legendre.basis(s - 1).deriv().roots()
    assert c == pytest.approx([0, *(1 + np.sort(inner)) / 2, 1], rel=0, abs=1e-15)
    for k in range(1, 2 * s - 1):
        assert b @ c ** (k - 1) == pytest.approx(1 / k, rel=0, abs=1e-15)
    for k in range(1, s + 1):
        assert a @ c ** (k - 1) == pytest.approx(c**k / k, rel=0, abs=1e-15)
    for k in range(1, s - 1):
        assert (b * c ** (k - 1)) @ a == pytest.approx(b * (1 - c**k) / k, rel=0, abs=1e-15)
    assert a + a[::-1, ::-1] == pytest.approx(np.tile(b, (s, 1)), rel=0, abs=1e-15)
    # The first stage is the start and the last is the end: what is computed there serves twice.
    assert row.c[0] == 0
    assert not any(row.a[0])
    assert row.c[-1] == 1
    assert row.a[-1] == row.b


def test_verner_has_the_simplifying_assumption_d1():
    """sum_i b_i a_ij = b_j (1 - c_j), on which the derivation of the method rests."""
    a, b, c = _arrays("verner9")
    assert b @ a == pytest.approx(b * (1 - c), rel=0, abs=1e-14)
    # Stages whose weights are fixed by what others do: 2 to 7 do not enter the end.
    assert np.flatnonzero(b).tolist() == [0, *range(7, 15)]


@pytest.mark.parametrize("name", method_names())
def test_a_broken_tableau_is_refused(name):
    """Any coefficient wrong in its eleventh digit, or an order that it does not have."""
    good = method(name)
    s = good.stages
    places = [("b", (i,)) for i in range(s)] + [("c", (i,)) for i in range(s)]
    places += [("a", pair) for pair in itertools.product(range(s), range(s))]
    for field, place in places:
        numbers = np.array(getattr(good, field))
        numbers[place] += 1e-11
        changed = tuple(map(tuple, numbers)) if numbers.ndim == 2 else tuple(numbers)
        with pytest.raises(ValueError, match=f"{name} violates"):
            dataclasses.replace(good, **{field: changed})
    with pytest.raises(ValueError, match="violates 'sum b c"):
        dataclasses.replace(good, order=good.order + 1)
    for field in ("a", "b", "c"):
        with pytest.raises(ValueError, match="must be s x s"):
            dataclasses.replace(good, **{field: getattr(good, field)[:-1]})


def test_a_consistent_tableau_is_accepted():
    heun = Method("heun", ((0.0, 0.0), (1.0, 0.0)), (0.5, 0.5), (0.0, 1.0), 2, "Heun 1900")
    assert heun.explicit
    assert heun.stages == 2


# -- estimates of the error -----------------------------------------------------------------------


def _misses(weights, a, order):
    """What the order conditions of the trees with `order` nodes leave."""
    return [weights @ _elementary(tree, a) - 1 / _density(tree) for tree in _trees(order)]


@pytest.mark.parametrize("name", ESTIMATING)
def test_an_estimate_is_the_difference_to_a_method_of_lower_order(name):
    """The weights b + d are those of a method of order p from the same stages, as high as there is one below b's."""
    a, b, _ = _arrays(name)
    s, highest = method(name).stages, method(name).estimates[0][1]
    for d, p in method(name).estimates:
        assert 1 <= p < method(name).order
        assert np.abs(d).sum() == pytest.approx(1, rel=1e-14)
        for order in range(1, p + 1):
            # As for b alone, see above.
            assert np.abs(_misses(b + d, a, order)).max() < 1e-13
        assert np.abs(_misses(b + d, a, p + 1)).max() > 1e-7
    if highest + 1 < method(name).order:  # all conditions of one order more leave no weights but zero
        conditions = [_elementary(tree, a) for order in range(1, highest + 2) for tree in _trees(order)]
        assert np.linalg.matrix_rank(conditions, tol=1e-9) == s


@pytest.mark.parametrize("name", ESTIMATING)
def test_no_estimate_of_a_symmetric_method_is_all_there_is(name):
    """One is odd about the middle of the step and one even, so that no motion escapes both."""
    row = method(name)
    if name.startswith(("gauss", "lobatto")):
        assert row.symmetric
        parities = [sign for d, _ in row.estimates for sign in (1, -1) if np.allclose(d, sign * np.array(d)[::-1])]
        assert sorted(parities) == [-1, 1]
    else:
        assert len(row.estimates) == 1 + row.symmetric


@pytest.mark.parametrize("name", ["gauss1", "gauss2"])
def test_few_stages_leave_no_estimate(name):
    with pytest.raises(ValueError, match=f"{name} has too few stages for an estimate of its error; choose another"):
        _ = method(name).estimates


def _pendulum_step(name, h, state):
    """One step of the tableau, by fixed-point iteration of all stages: the state at the end, and the estimates."""
    a, b, _ = _arrays(name)
    rates = np.zeros((len(b), 2))
    for _ in range(200):
        before, stages = rates, state + h * a @ rates
        rates = np.stack([stages[:, 1], -np.sin(stages[:, 0])], axis=1)
        if np.array_equal(before, rates):
            break
    return state + h * b @ rates, [h * np.array(d) @ rates for d, _ in method(name).estimates]


@pytest.mark.parametrize("name", ESTIMATING)
def test_the_estimate_of_a_pendulum_has_the_order_that_it_claims(name):
    for which, (_, p) in enumerate(method(name).estimates):
        h = {1: 0.05, 2: 0.05, 3: 0.05, 4: 0.2, 5: 0.2, 6: 0.4, 7: 0.8}[p]
        start = np.array([0.4, 0.9])
        coarse, fine = (np.linalg.norm(_pendulum_step(name, step, start)[1][which]) for step in (h, h / 2))
        assert fine > 1e-14  # rates of order 1, whose weights add up to nothing, leave 1e-15
        # Finite steps: the next term of the expansion shifts what is observed by a few tenths.
        assert np.log2(coarse / fine) == pytest.approx(p + 1, abs=0.4)


@pytest.mark.parametrize("tolerance", [1e-6, 1e-10])
@pytest.mark.parametrize("name", THRESHOLDS)
def test_a_step_whose_estimate_is_below_the_threshold_is_right(name, tolerance):
    """On a pendulum, for the longest such step: its error is below the tolerance, and not out of sight."""
    thresholds = method(name).thresholds(tolerance)
    function = lambda t, y: (y[1], -np.sin(y[0]))  # noqa: E731
    worst = 0.0
    for start in np.random.default_rng(0).uniform(-2, 2, (5, 2)):
        h = 1.0
        while any(np.abs(e).max() > t for e, t in zip(_pendulum_step(name, h, start)[1], thresholds, strict=True)):
            h *= 0.8
        end = solve_ivp(function, (0, h), start, "DOP853", rtol=3e-14, atol=1e-15).y[:, -1]
        worst = max(worst, np.abs(_pendulum_step(name, h, start)[0] - end).max())
    # The safety that a threshold allows for is a factor of 100, of 25 for Verner; a pendulum needs little of it. The
    # lower bound is where the reference ends, or the steps for which h = 1 is short.
    assert min(1e-4 * tolerance, 1e-14) < worst <= tolerance


@pytest.mark.parametrize("name", THRESHOLDS)
def test_thresholds_scale_as_the_estimate_does_with_the_error(name):
    row, powers = method(name), [p + 1 for _, p in method(name).estimates]
    usual = row.thresholds(1e-10)
    ratios = [1e6 ** (power / (row.order + 1)) for power in powers]
    assert np.divide(row.thresholds(1e-4), usual) == pytest.approx(ratios, rel=1e-12)
    # With a safety of one, the tolerance is that of the error itself.
    bold = dataclasses.replace(row, safety=1.0)
    assert bold.thresholds(1e-10 / row.safety) == pytest.approx(usual, rel=1e-12)


@pytest.mark.parametrize("name", THRESHOLDS)
def test_thresholds_compare_what_is_left_of_the_first_conditions_that_fail(name):
    """If every derivative is the same power of one rate, of length L: estimate and error both follow from h L."""
    row = method(name)
    a, b, _ = _arrays(name)
    error = np.linalg.norm(_misses(b, a, row.order + 1))
    for which, (d, p) in enumerate(row.estimates):
        estimate = np.linalg.norm(np.subtract(_misses(b + d, a, p + 1), _misses(b, a, p + 1)))
        for reach in (1e-2, 0.1):
            tolerance = row.safety * error * reach ** (row.order + 1)
            # A null vector is known to roundings of 1e-16, of sums that leave 1e-7 of their terms.
            assert row.thresholds(tolerance)[which] == pytest.approx(estimate * reach ** (p + 1), rel=1e-6)


# -- steps --------------------------------------------------------------------------------------


def _reference(rates, end):
    """State at time `end`, by SciPy at its tightest."""
    function = sp.lambdify([list(rates)], list(rates.values()))
    run = solve_ivp(lambda t, y: function(y), (0, end), [START[s] for s in rates], "DOP853", rtol=3e-14, atol=1e-15)
    return run.y[:, -1]


def _error(step, rates, end, steps, reference):
    state = {s: START[s] for s in rates}
    for _ in range(steps):
        state = step(end / steps, state)
    return np.abs(np.array([state[s] for s in rates]) - reference).max()


# Time, and numbers of steps between which the order is read off: small enough for the leading term of the error to
# rule, errors large enough to stand above the reference's own 1e-14.
STEPS = {
    "rk4": (2.0, 32, 64),
    "dop853": (4.0, 8, 16),
    "gauss1": (2.0, 32, 64),
    "gauss2": (2.0, 16, 32),
    "gauss3": (2.0, 8, 16),
    "gauss4": (4.0, 8, 16),
    "gauss5": (4.0, 2, 8),
    "gauss6": (8.0, 8, 16),
    "verner9": (4.0, 8, 16),
    "lobatto3": (2.0, 16, 32),
    "lobatto4": (2.0, 8, 16),
    "lobatto5": (4.0, 8, 16),
    "lobatto6": (8.0, 8, 16),
    "lobatto7": (8.0, 8, 16),
}


# Verner chose the free parameters so that little is left of the terms of order 10: the next ones show until rounding
# hides both. Its order is seen in the conditions above.
OBSERVED = {"verner9": 10}


@pytest.mark.parametrize(
    ("name", "system"), [*((n, "layered") for n in method_names()), *((n, "coupled") for n in EXPLICIT)]
)
def test_observed_order(name, system, stepper):
    rates = LAYERED if system == "layered" else COUPLED
    end, coarse, fine = STEPS[name]
    _, step = stepper(rates, list(rates), name)
    reference = _reference(rates, end)
    errors = [_error(step, rates, end, n, reference) for n in (coarse, fine)]
    assert errors[1] > 1e-13
    # Finite steps: the next term of the expansion shifts what is observed by a few tenths.
    order = OBSERVED.get(name, method(name).order)
    assert np.log(errors[0] / errors[1]) / np.log(fine / coarse) == pytest.approx(order, abs=0.5)


@pytest.mark.parametrize("name", COLLOCATION)
def test_an_implicit_method_is_refused_on_a_core(name, stepper):
    with pytest.raises(ValueError, match=r"would be implicit on \(y1, y2\).*'dop853'"):
        stepper(COUPLED, list(COUPLED), name)


@pytest.mark.parametrize("name", method_names())
def test_time_reversal(name, stepper):
    """A step forth and a step back: home, to rounding, for the symmetric methods and for no others."""
    rates = COUPLED if method(name).explicit else LAYERED
    _, step = stepper(rates, list(rates), name)
    there = step(0.8, START)
    back = step(-0.8, there)
    miss = max(abs(back[s] - START[s]) for s in rates)
    if name in COLLOCATION:
        assert miss < 1e-15  # a few roundings of numbers of order 1
    else:
        assert miss > 1e-10


@pytest.mark.parametrize("name", ["rk4", "gauss3"])
def test_substeps_are_steps(name, stepper):
    """`substeps=4` is four steps of a quarter, bit for bit."""
    rates = COUPLED if method(name).explicit else LAYERED
    _, once = stepper(rates, list(rates), name)
    _, split = stepper(rates, list(rates), name, substeps=4)
    state = dict(START)
    for _ in range(4):
        state = once(0.1, state)
    assert split(0.4, START) == state


@pytest.mark.parametrize("name", ["dop853", "gauss4"])
def test_numpy_and_numba_agree(name, stepper):
    """The same source for both; the compiler may contract a product and a sum into one rounding."""
    rates = COUPLED if method(name).explicit else LAYERED
    _, plain = stepper(rates, list(rates), name)
    _, compiled = stepper(rates, list(rates), name, backend="numba")
    a, b = dict(START), dict(START)
    for _ in range(10):
        a, b = plain(0.1, a), compiled(0.1, b)
    assert [float(a[s]) for s in rates] == pytest.approx([b[s] for s in rates], rel=1e-13, abs=1e-13)


def test_numpy_steps_many_states_at_once(stepper):
    """Arrays of any shape in, row by row what scalars give."""
    _, step = stepper(COUPLED, list(COUPLED), "rk4")
    shift = np.linspace(-1, 1, 6).reshape(2, 3)
    many = step(0.1, {s: START[s] + shift for s in COUPLED})
    for place in np.ndindex(shift.shape):
        one = step(0.1, {s: START[s] + shift[place] for s in COUPLED})
        # Vectorised sine and cosine may round otherwise.
        assert [many[s][place] for s in COUPLED] == pytest.approx([one[s] for s in COUPLED], rel=1e-14)


@pytest.mark.parametrize("name", method_names())
@pytest.mark.parametrize("h", [0.05, 3.0])
def test_exact_layers_are_closed_forms(name, h, stepper):
    """Where the rate is a polynomial in time, the method does not matter, nor does the step."""
    u = sp.Symbol("u")
    v, q, a = sp.symbols("v q a")
    flow, step = stepper({v: 2 * u, q: v, a: q + 1}, [a], name, held=[u])
    assert {layer.kind for layer in flow.layers} == {"exact"}
    v0, q0, a0, u0 = 0.3, -0.7, 1.1, 0.9
    end = step(h, {v: v0, q: q0, a: a0}, [u0])
    # A polynomial of four terms, rounded.
    assert end[v] == pytest.approx(v0 + 2 * u0 * h, rel=4e-16)
    assert end[q] == pytest.approx(q0 + v0 * h + u0 * h**2, rel=1e-15)
    assert end[a] == pytest.approx(a0 + (q0 + 1) * h + v0 * h**2 / 2 + u0 * h**3 / 3, rel=1e-15)

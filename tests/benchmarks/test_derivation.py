"""What is timed is right, and what is wrong is not printed."""

import dataclasses
import sys

import numpy as np
import pytest
import sympy as sp
from oracles import multiplier_acceleration
from rigid import assert_inertia_is_that_of, rotation

import mechanics
from benchmarks import derivation
from benchmarks.bodies import bodies
from benchmarks.contenders import CONTENDERS, NotApplicable, reference
from benchmarks.derivation import Arguments, Result
from mechanics import Mechanism
from mechanics.expressions import evaluate

AXES = "xyz"
# All three kinds: a rotor and two constraints, a potential, no constraint.
QUICK = ("snakeboard", "knife_edge_incline", "planar_rigid_body")
EACH = [name if name in QUICK else pytest.param(name, marks=pytest.mark.slow) for name in mechanics.names()]


def state(mechanism, seed=0, at=None):
    """Values by name, an allowed velocity and controls."""
    rng = np.random.default_rng(seed)
    q = rng.uniform(0.1, 1, mechanism.n) if at is None else np.full(mechanism.n, at)
    values = mechanism.parameters | dict(zip(mechanism.coordinates, q, strict=True))
    forms = mechanism.numeric(mechanism.one_forms, values)
    allowed = np.linalg.svd(forms)[2][len(forms) :] if len(forms) else np.eye(mechanism.n)
    return values, rng.normal(size=mechanism.rank) @ allowed, rng.normal(size=len(mechanism.controls))


# -- what Kane's method is given -----------------------------------------------------------------


@pytest.mark.parametrize("name", [*mechanics.names(), "snake_5"])
def test_bodies_have_the_inertia_tensor(name):
    mechanism = derivation.mechanism(name)
    described = bodies(mechanism)
    assert described

    def moving(values):
        scope = dict(values)
        for definition, text in mechanism.definitions.items():
            scope[definition] = evaluate(text, scope)
        for body in described:
            attitude = np.eye(3)
            for axis, angle in (*body.turns, *([body.spin] if body.spin else [])):
                attitude = attitude @ rotation(AXES.index(axis), float(evaluate(angle, scope)))
            xx, yy, zz, xy, yz, zx = (float(evaluate(text, scope)) for text in body.inertia)
            tensor = [[xx, xy, zx], [xy, yy, yz], [zx, yz, zz]]
            centre = [float(evaluate(text, scope)) for text in body.centre]
            yield float(evaluate(body.mass, scope)), tensor, centre, attitude

    assert_inertia_is_that_of(mechanism, moving)


def test_a_mechanism_without_bodies_has_no_kane():
    unknown = dataclasses.replace(mechanics.get("snakeboard"), name="unknown")
    assert bodies(unknown) is None
    for contender in derivation.KANE:
        with pytest.raises(NotApplicable, match="rigid bodies"):
            CONTENDERS[contender](unknown)


def test_kane_has_no_pole_where_it_begins():
    """Unlike the shortest choice, which solves for x and y: impossible with a straight joint."""
    mechanism = mechanics.get("roller_racer")
    values, qdot, u = state(mechanism, at=0.0)
    actual = CONTENDERS["Kane"](mechanism).acceleration(values, qdot, u)
    # Differences of order 4 with steps of 1e-3 leave 1e-12 or so, of terms that are a hundred times as large.
    expected = multiplier_acceleration(mechanism, values, qdot, u)
    np.testing.assert_allclose(actual, expected, rtol=0, atol=1e-9 * np.abs(expected).max())
    with np.errstate(all="ignore"):
        shortest = CONTENDERS["shortest"](mechanism).acceleration(values, qdot, u)
    assert not np.isfinite(shortest).all()


# -- the equations -------------------------------------------------------------------------------


@pytest.mark.parametrize("name", EACH)
@pytest.mark.parametrize("contender", [c for c in CONTENDERS if c not in ("eq. (6)", "shortest")])
def test_contenders_agree_with_multipliers(name, contender):
    mechanism = mechanics.get(name)
    equations = CONTENDERS[contender](mechanism)
    values, qdot, u = state(mechanism)
    expected = multiplier_acceleration(mechanism, values, qdot, u)
    actual = equations.acceleration(values, qdot, u)
    # As above.
    np.testing.assert_allclose(actual, expected, rtol=0, atol=1e-9 * np.abs(expected).max())
    assert len(equations.velocity) == mechanism.n
    assert len(equations.rates) == len(equations.speeds) in (mechanism.n, mechanism.rank)


def test_equation_6_and_the_shortest_agree_too():
    mechanism = mechanics.get("snakeboard")
    found = {contender: CONTENDERS[contender](mechanism) for contender in ("eq. (6)", "shortest", "Kane")}
    for equations in found.values():
        assert derivation.verdict(equations) == ""
    assert found["shortest"].operations <= found["Kane"].operations


@pytest.mark.parametrize("name", ["roller_racer", "wheeled_inverted_pendulum", "planar_rigid_body"])
def test_the_reference_agrees_with_the_multiplier_oracle(name):
    """Two ways to differentiate: numbers here, formulas there."""
    mechanism = mechanics.get(name)
    values, qdot, u = state(mechanism, seed=1)
    expected = multiplier_acceleration(mechanism, values, qdot, u)
    np.testing.assert_allclose(reference(mechanism, values, qdot, u), expected, rtol=0, atol=1e-9 * abs(expected).max())


@pytest.mark.parametrize("factor", [1.001, np.nan])
def test_a_wrong_result_is_seen(factor):
    equations = CONTENDERS["Thm 3.2"](mechanics.get("knife_edge_incline"))
    assert derivation.verdict(equations) == ""
    wrong = dataclasses.replace(equations, rates=[equations.rates[0] * factor, *equations.rates[1:]])
    assert derivation.verdict(wrong).startswith("wrong by")


def test_operations_are_counted_with_what_is_shared():
    mechanism = Mechanism.from_dict(
        {
            "name": "disk",
            "coordinates": ["a"],
            "parameters": {"J": 1.0},
            "inertia": [["J"]],
            "one_forms": [],
            "forces": {},
        }
    )
    a, J, w, step = sp.symbols("a J w step")
    counted = derivation.Equations(mechanism, [w], [step * w], [step + 1 / J], [(step, sp.sin(a) * J)])
    # sin, times J, times w, plus 1/J, which depends on a parameter alone.
    assert counted.operations == 4


# -- the benchmark -------------------------------------------------------------------------------


def test_a_derivation_in_a_process_of_its_own():
    result = Result()
    derivation.measure(result, "knife_edge_incline", "Thm 3.2", limit=60)
    assert not result.failure
    assert result.operations == CONTENDERS["Thm 3.2"](mechanics.get("knife_edge_incline")).operations
    derivation.measure(result, "knife_edge_incline", "Thm 3.2", limit=60)
    assert len(result.seconds) == 2
    assert min(result.seconds) > 0


def test_an_endless_derivation_is_stopped():
    result = Result()
    derivation.measure(result, "snake_4", "eq. (6)", limit=1)
    assert result == Result(failure="> 1 s")


def test_ctrl_c_keeps_what_is_done(monkeypatch, capsys):
    def measure(result, subject, contender, limit):
        if contender == "Lagrange":
            raise KeyboardInterrupt
        outcomes = {
            "Thm 3.2": Result([0.25], 10, steps=True),
            "Kane": Result([0.5], 40),
            "shortest": Result([0.1], 7, failure="wrong by 1e-01"),
            "eq. (6)": Result(failure="> 5 s"),
        }
        result.__dict__.update(outcomes.get(contender, Result([1.0], 99)).__dict__)

    monkeypatch.setattr(derivation, "measure", measure)
    monkeypatch.setattr(sys, "argv", ["derivation.py", "--repeats", "1"])
    derivation.main(Arguments(mechanisms=("snakeboard",), links=(2,), repeats=1))
    printed = capsys.readouterr().out
    seconds, operations = (line.split() for line in printed.splitlines() if "snakeboard" in line and "│" in line)
    assert [cell for cell in seconds if cell != "│"] == "snakeboard 0.25 1.00 > 5 s 0.50 - 1.00".split()
    # 24 by hand; the wrong result counts neither as operations nor in the ratio 10/40.
    assert [cell for cell in operations if cell != "│"] == "snakeboard 10* 99 40 99 24 0.25".split()
    assert "snakeboard, shortest: wrong by 1e-01" in printed
    assert printed.splitlines()[-1] == "python -m benchmarks.derivation --repeats 1"


def test_more_links_are_not_tried_once_fewer_were_too_many(monkeypatch):
    tried = []

    def measure(result, subject, contender, limit):
        tried.append((subject, contender))
        result.seconds.append(1.0)
        if contender == "eq. (6)" and subject == "snake_3":
            result.failure = "> 5 s"

    monkeypatch.setattr(derivation, "measure", measure)
    results = {}
    derivation.run(Arguments(mechanisms=(), links=(4, 2, 3), repeats=2), results)
    assert [subject for subject, contender in tried if contender == "eq. (6)"] == ["snake_2", "snake_3", "snake_2"]
    assert results["snake_4", "eq. (6)"].failure == derivation.NOT_TRIED
    assert tried.count(("snake_4", "Kane")) == 2

"""The truth is true, contenders solve what they are given, and errors that are there are seen."""

import csv
import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import mechanics
from benchmarks import default_errors, work_precision
from benchmarks.default_errors import hold_errors, run_errors
from benchmarks.equations import Equations, multipliers
from benchmarks.motions import MECHANISMS, POLICIES, problem
from benchmarks.reference import Reference
from benchmarks.solver_peers import PEERS, peers
from benchmarks.solvers import BATCHED, PEER, SINGLE, Contender, Point, ours
from benchmarks.textbook import REGULAR
from benchmarks.work_precision import Arguments, Sheet, curve_sheets, curves, least, main, truth
from mechanics.model import Model

DATA = Path(__file__).parents[1] / "data" / "reference"


@pytest.fixture(scope="module", params=MECHANISMS)
def short(request):
    """A problem of half a second, and its motions."""
    motions = problem(request.param, conditions=2, seconds=0.5)
    return motions, truth(motions)


# -- truth -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("mechanism", MECHANISMS)
def test_the_reference_agrees_with_quadruple_precision(mechanism):
    records = json.loads((DATA / f"{mechanism}.json").read_text(encoding="utf-8"))
    record = next(record for record in records if record["inputs"][0]["type"] == "zoh")
    torques = np.array([spec["values"] for spec in record["inputs"]]).T
    stored = [state for state in record["states"] if state["t_steps_of_0_05"] <= 20]
    reference = Reference(mechanics.get(mechanism), record["params"])
    q, qdot = reference.motion(
        [record["q0"]], [record["qdot0"]], lambda hold, *_: torques[None, hold], record["inputs"][0]["dt"], 20
    )
    assert len(stored) > 1
    for state in stored:
        for found, name in ((q, "q"), (qdot, "qdot")):
            true = np.array([np.longdouble(text) for text in state["hp"][name]])
            # The state at the beginning is given in double precision: half a unit of its last digit.
            np.testing.assert_allclose(found[state["t_steps_of_0_05"], 0], true, rtol=0, atol=3e-15)


def test_halving_the_steps_of_the_reference_changes_nothing(short):
    _, (q, qdot, doubt) = short
    assert q.dtype == qdot.dtype == np.longdouble
    assert 0 < doubt < 1e-16  # roundings of numbers up to 10 in long double, 5e-19 each, in ten holds


def test_the_reference_takes_the_steps_that_it_needs():
    reference = Reference(mechanics.get("snakeboard"))
    q = np.array([[0.1, 0.2, 0.3, 0.4, 0.5]] * 2, np.longdouble)
    q, qdot = reference.start(q, [[0, 0, 0, 1, 1], [0, 0, 0, 1, 300]])
    whole_q, whole_qdot, steps = reference.hold(q, qdot, np.ones((2, 2)), 0.05)
    assert steps[1] > steps[0]
    for _ in range(5):
        q, qdot, _ = reference.hold(q, qdot, np.ones((2, 2)), 0.01)
    # 15 rad in a hold; the length 0.05 is not five times 0.01 in double precision.
    np.testing.assert_allclose(whole_q, q, rtol=0, atol=1e-15)
    np.testing.assert_allclose(whole_qdot, qdot, rtol=0, atol=1e-15)


def test_the_start_satisfies_the_constraints_to_long_double():
    racer = mechanics.get("roller_racer")
    model = Model(racer)
    q = np.array([[0.1, 0.2, 0.3, 0.4]])
    q, qdot = Reference(racer).start(q, model.velocity(q, [[0.7, 0.9]]))
    theta, front = q[0, 2], q[0, 2] + q[0, 3]
    assert abs(np.sin(theta) * qdot[0, 0] - np.cos(theta) * qdot[0, 1]) < 1e-18
    arm = np.longdouble(0.1) + np.longdouble(0.3) * np.cos(q[0, 3])
    across = (
        np.sin(front) * qdot[0, 0] - np.cos(front) * qdot[0, 1] - arm * qdot[0, 2] - np.longdouble(0.1) * qdot[0, 3]
    )
    assert abs(across) < 1e-18


@pytest.mark.parametrize("mechanism", REGULAR)
def test_regular_constraints_are_the_mechanisms_own(mechanism):
    data = mechanics.get(mechanism)
    rng = np.random.default_rng(0)
    for _ in range(5):
        values = {**data.resolve(None), **dict(zip(data.coordinates, rng.uniform(-1.5, 1.5, data.n), strict=True))}

        def numbers(rows, values=values):
            return np.array([[float(data.symbolic(text).subs(values)) for text in row] for row in rows])

        own, regular = numbers(data.one_forms), numbers(REGULAR[mechanism])
        assert np.linalg.matrix_rank(regular, tol=1e-3) == len(own)
        assert np.linalg.matrix_rank(np.vstack([own, regular]), tol=1e-12) == len(own)


# -- equations for others --------------------------------------------------------------------------


def test_equations_for_others_are_those_of_the_model(short):
    motions, _ = short
    data, equations = mechanics.get(motions.mechanism), Equations(motions.mechanism)
    model, k = Model(data), equations.constants
    y, u = equations.start(motions.q, motions.qdot), motions.torques[0]
    q, v = y[:, : data.n], y[:, data.n :]
    expected = np.concatenate([model.velocity(q, v), model.rates(q, v, u)], axis=1)
    compiled, function = equations.compiled(), equations.function(sin=np.sin, cos=np.cos, sqrt=np.sqrt)
    by_numba = np.array([compiled(a, b, k) for a, b in zip(y, u, strict=True)])
    by_numpy = np.array([function(*a, *b, k) for a, b in zip(y, u, strict=True)])
    np.testing.assert_allclose(by_numba, expected, rtol=1e-13, atol=1e-13)
    np.testing.assert_allclose(by_numpy, expected, rtol=1e-13, atol=1e-13)
    q, qdot = equations.states(y)
    np.testing.assert_allclose(qdot, motions.qdot, rtol=0, atol=1e-15)


@pytest.mark.slow
def test_multipliers_in_double_precision_are_those_of_the_reference(short):
    motions, _ = short
    data = mechanics.get(motions.mechanism)
    u, right, reference = motions.torques[0], multipliers(motions.mechanism), Reference(data)
    pairs = np.concatenate([motions.q, motions.qdot], axis=1)
    found = np.array([right(a, b) for a, b in zip(pairs, u, strict=True)])
    q, qdot = reference.start(motions.q, motions.qdot)
    # Accelerations up to 30; the linear system has a condition of some hundred.
    np.testing.assert_allclose(found[:, data.n :].T, reference.acceleration(q.T, qdot.T, u.T), rtol=0, atol=1e-12)


def test_rolling_wheels_have_the_mechanisms_inertia(short):
    mujoco = pytest.importorskip("mujoco")
    from benchmarks.rolling_wheels import RollingWheels

    motions, _ = short
    data, wheels = mechanics.get(motions.mechanism), RollingWheels(motions.mechanism, 1e-3)
    q, qdot = motions.q[0], motions.qdot[0]
    wheels.start(q, qdot)
    np.testing.assert_allclose(np.concatenate(wheels.state()), np.concatenate([q, qdot]), rtol=1e-15)
    mujoco.mj_forward(wheels.model, wheels.data)
    for name in ("phi_wheel", "rear_wheel") if motions.mechanism == "snakeboard" else ("body_wheel", "front_wheel"):
        body = wheels.model.joint(name).bodyid[0]
        point, moves = wheels.data.xpos[body] * [1, 1, 0], np.zeros((3, wheels.model.nv))
        mujoco.mj_jac(wheels.model, wheels.data, moves, None, point, body)
        np.testing.assert_allclose(moves @ wheels.data.qvel, 0, atol=1e-4)  # m/s: it has sunk in by some µm
    full = np.zeros((wheels.model.nv, wheels.model.nv))
    mujoco.mj_fullM(wheels.model, wheels.data, full)
    places = [wheels.model.joint(name).dofadr[0] for name in data.coordinates]
    # An axle that turns along with another counts for both.
    select = np.eye(wheels.model.nv)[:, places]
    if motions.mechanism == "snakeboard":
        select[wheels.model.joint("rear").dofadr[0], data.coordinates.index("phi")] = 1
    values = {**data.resolve(None), **dict(zip(data.coordinates, q, strict=True))}
    expected = np.array([[float(data.symbolic(text).subs(values)) for text in row] for row in data.inertia])
    # Wheels and axles of 0.1 g each, up to 0.4 m away.
    np.testing.assert_allclose(select.T @ full @ select, expected, rtol=0, atol=2e-4)


def test_rolling_wheels_are_the_nearer_the_shorter_their_steps(short):
    pytest.importorskip("mujoco")
    motions, true = short
    errors = [
        max(work_precision.errors_by_kind(motions, contender.make(motions).motions(), true[:2]).values())
        for contender in peers(["MuJoCo, rolling wheels"])[1:3]
    ]
    assert errors[1] < 0.6 * errors[0] < 0.1  # first order: 0.4 with 1 ms of that with 2.5 ms


# -- contenders ------------------------------------------------------------------------------------

# Largest error in half a second with the first setting, the coarsest.
COARSE = {"SciPy LSODA": 0.2, "MuJoCo, rolling wheels": 0.3, "multipliers, RK4 in Numba": 0.05, "SciPy Radau": 1e-2}


@pytest.mark.slow
@pytest.mark.parametrize("name", PEERS)
def test_a_peer_solves_the_problem_if_it_is_installed(short, name):
    motions, true = short
    contender = peers([name])[0]
    try:
        solver = contender.make(motions)
        found = solver.motions()
    except ImportError as error:
        pytest.skip(str(error))
    assert found[0].shape == found[1].shape == true[0].shape
    errors = work_precision.errors_by_kind(motions, found, true[:2])
    assert set(errors) == {"held", "bang-bang"}
    assert 0 < max(errors.values()) < COARSE.get(name, 5e-3)
    assert 0 < solver.turn(0) < 1


def test_ours_are_right_alone_and_side_by_side(short):
    motions, true = short
    one, many = (c for c in ours(motions.mechanism, (5,)) if c.name.startswith("nhenv default"))
    assert (one.kind, one.environments, many.kind, many.environments) == (SINGLE, 1, BATCHED, 5)
    alone, together = one.make(motions).motions(), many.make(motions).motions()
    np.testing.assert_array_equal(alone[0], together[0])
    np.testing.assert_array_equal(alone[1], together[1])
    assert max(work_precision.errors_by_kind(motions, alone, true[:2]).values()) < 1e-10
    assert 0 < many.make(motions).turn(0) < 1e-3


def test_who_is_not_installed_or_fit_is_named_and_others_take_turns(short):
    motions, true = short

    def missing(_):
        raise ImportError("no such library")

    def unfit(_):
        raise ValueError("not for this mechanism")

    good = [c for c in ours(motions.mechanism, ()) if c.setting == ""]
    bad = [Contender("missing", "", PEER, 1, missing), Contender("unfit", "", PEER, 1, unfit)]
    skipped = {}
    points = curves(motions, true[:2], [*bad, *good], Arguments(turns=5, budget=0.0), skipped)
    assert skipped == {"missing": "no such library", "unfit": "not for this mechanism"}
    assert [point.contender.name for point in points] == ["nhenv default"]
    assert len(points[0].times) == work_precision.FEWEST_TURNS  # no budget for more


def test_what_is_not_finite_has_no_error_that_anyone_beats(short):
    motions, (q, qdot, _) = short
    broken = q.copy()
    broken[3, 0, 0] = np.nan
    assert work_precision.errors_by_kind(motions, (broken, qdot), (q, qdot)) == {"held": np.inf, "bang-bang": 0.0}


# -- tables ----------------------------------------------------------------------------------------


def test_the_least_time_is_that_of_a_point_or_lies_between_two():
    points = [(1e-2, 10.0), (1e-6, 1000.0), (1e-8, 100.0)]
    assert least(points, 1e-2, between=False) == 10
    assert least(points, 1e-4, between=False) == 100
    assert least(points, 1e-4, between=True) == pytest.approx(100)  # sqrt(10 * 1000), by the first two
    assert least(points, 1e-3, between=True) == pytest.approx(10**1.5)
    assert least(points, 1e-9, between=True) == np.inf


def test_ratios_compare_ours_as_measured_with_the_best_of_others():
    def point(name, kind, error, time):
        return Point("snakeboard", Contender(name, "", kind, 1, None), {"held": error, "bang-bang": error / 2}, [time])

    points = [
        point("nhenv default", SINGLE, 1e-9, 2e-5),
        point("nhenv default, 8 at once", BATCHED, 1e-9, 1e-6),
        point("SciPy DOP853", PEER, 1e-7, 1e-3),
        point("SciPy DOP853", PEER, 1e-9, 4e-3),
        point("other", PEER, 1e-5, 3e-4),
    ]
    rows = {row[0]: row[1:] for row in list(curve_sheets(points))[1].rows}
    assert rows["1e-05"] == ("1", "300 (other)", "300", "20", "1e+03", "50")
    assert rows["1e-08"] == ("1", "2e+03 (SciPy DOP853)", "2000", "20", "2e+03", "100")
    assert rows["1e-10"] == ("", "", "", "", "", "")
    assert rows["1e-09"][:3] == ("1", "4e+03 (SciPy DOP853)", "4000")


def test_a_sheet_is_a_table_in_markdown():
    sheet = Sheet("title", ("a", "b"), [("1", "2")])
    assert sheet.markdown() == "title\n\n| a | b |\n| --- | --- |\n| 1 | 2 |\n"


# -- errors of the default settings ----------------------------------------------------------------


@pytest.fixture
def few(monkeypatch):
    """Two policies, short episodes."""
    monkeypatch.setattr(default_errors, "POLICIES", [p for p in POLICIES if p.name in ("random bang-bang", "tracking")])
    monkeypatch.setattr(default_errors, "EPISODE", 40)


@pytest.mark.slow
def test_errors_of_holds_are_those_of_the_integrator(few):
    found = {one.policy: one for one in hold_errors("roller_racer", True, {}, rows=16, every=10)}
    for one in found.values():
        assert len(one.errors) == round(64 * (1 - one.left_out))
        # An impact that was not left out would leave an error of the order of one.
        assert 0 < one.errors.max() < 1e-6
    assert found["tracking"].errors.max() < 1e-11
    assert found["random bang-bang"].left_out > 0


def test_an_error_that_is_there_is_seen(few, monkeypatch):
    visited = default_errors._visited

    def disturbed(*arguments):
        before, (q, qdot), torques = visited(*arguments)
        return before, (q, qdot + 1e-5 * np.eye(qdot.shape[1])[1]), torques

    monkeypatch.setattr(default_errors, "_visited", disturbed)
    tracking = hold_errors("roller_racer", False, {}, rows=4, every=20)[-1]
    np.testing.assert_allclose(tracking.errors, 1e-5, rtol=1e-4)


def test_runs_are_judged_by_a_reference_that_acts_for_itself(few):
    found = {one.policy: one for one in run_errors("snakeboard", {}, count=2, seconds=1.0)}
    assert not found["random bang-bang"].closed
    assert found["tracking"].closed
    for one in found.values():
        assert one.errors.shape == one.amplification.shape == (2,)
    assert 0 < found["tracking"].errors.max() < 1e-10
    assert 0 < found["random bang-bang"].errors.max() < 1e-3  # other random numbers would make it 1
    # Nothing acts on the wheels' angle but the torque: what it begins with stays.
    assert found["random bang-bang"].amplification.min() > 0.99


# -- all -------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_quick_run_writes_tables_files_and_the_figure(monkeypatch, capsys, tmp_path):
    for name in ("diffrax", "mujoco"):
        monkeypatch.setitem(sys.modules, name, None)  # as if it were not installed
    names = ("SciPy DOP853", "diffrax Dopri8", "MuJoCo, rolling wheels")
    main(Arguments(mechanisms=("roller_racer",), peers=names, quick=True, out=tmp_path))
    printed = capsys.readouterr().out
    for name in names[1:]:
        assert f"skipped: {name} (" in printed
    with (tmp_path / "work_precision.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert {row["kind"] for row in rows} == {SINGLE, BATCHED, PEER}
    for row in rows:
        assert row["solver"] in printed
        assert 0 < float(row["error held"]) < 1
        assert 0 < float(row["seconds_q1"]) <= float(row["seconds"]) <= float(row["seconds_q3"])
    for file, count in (("holds", 14), ("runs", 12)):
        assert len((tmp_path / f"{file}.csv").read_text(encoding="utf-8").splitlines()) == count + 1
    assert (tmp_path / "work_precision.png").read_bytes()[:4] == b"\x89PNG"
    assert "| error | nhenv, batched |" in (tmp_path / "work_precision.md").read_text(encoding="utf-8")


def test_a_part_that_is_not_there_is_refused(tmp_path):
    with pytest.raises(SystemExit, match="no part 'curve'; there are curves, holds, runs"):
        main(replace(Arguments(), parts=("curve",), out=tmp_path))

"""The stranger of the stability benchmark is right, and what breaks is seen."""

import csv
import dataclasses
import math
from functools import partial

import numpy as np
import pytest
from oracles import multiplier_acceleration

import mechanics
import nhenv
from benchmarks import extreme_holds, extremes, invariants, stability
from benchmarks.extremes import FAILED, FLAGGED, HELD, UNCHECKED, Hold, judge
from benchmarks.fuzz import Report
from benchmarks.invariants import Found
from benchmarks.multipliers import DIGITS, Multipliers
from mechanics.model import Model
from nhenv.env import LocomotionEnv

LONG = pytest.mark.skipif(DIGITS < stability.FEWER, reason="long doubles are no longer than doubles here")
INTERPRETED = {"backend": "numpy"}


def _plain(work, words):
    return work


def _state(name, seed=0):
    mechanism, rng = mechanics.get(name), np.random.default_rng(seed)
    q, v = rng.uniform(-0.7, 0.7, mechanism.n), rng.uniform(-1, 1, mechanism.rank)
    u = rng.uniform(-0.3, 0.3, len(mechanism.controls))
    return mechanism, q, Model(mechanism).velocity(q, v), u


# -- the stranger ----------------------------------------------------------------------------------


# Constant inertia and one that changes, potentials, no constraints; the others are slow to derive.
DERIVED = (
    "snakeboard", "roller_racer", "knife_edge_incline", "planar_rigid_body", "falling_rolling_disk", "car",
    "wheeled_inverted_pendulum",
)  # fmt: skip


@pytest.mark.parametrize(
    "name", [name if name in DERIVED else pytest.param(name, marks=pytest.mark.slow) for name in mechanics.names()]
)
def test_accelerations_are_those_of_the_oracle(name):
    mechanism, q, qdot, u = _state(name)
    truth = Multipliers(mechanism)
    found = truth.acceleration(q[None], qdot[None], u[None], mechanism.parameters)[0]
    values = {**mechanism.parameters, **dict(zip(mechanism.coordinates, q, strict=True))}
    expected = multiplier_acceleration(mechanism, values, qdot, u)
    # Doubles, solved with matrices whose condition is up to 1e4.
    assert found.astype(float) == pytest.approx(expected, rel=1e-10, abs=1e-10)
    assert np.abs(truth.residual(q[None], qdot[None], mechanism.parameters)).max(initial=0) < 1e-14


@LONG
@pytest.mark.parametrize("name", ["snakeboard", "roller_racer"])
def test_holds_are_those_of_the_references(name, data_records):
    """Quadruple precision; the stored numbers have 25 digits, the input has 16."""
    truth, seen = Multipliers(mechanics.get(name)), 0
    for record in data_records(f"reference/{name}.json"):
        if record["inputs"][0]["type"] != "zoh":
            continue
        first = record["states"][1]
        q, qdot = (np.array([record[key]], np.longdouble) for key in ("q0", "qdot0"))
        for step in range(first["t_steps_of_0_05"]):
            torques = [[spec["values"][step] for spec in record["inputs"]]]
            motion = truth.hold(q, qdot, torques, record["inputs"][0]["dt"], record["params"])
            q, qdot = motion.q, motion.qdot
        expected = np.array([np.longdouble(text) for text in first["hp"]["q"]])
        assert np.abs(q[0] - expected).max() < 1e-15
        seen += 1
    assert seen > 1


@LONG
def test_a_stop_is_met_exactly():
    """The snakeboard's steering is a parabola; what the impact leaves is known."""
    mechanism = mechanics.get("snakeboard")
    truth, limit, dt = Multipliers(mechanism), 1.2, 0.05
    # Out and back in; on to rest; pressed at rest; the other side; turning just before the stop.
    angles = np.array([1.195, 1.15, 1.2, -1.15, 1.1899])
    rates, torques = np.array([1.0, 2.0, 0.0, -2.0, 1.0]), np.array([-0.5, 0.1, 0.1, 0.1, -0.5])
    q, qdot = np.zeros((5, 5)), np.zeros((5, 5))
    q[:, 4], qdot[:, 4] = angles, rates
    u = np.stack([np.zeros(5), torques], axis=1)
    motion = truth.hold(q, qdot, u, dt, mechanism.parameters, limit=limit, shortest=8)
    assert motion.resolved.all()
    assert motion.impacts.tolist() == [1, 1, 0, 1, 0]
    expected = []
    for angle, rate, torque in zip(angles, rates, torques, strict=True):
        side, bend = math.copysign(1, angle), torque / 0.01
        if angle == limit:
            expected.append((limit, 0.0))
            continue
        if angle == 1.1899:
            expected.append((angle + rate * dt + bend * dt**2 / 2, rate + bend * dt))
            continue
        hit = (-side * rate + math.sqrt(rate**2 + 2 * side * bend * (limit - side * angle))) / (side * bend)
        left = dt - hit
        off = bend if side * bend < 0 else 0.0
        expected.append((side * limit + off * left**2 / 2, off * left))
    # `expected` is computed in doubles.
    assert motion.q[:, 4].astype(float) == pytest.approx([angle for angle, _ in expected], abs=1e-15)
    assert motion.qdot[:, 4].astype(float) == pytest.approx([rate for _, rate in expected], abs=1e-13)
    assert motion.gained[[1, 3]].astype(float) == pytest.approx(
        [-0.02, -0.02], abs=4e-4
    )  # J_w phi_dot²/2, and the torque's work


@LONG
def test_more_digits_agree_and_reach_where_the_constraints_lose_rank():
    mechanism, q, qdot, u = _state("snakeboard")
    one, other = Multipliers(mechanism), Multipliers(mechanism, 40)
    ends = [truth.hold(q[None], qdot[None], u[None], 0.05, mechanism.parameters).q[0] for truth in (one, other)]
    assert ends[0].astype(float) == pytest.approx(ends[1].astype(float), rel=0, abs=1e-15)
    q[4] = math.pi / 2
    start = other.feasible(q[None], qdot[None], mechanism.parameters)
    motion = other.hold(q[None], start, u[None], 0.01, mechanism.parameters)
    work = u @ (motion.q[0] - q)[3:].astype(float)
    assert float(motion.gained[0]) == pytest.approx(work, abs=1e-14)


@LONG
def test_motions_go_through_where_the_multipliers_have_poles():
    """Eight times through phi = ±pi/2 in a hold: the same as in parts, and energy is kept."""
    mechanism, q, qdot, _ = _state("snakeboard")
    qdot[4] = 500.0
    truth, nothing = Multipliers(mechanism), np.zeros((1, 2))
    whole = truth.hold(q[None], qdot[None], nothing, 0.05, mechanism.parameters)
    assert whole.resolved.all()
    energy = truth.energy(q[None], qdot[None], mechanism.parameters)[0]
    assert abs(whole.gained[0]) < 1e-13 * energy
    part = whole
    for i in range(2):
        start = (q[None], qdot[None]) if i == 0 else (part.q, part.qdot)
        part = truth.hold(*start, nothing, 0.025, mechanism.parameters)
    assert np.abs(part.q - whole.q).max() < 1e-11  # the phase of 25 rad, from roundings of 0.05


@LONG
def test_what_is_too_fast_is_not_resolved():
    mechanism, q, qdot, u = _state("roller_racer")
    motion = Multipliers(mechanism).hold([q, q], [qdot, 1e9 * qdot], [u, u], 0.05, mechanism.parameters)
    assert motion.resolved.tolist() == [True, False]
    assert np.isfinite(motion.q.astype(float)).all(axis=1).tolist() == [True, False]


# -- verdicts --------------------------------------------------------------------------------------


def _holds(rate=0.5, **more):
    start = (rate, 0, 0.1, 0.2, 0.3)
    return [
        Hold("snakeboard", (0, 0, 0, 0, 0.1 * i), start, (0.5, -0.2), options=INTERPRETED, **more) for i in range(3)
    ]


@LONG
def test_a_hold_is_held():
    for stops in (True, False):
        outcomes = judge(_holds(stops=stops))
        assert [outcome.verdict for outcome in outcomes] == [HELD] * 3
        assert all(0 < outcome.error < 1e-12 for outcome in outcomes)


@LONG
@pytest.mark.parametrize("size", [1e-8, 1e-2, np.nan])
def test_an_error_is_seen(monkeypatch, size):
    """One coordinate off by a little, by a lot, or not a number; the script to see it runs."""
    real = LocomotionEnv.q

    def wrong(self):
        q = real.fget(self)
        q[0] += size * (q[0] != 0)
        return q

    monkeypatch.setattr(LocomotionEnv, "q", property(wrong))
    outcomes = judge(_holds(), vector=False)
    assert [outcome.verdict for outcome in outcomes] == [FAILED] * 3
    script = outcomes[0].why.split(": ", 1)[1]
    exec(script, {"LocomotionEnv": LocomotionEnv, "np": np})


@LONG
def test_a_row_that_differs_is_seen(monkeypatch):
    real = extremes.LocomotionVectorEnv.step

    def step(self, actions):
        actions = actions.copy()
        actions[1] *= 0.999
        return real(self, actions)

    monkeypatch.setattr(extremes.LocomotionVectorEnv, "step", step)
    outcomes = judge(_holds())
    assert [outcome.verdict for outcome in outcomes] == [HELD, FAILED, HELD]
    assert "a row of many" in outcomes[1].why


@LONG
def test_a_flag_is_seen_and_is_false_where_nothing_is_extreme(monkeypatch):
    real = LocomotionEnv.step

    def step(self, action):
        observation, reward, _, truncated, info = real(self, action)
        return observation, reward, True, truncated, {**info, "diverged": True}

    monkeypatch.setattr(LocomotionEnv, "step", step)
    outcomes = judge(_holds(), vector=False)
    assert [outcome.verdict for outcome in outcomes] == [FLAGGED] * 3
    assert [outcome.verdict for outcome in judge(_holds())] == [FAILED] * 3  # a row of many says nothing of the kind
    for calm, verdict, counts in ((False, FLAGGED, (3, 0)), (True, FAILED, (0, 3))):
        row = stability._family(extreme_holds.Family("calm", _holds(), calm=calm), outcomes)
        assert (row.verdict, row.flagged, row.failed) == (verdict, *counts)


@LONG
def test_energy_is_looked_at_where_nothing_else_can_be(monkeypatch):
    """Too fast for the reference: unchecked if energy and parts agree, else failed."""
    monkeypatch.setattr(extremes._Scene, "_errors", lambda self, chosen: np.full(len(chosen), np.nan))
    assert [outcome.verdict for outcome in judge(_holds(), vector=False)] == [UNCHECKED] * 3
    monkeypatch.setattr(extremes._Scene, "_split", lambda self, i: 0.1)
    assert [outcome.verdict for outcome in judge(_holds(), vector=False)] == [FAILED] * 3
    monkeypatch.setattr(extremes._Scene, "_balance", lambda self: np.full(3, 1e-7))
    outcomes = judge(_holds(), vector=False)
    assert all("energy less work" in outcome.why for outcome in outcomes)


def test_what_is_impossible_is_refused_and_that_is_a_flag():
    holds = [Hold("snakeboard", (0,) * 5, (0,) * 5, (0, 0), params={"J_r": 0.3}, options=INTERPRETED)]
    assert [outcome.verdict for outcome in judge(holds, vector=False)] == [FLAGGED]


@LONG
def test_the_bound_grows_with_what_the_motion_amplifies():
    """A racer that spins fast turns a change of its rate into one of its angle."""
    starts = [(rate, 0, rate, -rate) for rate in (0.1, 20)]
    holds = [Hold("roller_racer", (0, 0, 0, 0.3), start, (0.0,), options=INTERPRETED) for start in starts]
    slow, fast = extremes._Scene(holds)._amplified(np.arange(2))
    assert slow < 3
    assert fast > slow


def test_families_are_the_same_every_time_and_of_every_kind():
    one, two = ([*extreme_holds.families(4)] for _ in range(2))
    assert one == two
    assert len({family.name for family in one}) == len(one)
    words = ("c = 0", "l_2 = l_1", "phi = ±pi/2", "J_r", "nine decades", "rates of 10000/s", "1e+06 N m", "80 N m")
    assert [word for word in words if not any(word in family.name for family in one)] == []
    sizes = [abs(math.log10(hold.params["m"])) for family in one if "decades" in family.name for hold in family.holds]
    assert max(sizes) > 3


# -- invariants ------------------------------------------------------------------------------------


def test_a_long_run_conserves_and_what_does_not_is_seen(monkeypatch):
    run = invariants.long_run("snakeboard", 50, _plain, INTERPRETED)
    assert run.finite
    assert max(run.energy, run.residual, *run.momenta.values()) < 1e-13
    assert run.momenta.keys() == {"p1", "p2", "p3"}
    real, looks = LocomotionEnv.qdot, []

    def drifting(self):
        looks.append(self)
        return real.fget(self) * (1 + 1e-10 * len(looks))

    monkeypatch.setattr(LocomotionEnv, "qdot", property(drifting))
    assert invariants.long_run("snakeboard", 50, _plain, INTERPRETED).energy > 1e-10


@LONG
def test_orders_are_observed_and_a_wrong_one_is_seen(monkeypatch):
    right = invariants.observed_order("snakeboard", "gauss2")
    assert right.held
    real = invariants.method("gauss2")

    class Boastful:
        order = 6

        def __getattr__(self, name):
            return getattr(real, name)

    monkeypatch.setattr(invariants, "method", lambda name: Boastful())
    wrong = invariants.observed_order("snakeboard", "gauss2")
    assert not wrong.held
    assert wrong.error == pytest.approx(2, abs=0.5)


def test_a_drag_that_drives_is_seen(monkeypatch):
    assert invariants.drag_in_simulate(["snakeboard"], _plain).held
    real = mechanics.simulate

    def driven(*arguments, **options):
        run = real(*arguments, **options)
        return dataclasses.replace(run, energy=run.energy + 1e-3 * np.sin(9 * run.t))

    monkeypatch.setattr(mechanics, "simulate", driven)
    assert not invariants.drag_in_simulate(["snakeboard"], _plain).held
    assert not invariants.simulated_balance(["snakeboard"], _plain).held


@pytest.mark.parametrize("kind", ["reversal", "equivariance", "impacts", "work_energy"])
def test_symmetries_hold_and_their_breaking_is_seen(monkeypatch, kind):
    """All numbers of the state grow by a millionth in every step."""
    monkeypatch.setattr(invariants, "LocomotionEnv", partial(LocomotionEnv, **INTERPRETED))

    def found():
        match kind:
            case "reversal":
                return [invariants.reversal("snakeboard", 2)]
            case "equivariance":
                return [invariants.equivariance("snakeboard", 20)]
            case "impacts":
                return invariants.impacts("snakeboard", 60)
        return [invariants.work_energy(["snakeboard"], 20, _plain)]

    assert all(each.held for each in found())
    real = LocomotionEnv.step

    def step(self, action):
        response = real(self, action)
        self._memory[: self._scene.kernel.MEMORY["state"][1]] *= 1 + 1e-6
        return response

    monkeypatch.setattr(LocomotionEnv, "step", step)
    assert not all(each.held for each in found())


def test_nothing_is_held_that_is_not_a_number():
    assert not Found(math.nan, 1.0).held
    assert math.isnan(invariants._worst([0.0, math.nan, 1.0]))
    assert stability._number("x", Found(math.nan, 1.0)).verdict == FAILED


# -- the benchmark ---------------------------------------------------------------------------------


@LONG
def test_a_tiny_run_has_a_row_for_everything(monkeypatch, capsys, tmp_path):
    """What fails is counted, printed and in the status; what cannot be done is skipped by name."""
    family = extreme_holds.Family("easy", _holds(), calm=True)
    monkeypatch.setattr(stability, "families", lambda count: [family])
    monkeypatch.setattr(stability, "fuzz", lambda *_, **__: Report(3, 5, 1, 1, ["a reward that is not a number"]))
    monkeypatch.setattr(stability, "COMPILED", ())
    file = tmp_path / "stability.csv"
    failed = stability.main(stability.Arguments(kinds=("holds", "fuzz"), quick=True, csv=file))
    printed = capsys.readouterr().out
    assert failed == 1
    ids = [name for name in nhenv.environment_ids() if "Snakeboard" in name or "RollerRacer" in name]
    assert f"FAILED, {3 * len(ids)} random episodes" in printed
    assert "a reward that is not a number" in printed
    assert printed.splitlines()[-1].startswith("python -m benchmarks.stability")
    with file.open(encoding="utf-8") as lines:
        rows = list(csv.DictReader(lines))
    assert [row["verdict"] for row in rows] == [HELD, FAILED]
    assert int(rows[0]["held"]) == 3
    with pytest.raises(ValueError, match="unknown kind 'hold'"):
        stability.main(stability.Arguments(kinds=("hold",)))


@pytest.mark.slow
def test_the_quick_benchmark_holds(capsys):
    assert stability.main(stability.Arguments(quick=True)) == 0, capsys.readouterr().out

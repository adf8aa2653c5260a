"""`simulate` against trajectories of the multiplier formulation in quadruple precision."""

import itertools
import math

import numpy as np
import pytest

import mechanics
from benchmarks.multipliers import DIGITS, Multipliers
from mechanics.jumps import first_jump

# The reference is good to 1e-25; the bound is the project's promise for q and q̇, and holds with
# default tolerances, whose single steps are held to 1e-12.
REFERENCE_TOLERANCE = 1e-10
# Energy and work are of order 1 to 10 J and integrated with the same steps.
ENERGY_TOLERANCE = 1e-10

IDS = {
    "snakeboard": ("sb_00", "sb_02", "sb_04", "sb_06", "sb_10", "sb_12", "sb_14"),
    "roller_racer": ("rr_00", "rr_03", "rr_05", "rr_07", "rr_10", "rr_12", "rr_14"),
}


def torque(inputs):
    """Controls of a reference record as a function of time, with no hint of where they jump."""

    def one(spec, t):
        if spec["type"] == "zoh":
            return spec["values"][min(int(t / spec["dt"]), len(spec["values"]) - 1)]
        terms = zip(spec["amp"], spec["omega"], spec["phase"], strict=True)
        return spec["const"] + sum(a * np.sin(w * t + p) for a, w, p in terms)

    return lambda t: [one(spec, t) for spec in inputs]


@pytest.fixture
def record(data_records):
    def find(name, record_id):
        return next(r for r in data_records(f"reference/{name}.json") if r["id"] == record_id)

    return find


def stored(record, key):
    return np.array([state[key] for state in record["states"]])


@pytest.mark.parametrize(("name", "record_id"), [(n, i) for n, ids in IDS.items() for i in ids])
def test_reference_trajectories(record, name, record_id):
    r = record(name, record_id)
    controls = torque(r["inputs"].values() if isinstance(r["inputs"], dict) else r["inputs"])
    run = mechanics.simulate(
        mechanics.get(name), stored(r, "t"), r["q0"], qdot0=r["qdot0"], controls=controls, params=r["params"]
    )
    np.testing.assert_allclose(run.q, stored(r, "q"), rtol=0, atol=REFERENCE_TOLERANCE)
    np.testing.assert_allclose(run.qdot, stored(r, "qdot"), rtol=0, atol=REFERENCE_TOLERANCE)
    np.testing.assert_allclose(run.energy, stored(r, "energy"), rtol=0, atol=ENERGY_TOLERANCE)
    np.testing.assert_allclose(run.work, stored(r, "work"), rtol=0, atol=ENERGY_TOLERANCE)
    np.testing.assert_allclose(run.energy - run.work, run.energy[0], rtol=0, atol=ENERGY_TOLERANCE)
    model = mechanics.Model(mechanics.get(name), r["params"])
    assert np.abs(model.constraint_residual(run.q, run.qdot)).max() < 1e-12  # q̇ = X v is feasible to rounding


def test_every_reference_trajectory_is_used(data_records):
    for name, ids in IDS.items():
        assert tuple(r["id"] for r in data_records(f"reference/{name}.json")) == ids


@pytest.mark.parametrize(("name", "frame"), [("snakeboard", "paper"), ("roller_racer", "orthonormal")])
def test_frames_agree(record, name, frame):
    r = record(name, {"snakeboard": "sb_14", "roller_racer": "rr_03"}[name])  # through phi = ±pi/2 and through c = 0
    controls = torque(r["inputs"].values() if isinstance(r["inputs"], dict) else r["inputs"])
    run = mechanics.simulate(
        mechanics.get(name),
        stored(r, "t"),
        r["q0"],
        qdot0=r["qdot0"],
        controls=controls,
        params=r["params"],
        frame=frame,
    )
    np.testing.assert_allclose(run.q, stored(r, "q"), rtol=0, atol=REFERENCE_TOLERANCE)


def test_initial_pseudo_velocities_are_those_of_the_frame(record):
    r = record("snakeboard", "sb_02")
    run = mechanics.simulate(
        mechanics.get("snakeboard"), [0.0], r["q0"], v0=r["v0_paper"], params=r["params"], frame="paper"
    )
    np.testing.assert_allclose(run.qdot[0], r["qdot0"], rtol=0, atol=1e-14)  # the same numbers, rounded to 15 digits


def test_unforced_snakeboard_keeps_its_momenta():
    run = mechanics.simulate(mechanics.get("snakeboard"), [0, 5, 10], [0, 0, 0, 0, 0.3], v0=[1.0, 0.5, 0.1])
    np.testing.assert_allclose(run.v[:, :2], [[1.0, 0.5]] * 3, rtol=0, atol=1e-15)  # both rates are exactly zero
    assert run.energy == pytest.approx(run.energy[0], rel=1e-14)


def test_the_pole_of_a_frame_is_named():
    # Straight through c = 0, where the paper's first vector field is infinite.
    racer = mechanics.get("roller_racer")
    angle = np.arccos(-racer.parameters["l_2"] / racer.parameters["l_1"])
    with pytest.raises(mechanics.SimulationError, match="frame with a pole"):
        mechanics.simulate(
            racer, [0, 1], [0, 0, 0, angle], v0=[1.0, 0.0], frame="paper", controls=lambda t: [np.float64(1e308)]
        )


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"t": [0.0, 0.0]}, "increasing"),
        ({"t": [0.0, np.nan]}, "finite"),
        ({"t": "soon"}, "t must be a row of increasing finite times, got 'soon'"),
        ({"t": [[0.0], [1.0, 2.0]]}, "t must be a row"),
        ({"q0": [0.0] * 4}, r"q0 must have shape \(5,\)"),
        ({"q0": "here"}, "q0 must be 5 numbers, got 'here'"),
        ({"qdot0": [10**400] * 5}, "qdot0 must be 5 numbers"),
        ({"rtol": -1e-9}, "rtol must be a positive finite number, got -1e-09"),
        ({"rtol": "fine"}, "rtol must be a positive finite number, got 'fine'"),
        ({"atol": 0.0}, "atol must be a positive finite number, got 0.0"),
        ({"atol": np.nan}, "atol must be a positive finite number, got nan"),
        ({"controls": [0.0, 0.0]}, "controls must be a function of the time"),
        ({"controls": lambda t: "x"}, r"controls\(0\) must be 2 finite number\(s\) \(u_psi, u_phi\), got 'x'"),
        ({"controls": lambda t: [1j, 0.0]}, "finite"),
        ({"q0": [0.0, 0, 0, 0, np.inf]}, "finite"),
        ({"qdot0": [0.0, 1.0, 0, 0, 0]}, "nearest feasible velocity"),
        ({"v0": [0.0] * 3, "qdot0": [0.0] * 5}, "not both"),
        ({"controls": lambda t: [0.0]}, "u_psi, u_phi"),
        ({"controls": lambda t: [np.nan, 0.0]}, "finite"),
        ({"params": {"J_r": 1.0}}, "positive definite"),
        ({"params": {"mass": 1.0}}, "unknown parameter 'mass'"),
        ({"frame": "flta"}, "Did you mean 'flat'"),
    ],
)
def test_bad_input(change, words):
    arguments = {"t": [0.0, 1.0], "q0": [0.0] * 5, **change}
    with pytest.raises(mechanics.MechanismError, match=words):
        mechanics.simulate(mechanics.get("snakeboard"), **arguments)


def test_controls_of_what_has_none():
    sleigh = mechanics.get("chaplygin_sleigh").to_dict() | {"forces": {}, "torque_limits": {}}
    free = mechanics.Mechanism.from_dict(sleigh)
    start = {"t": [0.0, 1.0], "q0": [0.0] * 3, "v0": [1.0, 0.5]}
    still, given = mechanics.simulate(free, **start), mechanics.simulate(free, **start, controls=lambda t: [])
    assert np.array_equal(still.q, given.q)
    with pytest.raises(mechanics.MechanismError, match="must be 0 finite"):
        mechanics.simulate(free, **start, controls=lambda t: [1.0])


def test_numbers_in_numbers_out(record):
    """`acceleration` against a central difference of reference velocities along the simulated motion."""
    r = record("roller_racer", "rr_07")
    racer, controls = mechanics.get("roller_racer"), torque(r["inputs"])
    h = 1e-3
    run = mechanics.simulate(
        racer, [0, h, 2 * h, 3 * h, 4 * h], r["q0"], qdot0=r["qdot0"], controls=controls, params=r["params"]
    )
    given = mechanics.acceleration(racer, run.q[2], run.qdot[2], controls(2 * h), r["params"])
    difference = (run.qdot[0] - 8 * run.qdot[1] + 8 * run.qdot[3] - run.qdot[4]) / (12 * h)
    np.testing.assert_allclose(given, difference, rtol=0, atol=1e-9)  # fourth order: h^4 times the fifth derivative


class TestFirstJump:
    """The search that lets a solver land on the switches of held controls."""

    def test_smooth_functions_have_none(self):
        for f in (np.sin, np.cos, lambda t: t**2, lambda t: 1e-9 * np.sin(7 * t), lambda t: 0.0 * t):
            assert first_jump(lambda t, f=f: np.array([f(t)]), 0.1, 0.9) is None

    @pytest.mark.parametrize("at", [1 / 3, 0.5, 0.05, 0.999])
    def test_a_step_is_found_to_the_last_bit(self, at):
        below, above = first_jump(lambda t: np.array([np.sin(t) + (t >= at)]), 0.0, 1.0)
        assert below < at <= above
        assert above == np.nextafter(below, 2)

    def test_the_first_of_many_is_found(self):
        values = np.random.default_rng(0).normal(size=(40, 2))
        jump = first_jump(lambda t: values[int(t / 0.05)], 0.0, 1.9)
        assert jump == pytest.approx((0.05, 0.05), abs=1e-15)

    def test_a_tiny_step_on_a_constant(self):
        assert first_jump(lambda t: np.array([1e-12 * (t > 0.3)]), 0.0, 1.0) == pytest.approx((0.3, 0.3), abs=1e-15)


def test_work_is_that_of_the_controls():
    """Over a hold the work is torque times angle, because the control acts as d(psi)."""
    racer = mechanics.get("roller_racer")
    run = mechanics.simulate(racer, [0.0, 0.4], [0, 0, 0, 0.2], controls=lambda t: [0.3])
    assert run.work[-1] == pytest.approx(0.3 * (run.q[-1, 3] - 0.2), abs=1e-13)
    assert run.energy[-1] == pytest.approx(run.work[-1], abs=1e-13)


def test_catalogue_frames_all_simulate():
    """Every frame of every mechanism gives the same motion."""
    for mechanism in map(mechanics.get, mechanics.names()):
        q0 = np.full(mechanism.n, 0.3)
        model = mechanics.Model(mechanism)
        qdot0 = model.velocity(q0, np.full(mechanism.rank, 0.4))
        ends = [mechanics.simulate(mechanism, [0, 1], q0, qdot0=qdot0, frame=frame).q[-1] for frame in mechanism.frames]
        for one, other in itertools.pairwise(ends):
            np.testing.assert_allclose(one, other, rtol=0, atol=1e-10)  # the accuracy aimed at


# -- where a frame fails -----------------------------------------------------------------------------


def _near_failure(frame, rng):
    """(parameters, q, q̇) of a racer near a pole of the frame "paper", or near where the others' X₁ vanishes."""
    params, side = {}, rng.choice([-1, 1])
    if frame == "paper":
        psi = side * (math.acos(-1 / 3) + rng.choice([-1, 1]) * 10 ** rng.uniform(-6, -0.2))
    else:
        psi = math.pi + side * 10 ** rng.uniform(-6, -0.2)
        params = {"l_2": 0.3 * (1 + rng.choice([-1, 1]) * 10 ** rng.uniform(-9, -1))}
    rate = 10 ** rng.uniform(-1, 1.2)
    return params, np.array([0.1, -0.2, 0.4, psi]), rng.uniform(-rate, rate, 4)


@pytest.mark.skipif(DIGITS < 18, reason="long doubles are no longer than doubles here: there is no reference")
@pytest.mark.parametrize("frame", ["paper", "regular", "orthonormal"])
def test_where_a_frame_fails_the_motion_is_right_or_refused(frame):
    """Against multipliers, which have no frame. With one tolerance everywhere, half of those in "paper" are wrong."""
    mechanism, rng, refused, errors = mechanics.get("roller_racer"), np.random.default_rng(0), 0, []
    truth = Multipliers(mechanism)
    for _ in range(60):
        params, q, qdot = _near_failure(frame, rng)
        everything = {**mechanism.parameters, **params}
        u = rng.uniform(-0.4, 0.4, 1)
        try:
            model = mechanics.Model(mechanism, params, frame)
            qdot = model.velocity(q, model.project(q, truth.feasible(q[None], qdot[None], everything)[0].astype(float)))
            run = mechanics.simulate(
                mechanism, [0, 0.05], q, qdot0=qdot, controls=lambda t, u=u: u, params=params, frame=frame
            )
        except mechanics.SimulationError:
            refused += 1
            continue
        true = truth.hold(q[None], qdot[None], u[None], 0.05, everything)
        assert true.resolved.all()
        for ours, theirs in ((run.q[-1], true.q[0]), (run.qdot[-1], true.qdot[0])):
            errors.append((np.abs(ours - theirs) / (1 + np.abs(theirs))).max())
    assert max(errors) < REFERENCE_TOLERANCE
    assert refused >= 10
    assert len(errors) >= 2 * 10

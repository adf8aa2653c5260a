"""Inelastic stops of the joints: bounds, energy, and an independent integration through every impact."""

import math

import gymnasium as gym
import numpy as np
import pytest
from holds import HIT as IMPACT
from holds import RELEASE, through_events

import mechanics
from mechanics.model import Model


class Joint:
    """The joint of an environment that has stops, and the numbers that say where it is."""

    def __init__(self, env):
        mechanism = env.mechanism
        ((name, self.limit),) = env.joint_limits.items()
        self.place = mechanism.coordinates.index(name)
        # The control that acts on this joint alone.
        covector = ["1" if c == name else "0" for c in mechanism.coordinates]
        self.control = [list(row) for row in mechanism.forces.values()].index(covector)
        self.env, self.mechanism, self.model = env, mechanism, Model(mechanism, env.params, drag=env.drag)
        # The pseudo-velocity that moves it.
        frame = self.model.velocity(np.zeros(mechanism.n), np.eye(mechanism.rank))
        (self.moving,) = np.flatnonzero(frame[:, self.place])

    def state(self, angle, rate=0.0, others=0.3):
        """q, q̇ with this joint at `angle` and `rate`, the other pseudo-velocities `others`."""
        q = np.linspace(-0.2, 0.5, self.mechanism.n)
        q[self.place] = angle
        v = np.full(self.mechanism.rank, others)
        v[self.moving] = rate / self.model.velocity(q, np.eye(self.mechanism.rank)[self.moving])[self.place]
        return q, self.model.velocity(q, v)

    def torques(self, torque, others=0.2):
        u = np.full(len(self.mechanism.controls), others)
        u[self.control] = torque
        return u


@pytest.fixture(params=["nhenv/SnakeboardForward-v0", "nhenv/RollerRacerForward-v0"])
def env_id(request):
    """Stops have nothing to do with tasks."""
    return request.param


@pytest.fixture(params=[False, True], ids=["ideal", "drag"])
def joint(env_id, bare, request):
    """Joint of an environment whose torque limits are 1 unless asked, without drag and with it."""

    def make_joint(**kwargs):
        return Joint(bare(env_id, **{"torque_limits": 1.0, "drag": request.param, **kwargs}))

    return make_joint


def _through_impacts(joint, q, v, u):
    """State (q, v) after a control period, by an independent integration; also the number of impacts."""
    stop = joint.place, joint.limit
    q, v, happened = through_events(joint.model, q, v, u, joint.env.dt, stop)
    return q, v, sum(what == IMPACT for what, _ in happened)


def _mechanism(env_id):
    return gym.spec(env_id).kwargs["mechanism"]


def _hold(joint, q, qdot, u, steps=1):
    env = joint.env
    env.reset(options={"q": q, "qdot": qdot})
    for _ in range(steps):
        env.step(u / env.torque_limits)
    return env.q, env.v


# -- bounds and energy --------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["uniform", "bang-bang", "pressing"])
def test_a_joint_stays_within_its_stops_and_gains_no_energy(env_id, bare, kind):
    """Energy grows by the torques' work at most, and by exactly that unless an impact took some."""
    env = bare(env_id)
    env.reset(seed=4)
    joint, rng = Joint(env), np.random.default_rng(5)
    # The control one-forms are constant, so that the work over a hold is exact.
    at = {**env.params, **dict.fromkeys(env.mechanism.coordinates, 0.0)}
    forces = env.mechanism.numeric(env.mechanism.forces.values(), at)
    m = len(env.torque_limits)
    losses, resting = [], []
    q, energy, action = env.q, env.energy, np.ones(m)
    for i in range(400):
        if kind == "uniform":
            action = rng.uniform(-1, 1, m)
        elif rng.random() < 0.2 if kind == "bang-bang" else i % 40 == 0:
            action = rng.choice([-1.0, 1.0], m)
        observation, *_ = env.step(action)
        # Clamped where it meets its stop, so even the last digit obeys.
        assert abs(env.q[joint.place]) <= joint.limit
        assert abs(observation[0]) <= 1
        work = env.torque_limits * action @ forces @ (env.q - q)
        losses.append(work - (env.energy - energy))
        if abs(q[joint.place]) == abs(env.q[joint.place]) == joint.limit:
            resting.append(losses[-1])
        q, energy = env.q, env.energy
    # Over a hold E - sum u_a phi_a is constant. What the default integrators leave of that: at most 8e-10 J for the
    # racer at 12 J, 4e-14 J for the snakeboard at 138 J. An impact at 1 rad/s takes 5e-3 J.
    assert min(losses) > -2e-9
    assert np.median(np.abs(losses)) < 1e-10
    assert sum(loss > 1e-6 for loss in losses) >= 3
    assert len(resting) >= 3
    assert max(map(abs, resting)) < 2e-9


# -- impacts, exactly ---------------------------------------------------------------------------

# angle and rate at the start, torque, number of holds, and whether there is an impact after the start
HIT, FREE = True, False
CASES = {
    "hits and rests": (1.15, 2.0, 0.1, 1, HIT),
    "hits, and the torque takes it off again": (1.15, 2.0, -0.02, 1, HIT),
    "turns beyond the stop and is back at the end": (1.195, 1.0, -0.1, 1, HIT),
    "turns just before the stop": (1.15, 0.5, -0.1, 1, FREE),
    "rests on the stop for whole holds": (0.9, 3.0, 0.2, 4, HIT),
    "starts on the stop, moving outward": (1.2, 1.5, 0.1, 2, FREE),
    "starts on the stop, moving outward against the torque": (1.2, 1.5, -0.1, 2, FREE),
    "starts at rest on the stop, pressed": (1.2, 0.0, 0.1, 2, FREE),
    "starts at rest on the stop, no torque": (1.2, 0.0, 0.0, 2, FREE),
    "starts at rest on the stop, pulled off": (1.2, 0.0, -0.1, 2, FREE),
    "starts on the stop, moving inward against the torque": (1.2, -0.2, 0.1, 2, HIT),
}


@pytest.mark.parametrize("side", [1, -1])
@pytest.mark.parametrize(("angle", "rate", "torque", "steps", "hit"), CASES.values(), ids=CASES)
def test_impacts_agree_with_an_event_solver(joint, angle, rate, torque, steps, hit, side):
    j = joint()
    q, qdot = j.state(side * angle, side * rate)
    u = j.torques(side * torque)
    ours = _hold(j, q, qdot, u, steps)
    v, hits = j.model.project(q, qdot), 0
    for _ in range(steps):
        q, v, more = _through_impacts(j, q, v, u)
        hits += more
    assert (hits > 0) is hit
    # The default integrators at these speeds, 2e-12, and the solver itself.
    assert ours[0] == pytest.approx(q, rel=0, abs=1e-9)
    assert ours[1] == pytest.approx(v, rel=0, abs=1e-9)


def test_random_holds_agree_with_an_event_solver(joint):
    """Whatever the state and the torque, with fast turns near the stop preferred."""
    j, rng, hits = joint(torque_limits=3.0), np.random.default_rng(0), 0
    for _ in range(100):
        angle, rate = rng.choice([-1, 1]) * (j.limit - 10 ** rng.uniform(-6, 0)), rng.uniform(-8, 8)
        q, qdot = j.state(angle, rate, others=rng.uniform(-4, 4))
        u = j.torques(rng.uniform(-1, 1) * 10 ** rng.uniform(-2, 0.4), others=rng.uniform(-1, 1))
        ours = _hold(j, q, qdot, u)
        q, v, more = _through_impacts(j, q, j.model.project(q, qdot), u)
        hits += more
        # The default tolerance, at up to 50 rad/s; a missed impact changes the angle by 1e-3 and more.
        assert ours[0] == pytest.approx(q, rel=0, abs=1e-9)
        assert ours[1] == pytest.approx(v, rel=0, abs=1e-9)
    assert hits > 30


def test_both_stops_in_one_hold(env_id, joint):
    """Outward to one stop, then driven across to the other, where it rests: all within one control period."""
    (name,) = mechanics.get(_mechanism(env_id)).joint_limits
    j = joint(torque_limits=20.0, joint_limits={name: 0.1})
    for side in (1, -1):
        q, qdot = j.state(-side * 0.095, -side * 3.0)
        u = j.torques(1.0, others=0.0)
        u *= side * 500.0 / j.model.rates(q, np.zeros(j.mechanism.rank), u)[j.moving]  # 0.2 rad in 0.03 s
        ours = _hold(j, q, qdot, u)
        q, v, hits = _through_impacts(j, q, j.model.project(q, qdot), u)
        assert hits == 2
        assert ours[0][j.place] == side * 0.1
        assert ours[1][j.moving] == 0.0
        # The default tolerance.
        assert ours[0] == pytest.approx(q, rel=0, abs=1e-9)
        assert ours[1] == pytest.approx(v, rel=0, abs=1e-9)


def test_a_turn_beyond_the_stop_is_caught(bare):
    """The snakeboard's steering obeys phi'' = u/J_w, so that everything about one hold is a quadratic."""
    env = bare("nhenv/SnakeboardForward-v0")
    angle, rate, torque, dt, limit = 1.195, 1.0, -0.5, env.dt, 1.2
    acceleration = torque / env.params["J_w"]
    top = angle - rate**2 / (2 * acceleration)
    end = angle + rate * dt + acceleration * dt**2 / 2
    assert end < limit < top  # without a stop it would go out and come back within the hold
    hit = (-rate + math.sqrt(rate**2 + 2 * acceleration * (limit - angle))) / acceleration
    j = Joint(env)
    q, qdot = j.state(angle, rate)
    final, _ = _hold(j, q, qdot, np.array([0.0, -1.0]))
    # The root of a quadratic, rounded, and a polynomial of it.
    assert final[j.place] == pytest.approx(limit + acceleration * (dt - hit) ** 2 / 2, abs=1e-13)
    assert env.qdot[j.place] == pytest.approx(acceleration * (dt - hit), abs=1e-11)


@pytest.mark.parametrize("dt", [0.1, 0.3])
def test_a_torque_far_beyond_the_usual_ends_on_the_stop(bare, dt):
    """The racer at 80 N m: it would have turned by many revolutions, and has not diverged for that."""
    j = Joint(bare("nhenv/RollerRacerForward-v0", torque_limits=80.0, dt=dt, backend="numpy", whole_state=True))
    rng = np.random.default_rng(0)
    for side in (1, -1):
        q, qdot = j.state(side * 0.4, rng.uniform(-1, 1))
        j.env.reset(options={"q": q, "qdot": qdot})
        q, v = j.env.q, j.env.v
        _, _, terminated, _, info = j.env.step([float(side)])
        assert not terminated
        assert "diverged" not in info
        assert j.env.q[j.place] == side * j.limit
        q, v, hits = _through_impacts(j, q, v, np.array([side * 80.0]))
        assert hits > 0
        # The default tolerance, 1e-10 (1 + |z|), over the few flights of such a hold.
        assert j.env.q == pytest.approx(q, rel=1e-9, abs=1e-9)
        assert j.env.v == pytest.approx(v, rel=1e-9, abs=1e-9)


@pytest.mark.parametrize("rate", [1e2, 1e3, 1e4, 1e5])
def test_no_speed_takes_a_joint_through_its_stop(joint, rate):
    """It ends there, however often the angle that it would have reached is back between the stops."""
    j = joint()
    for side in (1, -1):
        for turns in (0.0, 1e-3, 0.1):
            q, qdot = j.state(side * turns, side * rate, others=0.0)
            j.env.reset(options={"q": q, "qdot": qdot})
            _, _, _, _, info = j.env.step(j.torques(0.0, others=0.0))
            assert "diverged" not in info
            assert abs(j.env.q[j.place]) <= j.limit
            if j.env.drag is None:
                # With no torque, both stay there: the racer's other velocity presses it outward if it does anything.
                assert j.env.q[j.place] == side * j.limit
                assert j.env.qdot[j.place] == 0.0


# -- resting on a stop --------------------------------------------------------------------------


def test_a_joint_rests_on_its_stop_while_pressed_and_leaves_when_pulled(joint):
    j = joint()
    for side in (1, -1):
        q, qdot = j.state(side * j.limit)
        j.env.reset(options={"q": q, "qdot": qdot})
        for _ in range(20):
            j.env.step(j.torques(side * 0.1))
            assert j.env.q[j.place] == side * j.limit
            assert j.env.qdot[j.place] == 0.0
        moved = np.delete(np.abs(j.env.q - q), j.place)
        assert (moved > 1e-4).all()  # the rest goes on moving
        angles = []
        for _ in range(3):
            j.env.step(j.torques(-side * 0.02))
            angles.append(side * j.env.q[j.place])
        assert j.limit > angles[0] > angles[1] > angles[2]


def test_an_impact_takes_the_joints_energy_and_nothing_else(joint):
    """At the stop the other pseudo-velocities, hence their energy, stay: the loss is 1/2 |X|^2 v^2 of the joint."""
    j = joint(dt=1e-6)
    q, qdot = j.state(j.limit - 1e-7, 2.0)
    env = j.env
    env.reset(options={"q": q, "qdot": qdot})
    before, energy = env.v, env.energy
    alone = np.zeros_like(before)
    alone[j.moving] = before[j.moving]
    env.step(j.torques(0.0, others=0.0))
    change = env.v - before
    assert change[j.moving] == -before[j.moving]
    # In a microsecond at these speeds everything moves by 1e-6 of its size.
    assert np.delete(change, j.moving) == pytest.approx(0, abs=1e-5)
    assert energy - env.energy == pytest.approx(j.model.energy(q, alone), rel=1e-5)


def test_stops_may_be_moved_and_taken_away(env_id, bare):
    """joint_limits by name moves a stop; False removes it."""
    joint, _ = next(iter(Joint(bare(env_id)).env.joint_limits.items()))
    near, none = bare(env_id, joint_limits={joint: 0.2}), bare(env_id, joint_limits=False)
    for env in (near, none):
        env.reset(seed=0)
        for _ in range(60):
            env.step(np.ones(env.action_space.shape, np.float32))
    place = near.mechanism.coordinates.index(joint)
    assert near.q[place] == 0.2
    assert none.q[place] > 1.3


# -- let go within a hold -----------------------------------------------------------------------

# Only here may what presses a resting joint change while the torques do not: the spin of the disk, whose gyroscopic
# torque leans it over, and the turning of the pendulum, whose centrifugal torque does.
RELEASING = {"nhenv/FallingRollingDiskForward-v0": 0.6, "nhenv/WheeledInvertedPendulumForward-v0": 0.3}


def _let_go(env, stop, count):
    """States with a joint at rest on its stop, and torques that press it there at first but not to the end.

    Each (q, v, u) with the state (q, v) after the hold and what happened within it.
    """
    ((name, limit),) = env.joint_limits.items()
    place, model = env.mechanism.coordinates.index(name), Model(env.mechanism, env.params)
    assert limit == stop
    rng, found = np.random.default_rng(1), []
    frame = model.velocity(np.zeros(env.mechanism.n), np.eye(env.mechanism.rank))
    (moving,) = np.flatnonzero(frame[:, place])
    while len(found) < count:
        q = rng.uniform(-1, 1, env.mechanism.n)
        q[place] = side = rng.choice([-1, 1]) * limit
        v = rng.uniform(-20, 20, env.mechanism.rank)
        v[moving] = 0.0
        u = rng.uniform(-1, 1, len(env.torque_limits)) * env.torque_limits
        # At least likely: the rates of the others, left alone for the hold, change its sign.
        change = model.rates(q, v, u)
        if change[moving] * side < 0 or abs(change[moving]) > 20:
            continue
        end, last, happened = through_events(model, q, v, u, env.dt, (place, limit))
        if happened and happened[0][0] == RELEASE:
            found.append((q, v, u, end, last, happened))
    return model, found


@pytest.mark.parametrize(("env_id", "stop"), RELEASING.items())
def test_a_resting_joint_is_let_go_when_what_presses_it_changes_sign(env_id, stop, bare):
    """In the middle of a hold: single and side by side, with an event solver to compare with."""
    arguments = {"dt": 0.2, "torque_limits": 5.0, "backend": "numpy", "whole_state": True}
    env = bare(env_id, **arguments)
    model, cases = _let_go(env, stop, 6)
    rows = gym.make_vec(env_id, num_envs=len(cases), **arguments)
    q, v, u = (np.array([case[i] for case in cases]) for i in range(3))
    # Exactly at rest: of a velocity that is projected, rounding may be left, and the joint is not pressed then.
    qdot = model.velocity(q, v)
    rows.reset(seed=0, options={"q": q, "qdot": qdot})
    _, _, terminated, _, _ = rows.step(u / 5.0)
    assert not terminated.any()
    times = []
    for i, (_, _, _, end, last, happened) in enumerate(cases):
        env.reset(options={"q": q[i], "qdot": qdot[i]})
        env.step(u[i] / 5.0)
        times += [time for what, time in happened if what == RELEASE]
        for ours in (env, rows):
            where, speed = (ours.q, ours.v) if ours is env else (ours.q[i], ours.v[i])
            # Tolerances of 1e-10 (1 + |z|), at up to 100 rad/s.
            assert where == pytest.approx(end, rel=1e-9, abs=1e-9)
            assert speed == pytest.approx(last, rel=1e-9, abs=1e-9)
    assert max(times) > 0.01

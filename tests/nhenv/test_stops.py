"""Inelastic stops of the joints: bounds, energy, and an independent integration through every impact."""

import math

import gymnasium as gym
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import mechanics
from mechanics.model import Model

# An adaptive method of order 8 at these tolerances stays within 1e-12 over one hold; short steps, so that no passage
# out and back is stepped over.
SOLVER = {"method": "DOP853", "rtol": 1e-13, "atol": 1e-14, "max_step": 0.005}


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
    """State (q, v) after a control period, by SciPy's events on the model's rates; also the number of impacts.

    At a stop the angle is clamped and the joint's rate taken away. While its acceleration presses outward it is held:
    its pseudo-velocity stays zero.
    """
    model, n, place, moving = joint.model, joint.mechanism.n, joint.place, joint.moving
    state, time, duration, impacts = np.concatenate([q, v]), 0.0, joint.env.dt, 0
    while time < duration:
        q, v = state[:n], state[n:]
        if abs(q[place]) >= joint.limit and v[moving] * q[place] >= 0:
            q[place], v[moving] = math.copysign(joint.limit, q[place]), 0.0
            if model.rates(q, v, u)[moving] * q[place] >= 0:  # pressed: nothing in these mechanisms lets go in a hold
                held = solve_ivp(lambda t, y: _rates(model, y, n, u, moving), (time, duration), state, **SOLVER)
                assert held.success
                return held.y[:n, -1], held.y[n:, -1], impacts
        # One event a side, each counting outward passages only, so that a start on the stop is none.
        outward = [_passing(place, side, joint.limit) for side in (1, -1)]
        run = solve_ivp(lambda t, y: _rates(model, y, n, u), (time, duration), state, events=outward, **SOLVER)
        assert run.success
        time, state = run.t[-1], run.y[:, -1].copy()
        if run.status == 1:
            impacts += 1
            state[place] = math.copysign(joint.limit, state[place])
            state[n + moving] = 0.0
    return state[:n], state[n:], impacts


def _rates(model, y, n, u, held=None):
    rates = model.rates(y[:n], y[n:], u)
    if held is not None:
        rates[held] = 0.0
    return np.concatenate([model.velocity(y[:n], y[n:]), rates])


def _passing(place, side, limit):
    def event(t, y):
        return side * y[place] - limit

    event.terminal, event.direction = True, 1
    return event


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
        # The default integrators at up to 50 rad/s; a missed impact changes the angle by 1e-3 and more.
        assert ours[0] == pytest.approx(q, rel=0, abs=1e-5)
        assert ours[1] == pytest.approx(v, rel=0, abs=1e-5)
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
        # The default integrators at up to 15 rad/s.
        assert ours[0] == pytest.approx(q, rel=0, abs=1e-7)
        assert ours[1] == pytest.approx(v, rel=0, abs=1e-7)


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

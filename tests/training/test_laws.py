import numpy as np
import pytest
from scipy.optimize import linprog

from mechanics.model import Model
from training.config import LawConfig
from training.laws import LAWS
from training.laws.snakeboard import acceleration_to_rest, momentum
from training.observed import Observed
from training.rollout import make_envs, rollout
from training.tuning import controller, family

IDS = {"snakeboard": "nhenv/SnakeboardForward-v0", "roller_racer": "nhenv/RollerRacerForward-v0"}
EVERY = [(mechanism, law) for mechanism, laws in LAWS.items() for law in laws]
every_law = pytest.mark.parametrize(("mechanism", "law"), EVERY, ids=[law for _, law in EVERY])
# What changes its sign if left and right are exchanged.
ODD = {"phi", "phi_dot", "psi", "psi_dot", "sin_heading"}


def anywhere(mechanism, law, count=4):
    """A controller for each of `count` random vectors within the ranges, and environments for them."""
    envs, config = make_envs(IDS[mechanism], count), LawConfig(mechanism=mechanism, law=law)
    bounds = family(envs, config).bounds
    vectors = np.random.default_rng(2).uniform(bounds.lb, bounds.ub, (count, len(bounds.lb)))
    return envs, lambda: controller(make_envs(IDS[mechanism], count), config, vectors)


@every_law
def test_a_law_gives_shares_of_the_limits_and_sees_observations_only(mechanism, law):
    envs, make = anywhere(mechanism, law)
    driver = make()  # its own environments are never reset, so that it could not look at their state
    driver.reset(4)
    observations, _ = envs.reset(seed=1)
    largest = 0.0
    for _ in range(300):
        actions = driver(observations)
        assert actions.dtype == np.float32
        assert np.abs(actions).max() <= 1
        largest = max(largest, np.abs(actions).min(axis=0).max())
        observations, *_ = envs.step(actions)
    assert largest == 1.0  # it uses all that it may


@every_law
def test_a_law_does_not_prefer_a_side(mechanism, law):
    envs, make = anywhere(mechanism, law)
    one, other = make(), make()
    mirror = np.where([label in ODD for label in envs.observation_labels], -1, 1).astype(np.float32)
    for driver in (one, other):
        driver.reset(4)
    observations, _ = envs.reset(seed=1)
    for _ in range(300):
        actions = one(observations)
        # Negating a float is exact; the angle of -pi from sine and cosine is one end of a turn, not met here.
        np.testing.assert_array_equal(other(mirror * observations), -actions)
        observations, *_ = envs.step(actions)


@every_law
def test_a_law_starts_anew_with_every_reset(mechanism, law):
    envs, make = anywhere(mechanism, law)
    driver = make()
    first, second = (rollout(driver, envs, range(4), record=False).returns for _ in range(2))
    np.testing.assert_array_equal(first, second)


def test_momentum_is_the_flat_frames():
    envs = make_envs(IDS["snakeboard"], 3, whole_state=True)
    envs.reset(seed=3)
    envs.action_space.seed(3)
    for _ in range(40):
        observations, *_ = envs.step(envs.action_space.sample())
    c2, turning = momentum(Observed(envs)(observations), envs.params)
    v = Model(envs.mechanism, frame="flat").feasible(envs.q, envs.qdot)
    assert np.abs(v[:, 1]).min() > 0.01
    np.testing.assert_allclose(c2, v[:, 1], rtol=1e-5)  # float32 observations
    np.testing.assert_allclose(turning * c2, envs.qdot[:, 2], rtol=1e-5)


def holds_needed(error, rate, limit, dt):
    """The least number of holds that bring a double integrator to rest at zero, by linear programming."""
    for count in range(1, 100):
        after = dt**2 * (count - np.arange(count) - 0.5)
        rows, ends = np.array([after, np.full(count, dt)]), [-error - count * dt * rate, -rate]
        if linprog(np.zeros(count), A_eq=rows, b_eq=ends, bounds=(-limit, limit)).success:
            return count
    raise AssertionError("no number of holds is enough")


def test_steering_comes_to_rest_in_the_least_time_and_stays():
    limit, dt, rng = 50.0, 0.05, np.random.default_rng(0)
    for _ in range(20):
        error, rate = rng.uniform(-2.4, 2.4), rng.uniform(-5, 5)
        least = holds_needed(error, rate, limit, dt)
        for _ in range(least + 1):  # one more than linear programming, which looks at the whole way
            a = float(acceleration_to_rest(np.array(error), np.array(rate), limit, dt))
            assert abs(a) <= limit
            error, rate = error + dt * rate + dt**2 * a / 2, rate + dt * a
        assert abs(error) < 1e-9  # rounding of a few dozen operations on numbers of order one
        assert abs(rate) < 1e-9
        assert abs(acceleration_to_rest(np.array(error), np.array(rate), limit, dt)) < 1e-6


# Mean returns, and with them metres in 15 s: 40.7, 51.2, 14.6, 14.7, 31.5 and 14.0. What turned up in searches; of the
# relay, what another search had found for another simulation.
KNOWN = [
    ("snakeboard", "bang-bang", False, 808.5, [2.184, 0.3566, 0.2524, 1.199, 0.3147]),
    ("snakeboard", "charge, then go", False, 1020.4, [6.751, 1.347, 0.407, 0.3822, 0.4232, 0.2136]),
    ("snakeboard", "charge, then go", True, 287.2, [0.6974, 1.181, 0.1428, 0.3218, 1.163, 0.3713]),
    ("snakeboard", "chirped steering", True, 287.9, [1.15, -0.6233, 19.35, 7.226, 0.3845, 11.02, 0.7496]),
    ("roller_racer", "relay", False, 624.9, [1.259, 0.017, 0.69, 0.36, 0.033]),
    ("roller_racer", "relay", True, 273.3, [1.16, 0.075, 1.65, 0.75, 0.013]),
]
# Drag takes kernels of its own, which compile for ten seconds.
with_drag = [pytest.param(*row, marks=pytest.mark.slow if row[2] else ()) for row in KNOWN]


@pytest.mark.parametrize(("mechanism", "law", "drag", "expected", "vector"), with_drag)
def test_laws_go_as_far_as_they_are_known_to(mechanism, law, drag, expected, vector):
    envs = make_envs(IDS[mechanism], 4, drag=drag)
    driver = controller(envs, LawConfig(mechanism=mechanism, law=law), vector)
    returns = rollout(driver, envs, range(4), record=False).returns
    # Starts differ by 0.05 rad of a joint, and the parameters are rounded.
    assert returns == pytest.approx(expected, rel=0.02)


def test_charging_means_to_spin_with_full_torque_at_the_stop():
    charge = 6.0
    vector = [charge, 1.347, 0.407, 0.3822, 0.4232, 0.2136]
    envs = make_envs(IDS["snakeboard"], 3, whole_state=True)
    driver = controller(envs, LawConfig(mechanism="snakeboard", law="charge, then go"), vector)
    episodes = rollout(driver, envs, range(3))
    params, charged = envs.params, slice(20, round(charge / envs.dt))  # 1 s to come to the stop
    phi = episodes.q[:, charged, 4]
    np.testing.assert_allclose(np.abs(phi), envs.joint_limits["phi"])
    assert (np.sign(phi[:, :1]) * np.sign(episodes.q[:, :1, 4]) == 1).all()  # on the side where it begins
    np.testing.assert_allclose(episodes.torques[:, charged, 0], np.sign(phi) * envs.torque_limits[:, :1])
    # It turns with c2 sin(phi)/sqrt(D), and c2 grows by u sin(phi)/sqrt(D) a second: theta'' = -u sin(phi)^2/D.
    sine = np.sin(envs.joint_limits["phi"]) ** 2
    growth = sine / (params["m"] * params["l"] ** 2 - params["J_r"] * sine)
    bend = np.diff(episodes.q[:, charged, 2], n=2, axis=1) / envs.dt**2
    np.testing.assert_allclose(bend, -np.sign(phi[:, 2:]) * growth, rtol=1e-6)
    assert np.abs(episodes.q[:, -1, 2] - episodes.q[:, 119, 2]).max() < 2 * np.pi  # then it no longer spins


def test_relay_turns_round_only_beyond_its_threshold():
    vector = [1.0, 0.2, 1.0, 0.4, 0.02]
    envs = make_envs(IDS["roller_racer"], 4)
    driver, observed = controller(envs, LawConfig(mechanism="roller_racer", law="relay"), vector), Observed(envs)
    driver.reset(4)
    observations, _ = envs.reset(seed=1)
    torque = np.sign(observed(observations)["psi"])
    turned = 0
    for step in range(300):
        seen = observed(observations)
        heading = np.arctan2(seen["sin_heading"], seen["cos_heading"])
        beyond = torque * (seen["psi"] + 0.02 * seen["psi_dot"] - 0.4 * heading) > 1.0 - 0.8 * step / 300
        torque = np.where(beyond, -torque, torque)
        turned += beyond.sum()
        actions = driver(observations)
        np.testing.assert_array_equal(actions[:, 0], torque)
        observations, *_ = envs.step(actions)
    assert turned > 20

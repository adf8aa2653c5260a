import gymnasium as gym
import numpy as np
import pytest

from mechanics.expressions import ExpressionError
from mechanics.model import Model
from training.config import COMPARED, GaitConfig, TorqueConfig
from training.gaits import Feedback, Gait, Joints, Sinusoid
from training.metrics import measure
from training.rollout import make_envs, rollout
from training.tuning import controller, family

SNAKEBOARD = "nhenv/SnakeboardForward-v0"
GOAL = "nhenv/SnakeboardGoal-v0"

every_environment = pytest.mark.parametrize("env_id", COMPARED)


@pytest.fixture
def moving(request):
    """An environment after 40 random actions, and its last observation."""
    env = gym.make(request.param)
    observation, _ = env.reset(seed=3)
    env.action_space.seed(3)
    for _ in range(40):
        observation, *_ = env.step(env.action_space.sample())
    return env.unwrapped, observation


on_the_move = pytest.mark.parametrize("moving", COMPARED, indirect=True)


@on_the_move
def test_state_is_read_off_the_observation(moving):
    env, observation = moving
    joints = Joints(env)
    q, v = joints.state(observation)
    assert np.abs(env.v).max() > 0.1
    # float32 keeps 6e-8 of each entry, and the linear system magnifies it less than tenfold.
    np.testing.assert_allclose(v, env.v, rtol=1e-6, atol=1e-6)
    limited = joints.index[~joints.cyclic]
    np.testing.assert_allclose(q[limited], env.q[limited], rtol=1e-6)


@on_the_move
def test_computed_torque_gives_the_acceleration_asked_for(moving):
    env, observation = moving
    joints = Joints(env)
    wanted = np.linspace(1.0, -2.0, len(joints.index))
    torque = joints.torque(*joints.state(observation), wanted)
    given = joints.model.acceleration(env.q, env.v, torque)[joints.index]
    np.testing.assert_allclose(given, wanted, rtol=1e-5, atol=1e-5)  # float32 observations


@every_environment
def test_computed_torque_overcomes_the_drag_that_acts(env_id):
    env = gym.make(env_id, drag={"b_psi": 0.04}, backend="numpy").unwrapped
    observation, _ = env.reset(seed=3)
    for _ in range(20):
        observation, *_ = env.step(np.full(env.action_space.shape, 0.3, np.float32))
    joints = Joints(env)
    wanted = np.linspace(1.0, -2.0, len(joints.index))
    torque = joints.torque(*joints.state(observation), wanted)
    dragged, ideal = (Model(env.mechanism, drag=drag) for drag in (env.drag, None))
    given = dragged.acceleration(env.q, env.v, torque)[joints.index]
    np.testing.assert_allclose(given, wanted, rtol=1e-5, atol=1e-5)  # float32 observations
    assert np.abs(ideal.acceleration(env.q, env.v, torque)[joints.index] - wanted).max() > 0.01


# A fixed gait, and one that grows while it slows down.
@pytest.mark.parametrize("last", [lambda m: (), lambda m: (np.full(m, 0.3), [1.0])])
@every_environment
def test_weak_gait_follows_its_reference(env_id, last):
    envs = make_envs(env_id, 3, whole_state=True)
    joints = Joints(envs)
    m = len(joints.index)
    vector = np.concatenate([np.full(m, 0.2), np.linspace(0.3, 1.0, m), np.full(m, 20.0), [2.0], *last(m)])
    gait = Gait.from_vector(vector, np.ones(m), 15.0)
    episodes = rollout(Sinusoid(joints, gait), envs, range(3))
    settled = slice(20, None)  # 1 s, many times 1/kd
    assert np.abs(episodes.torques[:, settled]).max(axis=(0, 1)).max() < 0.99 * joints.limits.min()
    times = np.arange(episodes.q.shape[1]) * envs.dt
    reference = np.array([gait.angle(t) for t in times])
    error = episodes.q[..., joints.index] - reference
    # A rotor's rate is followed, its angle is free: take the offset out.
    error -= np.where(joints.cyclic, error[:, settled].mean(axis=1, keepdims=True), 0.0)
    # Holding the torque over dt leaves an error of the order (w dt)^2 = 1e-2 of the amplitude of 0.2.
    assert np.abs(error[:, settled]).max() < 0.2 * (2.0 * envs.dt) ** 2


@pytest.mark.parametrize(("phase", "direction"), [(0.0, -1), (np.pi, 1)])
def test_snakeboard_goes_back_in_phase_and_forth_in_antiphase(phase, direction):
    # Ostrowski et al.: the 1:1 gait drives; S(nT) = -2π n κ w a_ψ J1(a_φ) for zero phases.
    envs = make_envs(SNAKEBOARD, 3, whole_state=True)
    joints = Joints(envs)
    gait = Gait.from_vector(np.array([1.0, 0.3, phase, 0.0, 15.0, 15.0, 3.0]), np.ones(2), 15.0)
    distance = measure(envs, rollout(Sinusoid(joints, gait), envs, range(3)))["distance_m"]
    assert (direction * distance > 1.0).all()


def test_cyclic_ratio_multiplies_the_rotor_only():
    driver = controller(make_envs(SNAKEBOARD, 1), GaitConfig(cyclic_ratio=2.0), np.ones(7))
    rotor, steering = driver.gait.angle(0.7)
    assert rotor == pytest.approx(np.sin(2 * 0.7 + 1))
    assert steering == pytest.approx(np.sin(0.7 + 1))


@pytest.mark.parametrize("make", [gym.make, lambda env_id: make_envs(env_id, 2)])
def test_gait_is_as_long_as_an_episode(make):
    config = GaitConfig(steered=True)
    driver = controller(make(SNAKEBOARD), config, np.array([1, 0.2, 0, 0, 9, 9, 4, 0.5, 0.4, 7, 0.1]))
    np.testing.assert_allclose(driver.gait.frequency_rate, (7 - 4) / 15.0)


def test_schedule_arrives_where_it_should():
    vector = np.array([1.0, 0.2, 0.1, -0.3, 9.0, 9.0, 4.0, 0.5, 0.4, 6.0])
    gait = Gait.from_vector(vector, np.ones(2), 15.0)
    step = 1e-6
    for t in (0.0, 7.0, 15.0):
        slope = (gait.angle(t + step) - gait.angle(t - step)) / (2 * step)
        np.testing.assert_allclose(gait.rate(t), slope, atol=1e-7)  # rounding of order eps / step
    np.testing.assert_allclose(gait.amplitude + 15.0 * gait.amplitude_rate, [0.5, 0.4])
    np.testing.assert_allclose(gait.frequency + 15.0 * gait.frequency_rate, [6.0])
    np.testing.assert_allclose(gait.angle(0.0), np.array([1.0, 0.2]) * np.sin([0.1, -0.3]))


def test_steering_turns_joints_with_stops_against_the_heading():
    board = make_envs(SNAKEBOARD, 1)
    vector = np.array([0.0, 0.0, 0.0, 0.0, 15.0, 15.0, 1.0, 0.0, 0.0, 1.0, -0.4])
    driver = controller(board, GaitConfig(steered=True), vector)
    observation, _ = board.reset(options={"q": [0, 0, 0.5, 0, 0]})
    for _ in range(60):  # 3 s, many times 1/kd
        observation, *_ = board.step(driver(observation))
    # The rotor rests, so the heading stays and the steering settles where it is asked to be.
    assert board.q[0, 4] == pytest.approx(-0.4 * np.sin(0.5), rel=1e-3)


def test_what_is_observed_of_a_target_scales_the_amplitudes_it_is_meant_for():
    envs = make_envs(GOAL, 5)
    joints = Joints(envs)
    observations, _ = envs.reset(seed=4)
    seen = joints.observed(observations)
    ahead, left = seen["goal_ahead"], seen["goal_left"]
    np.testing.assert_allclose(ahead**2 + left**2, 1.0, rtol=1e-6)  # float32 observations
    rules = Feedback(steering=("goal_left", np.array(0.3)), limited=("3*goal_ahead", np.array(0.5)))
    np.testing.assert_allclose(rules.offset(seen)[:, 0], 0.3 * left)
    rotor, steering = rules.scale(seen, joints.cyclic).T
    np.testing.assert_array_equal(rotor, 1.0)
    np.testing.assert_allclose(steering, np.clip(1.5 * ahead, -1, 1))
    assert len(set(np.abs(steering) < 1)) == 2  # some are cut off, some are not
    rotor, steering = Feedback(cyclic=("goal_ahead", np.array(0.5))).scale(seen, joints.cyclic).T
    np.testing.assert_allclose(rotor, 0.5 * ahead)
    np.testing.assert_array_equal(steering, 1.0)


def test_a_gait_whose_target_is_reached_rests():
    envs = make_envs(SNAKEBOARD, 2, whole_state=True)
    joints = Joints(envs)
    gait = Gait.from_vector(np.array([3.0, 0.5, 0.2, 0.0, 15.0, 15.0, 4.0]), np.ones(2), 15.0)
    nothing_left = ("speed - speed", np.array(1.0))
    driver = Sinusoid(joints, gait, Feedback(cyclic=nothing_left, limited=nothing_left))
    q = rollout(driver, envs, range(2)).q
    # Its joints go to rest from where they start, phi within 0.05 rad of the middle, and the board stays.
    assert np.abs(q[:, -1, 4]).max() < 1e-6
    assert np.abs(q[:, -1, :3]).max() < 1e-3
    moving = rollout(Sinusoid(joints, gait), envs, range(2)).q
    assert np.abs(moving[:, -1, :2]).max(axis=1).min() > 0.1


def test_feedback_of_what_is_not_observed_is_refused():
    with pytest.raises(ExpressionError, match="unknown observation 'sin_heding'.*Did you mean 'sin_heading'"):
        family(make_envs(SNAKEBOARD, 1), GaitConfig(steered=True, steered_by="-sin_heding"))


def test_torque_sinusoid_looks_at_nothing_and_is_that():
    envs = make_envs(SNAKEBOARD, 3)
    vector = np.array([[0.5, 1.0, 0.1, -0.4, 3.0], [1.0, 0.2, 0.0, 2.0, 5.0], [0.0, 0.9, 1.0, 1.0, 2.0]])
    driver = controller(envs, TorqueConfig(cyclic_ratio=2.0), vector)
    driver.reset(3)
    rng = np.random.default_rng(0)
    given = np.array([driver(rng.normal(size=(3, 6)).astype(np.float32)) for _ in range(20)])
    assert given.dtype == np.float32
    t = 0.05 * np.arange(20)[:, None, None]
    expected = vector[:, :2] * np.sin(vector[:, 4:] * [2.0, 1.0] * t + vector[:, 2:4])
    np.testing.assert_allclose(given, expected, atol=1e-6)  # float32


@pytest.mark.parametrize("steered", [False, True])
@every_environment
def test_ranges_respect_stops_and_sampling(env_id, steered):
    envs = make_envs(env_id, 1)
    joints, config = Joints(envs), GaitConfig(steered=steered)
    searched = family(envs, config)
    m, ranges = len(joints.index), searched.bounds
    low, high = (searched.controller(np.asarray(side)) for side in (ranges.lb, ranges.ub))
    assert ranges.lb.shape == ranges.ub.shape == (4 * m + 3 if steered else 3 * m + 1,)
    assert (ranges.lb < ranges.ub).all()
    assert (low.gait.amplitude == 0).all()
    np.testing.assert_array_equal(high.gait.amplitude, np.where(joints.cyclic, config.cyclic_amplitude, joints.stops))
    assert (low.gait.frequency.item(), high.gait.frequency.item()) == config.frequency
    assert (high.gait.amplitude_rate == 0).all()  # the last amplitudes have the same range
    assert high.gait.damping.max() * envs.dt < 2  # beyond it the held feedback overshoots more each time

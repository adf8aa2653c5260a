import dataclasses

import gymnasium as gym
import numpy as np
import pytest

from mechanics.model import Model
from training.config import COMPARED, EvaluationConfig, GaitConfig, for_env
from training.evaluate import evaluate, make_envs, measure, rollout
from training.gaits import Gait, Joints, Sinusoid, bounds, gait_path, sinusoid, tune, tune_piece
from training.store import read_json

SNAKEBOARD = "nhenv/SnakeboardForward-v0"
TINY = GaitConfig(population=16, generations=4, starts=1)

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
@pytest.mark.parametrize("last", [lambda m: (), lambda m: (np.full(m, 0.3), [1.0], [0.0])])
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
    controller = sinusoid(make_envs(SNAKEBOARD, 1), GaitConfig(cyclic_ratio=2.0), np.ones(7))
    rotor, steering = controller.gait.angle(0.7)
    assert rotor == pytest.approx(np.sin(2 * 0.7 + 1))
    assert steering == pytest.approx(np.sin(0.7 + 1))


@pytest.mark.parametrize("make", [gym.make, lambda env_id: make_envs(env_id, 2)])
def test_gait_is_as_long_as_an_episode(make):
    config = GaitConfig(steered=True)
    controller = sinusoid(make(SNAKEBOARD), config, np.array([1, 0.2, 0, 0, 9, 9, 4, 0.5, 0.4, 7, 0.1]))
    np.testing.assert_allclose(controller.gait.frequency_rate, (7 - 4) / 15.0)


def test_schedule_arrives_where_it_should():
    vector = np.array([1.0, 0.2, 0.1, -0.3, 9.0, 9.0, 4.0, 0.5, 0.4, 6.0, -0.7])
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
    joints = Joints(board)
    vector = np.array([0.0, 0.0, 0.0, 0.0, 15.0, 15.0, 1.0, 0.0, 0.0, 1.0, -0.4])
    controller = Sinusoid(joints, Gait.from_vector(vector, np.ones(2), 15.0))
    observation, _ = board.reset(options={"q": [0, 0, 0.5, 0, 0]})
    for _ in range(60):  # 3 s, many times 1/kd
        observation, *_ = board.step(controller(observation))
    # The rotor rests, so the heading stays and the steering settles where it is asked to be.
    assert board.q[0, 4] == pytest.approx(-0.4 * np.sin(0.5), rel=1e-3)


@pytest.mark.parametrize("steered", [False, True])
@every_environment
def test_bounds_respect_stops_and_sampling(env_id, steered):
    envs = make_envs(env_id, 1)
    joints, config = Joints(envs), GaitConfig(steered=steered)
    ranges = bounds(joints, config)
    m = len(joints.index)
    low, high = (Gait.from_vector(np.asarray(side), np.ones(m), 1.0) for side in (ranges.lb, ranges.ub))
    assert ranges.lb.shape == ranges.ub.shape == (4 * m + 3 if steered else 3 * m + 1,)
    assert (ranges.lb < ranges.ub).all()
    assert (low.amplitude == 0).all()
    np.testing.assert_array_equal(high.amplitude, np.where(joints.cyclic, config.cyclic_amplitude, joints.stops))
    assert (low.frequency.item(), high.frequency.item()) == config.frequency
    assert (high.amplitude_rate == 0).all()  # the last amplitudes have the same range
    assert high.damping.max() * envs.dt < 2  # beyond it the held feedback overshoots more each time


def test_finished_gait_is_not_tuned_again(tmp_path):
    tune_piece(SNAKEBOARD, TINY, tmp_path)
    written = read_json(gait_path(SNAKEBOARD, TINY, tmp_path))
    assert written["settings"]["gait"]["population"] == TINY.population
    assert len(written["result"]["vector"]) == 7
    tune_piece(SNAKEBOARD, TINY, tmp_path, lambda *message: pytest.fail("it tunes again"))


def test_a_gait_is_tuned_and_judged_in_the_environment_that_is_asked_for():
    weak = dataclasses.replace(TINY, generations=1, env_kwargs={"torque_limits": 0.01})
    strong = dataclasses.replace(weak, env_kwargs={})
    returns = [tune(SNAKEBOARD, config).history[-1] for config in (weak, strong)]
    assert returns[0] < 0.1 * returns[1]
    controller = sinusoid(make_envs(SNAKEBOARD, 1), TINY, np.ones(7))
    judged = EvaluationConfig(episodes=2, env_kwargs={"torque_limits": 0.01})
    asked = evaluate(controller, SNAKEBOARD, judged)[0].torques[:, 0]
    plain = evaluate(controller, SNAKEBOARD, EvaluationConfig(episodes=2))[0].torques[:, 0]
    twice = evaluate(controller, SNAKEBOARD, judged, torque_limits=0.02)[0].torques[:, 0]
    assert asked == pytest.approx(plain * [0.01, 0.02])  # the same actions; by default 1 and 0.5 N m
    assert twice == pytest.approx(2 * asked)


def test_tuning_improves_on_its_start_and_is_reproducible():
    heard = []
    tuned = tune(SNAKEBOARD, TINY, lambda *message: heard.append(message[:2]))
    assert tuned.history == sorted(tuned.history)
    assert tuned.history[-1] > tuned.history[0]
    assert heard == [(done, 5) for done in range(1, 6)]
    assert tuned.episodes == 5 * 14  # 16 candidates are rounded down to a multiple of 7 parameters
    assert tune(SNAKEBOARD, TINY) == tuned
    gait = sinusoid(make_envs(SNAKEBOARD, 1), TINY, tuned.vector)
    episodes, _ = evaluate(gait, SNAKEBOARD, for_env(SNAKEBOARD).evaluation)
    assert episodes.returns.mean() == pytest.approx(tuned.history[-1], rel=0.05)  # starts differ by 0.1 rad

import re

import gymnasium as gym
import numpy as np
import pytest

from training.config import COMPARED
from training.evaluate import Evaluate
from training.metrics import joint_index, measure
from training.rollout import make_envs, rollout
from training.store import write_json

SNAKEBOARD = "nhenv/SnakeboardForward-v0"
GOAL = "nhenv/RollerRacerGoal-v0"
every_environment = pytest.mark.parametrize("env_id", COMPARED)


class Constant:
    """The same action always."""

    def __init__(self, action):
        self.action = action

    def reset(self, episodes):
        self.episodes = episodes

    def __call__(self, observations):
        return np.full((self.episodes, self.action.size), self.action, dtype=np.float32)


class Noise:
    """Small random actions, the same in each rollout."""

    def __init__(self, size):
        self.size = size

    def reset(self, episodes):
        self.random = np.random.default_rng(5)

    def __call__(self, observations):
        return self.random.uniform(-0.2, 0.2, (len(observations), self.size)).astype(np.float32)


class Replayed:
    """Given actions (T, N, m), which notes the observations that it is shown."""

    def __init__(self, actions):
        self.actions = actions

    def reset(self, episodes):
        self.shown = []

    def __call__(self, observations):
        self.shown.append(observations.copy())
        return self.actions[len(self.shown) - 1]


def controls(envs):
    return len(envs.mechanism.controls)


def alone(env, seed, actions):
    """One episode of a single environment: return, coordinates, torques, and what is observed before each step."""
    observation, _ = env.reset(seed=seed)
    total, q, torques, shown, over = 0.0, [env.unwrapped.q], [], [], False
    while not over:
        action = actions[len(shown)]
        shown.append(observation)
        torques.append(np.clip(action, -1, 1) * env.unwrapped.torque_limits)
        observation, reward, terminated, truncated, _ = env.step(action)
        total += reward
        q.append(env.unwrapped.q)
        over = terminated or truncated
    return total, np.array(q), np.array(torques), shown


# Some of these goals are reached while others are not. (That scene follows every coordinate by itself.)
@pytest.mark.parametrize(
    ("env_id", "options"), [(env_id, {"whole_state": True}) for env_id in COMPARED] + [(GOAL, {"goal_radius": 1.3})]
)
def test_lockstep_changes_nothing(env_id, options):
    seeds = [0, 3, 50, 2, 10]
    envs = gym.make_vec(env_id, len(seeds), **options)
    single = gym.make(env_id, **options)
    phases = np.random.default_rng(0).uniform(-0.3, 0.3, (len(seeds), controls(envs)))
    actions = 1.2 * np.sin(0.25 * np.arange(300)[:, None, None] + phases).astype(np.float32)
    expected = [alone(single, seed, actions[:, i]) for i, seed in enumerate(seeds)]
    lengths = [len(shown) for *_, shown in expected]
    assert (len(set(lengths)) > 2) == (env_id == GOAL)
    for i, steps in enumerate(lengths):
        actions[steps:, i] = np.nan  # nothing that happens after its end concerns an episode
    controller = Replayed(actions)
    together = rollout(controller, envs, seeds)
    for i, (total, q, torques, shown) in enumerate(expected):
        steps = lengths[i]
        assert together.returns[i] == total
        np.testing.assert_array_equal(together.q[i, : steps + 1], q)
        np.testing.assert_array_equal(together.torques[i, :steps], torques)
        np.testing.assert_array_equal([observations[i] for observations in controller.shown[:steps]], shown)
        assert together.steps[i] == steps
        assert (together.q[i, steps:] == q[-1]).all()
        assert (together.v[i, steps:] == together.v[i, steps]).all()
        assert (together.torques[i, steps:] == 0).all()


@every_environment
def test_doing_nothing_goes_nowhere_for_nothing(env_id):
    envs = make_envs(env_id, 2, whole_state=True)
    episodes = rollout(Constant(np.zeros(controls(envs))), envs, [0, 1])
    assert episodes.torques.shape == (2, 300, controls(envs))
    assert episodes.q.shape == (2, 301, envs.mechanism.n)
    numbers = measure(envs, episodes)
    for name in ("distance_m", "energy_j", "return"):
        assert (numbers[name] == 0).all(), name
    assert np.isnan(numbers["cost_of_transport"]).all()


@every_environment
def test_same_seeds_give_the_same_numbers(env_id):
    envs = make_envs(env_id, 2, whole_state=True)
    first = rollout(Noise(controls(envs)), envs, [4, 5])
    again = rollout(Noise(controls(envs)), make_envs(env_id, 2, whole_state=True), [4, 5])
    other = rollout(Noise(controls(envs)), envs, [6, 7])
    for name in ("returns", "q", "v", "torques", "steps"):
        np.testing.assert_array_equal(getattr(first, name), getattr(again, name))
    for name in ("returns", "q", "v"):
        assert not np.array_equal(getattr(first, name), getattr(other, name))


@every_environment
def test_recorded_work_is_the_energy_gained(env_id):
    # Without drag, and short of the stops, work is kinetic energy. Exact, because torques are held.
    envs = make_envs(env_id, 2, whole_state=True)
    weak = Constant(np.full(controls(envs), 1e-4))
    episodes = rollout(weak, envs, [0, 1])
    for joint, stop in envs.mechanism.joint_limits.items():
        assert np.abs(episodes.q[:, :, envs.mechanism.coordinates.index(joint)]).max() < 0.99 * stop
    work = (episodes.torques * np.diff(episodes.q[:, :, joint_index(envs.mechanism)], axis=1)).sum(axis=(1, 2))
    np.testing.assert_allclose(work, envs.energy, rtol=1e-6)  # float32 actions keep 6e-8


@every_environment
def test_energy_counts_every_motor_for_itself(env_id):
    envs = make_envs(env_id, 1, whole_state=True)
    episodes = rollout(Noise(controls(envs)), envs, [0])
    signed = (episodes.torques * np.diff(episodes.q[:, :, joint_index(envs.mechanism)], axis=1)).sum()
    assert measure(envs, episodes)["energy_j"][0] > abs(signed)
    assert measure(envs, episodes)["energy_j"][0] >= envs.energy[0]


@every_environment
def test_distance_is_what_the_task_rewards(env_id):
    envs = make_envs(env_id, 2, whole_state=True)
    episodes = rollout(Noise(controls(envs)), envs, [0, 1])
    numbers = measure(envs, episodes)
    assert (np.abs(numbers["distance_m"]) > 1e-3).all()
    effort = ((episodes.torques / envs.torque_limits[:, None]) ** 2).mean(axis=2).sum(axis=1)
    np.testing.assert_allclose((episodes.returns + 0.02 * effort) * envs.dt, numbers["distance_m"], rtol=1e-6)
    # Both mechanisms call their mass m.
    weight = 9.81 * envs.params["m"]
    np.testing.assert_allclose(numbers["cost_of_transport"] * weight * numbers["distance_m"], numbers["energy_j"])


def test_torques_are_what_was_held_not_what_was_asked_for():
    envs = make_envs(SNAKEBOARD, 1, whole_state=True)
    torques = rollout(Constant(np.array([5.0, -5.0])), envs, [0]).torques
    (limits,) = envs.torque_limits
    np.testing.assert_array_equal(np.unique(torques[..., 0]), limits[0])
    np.testing.assert_array_equal(np.unique(torques[..., 1]), -limits[1])


def test_unrecorded_rollouts_return_the_same():
    recorded = rollout(Noise(2), make_envs(SNAKEBOARD, 2, whole_state=True), [0, 1])
    plain = rollout(Noise(2), make_envs(SNAKEBOARD, 2), [0, 1], record=False)
    np.testing.assert_array_equal(recorded.returns, plain.returns)
    assert plain.torques.shape == (2, 0, 2)


def test_coordinates_that_are_not_followed_cannot_be_recorded():
    with pytest.raises(ValueError, match="make them with whole_state=True"):
        rollout(Noise(2), make_envs(SNAKEBOARD, 2), [0, 1])


def test_failure_names_the_seed_of_the_episode():
    # Without stops and with these limits, the state overflows.
    wild = gym.make_vec(SNAKEBOARD, 3, torque_limits=1e200, whole_state=True)
    actions = np.zeros((300, 3, 2), np.float32)
    actions[:, 1] = 1
    with pytest.raises(FloatingPointError, match=re.escape("seed 71 diverged after actions [1. 1.]")):
        rollout(Replayed(actions), wild, [70, 71, 72])
    actions[:, 1], actions[5, 2] = 0, np.nan
    with pytest.raises(ValueError, match=re.escape("seed 72 was given actions that are not numbers, [nan nan]")):
        rollout(Replayed(actions), wild, [70, 71, 72])


def test_options_name_what_is_missing(tmp_path):
    with pytest.raises(ValueError, match="there is no policy"):
        Evaluate(tmp_path / "policy.zip")
    (tmp_path / "policy.zip").touch()
    with pytest.raises(ValueError, match="give --env-id"):
        Evaluate(tmp_path / "policy.zip")


def test_a_policy_is_judged_where_it_learned_unless_asked(tmp_path):
    policy = tmp_path / "policy.zip"
    policy.touch()
    assert Evaluate(policy, SNAKEBOARD).env_kwargs() == {}
    settings = {"env_id": SNAKEBOARD, "ppo": {"env_kwargs": {"drag": True, "dt": 0.04}}}
    write_json(policy.with_suffix(".json"), {"settings": settings})
    assert Evaluate(policy).env_kwargs() == {"drag": True, "dt": 0.04}
    assert Evaluate(policy, drag=False).env_kwargs() == {"drag": False, "dt": 0.04}


def test_help_warns_of_unpickling():
    assert "only load files that you trust" in Evaluate.__doc__

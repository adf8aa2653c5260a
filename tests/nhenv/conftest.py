"""Helpers for the tests of the environments."""

import sys
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest

import mechanics
import nhenv

sys.path.append(str(Path(__file__).parents[1]))  # for what tests share

# Their environments are compiled. Those of the other mechanisms are interpreted, and only in the slow tests; that
# both backends agree is a test of its own.
COMPILED = ("snakeboard", "roller_racer")


def _is_compiled(env_id):
    mechanism = gym.spec(env_id.removeprefix("nhenv:")).kwargs["mechanism"]
    return mechanism in COMPILED or mechanism not in mechanics.names()


def _ids():
    for env_id in nhenv.environment_ids():
        yield env_id if _is_compiled(env_id) else pytest.param(env_id, marks=pytest.mark.slow)


def _backend(env_id):
    return {} if _is_compiled(env_id) else {"backend": "numpy"}


@pytest.fixture(params=_ids())
def env_id(request):
    """Each registered id in turn."""
    return request.param


@pytest.fixture
def backend():
    """Arguments for making the environment of an id in the tests' usual way."""
    return _backend


@pytest.fixture
def make():
    """`gym.make` that closes what it made."""
    made = []

    def make_env(env_id, **kwargs):
        made.append(gym.make(env_id, **{**_backend(env_id), **kwargs}))
        return made[-1]

    yield make_env
    for env in made:
        env.close()


@pytest.fixture
def bare():
    """Make an environment without wrappers: no time limit, no checks but its own."""

    def make_env(env_id, **kwargs):
        return gym.make(env_id, disable_env_checker=True, **{**_backend(env_id), **kwargs}).unwrapped

    return make_env


@pytest.fixture
def actions():
    """Random actions of an environment, the same at every call: shape (steps, m), float32."""

    def draw(env, steps, seed=0):
        rng = np.random.default_rng(seed)
        return rng.uniform(-1, 1, (steps, *env.action_space.shape)).astype(np.float32)

    return draw


@pytest.fixture
def rollout():
    """Everything that an environment returns over given actions, after a reset with seed 3 or as asked."""

    def roll(env, actions, **reset):
        observations = [env.reset(**(reset or {"seed": 3}))[0]]
        rewards, infos = [], []
        for action in actions:
            observation, reward, _, _, info = env.step(action)
            observations.append(observation)
            rewards.append(reward)
            infos.append(info)
        return np.array(observations), np.array(rewards), infos

    return roll

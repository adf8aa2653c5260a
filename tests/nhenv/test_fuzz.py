"""Whatever is thrown at an environment, numbers come back, or a documented ValueError."""

import gymnasium as gym
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import nhenv
from benchmarks.fuzz import check, fuzz, fuzz_rows
from mechanics.model import Model
from nhenv.env import LocomotionEnv

# Those whose sources are short; every id has its turn in the slow test.
QUICK = (
    "nhenv/SnakeboardForward-v0",
    "nhenv/RollerRacerGoal-v0",
    "nhenv/RollerRacerVelocity-v0",
    "nhenv/ChaplyginSleighForward-v0",
)
ROWS = ("nhenv/SnakeboardForward-v0", "nhenv/RollerRacerForward-v0")
ALL = 100_000  # episodes of the slow test
ALONE = 400  # of them for each id, in single environments that are interpreted; the others are rows, compiled

ANY = st.floats(allow_nan=True, allow_infinity=True, allow_subnormal=True)
FINITE = st.floats(-1e6, 1e6, allow_subnormal=True)


def _made(env_id, **arguments):
    return gym.make(env_id, backend="numpy", **arguments)


@pytest.fixture(scope="module", params=ROWS)
def env(request):
    return _made(request.param)


def _assert_no_problem(report):
    assert report.episodes > 0
    assert not report.problems, "\n".join(report.problems[:5])


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_any_float_is_an_action(env, data):
    """Numbers are clipped, in both widths; what is not a number is refused and changes nothing."""
    m = env.action_space.shape[0]
    observation, info = env.reset(seed=data.draw(st.integers(0, 2**64)))
    assert check(env, observation, 0.0, info) == ""
    for values in data.draw(st.lists(st.lists(ANY, min_size=m, max_size=m), max_size=4)):
        with np.errstate(over="ignore"):
            action = np.array(values, data.draw(st.sampled_from([np.float32, np.float64])))
        before = env.unwrapped.q
        if np.isnan(action).any():
            with pytest.raises(ValueError, match="not a number"):
                env.step(action)
            assert np.array_equal(env.unwrapped.q, before)
            continue
        observation, reward, terminated, truncated, info = env.step(action)
        assert check(env, observation, reward, info) == ""
        assert not terminated
        assert not truncated


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_a_reset_may_be_anywhere(env, data):
    """Any state within the stops that satisfies the constraints begins an episode; numbers come back after it too."""
    bare = env.unwrapped
    mechanism = bare.mechanism
    bounds = [bare.joint_limits.get(name, 1e6) for name in mechanism.coordinates]
    q = np.array([data.draw(st.floats(-bound, bound, allow_subnormal=True)) for bound in bounds])
    v = np.array(data.draw(st.lists(FINITE, min_size=mechanism.rank, max_size=mechanism.rank)))
    observation, info = env.reset(options={"q": q, "qdot": Model(mechanism).velocity(q, v)})
    assert check(env, observation, 0.0, info) == ""
    assert np.array_equal(bare.q, q)
    observation, reward, terminated, _, info = env.step(np.ones(env.action_space.shape, np.float32))
    assert check(env, observation, reward, info) == ""
    assert terminated == info.get("diverged", False)
    assert np.isfinite([*bare.q, *bare.v]).all()


@settings(max_examples=30, deadline=None)
@given(
    env_id=st.sampled_from(ROWS),
    dt=st.floats(0, exclude_min=True, allow_infinity=False, allow_subnormal=True),
    limit=st.floats(0, exclude_min=True, allow_infinity=False, allow_subnormal=True),
    seed=st.integers(0, 2**32),
)
def test_any_period_and_any_torque(env_id, dt, limit, seed):
    """Numbers come back, or the argument is refused."""
    try:
        env = _made(env_id, dt=dt, torque_limits=limit)
    except ValueError:
        return
    env.reset(seed=seed)
    rng = np.random.default_rng(seed)
    for _ in range(3):
        action = rng.choice([-1.0, 0.3, 1.0], env.action_space.shape).astype(np.float32)
        observation, reward, terminated, _, info = env.step(action)
        assert check(env, observation, reward, info) == ""
        if terminated:
            assert info["diverged"]
            break


@pytest.mark.parametrize("env_id", QUICK)
def test_random_episodes(env_id):
    report = fuzz(env_id, 300, seed=1, backend="numpy")
    _assert_no_problem(report)
    assert report.refused > 0  # bad input was among it
    assert report.flagged > 0  # and what nobody can compute


@pytest.mark.parametrize("env_id", ROWS)
def test_random_episodes_of_rows(env_id):
    _assert_no_problem(fuzz_rows(env_id, 500, seed=1, rows=40, backend="numpy"))


@pytest.mark.slow
def test_a_hundred_thousand_random_episodes():
    """Every id, then rows with parameters of their own, compiled."""
    episodes = 0
    for env_id in nhenv.environment_ids():
        report = fuzz(env_id, ALONE, seed=2, backend="numpy")
        _assert_no_problem(report)
        episodes += report.episodes
    part = -(-(ALL - episodes) // (2 * len(ROWS)))
    for env_id in ROWS:
        for stops in ({}, {"joint_limits": False}):
            report = fuzz_rows(env_id, part, seed=3, **stops)
            _assert_no_problem(report)
            episodes += report.episodes
    assert episodes >= ALL


def test_what_is_wrong_is_seen(monkeypatch):
    """A reward, an observation, an info, an exception, a state: each is reported with what reproduces it."""
    real = LocomotionEnv.step

    def spoilt(change):
        def step(self, action):
            response = real(self, action)
            return change(self, *response)

        return step

    def first(values, value):
        values = values.copy()
        values[0] = value
        return values

    def fail(*response):
        raise ZeroDivisionError("boom")

    changes = {
        "reward nan": lambda self, o, r, d, t, i: (o, np.nan, d, t, i),
        "is not finite": lambda self, o, r, d, t, i: (first(o, np.inf), r, d, t, i),
        "is not in": lambda self, o, r, d, t, i: (first(o, np.nan), r, d, t, i),
        "info": lambda self, o, r, d, t, i: (o, r, d, t, {**i, "x_position": np.inf}),
        "ZeroDivisionError: boom": fail,
        "not terminated": lambda self, o, r, d, t, i: (o, r, False, t, {**i, "diverged": True}),
    }
    for words, change in changes.items():
        monkeypatch.setattr(LocomotionEnv, "step", spoilt(change))
        report = fuzz(QUICK[0], 5, backend="numpy", dt=0.05)
        assert report.problems
        assert words in report.problems[0]
        assert "gym.make('nhenv/SnakeboardForward-v0'" in report.problems[0]
        assert "env.step(" in report.problems[0]

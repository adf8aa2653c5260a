import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from scipy.stats import kstest

from mechanics.model import Model
from nhenv.sb3 import SB3VecEnv, make_sb3_vec_env
from training.wrappers import Clock, MovingStarts, ScaledReward

SNAKEBOARD, RACER = "nhenv/SnakeboardForward-v0", "nhenv/RollerRacerForward-v0"
ENERGY, ROWS = 40.0, 400


def _made(env_id, rows=ROWS, steps=10**9, offset=0.0, **arguments):
    envs = make_sb3_vec_env(env_id, rows, staggered=False, seed=0, whole_state=True, **arguments)
    return MovingStarts(envs, ENERGY, offset, steps, seed=3)


def _inner(envs):
    return envs.venv.vector_env.unwrapped


@pytest.mark.parametrize("env_id", [SNAKEBOARD, RACER])
def test_first_episodes_begin_in_motion(env_id):
    envs = _made(env_id, drag=True)
    observations, inner = envs.reset(), _inner(envs)
    # The seed is fixed, so a p-value says how lucky it is, once and for all.
    assert kstest(inner.energy, "uniform", (0, ENERGY)).pvalue > 0.01
    assert kstest(inner.q[:, 2], "uniform", (-np.pi, 2 * np.pi)).pvalue > 0.01
    assert (inner.q[:, :2] == 0).all()
    for joint, stop in inner.joint_limits.items():
        place = inner.mechanism.coordinates.index(joint)
        assert kstest(inner.q[:, place], "uniform", (-stop, 2 * stop)).pvalue > 0.01
        assert np.abs(inner.qdot[:, place]).max() < 1e-12  # a solve of a few terms of order one
    residual = Model(inner.mechanism, inner.params).constraint_residual(inner.q, inner.qdot)
    assert np.abs(residual).max() < 1e-12
    # What is seen is this state and not the one at rest.
    speed = inner.observation_labels.index("speed")
    ahead = np.cos(inner.q[:, 2]) * inner.qdot[:, 0] + np.sin(inner.q[:, 2]) * inner.qdot[:, 1]
    assert observations[:, speed] == pytest.approx(ahead, rel=1e-6, abs=1e-6)  # float32
    assert np.abs(ahead).max() > 1


def test_a_seed_has_starts_of_its_own():
    def starts(seed):
        envs = MovingStarts(make_sb3_vec_env(SNAKEBOARD, 3, seed=0, whole_state=True), ENERGY, 0.0, 10**9, seed)
        envs.reset()
        return _inner(envs).q[:, 2], _inner(envs).energy

    first, again, other = (starts(seed) for seed in (1, 1, 2))
    np.testing.assert_array_equal(first, again)
    assert (np.array(first) != other).all()


def test_episodes_begin_away_from_where_their_targets_were_drawn():
    envs = _made("nhenv/SnakeboardTurn-v0", offset=0.5)
    observations, inner = envs.reset(), _inner(envs)
    assert kstest(inner.q[:, :2].ravel(), "uniform", (-0.5, 1.0)).pvalue > 0.01
    assert all((inner.targets[name] == 0).all() for name in ("start_x", "start_y"))
    turn = np.abs(inner.targets["target_heading"] - inner.q[:, 2])
    assert kstest(turn, "uniform", (np.pi / 4, 3 * np.pi / 4)).pvalue > 0.01
    # What is seen is this place and not the origin: start_ahead and start_left.
    seen = [inner.observation_labels.index(f"start_{way}") for way in ("ahead", "left")]
    away = np.hypot(*inner.q[:, :2].T)
    assert np.hypot(*observations[:, seen].T) == pytest.approx(away, rel=1e-6)  # float32
    assert kstest(inner.energy, "uniform", (0, ENERGY)).pvalue > 0.01


def test_ever_fewer_begin_in_motion_and_at_last_none():
    envs = _made(SNAKEBOARD, steps=ROWS * 900)
    envs.reset()
    shares = []
    for step in range(1, 1201):
        _, _, dones, _ = envs.step(np.zeros((ROWS, 2), np.float32))
        if dones.any():
            assert dones.all()
            assert step % 300 == 0
            shares.append((_inner(envs).energy > 0).mean())
    # Thrown like coins: a deviation of 0.025.
    assert shares[:2] == pytest.approx([2 / 3, 1 / 3], abs=0.08)
    assert shares[2:] == [0, 0]


def test_rows_whose_episodes_go_on_do_so():
    """Nothing drives them, so that they keep their energy, while others begin anew."""
    envs = MovingStarts(make_sb3_vec_env(SNAKEBOARD, 50, seed=2, whole_state=True), ENERGY, 0.0, 10**9, seed=3)
    envs.reset()
    inner, begun = _inner(envs), 0
    for _ in range(40):
        energy, elapsed = inner.energy, inner.elapsed_steps
        _, _, dones, _ = envs.step(np.zeros((50, 2), np.float32))
        np.testing.assert_allclose(inner.energy[~dones], energy[~dones], rtol=1e-6)  # 40 steps of 1e-10 each
        assert (inner.elapsed_steps == np.where(dones, 0, elapsed + 1)).all()
        assert (inner.energy[dones] != energy[dones]).all()
        begun += dones.sum()
    assert begun > 2


def test_a_row_at_rest_is_left_alone():
    """It begins as if there were no curriculum."""
    envs = _made(SNAKEBOARD, 20, steps=20)
    plain = make_sb3_vec_env(SNAKEBOARD, 20, staggered=False, whole_state=True)
    envs.taken = 10  # half of them
    for each in (envs, plain):
        each.seed(5)
    moved = (envs.reset() != plain.reset()).any(axis=1)
    assert 0 < moved.sum() < 20
    inner, bare = _inner(envs), plain.vector_env.unwrapped
    assert np.array_equal(inner.q[~moved], bare.q[~moved])
    assert (inner.energy[~moved] == 0).all()


def test_rewards_are_scaled_and_nothing_else():
    envs, plain = (make_sb3_vec_env(SNAKEBOARD, 3, seed=1) for _ in range(2))
    scaled = ScaledReward(envs, 0.25)
    assert np.array_equal(scaled.reset(), plain.reset())
    for _ in range(30):
        first, second = (each.step(np.full((3, 2), 0.7, np.float32)) for each in (scaled, plain))
        assert np.array_equal(first[0], second[0])
        assert np.array_equal(first[1], 0.25 * second[1])  # a power of two
        assert np.array_equal(first[2], second[2])
    assert (first[1] != 0).all()


def test_the_clock_shows_the_time_and_makes_the_limit_an_end():
    envs, plain = (make_sb3_vec_env(SNAKEBOARD, 5, seed=1) for _ in range(2))  # out of phase at first
    clocked = Clock(ScaledReward(envs, 1.0))
    seen, bare = clocked.reset(), plain.reset()
    assert clocked.observation_space.contains(seen[0])
    over = 150 * (1 + seen[:, -1])
    assert len(set(over)) == 5
    ended = 0
    for _ in range(350):
        (seen, *_, infos), (bare, _, dones, told) = (
            each.step(np.full((5, 2), 0.3, np.float32)) for each in (clocked, plain)
        )
        over = np.where(dones, 0, over + 1)
        assert np.array_equal(seen[:, :-1], bare)
        assert seen[:, -1] == pytest.approx(over / 150 - 1, abs=1e-6)  # float32
        for row in np.flatnonzero(dones):
            assert told[row]["TimeLimit.truncated"]
            assert not infos[row]["TimeLimit.truncated"]
            ended += 1
    assert ended >= 5


def test_a_clock_needs_a_limit():
    envs = make_sb3_vec_env(SNAKEBOARD, 1, staggered=False, max_episode_steps=None)
    envs.vector_env.unwrapped.max_episode_steps = None
    with pytest.raises(ValueError, match="without max_episode_steps"):
        Clock(envs)


def test_other_environments_are_refused():
    envs = SyncVectorEnv([lambda: gym.make(SNAKEBOARD)], autoreset_mode=AutoresetMode.SAME_STEP)
    with pytest.raises(TypeError, match="only native environments can begin in motion"):
        MovingStarts(SB3VecEnv(envs), 1.0, 0.0, 1, 0)
    with pytest.raises(TypeError, match="only native environments can tell the time"):
        Clock(SB3VecEnv(envs))

"""What every registered environment promises to Gymnasium, Stable-Baselines3 and their users."""

import copy
import inspect
import pickle
import re
import warnings

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env as gymnasium_check
from stable_baselines3.common.env_checker import check_env as sb3_check

import mechanics
import nhenv
from mechanics.model import Model
from nhenv.configuration import Configuration
from nhenv.env import LocomotionEnv
from nhenv.vector_env import LocomotionVectorEnv

STEPS = 300  # of an episode, as registered
# The same in every step, unless the goal is reached.
CONSTANT_TERMS = {"reward_time", "reward_goal"}


def _reasons(caught):
    """Messages of warnings that are more than advice about infinite bounds."""
    messages = [str(warning.message) for warning in caught]
    return [text for text in messages if not re.search("m..imum value is -?infinity", text)]


def _same(first, second):
    """Whether two values are equal bit for bit, in type and in content."""
    if isinstance(first, np.ndarray):
        return first.dtype == second.dtype and first.shape == second.shape and first.tobytes() == second.tobytes()
    if isinstance(first, dict):
        return first.keys() == second.keys() and all(_same(first[key], second[key]) for key in first)
    if isinstance(first, tuple):
        return len(first) == len(second) and all(map(_same, first, second))
    return type(first) is type(second) and first == second


# -- the checkers -------------------------------------------------------------------------------


def test_every_mechanism_has_an_environment_for_every_task():
    everywhere = sum(not task.any_pose for task in nhenv.TASKS)
    most, some = len(mechanics.names(in_the_plane=True)), len(mechanics.names(any_pose=True))
    assert len(nhenv.environment_ids()) == most * everywhere + some * (len(nhenv.TASKS) - everywhere)
    assert set(nhenv.environment_ids()) == {name for name in gym.registry if name.startswith("nhenv/")}


def test_the_catalogue_says_rightly_what_moves_in_the_plane():
    """It says so to save time on import."""
    fit = [m.name for m in map(mechanics.get, mechanics.names()) if m.fibre and m.controls]
    assert sorted(mechanics.names(in_the_plane=True)) == sorted(fit)


def test_gymnasium_checker(env_id, make):
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        gymnasium_check(make(env_id).unwrapped)
    assert _reasons(caught) == []


def test_stable_baselines3_checker(env_id, make):
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        sb3_check(make(env_id))
    assert _reasons(caught) == []


def test_make_by_module_and_id(env_id, make):
    assert isinstance(make(f"nhenv:{env_id}").unwrapped, LocomotionEnv)


@pytest.mark.parametrize("face", [LocomotionEnv, LocomotionVectorEnv])
def test_signatures_show_every_argument(face):
    """Those that are passed on too, with their defaults, and the docstring names those that are new."""
    shown = inspect.signature(face).parameters
    for name, passed_on in inspect.signature(Configuration).parameters.items():
        assert (shown[name].default, shown[name].kind) == (passed_on.default, passed_on.kind)
    explained = inspect.getdoc(LocomotionEnv) + inspect.getdoc(face)
    assert all(f"\n    {name}: " in explained for name in shown.keys() - {"weights"})


def test_a_mechanism_of_the_users_own_needs_no_registration(actions):
    """The class takes the object itself, and behaves as the registered id of the same data does."""
    mechanism = mechanics.Mechanism.from_dict(mechanics.get("snakeboard").to_dict())
    env = LocomotionEnv(mechanism, nhenv.TASKS[0])
    env.reset(seed=0)
    other = LocomotionEnv("snakeboard")
    other.reset(seed=0)
    action = actions(env, 1)[0]
    assert _same(env.step(action), other.step(action))


def test_vectorised_by_gymnasium(env_id, actions, backend):
    """`gym.make_vec` steps copies of the environment; row 1 is the environment with the next seed."""
    vector = gym.make_vec(env_id, num_envs=2, vectorization_mode="sync", **backend(env_id))
    single = gym.make(env_id, **backend(env_id))
    try:
        observations, infos = vector.reset(seed=5)
        expected, info = single.reset(seed=6)
        assert _same(observations[1], expected)
        assert {key: infos[key][1] for key in info} == info
        for action in actions(single, 5):
            observations, rewards, *_, infos = vector.step(np.stack([-action, action]))
            expected, reward, *_, info = single.step(action)
            assert _same(observations[1], expected)
            assert rewards[1] == reward
            assert {key: infos[key][1] for key in info} == info
    finally:
        vector.close()
        single.close()


# -- determinism --------------------------------------------------------------------------------


def test_same_seed_same_trajectory(env_id, make, actions, rollout):
    env, other = make(env_id), make(env_id)
    acts = actions(env, 50)
    first, again, elsewhere = rollout(env, acts), rollout(env, acts), rollout(other, acts)
    for trajectory in (again, elsewhere):
        assert _same(first[0], trajectory[0])
        assert _same(first[1], trajectory[1])
        assert all(map(_same, first[2], trajectory[2]))


def test_another_seed_another_trajectory(env_id, make, actions, rollout):
    env = make(env_id)
    acts = actions(env, 20)
    first, second = rollout(env, acts, seed=0), rollout(env, acts, seed=1)
    assert (first[0][0] != second[0][0]).any()
    assert (first[1] != second[1]).all()


def test_a_reset_without_seed_draws_on(env_id, make):
    env = make(env_id)
    drawn = [env.reset(seed=0)[0], env.reset()[0], env.reset()[0]]
    again = [env.reset(seed=0)[0], env.reset()[0], env.reset()[0]]
    assert all(map(_same, drawn, again))
    assert (drawn[0] != drawn[1]).any()
    assert (drawn[1] != drawn[2]).any()


@pytest.mark.parametrize("scale", [0.05, 0.2, 0.0])
def test_reset_is_random_within_the_noise_scale(env_id, bare, scale):
    """Joints with stops, or else the heading, are uniform in ±scale; everything else is at rest at the origin."""
    env = bare(env_id, reset_noise_scale=scale)
    assert inspect.signature(LocomotionEnv).parameters["reset_noise_scale"].default == 0.05
    names = env.mechanism.joint_limits or env.mechanism.fibre[2:]
    joints = [env.mechanism.coordinates.index(name) for name in names]
    others = [i for i in range(env.mechanism.n) if i not in joints]
    starts = []
    for seed in range(40):
        env.reset(seed=seed)
        starts.append(env.q)
        assert not env.v.any()
    starts = np.array(starts)
    assert not starts[:, others].any()
    assert (np.abs(starts[:, joints]) <= scale).all()
    if scale:
        # 40 uniform draws leave the outer tenth on a side empty with probability 0.95^40 = 0.13; the outer half, 1e-5.
        assert (starts[:, joints].max(axis=0) > scale / 2).all()
        assert (starts[:, joints].min(axis=0) < -scale / 2).all()


# -- what comes back ----------------------------------------------------------------------------


def test_types(env_id, make, actions):
    env = make(env_id)
    observation, info = env.reset(seed=0)
    assert observation.dtype == np.float32
    assert info == env.unwrapped.targets
    assert all(type(value) is float for value in info.values())
    assert env.observation_space.contains(observation)
    for action in actions(env, 5):
        observation, reward, terminated, truncated, info = env.step(action)
        assert type(observation) is np.ndarray
        assert observation.dtype == np.float32
        assert type(reward) is float
        assert type(terminated) is bool
        assert type(truncated) is bool
        assert all(type(value) is float for value in info.values())
        assert env.observation_space.contains(observation)


def test_what_is_returned_is_fresh(env_id, make, actions):
    """No two observations share memory, no two infos are the same object, and none changes later."""
    env = make(env_id)
    observation, info = env.reset(seed=0)
    kept, infos = [observation], [info]
    copies = [observation.copy()]
    for action in actions(env, 20):
        observation, *_, info = env.step(action)
        kept.append(observation)
        copies.append(observation.copy())
        infos.append(info)
    observation, info = env.reset()
    kept.append(observation)
    copies.append(observation.copy())
    infos.append(info)
    assert len({id(info) for info in infos}) == len(infos)
    for i, first in enumerate(kept):
        assert not any(np.shares_memory(first, second) for second in kept[:i])
    assert all(map(_same, kept, copies))


def test_arguments_are_not_changed(env_id, make):
    """Neither an action that is clipped nor the options of a reset."""
    env = make(env_id)
    options = {"q": np.zeros(env.unwrapped.mechanism.n), "qdot": np.zeros(env.unwrapped.mechanism.n)}
    given = {key: value.copy() for key, value in options.items()}
    env.reset(seed=0, options=options)
    action = np.full(env.action_space.shape, 3, np.float32)
    env.step(action)
    assert (action == 3).all()
    assert _same(options, given)
    env.unwrapped.q[:] = np.nan
    assert np.isfinite(env.unwrapped.q).all()


def test_every_observation_moves(env_id, make, actions, rollout):
    """An element that is constant, but for what the task has drawn, would be a mistake in a task or a mechanism."""
    env = make(env_id)
    observations, _, _ = rollout(env, actions(env, STEPS))
    labels, targets = env.unwrapped.observation_labels, env.unwrapped.targets
    assert observations.shape[1] == len(labels) == len(set(labels))
    moving = dict(zip(labels, np.ptp(observations, axis=0), strict=True))
    # The slowest of the snakeboard and the racer, the cosine of the heading, changes by 1e-2; rounding by 1e-7.
    assert not [name for name, change in moving.items() if not change > 1e-4 and name not in targets]
    assert all(moving[name] == 0 for name in targets if name in moving)


def test_every_action_matters(env_id, make):
    """Each control changes the next observation on its own."""
    env = make(env_id)
    env.reset(seed=0)
    nothing = env.step(np.zeros(env.action_space.shape, np.float32))[0]
    for i in range(env.action_space.shape[0]):
        env.reset(seed=0)
        action = np.zeros(env.action_space.shape, np.float32)
        action[i] = 1
        assert np.abs(env.step(action)[0] - nothing).max() > 1e-3


def test_reward_terms_sum_to_the_reward(env_id, make, actions, rollout):
    env = make(env_id)
    _, rewards, infos = rollout(env, actions(env, 50))
    terms = [[value for key, value in info.items() if key.startswith("reward_")] for info in infos]
    # The same two numbers added in the same order: equal, not close.
    assert [sum(row) for row in terms] == rewards.tolist()
    names = [key for key in infos[0] if key.startswith("reward_")]
    constant = {name for name, column in zip(names, zip(*terms, strict=True), strict=True) if len(set(column)) == 1}
    assert constant == CONSTANT_TERMS & set(names)


def test_reward_of_the_forward_task(make, actions):
    """The documented formula, from what can be seen outside: x of env.q, the action, dt."""
    for env_id in ("nhenv/SnakeboardForward-v0", "nhenv/RollerRacerForward-v0"):
        env = make(env_id, forward_reward_weight=2.5, ctrl_cost_weight=0.3, dt=0.04)
        env.reset(seed=0)
        bare = env.unwrapped
        p = bare.params
        way = 1.0 if bare.mechanism.name == "snakeboard" else np.sign(p["l_1"] * p["I_2"] - p["l_2"] * p["I_1"])
        before = bare.q[0]
        for action in actions(env, 10):
            _, _, _, _, info = env.step(action)
            after = bare.q[0]
            # x is of the order 1e-3 to 1e-1 and dt is 0.04: roundings of 1e-17 grow to 1e-15.
            assert info["reward_forward"] == pytest.approx(2.5 * way * (after - before) / 0.04, rel=1e-12, abs=1e-14)
            assert info["reward_ctrl"] == pytest.approx(-0.3 * np.mean(action.astype(float) ** 2), rel=1e-14)
            assert info["x_position"] == after
            assert info["x_velocity"] == pytest.approx((after - before) / 0.04, rel=1e-12, abs=1e-14)
            before = after


def test_actions_are_clipped_before_dynamics_and_cost(env_id, make, rollout):
    env = make(env_id)
    huge = np.full((5, *env.action_space.shape), 1e9, np.float32)
    for sign in (1, -1):
        large, one = rollout(env, sign * huge), rollout(env, np.sign(sign * huge))
        assert _same(large[0], one[0])
        assert _same(large[1], one[1])
        assert all(map(_same, large[2], one[2]))
    half = rollout(env, 0.5 * np.sign(huge))
    assert (half[1] != one[1]).all()
    assert _same(rollout(env, np.inf * huge)[0], rollout(env, huge)[0])


def test_truncated_by_the_time_limit_only(env_id, make, actions):
    env = make(env_id)
    env.reset(seed=0)
    steps = env.spec.max_episode_steps
    assert steps == env.unwrapped.task.max_episode_steps
    flags = [env.step(action)[2:4] for action in actions(env, steps)]
    assert flags == [(False, False)] * (steps - 1) + [(False, True)]
    env.reset()
    assert env.step(actions(env, 1)[0])[2:4] == (False, False)


def test_close_is_idempotent(env_id, make):
    env = make(env_id)
    env.reset(seed=0)
    env.close()
    env.close()
    env.unwrapped.close()


# -- copies -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "duplicate", [lambda env: pickle.loads(pickle.dumps(env)), copy.deepcopy], ids=["pickle", "deepcopy"]
)
@pytest.mark.parametrize("looked", [False, True], ids=["blind", "looked"])
def test_a_copy_made_mid_episode_goes_on_identically(env_id, make, actions, duplicate, looked):
    """State, generator and what env.q is worked out from all travel; the original is not disturbed."""
    env = make(env_id)
    env.reset(seed=11)
    acts = actions(env, 60)
    for action in acts[:30]:
        env.step(action)
    if looked:  # env.q makes things that must not be lost, nor shared with the copy
        assert np.isfinite(env.unwrapped.q).all()
    twin = duplicate(env)
    assert _same(twin.unwrapped.q, env.unwrapped.q)
    expected = [env.step(action) for action in acts[30:]]
    state = env.unwrapped.q, env.unwrapped.qdot, env.unwrapped.v, env.unwrapped.energy
    assert all(map(_same, [twin.step(action) for action in acts[30:]], expected))
    assert _same((twin.unwrapped.q, twin.unwrapped.qdot, twin.unwrapped.v, twin.unwrapped.energy), state)
    assert twin.unwrapped.np_random.bit_generator.state == env.unwrapped.np_random.bit_generator.state
    assert _same(twin.reset(), env.reset())
    assert twin.unwrapped.np_random.bit_generator.state == env.unwrapped.np_random.bit_generator.state


def test_a_copy_made_before_reset_still_wants_one(env_id, bare):
    twin = pickle.loads(pickle.dumps(bare(env_id)))
    with pytest.raises(gym.error.ResetNeeded):
        twin.step(np.zeros(twin.action_space.shape, np.float32))
    twin.reset(seed=0)
    twin.step(np.zeros(twin.action_space.shape, np.float32))


# -- the state behind the observation -----------------------------------------------------------


def test_state_agrees_with_the_model(env_id, bare, actions):
    """Position, velocities, energy and observation tell one story, and the wheels do not slip."""
    env = bare(env_id)
    env.reset(seed=0)
    model = Model(env.mechanism, env.params)
    for action in actions(env, 100):
        observation, *_, info = env.step(action)
        q, qdot, v = env.q, env.qdot, env.v
        assert q.shape == qdot.shape == (env.mechanism.n,)
        assert v.shape == (env.mechanism.rank,)
        # Rounding of sums of a few terms of size 10.
        assert np.abs(model.constraint_residual(q, qdot)).max(initial=0) < 1e-12
        assert np.array_equal(qdot, model.velocity(q, v))
        assert model.project(q, qdot) == pytest.approx(v, rel=1e-12, abs=1e-12)
        values = {**env.params, **dict(zip(env.mechanism.coordinates, q, strict=True))}
        inertia = env.mechanism.numeric(env.mechanism.inertia, values)
        energy = 0.5 * qdot @ inertia @ qdot + env.mechanism.numeric((env.mechanism.potential,), values)[0]
        assert env.energy == pytest.approx(energy, rel=1e-12, abs=1e-14)  # not by the model
        assert type(env.energy) is float
        places = [env.mechanism.coordinates.index(name) for name in env.mechanism.fibre]
        told = {
            "x_position": q[places[0]],
            "y_position": q[places[1]],
            "cos_heading": np.cos(q[places[2]]),
            "sin_heading": np.sin(q[places[2]]),
        }
        assert all(info[name] == told[name] for name in info.keys() & told.keys())
        seen = dict(zip(env.observation_labels, observation, strict=True))
        for name in seen.keys() & told.keys():
            assert seen[name] == pytest.approx(told[name], abs=1e-7)  # float32 rounds to 6e-8


@pytest.mark.parametrize(
    ("env_id", "columns"),
    [
        ("nhenv/SnakeboardForward-v0", {"phi": 1.2, "phi_dot": 10, "psi_dot": 10, "speed": 1}),
        ("nhenv/RollerRacerForward-v0", {"psi": 1.2, "psi_dot": 10, "speed": 1}),
    ],
)
def test_observation_is_as_documented(env_id, columns, bare, actions):
    env = bare(env_id)
    env.reset(options={"q": np.linspace(-0.9, 0.7, env.mechanism.n)})  # away from the origin, with a heading
    for action in actions(env, 20):
        observation = env.step(action)[0]
        q, qdot = (dict(zip(env.mechanism.coordinates, values, strict=True)) for values in (env.q, env.qdot))
        seen = {**q, **{f"{name}_dot": rate for name, rate in qdot.items()}}
        seen["speed"] = np.cos(q["theta"]) * qdot["x"] + np.sin(q["theta"]) * qdot["y"]
        expected = [seen[name] / unit for name, unit in columns.items()]
        # float32 rounds to 6e-8 of the value.
        assert observation[: len(columns)] == pytest.approx(expected, rel=2e-7, abs=1e-9)


def test_looking_at_the_state_changes_nothing(env_id, make, actions, rollout):
    blind, seen = make(env_id), make(env_id)
    acts = actions(blind, 50)
    expected = rollout(blind, acts)
    observations = [seen.reset(seed=3)[0]]
    for action in acts:
        bare = seen.unwrapped
        assert all(np.isfinite(value).all() for value in (bare.q, bare.qdot, bare.v, bare.energy))
        observations.append(seen.step(action)[0])
    assert _same(np.array(observations), expected[0])
    assert _same(seen.unwrapped.q, blind.unwrapped.q)
    assert _same(seen.unwrapped.v, blind.unwrapped.v)


def test_a_new_episode_forgets_the_last(env_id, bare, actions):
    """What was remembered to work out env.q does not leak into the next episode."""
    env, fresh = bare(env_id), bare(env_id)
    acts = actions(env, 8)
    env.reset(seed=1)
    for action in acts:
        env.step(action)
        assert np.isfinite(env.q).all()
    for twin in (env, fresh):
        twin.reset(seed=2)
        for action in acts[:6]:
            twin.step(action)
    assert _same(env.q, fresh.q)
    assert _same(env.v, fresh.v)


def test_state_is_known_after_any_number_of_steps(env_id, bare, actions):
    """The kernel remembers 512 actions for coordinates that it leaves out; an episode may be longer.

    One environment is looked at once at the end, one at every step, and one starts half-way, so that its memory
    fills up at another time.
    """
    late, always, fresh = bare(env_id), bare(env_id), bare(env_id)
    acts = actions(late, 1100)
    late.reset(seed=0)
    always.reset(seed=0)
    for i, action in enumerate(acts):
        late.step(action)
        always.step(action)
        assert np.isfinite(always.q).all()
        if i == 499:
            fresh.reset(options={"q": always.q, "qdot": always.qdot})
        elif i >= 500 and i < 600:
            fresh.step(action)
            # v from q̇ rounds by 1e-15 of its size; a hundred random steps amplify that by less than 1e3.
            assert always.q == pytest.approx(fresh.q, rel=1e-11, abs=1e-11)
    assert _same(late.q, always.q)
    assert _same(late.v, always.v)


def test_a_start_may_be_given(env_id, bare):
    """The state right after reset is the one asked for, and the seed does not matter to it."""
    env = bare(env_id)
    limits = [env.mechanism.joint_limits.get(name, 2.0) for name in env.mechanism.coordinates]
    q = np.clip(np.linspace(-0.5, 0.9, env.mechanism.n), -0.8 * np.array(limits), 0.8 * np.array(limits))
    env.reset(seed=0)
    v = np.linspace(0.3, -0.7, env.mechanism.rank)
    qdot = Model(env.mechanism).velocity(q, v)
    first, info = env.reset(seed=1, options={"q": q, "qdot": qdot})
    assert np.array_equal(env.q, q)
    assert env.v == pytest.approx(v, rel=1e-13)  # rounding of a projection
    second, _ = env.reset(seed=2, options={"q": q.tolist(), "qdot": qdot.tolist(), "target": info})
    assert _same(first, second)


def test_dt_and_torque_limits_are_what_they_say(env_id, bare):
    """Half the torque limit at full action is the full limit at half action; two holds of dt/2 are one of dt."""
    env, weak, fast = bare(env_id), bare(env_id, torque_limits=0.05), bare(env_id, dt=0.01, torque_limits=0.1)
    q = np.full(env.mechanism.n, 0.1)
    assert (weak.torque_limits == 0.05).all()
    assert env.torque_limits.tolist() == [env.mechanism.torque_limits[name] for name in env.mechanism.controls]
    slow = bare(env_id, dt=0.02, torque_limits=0.1)
    half, one = np.full(env.action_space.shape, 0.5, np.float32), np.ones(env.action_space.shape, np.float32)
    weak = bare(env_id, dt=0.02, torque_limits=0.05)
    for other in (slow, weak, fast):
        other.reset(options={"q": q})
    slow.step(half)
    weak.step(one)
    fast.step(half)
    fast.step(half)
    assert np.array_equal(slow.q, weak.q)
    # One step of order 8 against two: the error of a step of 0.02 s.
    assert slow.q == pytest.approx(fast.q, rel=1e-12, abs=1e-13)
    assert slow.v == pytest.approx(fast.v, rel=1e-12, abs=1e-13)

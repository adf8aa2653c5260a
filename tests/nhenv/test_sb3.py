"""The environments for Stable-Baselines3, against its own `DummyVecEnv` of the same single environments."""

import pickle
import sys
from functools import partial

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium.error import DependencyNotInstalled
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.wrappers import TimeLimit
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecCheckNan, VecFrameStack, VecMonitor, VecNormalize

from nhenv.sb3 import SB3VecEnv, make_sb3_vec_env
from nhenv.vector_env import LocomotionVectorEnv

FORWARD, GOAL = "nhenv/SnakeboardForward-v0", "nhenv/RollerRacerGoal-v0"

# Episodes that end in every way. A goal this large is reached now and then by random actions, sometimes in one step.
BY_TIME = (FORWARD, {"max_episode_steps": 40})
BY_BOTH = (GOAL, {"max_episode_steps": 40, "goal_radius": 1.3})
AT_ONCE = (GOAL, {"max_episode_steps": 1, "goal_radius": 4.0})  # terminated and out of time in the same step


def made(env_id, n_envs, **kwargs):
    return make_sb3_vec_env(env_id, n_envs, staggered=False, **kwargs)


def on_sync(env_id, n_envs, **kwargs):
    return SB3VecEnv(
        gym.make_vec(env_id, n_envs, "sync", vector_kwargs={"autoreset_mode": AutoresetMode.SAME_STEP}, **kwargs)
    )


@pytest.fixture(params=[made, on_sync])
def contender(request):
    """What makes environments without staggering: the function, and Gymnasium's vector environment in the adapter."""
    return request.param


def dummy(env_id, n_envs, **kwargs):
    return DummyVecEnv([partial(gym.make, env_id, **kwargs)] * n_envs)


class CutOnce(gym.Wrapper):
    """Ends the first episode at a given step: what staggering does to a row, said in another way."""

    def __init__(self, env, steps):
        super().__init__(env)
        self.left = steps

    def step(self, action):
        observation, reward, terminated, truncated, info = self.env.step(action)
        self.left -= 1
        if terminated or truncated:
            self.left = -1
        return observation, reward, terminated, truncated or self.left == 0, info


def cut_dummy(env_id, steps, **kwargs):
    return DummyVecEnv([lambda steps=steps: CutOnce(gym.make(env_id, **kwargs), steps) for steps in steps])


def draw(env, steps, seed=0):
    """Actions at the limits, shape (steps, n_envs, m), float32: they go furthest."""
    shape = (steps, env.num_envs, *env.action_space.shape)
    return np.sign(np.random.default_rng(seed).uniform(-1, 1, shape)).astype(np.float32)


def same_info(ours, theirs):
    assert ours.keys() == theirs.keys()
    for key, value in ours.items():
        assert type(value) is type(theirs[key]), key
        np.testing.assert_array_equal(value, theirs[key])
        if isinstance(value, np.ndarray):
            assert value.dtype == theirs[key].dtype


def same_step(ours, theirs):
    """Equal to the last bit; of rows that go on, infos may say less, but nothing else."""
    for mine, other in zip(ours[:3], theirs[:3], strict=True):
        assert mine.dtype == other.dtype
        np.testing.assert_array_equal(mine, other)
    for done, mine, other in zip(theirs[2], ours[3], theirs[3], strict=True):
        if done:
            same_info(*({k: v for k, v in info.items() if k != "episode"} for info in (mine, other)))
        else:
            assert mine.items() <= other.items()


def same_course(ours, theirs, steps, seed=0):
    """Reset and step both; return how often an episode ended, by whether it was truncated."""
    start, other = ours.reset(), theirs.reset()
    assert start.dtype == other.dtype
    np.testing.assert_array_equal(start, other)
    assert ours.unwrapped.reset_infos == theirs.unwrapped.reset_infos
    return same_steps(ours, theirs, draw(ours, steps, seed))


def same_steps(ours, theirs, actions):
    ends = {True: 0, False: 0}
    for action in actions:
        result = ours.step(action)
        same_step(result, theirs.step(action))
        assert ours.unwrapped.reset_infos == theirs.unwrapped.reset_infos
        for i in np.flatnonzero(result[2]):
            ends[result[3][i]["TimeLimit.truncated"]] += 1
    return ends


def test_environments_of_this_package_are_stepped_together():
    assert type(made(FORWARD, 2).vector_env) is LocomotionVectorEnv
    # CartPole's own vector environment does not reset in the same step.
    other = made("CartPole-v1", 2)
    assert type(other.vector_env) is SyncVectorEnv
    assert other.spec.id == "CartPole-v1"


# -- the same as DummyVecEnv -----------------------------------------------------------------------


@pytest.mark.parametrize(("env_id", "kwargs"), [BY_TIME, BY_BOTH, AT_ONCE])
def test_course_equals_that_of_single_environments(contender, env_id, kwargs):
    ours, theirs = contender(env_id, 5, **kwargs), dummy(env_id, 5, **kwargs)
    ours.seed(7), theirs.seed(7)
    truncated, terminated = same_course(ours, theirs, 1100).values()
    assert (truncated > 100) == (kwargs != AT_ONCE[1])
    assert (terminated > 10) == (env_id == GOAL)
    assert ours.observation_space == theirs.observation_space
    assert ours.action_space == theirs.action_space


@pytest.mark.parametrize("env_id", [FORWARD, GOAL])
def test_one_environment_over_the_registered_time_limit(contender, env_id):
    ours, theirs = contender(env_id, 1), dummy(env_id, 1)
    ours.seed(0), theirs.seed(0)
    assert sum(same_course(ours, theirs, 610).values()) >= 2


@pytest.mark.parametrize("contender", [partial(made, info="all"), on_sync])
def test_details_asked_for_of_every_step_are_those_of_single_environments(contender):
    env_id, kwargs = BY_BOTH
    ours, theirs = contender(env_id, 3, **kwargs), dummy(env_id, 3, **kwargs)
    ours.seed(0), theirs.seed(0)
    ours.reset(), theirs.reset()
    for action in draw(ours, 100):
        for mine, other in zip(ours.step(action)[3], theirs.step(action)[3], strict=True):
            same_info({"TimeLimit.truncated": False} | mine, other)


def test_what_is_returned_is_the_callers(contender):
    def deface(observations, rewards, dones, infos):
        observations[...], rewards[...], dones[...] = np.nan, np.nan, True
        for info in infos:
            if "terminal_observation" in info:
                info["terminal_observation"][...] = np.nan
            info["mine"] = "mine"

    env_id, kwargs = BY_BOTH
    ours, theirs = contender(env_id, 4, **kwargs), dummy(env_id, 4, **kwargs)
    ours.seed(0), theirs.seed(0)
    ours.reset()[...] = np.nan
    theirs.reset()
    for action in draw(ours, 200):
        result = ours.step(action)
        same_step(result, theirs.step(action))
        deface(*result)


def test_a_vector_environment_that_reuses_its_arrays_is_copied():
    make = [partial(gym.make, FORWARD, max_episode_steps=20)] * 3
    ours = SB3VecEnv(SyncVectorEnv(make, copy=False, autoreset_mode="SameStep"), longest_first_episode=20)
    ours.seed(0)
    kept = [ours.reset()]
    copies = [kept[0].copy()]
    for action in draw(ours, 50):
        observations, _, _, infos = ours.step(action)
        kept += [observations, *(info["terminal_observation"] for info in infos if "terminal_observation" in info)]
        copies += [array.copy() for array in kept[len(copies) :]]
    assert len(kept) > 51
    for array, copy in zip(kept, copies, strict=True):
        np.testing.assert_array_equal(array, copy)


# -- resets ----------------------------------------------------------------------------------------


def test_seeds_are_used_once_and_count_up_from_the_first(contender):
    first = contender(FORWARD, 3)
    first.seed(5)
    starts = first.reset()
    singles = [gym.make(FORWARD).reset(seed=seed)[0] for seed in (5, 6, 7)]
    np.testing.assert_array_equal(starts, singles)
    assert not np.array_equal(first.reset(), starts)
    np.testing.assert_array_equal(make_sb3_vec_env(FORWARD, 3, 5).reset(), starts)
    assert not np.array_equal(contender(FORWARD, 3).reset(), contender(FORWARD, 3).reset())


def test_seeds_may_be_those_of_some_rows(contender):
    envs = contender(FORWARD, 3)
    envs.reset()
    envs._seeds = [None, 6, None]
    start = envs.reset()
    np.testing.assert_array_equal(start[1], gym.make(FORWARD).reset(seed=6)[0])
    assert not np.array_equal(envs.reset()[1], start[1])


@pytest.mark.parametrize("first", ["of all", "of each"])
@pytest.mark.parametrize("begun", [False, True])
def test_options_are_those_of_all_rows_or_of_each_and_used_once(contender, begun, first):
    ours, theirs = contender(GOAL, 4), dummy(GOAL, 4)
    ours.seed(3), theirs.seed(3)
    if begun:  # then the options meet rows whose generators have been used
        ours.reset(), theirs.reset()
    turned = {"q": np.array([0.0, 0.0, 1.0, 0.1])}
    aimed = {"target": {"goal_x": 1.5, "goal_y": -1.0}}
    both = [turned | aimed, [turned, {}, turned | aimed, aimed]]
    for options in both if first == "of all" else both[::-1]:
        ours.set_options(options), theirs.set_options(options)
        same_course(ours, theirs, 5)
        assert ours.reset_infos[3] == {"goal_x": 1.5, "goal_y": -1.0}
        same_course(ours, theirs, 5)
        assert ours.reset_infos[3] != {"goal_x": 1.5, "goal_y": -1.0}


# -- inside the wrappers of Stable-Baselines3 ------------------------------------------------------

WRAPPERS = {
    "monitor": partial(VecMonitor, info_keywords=("reward_ctrl", "is_success")),
    "normalize": VecNormalize,
    "stack": partial(VecFrameStack, n_stack=3),
    "nan": partial(VecCheckNan, raise_exception=True),
    "all": lambda env: VecFrameStack(VecNormalize(VecMonitor(VecCheckNan(env))), 2),
}


@pytest.mark.parametrize("wrapper", WRAPPERS)
def test_wrappers_give_the_same_on_top(contender, wrapper):
    env_id, kwargs = BY_BOTH
    ours, theirs = (WRAPPERS[wrapper](make(env_id, 3, **kwargs)) for make in (contender, dummy))
    ours.seed(1), theirs.seed(1)
    ours.reset(), theirs.reset()
    episodes = []
    for action in draw(ours, 200):
        result, other = ours.step(action), theirs.step(action)
        same_step(result, other)
        for mine, their in zip(result[3], other[3], strict=True):
            assert ("episode" in mine) == ("episode" in their)
            if "episode" in mine:
                episodes.append(mine["episode"])
                assert {**mine["episode"], "t": 0} == {**their["episode"], "t": 0}
    assert (len(episodes) > 10) == (wrapper in ("monitor", "all"))


def test_monitor_finds_its_keywords_where_first_episodes_are_cut():
    env_id, kwargs = BY_BOTH
    envs = make_sb3_vec_env(env_id, 20, seed=0, staggered=True, **kwargs)
    envs = VecMonitor(envs, info_keywords=("is_success",))
    envs.reset()
    episodes = []
    for action in draw(envs, 40):
        episodes += [info["episode"] for info in envs.step(action)[3] if "episode" in info]
    assert len(episodes) > 20
    assert {episode["is_success"] for episode in episodes} == {0.0, 1.0}


def test_policies_are_evaluated_the_same(contender):
    env_id, kwargs = BY_BOTH
    ours, theirs = contender(env_id, 3, **kwargs), dummy(env_id, 3, **kwargs)
    model = PPO("MlpPolicy", theirs, n_steps=8, batch_size=8, seed=0, device="cpu")
    results = []
    for env in (ours, theirs):
        env.seed(20)
        results.append(evaluate_policy(model, VecMonitor(env), n_eval_episodes=10, return_episode_rewards=True))
    assert len(results[0][0]) == 10
    assert results[0] == results[1]


def parameters(model):
    return torch.cat([value.flatten() for value in model.policy.parameters()]).detach().numpy()


def train_ppo(env):
    model = PPO("MlpPolicy", env, n_steps=64, batch_size=128, n_epochs=3, seed=11, device="cpu")
    return parameters(model.learn(4 * 8 * 64))


def test_ppo_learns_the_same_to_the_last_bit(contender):
    torch.set_num_threads(1)
    ours, theirs = (train_ppo(make(FORWARD, 8, max_episode_steps=50)) for make in (contender, dummy))
    np.testing.assert_array_equal(ours, theirs)
    assert np.isfinite(ours).all()
    # Bootstrapping at truncation counts: without it the outcome is another.
    assert not np.array_equal(ours, train_ppo(WithoutTimeouts(contender(FORWARD, 8, max_episode_steps=50))))


class WithoutTimeouts(VecCheckNan):
    def step_wait(self):
        observations, rewards, dones, infos = super().step_wait()
        return observations, rewards, dones, [info | {"TimeLimit.truncated": False} for info in infos]


def test_off_policy_algorithms_remember_the_same(contender):
    env_id, kwargs = BY_BOTH
    buffers = []
    for make in (contender, dummy):
        model = SAC(
            "MlpPolicy", make(env_id, 4, **kwargs), buffer_size=2000, learning_starts=2000, seed=2, device="cpu"
        )
        buffers.append(model.learn(1200).replay_buffer)
    ours, theirs = buffers
    for name in ("observations", "next_observations", "actions", "rewards", "dones", "timeouts"):
        np.testing.assert_array_equal(getattr(ours, name), getattr(theirs, name))
    assert ours.timeouts.sum() > 10
    assert (ours.dones > ours.timeouts).any()


# -- staggered first episodes ----------------------------------------------------------------------


def first_ends(envs, steps):
    """Step at which the first episode of each row ends, with zero actions; the environments are reset before."""
    envs.reset()
    ends = np.zeros(envs.num_envs, int)
    for step in range(1, steps + 1):
        dones = envs.step(np.zeros((envs.num_envs, *envs.action_space.shape), np.float32))[2]
        ends[dones & (ends == 0)] = step
    return ends.tolist()


def test_first_episodes_end_at_random_steps_and_later_ones_do_not():
    count, limit = 200, 50
    envs = make_sb3_vec_env(FORWARD, count, seed=0, staggered=True, max_episode_steps=limit)
    envs.reset()
    ends = [[] for _ in range(count)]
    for step in range(1, 2 * limit + 1):
        _, _, dones, infos = envs.step(np.zeros((count, 2), np.float32))
        for i in np.flatnonzero(dones):
            assert infos[i]["TimeLimit.truncated"]
            ends[i].append(step)
    first = np.array([times[0] for times in ends])
    assert first.min() >= 1
    assert first.max() <= limit
    # Uniform in 1 to 50: the mean of 200 is 25.5 with a deviation of 1.02, and all ten bins have some of 20 ± 4.2.
    assert abs(first.mean() - 25.5) < 4 * 1.02
    assert np.histogram(first, 10, (0.5, 50.5))[0].min() >= 20 - 4 * 4.2
    assert all(times[1] - times[0] == limit for times in ends if len(times) > 1)
    assert first_ends(made(FORWARD, 3, max_episode_steps=limit), limit) == [limit] * 3


def test_seed_decides_where_first_episodes_are_cut_and_every_reset_cuts_anew():
    envs = make_sb3_vec_env(FORWARD, 8, seed=4, max_episode_steps=30)
    cuts = first_ends(envs, 30)
    assert first_ends(make_sb3_vec_env(FORWARD, 8, seed=4, max_episode_steps=30), 30) == cuts
    assert first_ends(make_sb3_vec_env(FORWARD, 8, seed=5, max_episode_steps=30), 30) != cuts
    assert first_ends(make_sb3_vec_env(FORWARD, 8, max_episode_steps=30), 30) != cuts
    again = first_ends(envs, 30)
    assert again != cuts
    assert min(again) < 30
    envs.seed(4)
    assert first_ends(envs, 30) == cuts


def test_every_step_up_to_the_limit_may_be_the_last():
    envs = make_sb3_vec_env(FORWARD, 64, seed=0, staggered=True, max_episode_steps=3)
    assert set(first_ends(envs, 3)) == {1, 2, 3}


STAGGERED = {
    "made": partial(make_sb3_vec_env, staggered=True),
    "on_sync": lambda env_id, n_envs, **kwargs: SB3VecEnv(
        on_sync(env_id, n_envs, **kwargs).vector_env, longest_first_episode=kwargs["max_episode_steps"]
    ),
}


def cut_pair(make, env_id, n_envs, seed, **kwargs):
    """Staggered environments, and single environments that are cut at the same steps."""
    forward = env_id.replace("Goal", "Forward")  # where nothing but the cut ends the first episode
    steps = STAGGERED[make](forward, n_envs, max_episode_steps=kwargs["max_episode_steps"])
    steps.seed(seed)
    ours, theirs = STAGGERED[make](env_id, n_envs, **kwargs), cut_dummy(env_id, first_ends(steps, 60), **kwargs)
    ours.seed(seed), theirs.seed(seed)
    return ours, theirs


@pytest.mark.parametrize("make", STAGGERED)
@pytest.mark.parametrize(("env_id", "kwargs"), [BY_TIME, BY_BOTH, AT_ONCE])
def test_cut_course_equals_that_of_single_environments_cut_at_the_same_steps(make, env_id, kwargs):
    ours, theirs = cut_pair(make, env_id, 12, 9, **kwargs)
    # A cut row need not say more of its last step than a row that goes on: compare the rest.
    start, other = ours.reset(), theirs.reset()
    np.testing.assert_array_equal(start, other)
    assert ours.reset_infos == theirs.reset_infos
    fresh = np.ones(12, bool)
    cuts = 0
    for action in draw(ours, 300):
        result, reference = ours.step(action), theirs.step(action)
        for i in np.flatnonzero(reference[2]):
            mine, their = result[3][i], reference[3][i]
            if fresh[i] and their["TimeLimit.truncated"] and theirs.envs[i].left == 0:
                cuts += 1
                assert {"terminal_observation", "TimeLimit.truncated"} <= mine.keys() <= their.keys()
                reference[3][i] = {key: their[key] for key in mine}
            fresh[i] = False
        same_step(result, reference)
        assert ours.reset_infos == theirs.reset_infos
    assert not fresh.any()
    assert (cuts >= 6) == (kwargs != AT_ONCE[1])


@pytest.mark.parametrize("make", STAGGERED)
def test_ppo_bootstraps_where_first_episodes_are_cut(make):
    torch.set_num_threads(1)
    # PPO seeds its environments with its own seed.
    ours, theirs = (train_ppo(env) for env in cut_pair(make, FORWARD, 8, 11, max_episode_steps=50))
    np.testing.assert_array_equal(ours, theirs)


# -- pickling --------------------------------------------------------------------------------------


@pytest.mark.parametrize("staggered", [False, True])
@pytest.mark.parametrize(("env_id", "kwargs"), [BY_TIME, BY_BOTH, ("Pendulum-v1", {"max_episode_steps": 40})])
def test_pickled_in_the_middle_of_a_run_it_goes_on_the_same(env_id, kwargs, staggered):
    envs = make_sb3_vec_env(env_id, 6, seed=0, staggered=staggered, **kwargs)
    envs.reset()
    for action in draw(envs, 15):
        envs.step(action)
    twin = pickle.loads(pickle.dumps(envs))
    assert sum(same_steps(twin, envs, draw(envs, 150, seed=1)).values()) > 6
    np.testing.assert_array_equal(twin.reset(), envs.reset())
    same_steps(twin, envs, draw(envs, 50, seed=2))


# -- attributes, methods, pictures -----------------------------------------------------------------


# With two rows, the two torque limits of the snakeboard are not one for each.
@pytest.mark.parametrize("n_envs", [2, 3])
def test_attributes_are_those_of_single_environments(contender, n_envs):
    # Else rows do not follow what nothing depends on.
    ours, theirs = contender(FORWARD, n_envs, whole_state=True), dummy(FORWARD, n_envs, whole_state=True)
    ours.seed(0), theirs.seed(0)
    same_course(ours, theirs, 10)
    names = ("q", "v", "qdot", "energy", "dt", "params", "torque_limits", "render_mode", "observation_space")
    for name in (*names, "action_space", "observation_labels", "targets"):
        for indices in (None, 0, [n_envs - 1, 0]):
            mine, other = ours.get_attr(name, indices), theirs.get_attr(name, indices)
            assert len(mine) == len(other)
            for value, expected in zip(mine, other, strict=True):
                np.testing.assert_array_equal(value, expected, err_msg=name)
    assert ours.has_attr("q")
    assert not ours.has_attr("no_such_attribute")
    assert ours.spec.id == FORWARD


def test_attributes_of_single_environments_are_set_where_there_are_some():
    envs = on_sync(FORWARD, 3)
    envs.set_attr("mark", 7, [0, 2])
    envs.set_attr("dt", [1, 2, 3])
    assert envs.get_attr("mark", [0, 2]) == [7, 7]
    assert envs.get_attr("dt") == [[1, 2, 3]] * 3
    assert not envs.vector_env.envs[1].has_wrapper_attr("mark")


def test_methods_of_single_environments_are_called_where_there_are_some():
    envs = on_sync(FORWARD, 3)
    assert envs.env_method("get_wrapper_attr", "dt", indices=[0, 2]) == [0.05, 0.05]
    assert envs.env_method("has_wrapper_attr", name="dt") == [True] * 3
    assert envs.env_is_wrapped(TimeLimit) == [True] * 3
    assert envs.env_is_wrapped(Monitor, indices=1) == [False]


@pytest.mark.parametrize("method", ["reset", "step", "close"])
def test_methods_that_would_break_the_rollout_are_refused(contender, method):
    with pytest.raises(ValueError, match=rf"env_method\('{method}'\).*behind the back.* {method}\(\) of all rows"):
        contender(FORWARD, 2).env_method(method)


class Rows(gym.vector.VectorEnv):
    """An array program, the smallest there is: counts up, ends at the third step, and draws the count."""

    def __init__(self, n_envs, mode=AutoresetMode.SAME_STEP, render_mode=None, final=True):
        self.num_envs, self.render_mode, self.final = n_envs, render_mode, final
        self.metadata = {"autoreset_mode": mode, "render_fps": 20}
        self.single_observation_space = gym.spaces.Box(0, 9, (1,), np.float32)
        self.single_action_space = gym.spaces.Discrete(2)
        self.limit = 3

    def reset(self, *, seed=None, options=None):
        self.count = np.zeros((self.num_envs, 1), np.float32)
        return self.count, {}

    def step(self, actions):
        self.count = self.count + 1
        done = self.count[:, 0] == self.limit
        info = {"count": self.count[:, 0].astype(int)}
        if done.any():
            info["episode"], info["_episode"] = {"l": np.full(self.num_envs, 3)}, done
        if done.any() and self.final:
            info |= {"final_obs": self.count, "final_info": {"big": np.ones((self.num_envs, 2, 2)) > 0}}
        self.count = np.where(done[:, None], 0, self.count).astype(np.float32)
        return self.count, np.ones(self.num_envs), np.zeros(self.num_envs, bool), done, info

    def render(self):
        return tuple(np.full((4, 4, 3), int(count), np.uint8) for count in self.count[:, 0])


def test_array_program_has_values_but_no_single_environments():
    envs = SB3VecEnv(Rows(4))
    envs.reset()
    envs.step(np.zeros(4, int))
    assert [value.tolist() for value in envs.get_attr("count", [1, 3])] == [[1.0], [1.0]]
    assert envs.get_attr("limit") == [3] * 4
    assert envs.get_attr("action_space", 0) == [gym.spaces.Discrete(2)]
    assert not envs.has_attr("no_such_attribute")
    assert envs.env_is_wrapped(Monitor) == [False] * 4
    for refused in (lambda: envs.set_attr("limit", 5), lambda: envs.env_method("render")):
        with pytest.raises(
            NotImplementedError, match=r"cannot (set 'limit'|call 'render') of single rows: Rows.*get_attr"
        ):
            refused()


def test_reports_without_masks_and_below_masks_are_of_all_those_rows():
    envs = SB3VecEnv(Rows(2))
    envs.reset()
    infos = [envs.step(np.zeros(2, int))[3] for _ in range(3)]
    assert infos[0] == [{"count": 1}] * 2
    assert envs.reset_infos == [{"count": 3, "episode": {"l": 3}}] * 2
    assert {key for info in infos[2] for key in info} == {"big", "TimeLimit.truncated", "terminal_observation"}
    assert infos[2][1]["big"].shape == (2, 2)
    assert infos[2][1]["terminal_observation"].tolist() == [3.0]
    envs.reset()
    assert envs.reset_infos == [{}] * 2  # nothing is left of what was said before


def test_closing_closes_the_vector_environment(contender):
    envs = contender(FORWARD, 2)
    envs.close()
    envs.close()
    assert envs.vector_env.closed


def test_pictures_are_tiled():
    envs = SB3VecEnv(Rows(4, render_mode="rgb_array"))
    envs.reset()
    envs.step(np.zeros(4, int))
    assert [picture.shape for picture in envs.get_images()] == [(4, 4, 3)] * 4
    assert envs.render().shape == (8, 8, 3)
    assert envs.render().max() == 1
    assert envs.metadata["render_fps"] == 20


def test_without_pictures_it_warns(contender):
    with pytest.warns(UserWarning, match="render mode is None.*render_mode='rgb_array'"):
        assert contender(FORWARD, 2).get_images() == [None, None]


# -- refusals --------------------------------------------------------------------------------------

REFUSED = [
    (("nhenv/SnakebordForward-v0", 2), {}, gym.error.NameNotFound, "Did you mean: `SnakeboardForward`"),
    ((gym.spec(FORWARD), 2), {}, ValueError, "env_id must be an id such as 'nhenv/.*got EnvSpec"),
    ((FORWARD, 0), {}, ValueError, "n_envs must be a positive whole number, got 0"),
    ((FORWARD, 2.0), {}, ValueError, "n_envs must be a positive whole number, got 2.0"),
    ((FORWARD, True), {}, ValueError, "n_envs must be a positive whole number, got True"),
    ((FORWARD, 2), {"autoreset_mode": "NextStep"}, ValueError, "decides on autoreset_mode itself, got 'NextStep'"),
    ((FORWARD, 2), {"vectorization_mode": "sync"}, ValueError, "vectorization_mode itself.*give .* to SB3VecEnv"),
    (
        (FORWARD, 2),
        {"staggered": True, "max_episode_steps": -1},
        ValueError,
        "max_episode_steps is -1.*staggered=False",
    ),
]


@pytest.mark.parametrize(("arguments", "kwargs", "error", "message"), REFUSED)
def test_impossible_arguments_are_refused(arguments, kwargs, error, message):
    with pytest.raises(error, match=message):
        make_sb3_vec_env(*arguments, **kwargs)


@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, AutoresetMode.DISABLED, None])
def test_other_autoreset_modes_are_refused(mode):
    with pytest.raises(ValueError, match=rf"needs AutoresetMode.SAME_STEP.*got Rows.* with {mode}.*'SameStep'"):
        SB3VecEnv(Rows(2, mode))


def test_first_episodes_need_a_step():
    with pytest.raises(ValueError, match="longest_first_episode must be at least 1 step, or None, got 0"):
        SB3VecEnv(Rows(2), longest_first_episode=0)


def test_a_silent_end_is_refused():
    envs = SB3VecEnv(Rows(2, final=False))
    envs.reset()
    envs.step(np.zeros(2, int)), envs.step(np.zeros(2, int))
    with pytest.raises(ValueError, match=r"info\['final_obs'\], which Stable-Baselines3 needs"):
        envs.step(np.zeros(2, int))


def test_an_id_may_name_the_module_that_registers_it():
    assert make_sb3_vec_env("nhenv:" + FORWARD, 2).spec.id == FORWARD


def test_without_stable_baselines3_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "stable_baselines3.common.env_util", None)
    monkeypatch.delitem(sys.modules, "nhenv.sb3")
    with pytest.raises(DependencyNotInstalled, match=r'stable_baselines3.*pip install "nhenv\[train\]"'):
        import nhenv.sb3  # noqa: F401

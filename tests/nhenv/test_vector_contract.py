"""What a user of the vector environment may rely on: resets, autoreset, info, fresh arrays, bad rows, refusals."""

import copy
import itertools
import pickle

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.error import ResetNeeded
from gymnasium.vector import AutoresetMode
from gymnasium.wrappers.vector import NormalizeObservation, NormalizeReward, RecordEpisodeStatistics

import nhenv
from mechanics.mechanism import MechanismError
from nhenv.env import LocomotionEnv
from nhenv.vector_env import LocomotionVectorEnv

SNAKEBOARD, RACER, GOAL = "nhenv/SnakeboardForward-v0", "nhenv/RollerRacerForward-v0", "nhenv/SnakeboardGoal-v0"
NEXT_STEP, SAME_STEP, DISABLED = AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP, AutoresetMode.DISABLED


@pytest.fixture
def rows():
    """Make a vector environment, interpreted unless asked otherwise."""
    made = []

    def make(env_id=SNAKEBOARD, size=3, mode=NEXT_STEP, **arguments):
        made.append(gym.make_vec(env_id, num_envs=size, autoreset_mode=mode.value, **{"backend": "numpy", **arguments}))
        return made[-1]

    yield make
    for env in made:
        env.close()


def _actions(env, steps, seed=0):
    return np.random.default_rng(seed).uniform(-1, 1, (steps, *env.action_space.shape)).astype(np.float32)


def _message(error, *words):
    text = str(error.value)
    missing = [word for word in words if word not in text]
    assert not missing, f"{missing} not in {text!r}"


def _arrays(*returned):
    """All arrays in what `reset` or `step` returned."""
    for value in returned:
        if isinstance(value, dict):
            yield from _arrays(*value.values())
        elif isinstance(value, tuple):
            yield from _arrays(*value)
        elif value is not None:
            yield value
            if value.dtype == object:
                yield from _arrays(*value)


# -- what make_vec makes -------------------------------------------------------------------------


def test_make_vec_makes_it_by_default(rows):
    env = rows(size=5)
    assert type(env) is LocomotionVectorEnv
    assert env.num_envs == 5
    assert env.max_episode_steps == gym.spec(SNAKEBOARD).max_episode_steps == 300
    assert env.spec.id == SNAKEBOARD
    assert not env.closed
    env.close()
    env.close()
    assert env.closed


@pytest.mark.parametrize("endless", [None, -1])
def test_no_time_limit(rows, endless):
    """None, and Gymnasium's own way of saying it."""
    env = rows(max_episode_steps=endless)
    env.reset(seed=0)
    actions = np.zeros((3, 2))
    assert not any(env.step(actions)[3].any() for _ in range(320))
    assert env.elapsed_steps.tolist() == [320] * 3


def test_everything_returned_is_of_its_type(rows):
    env = rows(GOAL, info="all")
    observations, infos = env.reset(seed=0)
    assert observations in env.observation_space
    step = env.step(env.action_space.sample())
    assert step[0] in env.observation_space
    assert [array.dtype for array in step[:4]] == [np.float32, np.float64, np.bool_, np.bool_]
    for found in (infos, step[4]):
        assert {key for key in found if key.startswith("_")} == {f"_{key}" for key in found if not key.startswith("_")}
        assert all(array.shape == (3,) for array in found.values())


# -- resets --------------------------------------------------------------------------------------


def test_seeds(rows):
    """An integer counts up, a list has one for each row, huge ones are exact; a row has no memory of others."""
    env = rows(size=4)
    by_number = env.reset(seed=5)[0]
    assert env.np_random_seed == (5, 6, 7, 8)
    assert np.array_equal(env.reset(seed=[8, 7, 6, 5])[0], by_number[::-1])
    assert np.array_equal(env.reset(seed=np.array([8, 7, 6, 5]))[0], by_number[::-1])
    huge = [2**200, 2**64 - 1, 2**127, 0]
    observations = env.reset(seed=huge)[0]
    assert env.np_random_seed == tuple(huge)
    one = LocomotionEnv("snakeboard", backend="numpy")
    for seed, observation in zip(huge, observations, strict=True):
        assert np.array_equal(one.reset(seed=seed)[0], observation)
    first = env.reset(seed=2**80)[0]
    assert env.np_random_seed == tuple(2**80 + i for i in range(4))
    assert np.array_equal(one.reset(seed=2**80)[0], first[0])


def test_none_in_a_list_of_seeds_lets_a_row_go_on(rows):
    env, twin = rows(), rows()
    for other in (env, twin):
        other.reset(seed=1)
    mixed, unseeded = env.reset(seed=[4, None, 6])[0], twin.reset()[0]
    assert env.np_random_seed == (4, 2, 6)
    assert np.array_equal(mixed[1], unseeded[1])
    seeded = twin.reset(seed=4)[0]
    assert np.array_equal(mixed[[0, 2]], seeded[[0, 2]])
    assert not np.array_equal(mixed[1], seeded[1])
    strangers = [rows().reset(seed=[4, None, 6])[0] for _ in range(2)]  # a row that was never seeded
    assert [(one == seeded)[:, 0].tolist() for one in strangers] == [[True, False, True]] * 2
    assert strangers[0][1, 0] != strangers[1][1, 0] != 0


def test_episodes_differ_and_are_the_same_again(rows):
    env = rows()
    runs = []
    for _ in range(2):
        starts = [env.reset(seed=3)[0]] + [env.reset()[0] for _ in range(4)]
        angles = np.array(starts)[:, :, 0].ravel()
        assert len(set(angles.tolist())) == 15  # no two rows and no two episodes begin alike
        runs.append(angles)
    assert np.array_equal(*runs)


def test_without_a_seed_every_environment_is_different(rows):
    starts = [rows().reset()[0][:, 0] for _ in range(3)]
    assert len(set(np.ravel(starts).tolist())) == 9
    env = rows()
    assert env.np_random_seed == (-1, -1, -1)
    streams = [generator.random() for generator in env.np_random]
    assert len(set(streams)) == 3
    assert [generator.random() for generator in env.np_random] == streams  # nothing was drawn from the rows
    noise = 2 * np.array(streams) - 1
    assert env.reset()[0][:, 0] * 1.2 == pytest.approx(0.05 * noise, rel=1e-5)  # they are the rows' own


def test_reset_mask(rows):
    """Resets those rows and no others, returns every row's observation, and leaves the caller's options alone."""
    env, twin = rows(info="all"), rows(info="all")
    actions = _actions(env, 8)
    for other in (env, twin):
        other.reset(seed=0)
        for action in actions[:4]:
            last = other.step(action)[0]
    mask = np.array([False, True, False])
    options = {"reset_mask": mask}
    observations, _ = env.reset(seed=[7, 8, 9], options=options)
    assert options == {"reset_mask": mask}
    assert options["reset_mask"] is mask
    assert np.array_equal(observations[~mask], last[~mask])
    assert np.array_equal(observations[1], env.reset(seed=8, options=options)[0][1]) is False  # 8 + 1
    assert np.array_equal(observations[1], env.reset(seed=7, options=options)[0][1])
    assert env.np_random_seed == (0, 8, 2)
    assert env.elapsed_steps.tolist() == [4, 0, 4]
    for action in actions[4:]:
        ours, theirs = env.step(action), twin.step(action)
        assert np.array_equal(ours[0][~mask], theirs[0][~mask])
        assert np.array_equal(ours[1][~mask], theirs[1][~mask])
        assert not np.array_equal(ours[0][mask], theirs[0][mask])


def test_reset_infos_have_the_targets_of_rows_that_were_reset(rows):
    env = rows(GOAL)
    _, infos = env.reset(seed=0)
    assert infos["_goal_x"].all()
    assert np.array_equal(infos["goal_x"], env.targets["goal_x"])
    _, infos = env.reset(options={"reset_mask": np.array([True, False, False])})
    assert infos["_goal_x"].tolist() == [True, False, False]
    assert infos["goal_x"].tolist() == [env.targets["goal_x"][0], 0.0, 0.0]


def _feasible(env, seed):
    """A state of each row that satisfies the constraints: q and qdot (N, n), joints within their stops."""
    rng = np.random.default_rng(seed)
    q = rng.uniform(-0.5, 0.5, (env.num_envs, env.mechanism.n))
    v = rng.uniform(-0.5, 0.5, (env.num_envs, env.mechanism.rank))
    return q, env._configuration.model.velocity(q, v)


@pytest.mark.parametrize("env_id", [SNAKEBOARD, RACER, GOAL])
def test_states_given_at_reset(rows, env_id):
    env = rows(env_id, whole_state=True)
    q, qdot = _feasible(env, 0)
    env.reset(seed=0, options={"q": q, "qdot": qdot})
    assert np.array_equal(env.q, q)
    assert env.qdot == pytest.approx(qdot, abs=1e-13)
    singles = [gym.make(env_id, backend="numpy", whole_state=True).unwrapped for _ in range(3)]
    for i, one in enumerate(singles):
        one.reset(seed=i, options={"q": q[i], "qdot": qdot[i]})
    actions = _actions(env, 5)
    for action in actions:
        observations = env.step(action)[0]
        assert np.array_equal(observations, [one.step(own)[0] for one, own in zip(singles, action, strict=True)])
    observations, _ = env.reset(options={"q": q[1], "qdot": qdot[1]})  # one state for all
    assert (env.q == q[1]).all()
    moving = env.qdot
    env.reset(options={"q": q, "reset_mask": np.array([True, False, False])})
    assert not env.v[0].any()  # at rest
    assert np.array_equal(env.q[0], q[0])
    assert np.array_equal(env.qdot[1:], moving[1:])


def test_what_is_given_for_rows_that_are_not_reset_does_not_matter(rows):
    env = rows(GOAL, whole_state=True)
    env.reset(seed=0)
    mask = np.array([False, True, False])
    q, goals = np.full((3, env.mechanism.n), np.nan), np.array([np.nan, 0.5, np.inf])
    q[1] = 0.25
    before = env.q
    env.reset(options={"q": q, "qdot": 0 * q, "target": {"goal_x": goals}, "reset_mask": mask})
    assert np.array_equal(env.q[~mask], before[~mask])
    assert (env.q[1] == 0.25).all()
    assert env.targets["goal_x"][1] == 0.5


def test_a_velocity_at_a_drawn_place(rows):
    """As for one environment: joints are drawn, the velocity is as given, if the constraints allow it there."""
    env, one = rows(), gym.make(SNAKEBOARD, backend="numpy").unwrapped
    qdot = np.zeros((3, env.mechanism.n))
    qdot[:, env.mechanism.coordinates.index("psi")] = [1.0, 2.0, 3.0]  # the rotor turns, and all else stands still
    qdot[:, env.mechanism.coordinates.index("theta")] = 0.0
    observations, _ = env.reset(seed=4, options={"qdot": qdot})
    expected = [one.reset(seed=4 + i, options={"qdot": qdot[i]})[0] for i in range(3)]
    assert np.array_equal(observations, expected)
    assert np.array_equal(env.reset()[0][:, 0], [one.reset(seed=4 + i) and one.reset()[0][0] for i in range(3)])


def test_targets_given_at_reset(rows):
    env = rows(GOAL)
    _, infos = env.reset(seed=0, options={"target": {"goal_x": 1.5, "goal_y": np.array([0.0, 1.0, 2.0])}})
    assert env.targets["goal_x"].tolist() == infos["goal_x"].tolist() == [1.5] * 3
    assert env.targets["goal_y"].tolist() == [0.0, 1.0, 2.0]
    drawn = [LocomotionEnv("snakeboard", "Goal", backend="numpy").reset(seed=i)[1]["goal_y"] for i in range(3)]
    env.reset(seed=0, options={"target": {"goal_x": 1.5}})
    assert env.targets["goal_y"].tolist() == drawn  # what is given changes nothing of what is drawn


# -- autoreset -----------------------------------------------------------------------------------


@pytest.mark.parametrize("mode", AutoresetMode, ids=lambda mode: mode.value)
def test_transitions(rows, mode):
    """What a learner stores, (observation, action, reward, end, next observation), is what a single row really did.

    Goals so near that some rows begin there, and end at once; a time limit cuts the others.
    """
    env = rows(GOAL, 3, mode, max_episode_steps=9, goal_radius=1.5, info="all", torque_limits=[8.0, 4.0])
    singles = [
        gym.make(GOAL, backend="numpy", max_episode_steps=9, goal_radius=1.5, torque_limits=[8.0, 4.0])
        for _ in range(3)
    ]
    observations, infos = env.reset(seed=3)
    begun = [one.reset(seed=3 + i) for i, one in enumerate(singles)]
    expected = [observation for observation, _ in begun]
    assert np.array_equal(observations, expected)
    assert infos["goal_x"].tolist() == [info["goal_x"] for _, info in begun]
    over, ends = [False] * 3, {"terminated": 0, "truncated": 0}
    for action in _actions(env, 40):
        if mode is DISABLED and any(over):
            observations, infos = env.reset(options={"reset_mask": np.array(over)})
            for i in np.flatnonzero(over):
                expected[i], info = singles[i].reset()
                assert infos["goal_x"][i] == info["goal_x"]
            assert np.array_equal(observations, expected)
            over = [False] * 3
        observations, rewards, terminated, truncated, infos = env.step(action)
        for i, one in enumerate(singles):
            if over[i]:  # NEXT_STEP: this step does nothing but to reset it
                first, info = one.reset()
                assert (rewards[i], terminated[i], truncated[i]) == (0.0, False, False)
                assert np.array_equal(observations[i], first)
                assert infos["goal_x"][i] == info["goal_x"]
                assert infos["_goal_x"][i]
                over[i] = False
                continue
            last, reward, *flags, info = one.step(action[i])
            assert rewards[i] == reward
            assert [terminated[i], truncated[i]] == flags
            ends["terminated"] += flags[0]
            ends["truncated"] += flags[1]
            of_step = infos
            if mode is SAME_STEP and any(flags):
                assert np.array_equal(infos["final_obs"][i], last)
                of_step = infos["final_info"]
                last, reset_info = one.reset()
                assert infos["goal_x"][i] == reset_info["goal_x"]
            elif mode is SAME_STEP and "final_obs" in infos:
                assert infos["final_obs"][i] is None
                assert not infos["_final_obs"][i]
            else:
                over[i] = any(flags)
            for key, value in info.items():
                assert of_step[key][i] == value
                assert of_step[f"_{key}"][i]
            assert np.array_equal(observations[i], last)
            expected[i] = last
    assert min(ends.values()) > 3  # both kinds of end were seen


def test_a_step_of_an_episode_that_is_over_is_refused_without_autoreset(rows):
    """As often as it is tried; once the rows are reset, the episodes of the others go on."""
    env = rows(GOAL, mode=DISABLED, max_episode_steps=3)
    action = np.ones((3, 2))
    env.reset(seed=0)
    env.step(action)
    env.reset(options={"reset_mask": np.array([False, False, True])})
    env.step(action)
    truncated = env.step(action)[3]
    assert truncated.tolist() == [True, True, False]
    before, clone = env.q, copy.deepcopy(env)
    for other in (env, env, clone):
        with pytest.raises(ResetNeeded, match="autoreset mode is DISABLED") as error:
            other.step(action)
        _message(error, "reset_mask", "terminated | truncated")
        assert np.array_equal(other.q, before, equal_nan=True)
    env.reset(options={"reset_mask": np.array([True, False, False])})
    with pytest.raises(ResetNeeded, match="episodes that are over"):  # there is another
        env.step(action)
    env.reset(options={"reset_mask": np.array([False, True, False])})
    assert env.step(action)[3].tolist() == [False, False, True]
    assert env.elapsed_steps.tolist() == [1, 1, 3]


# -- info ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("mode", AutoresetMode, ids=lambda mode: mode.value)
def test_levels_of_info(rows, mode):
    """The levels change nothing else; each says what the next says of fewer steps."""
    envs = {level: rows(GOAL, mode=mode, max_episode_steps=4, info=level) for level in ("none", "final", "all")}
    for env in envs.values():
        env.reset(seed=0)
        env.step(np.ones((3, 2)))
        env.reset(options={"reset_mask": np.array([True, False, True])})  # so that row 1 ends first
    terms = {"reward_progress", "reward_time", "reward_ctrl", "reward_goal", "x_position", "goal_distance"}
    targets = {key for name in envs["all"].targets for key in (name, f"_{name}")}
    for t, action in enumerate(_actions(envs["all"], 3)):
        steps = {level: env.step(action) for level, env in envs.items()}
        for level in ("none", "final"):
            for ours, theirs in zip(steps[level][:4], steps["all"][:4], strict=True):
                assert np.array_equal(ours, theirs)
        none, final, every = (steps[level][4] for level in envs)
        if t < 2:
            assert none == final == {}
            assert terms <= every.keys()
            continue
        if mode is SAME_STEP:
            assert none.keys() == {"final_obs", "_final_obs"}
            assert final.keys() == none.keys() | {"final_info", "_final_info"} | targets
            assert final.keys() | {f"_{term}" for term in terms} <= every.keys()
            assert every["_reward_ctrl"].tolist() == [True, False, True]
            final, every = final["final_info"], every["final_info"]
        else:
            assert none == {}
        assert terms <= final.keys() == every.keys()
        for key in final:
            assert np.array_equal(final[key][1], every[key][1])
            assert final[f"_{key.removeprefix('_')}"].tolist() == [False, True, False]
    if mode is NEXT_STEP:  # row 1 is reset, and the others end
        none, final, every = (env.step(action)[4] for env in envs.values())
        assert none == {}
        assert targets < final.keys() == every.keys()
        assert final["_goal_x"].tolist() == every["_goal_x"].tolist() == [False, True, False]
        assert np.array_equal(final["goal_x"], every["goal_x"])
        assert final["_reward_ctrl"].tolist() == every["_reward_ctrl"].tolist() == [True, False, True]


def test_rewards_are_the_sums_of_their_terms(rows):
    env = rows(GOAL, info="all")
    env.reset(seed=0)
    for action in _actions(env, 5):
        _, rewards, _, _, infos = env.step(action)
        total = sum(value for key, value in infos.items() if key.startswith("reward_"))
        assert rewards == pytest.approx(total, rel=1e-12)


# -- arrays --------------------------------------------------------------------------------------


@pytest.mark.parametrize("mode", AutoresetMode, ids=lambda mode: mode.value)
@pytest.mark.parametrize("level", ["final", "all"])
def test_nothing_returned_is_ever_written_again(rows, mode, level):
    """Nor does any array share memory with another, or with what a property returned."""
    env = rows(GOAL, mode=mode, max_episode_steps=2, info=level)
    kept = [*_arrays(env.reset(seed=0))]
    snapshots = [copy.deepcopy(array) for array in kept]
    over = False
    for t, action in enumerate(_actions(env, 8)):
        if t == 3:
            action[1] = np.nan
        if mode is DISABLED and over:
            fresh = [*_arrays(env.reset(options={"reset_mask": np.ones(3, bool)}))]
        else:
            step = env.step(action)
            over = (step[2] | step[3]).any()
            fresh = [*_arrays(step)]
        fresh += [env.q, env.v, env.qdot, env.energy, env.elapsed_steps, env.torque_limits, *env.targets.values()]
        kept += fresh
        snapshots += [copy.deepcopy(array) for array in fresh]
    for array, snapshot in zip(kept, snapshots, strict=True):
        if array.dtype != object:
            assert np.array_equal(array, snapshot, equal_nan=array.dtype.kind == "f")
    for one, other in itertools.combinations(kept, 2):
        assert not np.shares_memory(one, other)


def test_actions_are_not_written_to(rows):
    env = rows()
    env.reset(seed=0)
    actions = np.full((3, 2), 7.0, np.float32)
    env.step(actions)
    assert (actions == 7.0).all()


def _guises(plain):
    frozen = plain.copy()
    frozen.flags.writeable = False
    wide = np.zeros((6, 4), np.float32)
    wide[::2, ::2] = plain
    return {
        "float64": plain.astype(float),
        "list": plain.tolist(),
        "read-only": frozen,
        "non-contiguous": wide[::2, ::2],
        "Fortran": np.asfortranarray(plain),
        "another byte order": plain.astype(">f4"),
        "another byte order, wide": plain.astype(">f8"),
        "float16": plain.astype(np.float16),
        "subclass": plain.view(np.recarray),
        "matrix of objects": plain.astype(object),
    }


@pytest.mark.parametrize("backend", ["numpy", "numba"])
def test_actions_may_come_in_any_guise(rows, backend):
    env = rows(backend=backend)
    plain = np.array([[0.5, -1.0], [2.0, 0.25], [0.0, 1.0]], np.float32)  # numbers that all of them can hold

    def outcome(actions):
        env.reset(seed=0)
        return env.step(actions)[0].tobytes()

    expected = outcome(plain)
    outcome(plain.astype(float))
    compiled = len(getattr(env._kernel.step_rows, "signatures", ()))
    for name, actions in _guises(plain).items():
        assert outcome(actions) == expected, name
    assert len(getattr(env._kernel.step_rows, "signatures", ())) == compiled
    masks = np.ones((3, 2), bool)
    for mask in (masks[:, 0], np.broadcast_to(True, 3)):
        env.reset(options={"reset_mask": mask})
    assert len(getattr(env._kernel.begin_rows, "signatures", (None,))) == 1
    whole = outcome(np.ones((3, 2), np.float32))
    assert outcome(np.ones((3, 2), int)) == outcome(np.ones((3, 2), bool)) == whole


# -- rows that go wrong --------------------------------------------------------------------------


@pytest.mark.parametrize("level", ["none", "all"])
@pytest.mark.parametrize("element", [0, 1])
def test_an_action_that_is_not_a_number(rows, level, element):
    """The row is stepped without torque, as with an action of zeros, and flagged; its neighbours notice nothing."""
    env, twin = rows(info=level), rows(info=level)
    actions = _actions(env, 6)
    for other in (env, twin):
        other.reset(seed=0)
    for t, action in enumerate(actions):
        other = action.copy()
        if t in (2, 3):
            row = 3 - t
            action[row, element], other[row] = np.nan, 0.0
        ours, theirs = env.step(action), twin.step(other)
        for one, two in zip(ours[:4], theirs[:4], strict=True):
            assert np.array_equal(one, two)
        if t in (2, 3):
            flagged = [row == i for i in range(3)]
            assert ours[4].pop("bad_action").tolist() == ours[4].pop("_bad_action").tolist() == flagged
        assert ours[4].keys() == theirs[4].keys()


@pytest.mark.parametrize("mode", AutoresetMode, ids=lambda mode: mode.value)
@pytest.mark.parametrize("env_id", [SNAKEBOARD, RACER])
def test_a_row_that_diverges(rows, env_id, mode):
    """It ends with its last finite observation, and says why; its neighbours are the same to the last bit."""
    env, twin = (rows(env_id, mode=mode, joint_limits=False) for _ in range(2))
    q = np.zeros((3, env.mechanism.n))
    qdot = np.zeros_like(q)
    for other in (env, twin):
        other.reset(seed=0, options={"q": q, "qdot": qdot})
    fast = qdot.copy()
    fast[1, 0] = 1e14  # straight ahead
    mask = np.array([False, True, False])
    before, _ = env.reset(options={"q": q, "qdot": fast, "reset_mask": mask})
    (action,) = _actions(env, 1)
    ours, theirs = env.step(action), twin.step(action)
    observations, rewards, terminated, truncated, infos = ours
    for one, two in zip(ours[:4], theirs[:4], strict=True):
        assert np.array_equal(one[~mask], two[~mask])
    assert terminated.tolist() == mask.tolist()
    assert not truncated.any()
    assert np.isfinite(rewards).all()
    assert np.isfinite(observations).all()
    if mode is SAME_STEP:
        assert np.array_equal(infos["final_obs"][1], before[1])
        infos = infos["final_info"]
    else:
        assert np.array_equal(observations[1], before[1])
    assert infos["diverged"].tolist() == infos["_diverged"].tolist() == mask.tolist()
    if mode is DISABLED:
        env.reset(options={"reset_mask": mask})
    later = env.step(np.zeros(env.action_space.shape))
    assert "diverged" not in later[4]
    assert np.isfinite(env.energy).all()


# -- threads, copies -----------------------------------------------------------------------------


@pytest.mark.parametrize("threads", [2, 3, 16])
def test_threads_change_nothing(rows, threads):
    """More rows than a block and no multiple of it; more threads than blocks."""
    envs = [rows(size=300, backend="numba", info="all", max_episode_steps=20, threads=n) for n in (1, threads)]
    starts = [env.reset(seed=0)[0] for env in envs]
    assert np.array_equal(*starts)
    for action in _actions(envs[0], 60):
        action[137] *= np.nan
        returned = [[*_arrays(env.step(4 * action))] for env in envs]
        for one, other in zip(*returned, strict=True):
            assert np.array_equal(one, other)
    envs[1].close()
    assert np.array_equal(*(env.step(action)[0] for env in envs))  # it could go on


@pytest.mark.parametrize("clone", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))], ids=["copy", "pickle"])
@pytest.mark.parametrize("arguments", [{}, {"params": {"m": np.array([4.0, 5.0, 6.0])}}, {"threads": 2}], ids=str)
def test_a_copy_in_the_middle_of_an_episode_goes_on_alike(rows, clone, arguments):
    env = rows(GOAL, info="all", max_episode_steps=7, **arguments)
    env.reset(seed=0)
    actions = _actions(env, 30)
    for action in actions[:10]:
        env.step(action)
    other = clone(env)
    for action in actions[10:]:
        for one, two in zip(_arrays(env.step(action)), _arrays(other.step(action)), strict=True):
            assert np.array_equal(one, two)
    other.reset()
    assert not np.array_equal(env.q, other.q, equal_nan=True)  # they are two


def test_a_copy_before_the_first_reset_refuses_to_step_too(rows):
    for env in (rows(), copy.deepcopy(rows())):
        with pytest.raises(ResetNeeded, match="before reset"):
            env.step(np.zeros((3, 2)))
        for name in ("q", "v", "qdot", "energy", "targets", "elapsed_steps"):
            with pytest.raises(ResetNeeded, match="call reset"):
                getattr(env, name)


# -- wrappers ------------------------------------------------------------------------------------


@pytest.mark.parametrize("wrapper", [RecordEpisodeStatistics, NormalizeObservation, NormalizeReward])
def test_wrappers_do_as_on_single_environments(rows, wrapper):
    native = wrapper(rows(info="all", max_episode_steps=5))
    sync = wrapper(
        gym.make_vec(SNAKEBOARD, num_envs=3, vectorization_mode="sync", max_episode_steps=5, backend="numpy")
    )
    returned = [[env.reset(seed=0)] for env in (native, sync)]
    for action in _actions(native, 17):
        for env, kept in zip((native, sync), returned, strict=True):
            kept.append(env.step(action))
    for ours, theirs in zip(*returned, strict=True):
        ours[-1].get("episode", {}).pop("t", None)  # the time on the clock
        theirs[-1].get("episode", {}).pop("t", None)
        for one, other in zip(ours[:-1], theirs[:-1], strict=True):
            assert np.array_equal(one, other)
        assert ours[-1].keys() == theirs[-1].keys()
        for key, value in ours[-1].get("episode", {}).items():
            assert np.array_equal(value, theirs[-1]["episode"][key])
    if wrapper is RecordEpisodeStatistics:
        assert sum("episode" in step[-1] for step in returned[0]) == 3


# -- refusals ------------------------------------------------------------------------------------

N = 3
ARGUMENTS = {
    "no rows": ({"num_envs": 0}, ValueError, ["num_envs", "positive whole", "got 0"]),
    "rows fraction": ({"num_envs": 1.5}, ValueError, ["num_envs", "1.5"]),
    "rows bool": ({"num_envs": True}, ValueError, ["num_envs", "True"]),
    "steps zero": ({"max_episode_steps": 0}, ValueError, ["max_episode_steps", "positive whole", "got 0"]),
    "threads zero": ({"threads": 0}, ValueError, ["threads", "positive whole", "got 0"]),
    "mode misspelt": ({"autoreset_mode": "NextSteps"}, ValueError, ["'NextSteps'", "Disabled", "mean 'NextStep'"]),
    "info misspelt": ({"info": "finall"}, ValueError, ["'finall'", "none", "mean 'final'"]),
    "info bool": ({"info": True}, ValueError, ["'True'", "none, final, all"]),
    "argument misspelt": ({"thread": 2}, TypeError, ["'thread'", "argument"]),
    "weight misspelt": ({"ctrl_cost_wieght": 0.1}, TypeError, ["'ctrl_cost_wieght'", "mean 'ctrl_cost_weight'"]),
    "whole_state": ({"whole_state": "yes"}, ValueError, ["whole_state", "True or False", "'yes'"]),
    "drawing": ({"render_mode": "human"}, ValueError, ["render_mode", "'rgb_array'", "'human'"]),
    "parameter misspelt": ({"params": {"J_rr": np.full(N, 0.1)}}, MechanismError, ["'J_rr'", "mean 'J_r'"]),
    "parameter shape": ({"params": {"m": np.ones(4)}}, ValueError, ["params: m", "(3,)", "(4,)"]),
    "parameter ragged": ({"params": {"m": [1.0, [2.0], 3]}}, ValueError, ["params: m", "3 of them"]),
    "parameter words": ({"params": {"m": ["a", "b", "c"]}}, ValueError, ["params: m", "3 of them", "'a'"]),
    "parameter no number": ({"params": {"m": "heavy"}}, MechanismError, ["m", "number", "'heavy'"]),
    "parameter of a row": ({"params": {"m": [4.0, -1.0, 4.0]}}, MechanismError, ["row 1", "positive", "m=-1"]),
    "parameter NaN": ({"params": {"m": [4.0, 4.0, np.nan]}}, MechanismError, ["row 2", "m", "nan"]),
    "first row": ({"params": {"m": [-1.0, 4.0, 4.0]}}, MechanismError, ["positive", "m=-1"]),
    "drag misspelt": ({"drag": {"b_phy": np.ones(N)}}, MechanismError, ["'b_phy'", "mean 'b_phi'"]),
    "drag shape": ({"drag": {"C": np.ones(4)}}, ValueError, ["drag: C", "(3,)", "(4,)"]),
    "drag words": ({"drag": {"C": ["a", "b", "c"]}}, ValueError, ["drag: C", "3 of them", "'a'"]),
    "drag of a row": ({"drag": {"C": [1.0, 0.0, -1.0]}}, MechanismError, ["row 2", "drag coefficient C", "-1.0"]),
    "drag NaN": ({"drag": {"C": [1.0, np.nan, 1.0]}}, MechanismError, ["row 1", "C", "finite"]),
    "drag of the first row": ({"drag": {"C": [-1.0, 1.0, 1.0]}}, MechanismError, ["drag coefficient C", "-1.0"]),
    "drag bare": ({"drag": np.ones(N)}, MechanismError, ["drag", "True, False or coefficients"]),
    "torque misspelt": ({"torque_limits": {"u_phy": np.ones(N)}}, ValueError, ["'u_phy'", "mean 'u_phi'"]),
    "torque shape": ({"torque_limits": {"u_phi": np.ones(2)}}, ValueError, ["torque_limits: u_phi", "(3,)", "(2,)"]),
    "torque of a row": ({"torque_limits": {"u_phi": [1.0, 0.0, 1.0]}}, ValueError, ["u_phi", "positive"]),
}  # fmt: skip


@pytest.mark.parametrize(("arguments", "kind", "words"), ARGUMENTS.values(), ids=ARGUMENTS)
def test_impossible_arguments(arguments, kind, words):
    with pytest.raises(kind) as error:
        LocomotionVectorEnv("snakeboard", "Forward", **{"num_envs": N, "backend": "numpy", **arguments})
    _message(error, *words)


RESETS = {
    "unknown option": ({"options": {"Q": 0}}, ValueError, ["'Q'", "q, qdot, target, reset_mask"]),
    "misspelt option": ({"options": {"resetmask": 0}}, ValueError, ["'resetmask'", "mean 'reset_mask'"]),
    "mask list": ({"options": {"reset_mask": [True, False, True]}}, ValueError, ["reset_mask", "NumPy array", "(3,)"]),
    "mask integers": ({"options": {"reset_mask": np.ones(3, int)}}, ValueError, ["bool", "int64"]),
    "mask shape": ({"options": {"reset_mask": np.ones(2, bool)}}, ValueError, ["(3,)", "(2,)"]),
    "mask empty": ({"options": {"reset_mask": np.zeros(3, bool)}}, ValueError, ["reset_mask", "selects no row"]),
    "q shape": ({"options": {"q": np.zeros((2, 5))}}, ValueError, ["'q'", "(5,)", "(3, 5)", "(2, 5)", "x, y"]),
    "q NaN": ({"options": {"q": np.full(5, np.nan)}}, ValueError, ["'q'", "finite", "nan"]),
    "q beyond": ({"options": {"q": np.array([[0, 0, 0, 0, 2.0]] * 3)}}, ValueError, ["phi", "2.0", "beyond its stop"]),
    "qdot slips": ({"options": {"q": np.zeros(5), "qdot": [[0] * 5, [0, 1, 0, 0, 0], [0] * 5]}}, MechanismError,
                   ["row 1", "violates the rolling constraints"]),
    "qdot slips where drawn": ({"options": {"qdot": [0, 1, 0, 0, 0]}}, MechanismError, ["row 0", "violates"]),
    "target unknown": ({"options": {"target": {"goal_z": 0}}}, ValueError, ["'goal_z'", "mean 'goal_"]),
    "target shape": ({"options": {"target": {"goal_x": [1.0, 2.0]}}}, ValueError, ["goal_x", "(3,)", "(2,)"]),
    "target NaN": ({"options": {"target": {"goal_x": np.nan}}}, ValueError, ["goal_x", "finite"]),
    "target no mapping": ({"options": {"target": 1.0}}, ValueError, ["'target'", "map", "1.0"]),
    "seed text": ({"seed": "123"}, ValueError, ["seed", "'123'"]),
    "seed bool": ({"seed": True}, ValueError, ["seed", "True"]),
    "seed fraction": ({"seed": 1.5}, ValueError, ["seed", "1.5"]),
    "seeds too few": ({"seed": [1, 2]}, ValueError, ["seed", "3 of them", "got 2"]),
    "seeds fractions": ({"seed": [1, 2, 1.5]}, ValueError, ["whole numbers", "1.5"]),
    "seed negative": ({"seed": -1}, gym.error.Error, ["negative", "-1"]),
    "seeds negative": ({"seed": [1, 2, -3]}, gym.error.Error, ["negative", "-3"]),
}  # fmt: skip


@pytest.mark.parametrize(("arguments", "kind", "words"), RESETS.values(), ids=RESETS)
def test_impossible_resets(rows, arguments, kind, words):
    """Refused, and the present episodes and random streams are as they were."""
    env, twin = rows(GOAL, whole_state=True), rows(GOAL, whole_state=True)
    for other in (env, twin):
        other.reset(seed=0)
        other.step(np.ones((3, 2)))
    with pytest.raises(kind) as error:
        env.reset(**arguments)
    _message(error, *words)
    assert np.array_equal(env.q, twin.q)
    assert env.np_random_seed == (0, 1, 2)
    assert np.array_equal(env.reset()[0], twin.reset()[0])


def test_the_first_reset_must_be_of_all_rows(rows):
    env = rows()
    with pytest.raises(ResetNeeded, match="first reset must be of all rows"):
        env.reset(options={"reset_mask": np.array([True, False, True])})
    env.reset(options={"reset_mask": np.ones(3, bool)})
    env.step(np.zeros((3, 2)))


@pytest.mark.parametrize(
    "actions", [np.zeros((3, 1)), np.zeros((2, 2)), np.zeros(6), np.zeros((3, 2, 1)), [[0.0, 0.0]]]
)
def test_actions_of_another_shape(rows, actions):
    env = rows()
    env.reset(seed=0)
    with pytest.raises(ValueError, match="shape") as error:
        env.step(actions)
    _message(error, "(3, 2)", str(np.shape(actions)), "u_psi, u_phi")


@pytest.mark.parametrize("actions", ["left", [["a", "b"]] * 3, [[1.0], [1.0, 2.0], [0.0]], None, np.full((3, 2), 1j)])
def test_actions_that_are_no_numbers(rows, actions):
    env = rows()
    env.reset(seed=0)
    with pytest.raises(ValueError, match="action"):
        env.step(actions)


def test_parameters_of_rows_that_share_them(rows):
    with pytest.raises(ValueError, match="share their parameters") as error:
        rows().set_params({"m": 5.0})
    _message(error, "'m'", "np.full")


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"params": {"mm": 1.0}}, ["'mm'", "mean 'm'"]),
        ({"params": {"m": "heavy"}}, ["params: m", "'heavy'"]),
        ({"params": {"m": np.ones(2)}}, ["params: m", "(3,)", "(2,)"]),
        ({"params": {"m": -1.0}}, ["row 0", "positive"]),
        ({"params": {"m": 5.0}, "torque_limits": {"u_phi": -1.0}}, ["u_phi", "positive"]),
        ({"torque_limits": {"u_phy": 1.0}}, ["'u_phy'", "mean 'u_phi'"]),
        ({"drag": {"b_phy": 1.0}}, ["'b_phy'", "mean 'b_phi'"]),
        ({"drag": {"C": -1.0}}, ["row 0", "drag coefficient C", "at least 0"]),
        ({"drag": {"C": 0.5, "b_phi": np.nan}}, ["row 0", "b_phi", "finite"]),
        ({"params": {"m": 5.0}, "drag": {"C": np.ones(2)}}, ["drag: C", "(3,)", "(2,)"]),
        ({"drag": False}, ["drag", "by name", "cannot change"]),
        ({"params": {"m": 5.0}, "mask": np.zeros(3, bool)}, ["mask", "selects no row"]),
        ({"params": {"m": 5.0}, "mask": [True] * 3}, ["mask", "NumPy array"]),
    ],
)
def test_impossible_parameters_of_rows(rows, given, words):
    """Refused, and none of them is taken."""
    env = rows(params={"m": np.array([4.0, 5.0, 6.0])}, drag={"C": 0.4})
    blocks = env._memory.blocks.copy()
    with pytest.raises(ValueError, match=r".") as error:
        env.set_params(**given)
    _message(error, *words)
    assert env.params["m"].tolist() == [4.0, 5.0, 6.0]
    assert env.drag["C"] == 0.4
    assert np.array_equal(env._memory.blocks, blocks)


def test_drag_of_rows_that_have_none(rows):
    env = rows(params={"m": np.array([4.0, 5.0, 6.0])})
    with pytest.raises(ValueError, match="have none") as error:
        env.set_params(drag={"C": 0.5})
    _message(error, "C cannot change", "drag=True")
    assert env.drag is None


def test_parameters_of_some_rows_before_the_first_reset(rows):
    env = rows(params={"m": np.array([4.0, 5.0, 6.0])})
    env.set_params({"m": 7.0}, mask=np.array([False, True, False]))
    assert env.params["m"].tolist() == [4.0, 7.0, 6.0]
    env.params["m"][:] = 0.0  # a copy
    assert env.params["m"].tolist() == [4.0, 7.0, 6.0]


def test_ids_of_this_file_are_registered():
    assert {SNAKEBOARD, RACER, GOAL} <= set(nhenv.environment_ids())

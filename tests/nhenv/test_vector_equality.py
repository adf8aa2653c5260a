"""The vector environment against Gymnasium's `SyncVectorEnv` of single environments: equal to the last bit.

Both run the same source, but compiled for many rows side by side the one, for one environment the other; impacts on
stops are found by loops over rows and by branches. So nothing here has a tolerance.
"""

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, SyncVectorEnv

import nhenv
from nhenv.env import LocomotionEnv
from nhenv.vector_env import LocomotionVectorEnv

SNAKEBOARD, RACER = "nhenv/SnakeboardForward-v0", "nhenv/RollerRacerGoal-v0"
OFTEN = {"max_episode_steps": 47}  # so that episodes end all the time

MODES = pytest.mark.parametrize("mode", AutoresetMode, ids=lambda mode: mode.value)


def _pair(env_id, size, mode, **arguments):
    """The vector environment, and what it should equal."""
    native = gym.make_vec(env_id, num_envs=size, autoreset_mode=mode.value, info="all", **arguments)
    sync = gym.make_vec(
        env_id, num_envs=size, vectorization_mode="sync", vector_kwargs={"autoreset_mode": mode}, **arguments
    )
    assert isinstance(native, LocomotionVectorEnv)
    assert isinstance(sync, SyncVectorEnv)
    return native, sync


def _assert_same(ours, theirs, where):
    """The same arrays bit by bit, of the same types, under the same keys."""
    if isinstance(theirs, dict):
        assert ours.keys() == theirs.keys(), where
        for key, value in theirs.items():
            _assert_same(ours[key], value, (*where, key))
    elif theirs.dtype == object:
        assert [value is None for value in ours] == [value is None for value in theirs], where
        for one, other in zip(ours, theirs, strict=True):
            if other is not None:
                _assert_same(one, other, where)
    else:
        assert ours.dtype == theirs.dtype, where
        assert ours.shape == theirs.shape, where
        # Compared as bits, but for the sign of zero; there are no NaNs.
        assert np.array_equal(ours, theirs), (*where, np.argwhere(ours != theirs)[:5].tolist())


def _actions(rng, t, shape):
    """Actions of every kind that there may be, in turn for some steps each."""
    random = rng.uniform(-1.5, 1.5, shape)
    match t // 5 % 6:
        case 0:
            return random.astype(np.float32)
        case 1:
            return np.sign(random).astype(np.float32)  # bang-bang
        case 2:
            return np.ones(shape, np.float32) * (1 if t // 30 % 2 else -1)  # pressed against a stop
        case 3:
            return random
        case 4:
            return np.where(random > 0, 1e30, -np.inf).astype(np.float32)
    return np.zeros(shape, np.float32)


def _assert_equal_rollouts(native, sync, steps, seed=0):
    """Reset both and step them with the same actions; return how often a joint was seen on its stop."""
    rng, done, touched = np.random.default_rng(seed), np.zeros(native.num_envs, bool), 0
    joints = [(native.mechanism.coordinates.index(joint), stop) for joint, stop in native.joint_limits.items()]
    for ours, theirs in zip(native.reset(seed=seed), sync.reset(seed=seed), strict=True):
        _assert_same(ours, theirs, ("reset",))
    for t in range(steps):
        if native.autoreset_mode is AutoresetMode.DISABLED and done.any():
            both = [env.reset(options={"reset_mask": done.copy()}) for env in (native, sync)]
            for ours, theirs in zip(*both, strict=True):
                _assert_same(ours, theirs, ("masked reset", t))
        actions = _actions(rng, t, native.action_space.shape)
        both = native.step(actions), sync.step(actions)
        for name, ours, theirs in zip(("obs", "reward", "terminated", "truncated", "info"), *both, strict=True):
            _assert_same(ours, theirs, (name, t))
        done = both[0][2] | both[0][3]
        touched += sum(int((np.abs(native.q[:, i]) == stop).sum()) for i, stop in joints)
    return touched


@MODES
@pytest.mark.parametrize(
    ("size", "steps"),
    [(1, 1000), (7, 1000), (131, 130)],  # less and more than a block
)
@pytest.mark.parametrize("env_id", [SNAKEBOARD, RACER])
def test_equals_single_environments(env_id, size, steps, mode):
    native, sync = _pair(env_id, size, mode, **OFTEN)
    assert _assert_equal_rollouts(native, sync, steps) > steps * size / 50


@pytest.mark.slow
@MODES
@pytest.mark.parametrize("size", [1, 2, 3, 63, 64, 65, 127, 128, 129, 255, 257, 1000])
@pytest.mark.parametrize("env_id", [SNAKEBOARD, RACER])
def test_equals_single_environments_over_a_thousand_steps(env_id, size, mode):
    native, sync = _pair(env_id, size, mode, **OFTEN)
    assert _assert_equal_rollouts(native, sync, 1000, seed=size) > 20 * size


@pytest.mark.parametrize(("env_id", "limit"), [(SNAKEBOARD, {"u_phi": 8.0}), (RACER, {"u_psi": 4.0})])
def test_equals_single_environments_that_meet_stops_again_and_again(env_id, limit):
    """Torques so large that a joint crosses from stop to stop, and meets more than one of them in a hold."""
    native, sync = _pair(env_id, 131, AutoresetMode.NEXT_STEP, torque_limits=limit, **OFTEN)
    assert _assert_equal_rollouts(native, sync, 120) > 131 * 20


# Impacts of several joints take another way than those of one.
TWO_ARMS = {
    "name": "two_arms",
    "coordinates": ["x", "y", "theta", "a", "b"],
    "parameters": {"m": 2.0, "I": 0.3, "J": 0.1},
    "inertia": [[("m", "m", "I", "J", "2*J")[i] if i == j else "0" for j in range(5)] for i in range(5)],
    "one_forms": [["sin(theta + a)", "-cos(theta + a)", "0", "0", "0"]],
    "forces": {"u_a": list("00010"), "u_b": list("00001"), "u_x": ["cos(theta)", "sin(theta)", "0.1", "0", "0"]},
    "joint_limits": {"a": 0.3, "b": 0.2},
    "fibre": ["x", "y", "theta"],
}


VARIANTS = {
    "Velocity": ("nhenv/RollerRacerVelocity-v0", {}),
    "Goal": ("nhenv/SnakeboardGoal-v0", {}),
    "goals nearby": (RACER, {"goal_radius": 1.2}),  # so that episodes end by themselves
    "no stops": ("nhenv/RollerRacerForward-v0", {"joint_limits": False}),
    "no stops, explicit": (SNAKEBOARD, {"joint_limits": False}),
    "other stops": (SNAKEBOARD, {"joint_limits": {"phi": 0.3}}),
    "the whole state": (SNAKEBOARD, {"whole_state": True}),
    "parameters": (SNAKEBOARD, {"params": {"m": 5.0, "J_r": 0.1}, "dt": 0.04, "reset_noise_scale": 0.8}),
    "substeps": ("nhenv/RollerRacerForward-v0", {"integrator": "rk4", "substeps": 3}),
    "drag": (SNAKEBOARD, {"drag": True}),
    "some drag": (RACER, {"drag": {"C": 0.05}, "goal_radius": 1.2}),
    "kept energy": ("nhenv/RollerRacerForward-v0", {"keep_energy": True, "torque_limits": {"u_psi": 2.0}}),
    "kept energy, explicit": (SNAKEBOARD, {"keep_energy": True, "tolerance": 1e-13}),
    "two joints": ("nhenv/TwoArmsForward-v0", {}),
}


@pytest.fixture
def two_arms():
    (name,) = nhenv.register(TWO_ARMS, ["Forward"])
    yield
    del gym.registry[name]


@MODES
@pytest.mark.usefixtures("two_arms")
@pytest.mark.parametrize("backend", ["numpy", pytest.param("numba", marks=pytest.mark.slow)])
@pytest.mark.parametrize(("env_id", "arguments"), VARIANTS.values(), ids=VARIANTS)
def test_variants_equal_single_environments(env_id, arguments, backend, mode):
    """Interpreted, the rows' loops are compared with one environment's branches; compiled, all of it is."""
    size, steps = (3, 40) if backend == "numpy" else (131, 200)
    native, sync = _pair(env_id, size, mode, backend=backend, max_episode_steps=17, **arguments)
    touched = _assert_equal_rollouts(native, sync, steps)
    assert (touched > 0) == bool(native.joint_limits)


# Holds so long, and torques so large, that few of them are right in one flight.
HARD = {
    "layers": (SNAKEBOARD, {}),
    "core": (RACER, {}),
    "no joints": ("nhenv/ChaplyginBeanieForward-v0", {}),
    "two joints": ("nhenv/TwoArmsForward-v0", {}),
    "layers, no stops": (SNAKEBOARD, {"joint_limits": False}),
    "core, no stops": (RACER, {"joint_limits": False}),
    "no core, no joints": ("nhenv/DifferentialDriveForward-v0", {}),
    "released": ("nhenv/FallingRollingDiskForward-v0", {}),
    "each with its own": (SNAKEBOARD, {"params": {"m": np.array([4.0, 5.0, 6.0])}}),
}


@pytest.fixture
def late_rows(monkeypatch):
    """Count the rows of an interpreted vector environment that go in shorter flights, and those left to `hold`."""

    def watch(native, counts):
        kernel = native._kernel
        begin, end, hold = kernel.begin_flights, kernel.end_flights, kernel.hold

        def begin_flights(p, w, count, numbers):
            counts["late"] += int(count)
            begin(p, w, count, numbers)

        def end_flights(p, w, count, numbers):
            lost = end(p, w, count, numbers)
            counts["through"] += int(count - lost)
            return lost

        def counted(*arguments):
            counts["held"] += 1
            return hold(*arguments)

        for name, function in (("begin_flights", begin_flights), ("end_flights", end_flights), ("hold", counted)):
            monkeypatch.setattr(kernel, name, function)

    return watch


def _hard_pair(env_id, arguments, size, mode, dt, factor, **more):
    """A pair with so many times the usual torques; each row with parameters of its own if they are given like that."""
    one = gym.make(env_id, backend="numpy").unwrapped
    limits = dict(zip(one.mechanism.controls, factor * one.torque_limits, strict=True))
    shared = {"dt": dt, "torque_limits": limits, "max_episode_steps": 4, **more}
    if "params" not in arguments:
        return _pair(env_id, size, mode, **shared, **arguments)
    native = gym.make_vec(env_id, num_envs=size, autoreset_mode=mode.value, info="all", **shared, **arguments)
    single = [{name: float(value[row]) for name, value in arguments["params"].items()} for row in range(size)]
    made = [lambda params=params: gym.make(env_id, params=params, **shared) for params in single]
    return native, SyncVectorEnv(made, autoreset_mode=mode)


def _hard_cases():
    """The first four in every mode, the others in one."""
    for i, (name, case) in enumerate(HARD.items()):
        for mode in AutoresetMode if i < 4 else [AutoresetMode.SAME_STEP]:
            marks = [pytest.mark.slow] if name == "core, no stops" else []
            yield pytest.param(*case, mode, id=f"{name}-{mode.value}", marks=marks)


@pytest.mark.usefixtures("two_arms")
@pytest.mark.parametrize(("env_id", "arguments", "mode"), list(_hard_cases()))
def test_hard_holds_equal_those_of_single_environments(env_id, arguments, mode, late_rows):
    """To the last bit, whether rows go in shorter flights side by side or, where a few do not do, one by one."""
    counts = {"late": 0, "through": 0, "held": 0}
    # Many times the usual torques, then a few, with which the flights of most rows are halved once or twice.
    for dt, factor in ((0.3, 20), (0.2, 2)):
        native, sync = _hard_pair(env_id, arguments, 3, mode, dt, factor, backend="numpy")
        late_rows(native, counts)
        _assert_equal_rollouts(native, sync, 15)
    assert counts["late"] >= 10, counts
    assert counts["through"] >= 3, counts
    if native.joint_limits:
        assert counts["held"] > 0, counts


@pytest.mark.slow
@MODES
@pytest.mark.usefixtures("two_arms")
@pytest.mark.parametrize(("env_id", "arguments"), list(HARD.values())[:-1], ids=list(HARD)[:-1])
def test_compiled_hard_holds_equal_those_of_single_environments(env_id, arguments, mode):
    for dt, factor in ((0.3, 20), (0.2, 2)):
        _assert_equal_rollouts(*_hard_pair(env_id, arguments, 131, mode, dt, factor), 60)


@pytest.mark.parametrize(
    "env_id",
    [
        env_id if env_id.startswith(("nhenv/Car", "nhenv/Trailer")) else pytest.param(env_id, marks=pytest.mark.slow)
        for env_id in nhenv.environment_ids()
    ],
)
def test_every_id_equals_single_environments(env_id):
    native, sync = _pair(env_id, 3, AutoresetMode.SAME_STEP, backend="numpy", max_episode_steps=7)
    _assert_equal_rollouts(native, sync, 20)


@pytest.mark.slow
@pytest.mark.parametrize("env_id", nhenv.environment_ids())
def test_every_compiled_id_equals_single_environments(env_id):
    native, sync = _pair(env_id, 131, AutoresetMode.SAME_STEP, max_episode_steps=47)
    _assert_equal_rollouts(native, sync, 200)


# -- parameters of each row -----------------------------------------------------------------------

OWN = {"params": {"m": np.array([4.0, 5.0, 6.0]), "l": 0.22}, "torque_limits": {"u_phi": np.array([0.1, 0.5, 9.0])}}


def _single_with(row, backend, parameters=OWN):
    """Maker of the single environment that a row with parameters of its own should equal."""
    values = {
        what: {name: float(np.broadcast_to(value, 3)[row]) for name, value in given.items()}
        for what, given in parameters.items()
    }
    return lambda: gym.make(SNAKEBOARD, max_episode_steps=17, backend=backend, whole_state=True, **values)


BACKENDS = pytest.mark.parametrize("backend", ["numpy", pytest.param("numba", marks=pytest.mark.slow)])


@BACKENDS
def test_rows_may_have_parameters_of_their_own(backend):
    native = gym.make_vec(
        SNAKEBOARD, num_envs=3, info="all", max_episode_steps=17, backend=backend, whole_state=True, **OWN
    )
    sync = SyncVectorEnv([_single_with(row, backend) for row in range(3)])
    assert _assert_equal_rollouts(native, sync, 60) > 0
    for name in ("q", "v", "qdot", "energy"):
        assert np.array_equal(getattr(native, name), [getattr(env.unwrapped, name) for env in sync.envs])
    assert np.array_equal(native.torque_limits, [env.unwrapped.torque_limits for env in sync.envs])
    assert native.params["m"].tolist() == [4.0, 5.0, 6.0]
    assert native.params["l"] == 0.22


@BACKENDS
def test_new_parameters_in_the_middle_of_an_episode(backend):
    """The rows of a mask go on with them from where they are; nothing is compiled, the others notice nothing."""
    native = gym.make_vec(SNAKEBOARD, num_envs=3, backend=backend, whole_state=True, **OWN)
    kernel, rng = native._kernel, np.random.default_rng(0)
    native.reset(seed=0)
    native.step(rng.uniform(-1, 1, (3, 2)).astype(np.float32))
    compiled = len(getattr(kernel.step_rows, "signatures", ()))
    new = {"params": {"m": np.array([4.0, 7.0, 5.5])}, "torque_limits": {"u_phi": np.array([0.1, 0.4, 0.2])}}
    native.set_params(new["params"], new["torque_limits"], mask=np.array([False, True, True]))
    changed = {**new, "params": {**OWN["params"], **new["params"]}}
    singles = [_single_with(row, backend, changed if row else OWN)() for row in range(3)]
    for env, q, qdot in zip(singles, native.q, native.qdot, strict=True):
        env.reset(options={"q": q, "qdot": qdot})
    for _ in range(10):
        actions = rng.uniform(-1, 1, (3, 2)).astype(np.float32)
        observations = native.step(actions)[0]
        for env, action, observation in zip(singles, actions, observations, strict=True):
            # v is projected from q̇, which leaves rounding errors that the motion amplifies little in ten steps.
            assert env.step(action)[0] == pytest.approx(observation, rel=1e-5, abs=1e-6)
    assert native._kernel is kernel
    assert len(getattr(kernel.step_rows, "signatures", ())) == compiled
    assert native.params["m"].tolist() == [4.0, 7.0, 5.5]
    assert native.torque_limits[:, 1].tolist() == [0.1, 0.4, 0.2]


def test_the_same_parameters_in_each_row_are_those_of_all():
    """The kernel with parameters for each row equals that without."""
    same = {"m": np.full(5, 5.0)}
    own = gym.make_vec(SNAKEBOARD, num_envs=5, backend="numpy", params=same)
    shared = gym.make_vec(SNAKEBOARD, num_envs=5, backend="numpy", params={"m": 5.0})
    assert np.array_equal(own.reset(seed=0)[0], shared.reset(seed=0)[0])
    rng = np.random.default_rng(0)
    for _ in range(20):
        actions = rng.uniform(-1, 1, (5, 2)).astype(np.float32)
        for ours, theirs in zip(own.step(actions)[:4], shared.step(actions)[:4], strict=True):
            assert np.array_equal(ours, theirs)


# -- state ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("task", ["Forward", "Velocity", "Goal"])
def test_states_are_those_of_single_environments(task):
    arguments = {"backend": "numpy", "whole_state": True}
    native, sync = _pair(f"nhenv/Snakeboard{task}-v0", 3, AutoresetMode.NEXT_STEP, **arguments)
    for env in (native, sync):
        env.reset(seed=0)
    rng = np.random.default_rng(0)
    for t in range(5):
        actions = rng.uniform(-1, 1, (3, 2))
        for env in (native, sync):
            env.step(actions)
        singles = [env.unwrapped for env in sync.envs]
        for name in ("q", "v", "qdot", "energy", "torque_limits"):
            value = getattr(native, name)
            assert np.array_equal(value, [getattr(env, name) for env in singles])
            assert value.dtype == np.float64
        assert native.targets.keys() == singles[0].targets.keys()
        for name, values in native.targets.items():
            assert values.tolist() == [env.targets[name] for env in singles]
        assert native.elapsed_steps.tolist() == [t + 1] * 3


def test_what_is_not_followed_is_not_a_number():
    """And whatever depends on it is not either; the rest equals that of an environment that follows everything."""
    some, every = (gym.make_vec(SNAKEBOARD, num_envs=3, backend="numpy", whole_state=whole) for whole in (False, True))
    for env in (some, every):
        env.reset(seed=0)
        env.step(np.ones((3, 2)))
    names = np.array(some.mechanism.coordinates)
    unknown = np.isnan(some.q).all(axis=0)
    assert set(names[unknown]) == {"y", "psi"} == set(some.mechanism.coordinates) - set(some._kernel.STATES)
    assert np.array_equal(some.q[:, ~unknown], every.q[:, ~unknown])
    for name in ("v", "qdot", "energy"):
        assert np.array_equal(getattr(some, name), getattr(every, name))


def test_rows_are_made_as_single_environments_are():
    """Without `make_vec` too; spaces are batches of a single environment's."""
    one = LocomotionEnv("snakeboard", "Goal", backend="numpy")
    env = LocomotionVectorEnv("snakeboard", "Goal", 4, backend="numpy")
    assert env.single_action_space == one.action_space
    assert env.single_observation_space == one.observation_space
    assert env.observation_labels == one.observation_labels
    assert env.observation_space.shape == (4, *one.observation_space.shape)
    assert env.metadata["autoreset_mode"] is AutoresetMode.NEXT_STEP
    assert "autoreset_mode" not in LocomotionVectorEnv.metadata

"""Environments of a mechanism that a user writes down: from plain data to `gym.make` and `gym.make_vec`."""

import dataclasses
import json
import pickle
import re
import warnings

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.envs.registration import EnvSpec
from gymnasium.utils.env_checker import check_env as gymnasium_check
from stable_baselines3.common.env_checker import check_env as sb3_check

import mechanics
import nhenv
from mechanics.mechanism import Mechanism
from nhenv.env import LocomotionEnv
from nhenv.registration import as_mechanism
from nhenv.tasks import Task

# A knife edge behind the centre of mass, and a rotor to swing. No frame, no fibre, no limits, no observation.
SLEIGH = {
    "name": "my_sleigh",
    "coordinates": ["x", "y", "theta", "psi"],
    "parameters": {"m": 1.0, "I": 0.1, "J": 0.02, "a": 0.2},
    "inertia": [
        ["m", "0", "-m*a*sin(theta)", "0"],
        ["0", "m", "m*a*cos(theta)", "0"],
        ["-m*a*sin(theta)", "m*a*cos(theta)", "I + J + m*a**2", "J"],
        ["0", "0", "J", "J"],
    ],
    "one_forms": [["-sin(theta)", "cos(theta)", "0", "0"]],
    "forces": {"u_psi": ["0", "0", "0", "1"]},
}
IDS = ("nhenv/MySleighForward-v0", "nhenv/MySleighVelocity-v0", "nhenv/MySleighGoal-v0")
STAY = Task(name="Stay", reward={"reward_stay": "-abs(psi_dot)"}, max_episode_steps=20)


@pytest.fixture(autouse=True)
def forget():
    """Leave Gymnasium's registry as it was."""
    before = dict(gym.registry)
    yield
    gym.registry.clear()
    gym.registry.update(before)


@pytest.fixture
def sleigh():
    """A mechanism like the spec's with other values."""

    def make_sleigh(**changes):
        return Mechanism.from_dict({**SLEIGH, **changes})

    return make_sleigh


def _roll(env, steps=30, seed=4):
    """Observations and rewards of random actions."""
    rows = [env.reset(seed=seed)[0]]
    rng = np.random.default_rng(0)
    for _ in range(steps):
        observation, reward, *_ = env.step(rng.uniform(-1, 1, env.action_space.shape).astype(np.float32))
        rows.append(np.append(observation, reward))
    return np.concatenate(rows)


# -- from data to environments ------------------------------------------------------------------


def test_ids_of_a_mechanism_of_ones_own():
    before = nhenv.environment_ids()
    assert nhenv.register(SLEIGH) == IDS
    assert nhenv.environment_ids() == (*before, *IDS)
    assert [gym.spec(name).max_episode_steps for name in IDS] == [300, 300, 300]


def test_plain_data_to_gym_make(make):
    """The whole way, compiled: both checkers, seeds, a copy in mid-episode, and what is documented as default."""
    nhenv.register(SLEIGH)
    env = make("nhenv/MySleighGoal-v0", torque_limits=0.5)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        gymnasium_check(env.unwrapped)
        sb3_check(env)
    assert not [str(w.message) for w in caught if not re.search("m..imum value is -?infinity", str(w.message))]
    assert env.unwrapped.mechanism.fibre == ("x", "y", "theta")  # found
    assert env.unwrapped.observation_labels[:3] == ("psi_dot", "speed", "heading_dot")
    assert np.array_equal(_roll(env), _roll(make("nhenv/MySleighGoal-v0", torque_limits=0.5)))
    assert not np.array_equal(_roll(env), _roll(env, seed=5))
    twin = pickle.loads(pickle.dumps(env))
    action = np.array([0.5], np.float32)
    assert np.array_equal(env.step(action)[0], twin.step(action)[0])
    assert env.unwrapped.targets == twin.unwrapped.targets


def test_defaults_of_what_a_mechanism_does_not_declare(make):
    """Torque limit 1, no stops, and the heading random at reset: no two episodes are alike."""
    nhenv.register(SLEIGH)
    env = make("nhenv/MySleighForward-v0", backend="numpy")
    bare = env.unwrapped
    assert bare.torque_limits.tolist() == [1.0]
    assert bare.joint_limits == {}
    starts = [env.reset(seed=seed) and bare.q for seed in range(40)]
    assert all(not q[[0, 1, 3]].any() for q in starts)
    # 40 uniform draws leave an outer half empty with probability 1e-12.
    assert 0.025 < max(q[2] for q in starts) <= 0.05
    assert -0.05 <= min(q[2] for q in starts) < -0.025


@pytest.mark.parametrize(
    "mode", ["sync", pytest.param("async", marks=pytest.mark.slow)], ids=["sync", "async"]
)  # two processes
def test_vectors_of_a_mechanism_of_ones_own(make, mode):
    nhenv.register(SLEIGH)
    vector = gym.make_vec(IDS[0], num_envs=2, vectorization_mode=mode, backend="numpy")
    single = make(IDS[0], backend="numpy")
    try:
        observations, _ = vector.reset(seed=7)
        assert np.array_equal(observations[1], single.reset(seed=8)[0])
        for sign in (1, -1, 1):
            observations, rewards, *_ = vector.step(np.full((2, 1), sign, np.float32))
            expected, reward, *_ = single.step(np.full(1, sign, np.float32))
            assert np.array_equal(observations[1], expected)
            assert rewards[1] == reward
    finally:
        vector.close()


def test_an_environment_by_data_is_that_by_object(sleigh):
    """What register stores, what `from_dict` makes and what the class is given are one mechanism."""
    nhenv.register(SLEIGH)
    by_id = gym.make(IDS[1], backend="numpy")
    mechanism = sleigh(fibre=["x", "y", "theta"])
    assert by_id.unwrapped.mechanism == mechanism
    assert np.array_equal(_roll(by_id), _roll(LocomotionEnv(mechanism, "Velocity", backend="numpy")))
    by_id.close()


def test_specs_are_plain_data(capsys):
    """They can be printed, and go through JSON to another process."""
    nhenv.register(SLEIGH, tasks=["Goal", STAY])
    for name in (IDS[2], "nhenv/MySleighStay-v0"):
        spec = gym.spec(name)
        spec.pprint(print_all=True)
        assert name in capsys.readouterr().out
        text = spec.to_json()
        assert "my_sleigh" in text
        again = EnvSpec.from_json(text)
        first, second = (gym.make(s, backend="numpy") for s in (spec, again))
        assert np.array_equal(_roll(first), _roll(second))
        assert second.spec.max_episode_steps == spec.max_episode_steps
        first.close()
        second.close()


def test_many_environments_check_the_mechanism_once(monkeypatch):
    nhenv.register(SLEIGH)
    kwargs = gym.spec(IDS[0]).kwargs
    assert as_mechanism(kwargs["mechanism"]) is as_mechanism(json.loads(json.dumps(kwargs["mechanism"])))


@pytest.mark.parametrize("suffix", [".json", ".toml"])
def test_a_mechanism_may_be_a_file(tmp_path, suffix):
    text = json.dumps(SLEIGH)
    if suffix == ".toml":
        parameters = "\n".join(f"{name} = {value}" for name, value in SLEIGH["parameters"].items())
        keys = ("name", "coordinates", "inertia", "one_forms")
        rest = "\n".join(f"{key} = {json.dumps(SLEIGH[key])}" for key in keys)
        text = f"{rest}\n[parameters]\n{parameters}\n[forces]\nu_psi = {json.dumps(SLEIGH['forces']['u_psi'])}\n"
    path = tmp_path / f"sleigh{suffix}"
    path.write_text(text, encoding="utf-8")
    assert nhenv.register(path) == nhenv.register(str(path)) == nhenv.register(SLEIGH) == IDS
    assert LocomotionEnv(str(path), backend="numpy").mechanism.name == "my_sleigh"


def test_a_task_of_ones_own(make):
    assert nhenv.register(SLEIGH, tasks=(STAY, "Forward")) == ("nhenv/MySleighStay-v0", IDS[0])
    env = make("nhenv/MySleighStay-v0", backend="numpy")
    env.reset(seed=0)
    _, reward, *_ = env.step(np.ones(1, np.float32))
    assert reward == pytest.approx(-abs(env.unwrapped.qdot[3]), rel=1e-15)
    flags = [env.step(np.zeros(1, np.float32))[3] for _ in range(19)]
    assert flags == [False] * 18 + [True]


def test_a_task_without_a_pose_needs_none(sleigh):
    """No x, y or heading in it: any mechanism with a control will do."""
    tilted = sleigh(name="tilted", potential="9.81*m*sin(x)")  # nothing to displace freely
    assert nhenv.register(tilted, tasks=[STAY]) == ("nhenv/TiltedStay-v0",)
    with gym.make("nhenv/TiltedStay-v0", backend="numpy") as env:
        assert np.isfinite(_roll(env)).all()


# -- again, and another -------------------------------------------------------------------------


def test_registering_the_same_again_is_harmless(sleigh):
    first = nhenv.register(SLEIGH)
    specs = [gym.spec(name) for name in first]
    assert nhenv.register(sleigh()) == nhenv.register(sleigh(fibre=["x", "y", "theta"])) == first
    assert [gym.spec(name) for name in first] == specs
    assert all(gym.spec(name) is spec for name, spec in zip(first, specs, strict=True))


def test_registering_the_catalogues_own_is_harmless():
    before = dict(gym.registry)
    ids = tuple(name for name in nhenv.environment_ids() if name.startswith("nhenv/Snakeboard"))
    assert nhenv.register("snakeboard") == nhenv.register(mechanics.get("snakeboard")) == ids
    assert nhenv.register(mechanics.get("snakeboard").to_dict(), tasks=["Goal"]) == ids[2:3]
    assert gym.registry == before


def test_another_mechanism_of_the_same_name():
    nhenv.register(SLEIGH, tasks=["Velocity"])
    before = dict(gym.registry)
    heavier = {**SLEIGH, "parameters": {**SLEIGH["parameters"], "m": 2.0}}
    with pytest.raises(ValueError, match="registered already") as error:
        nhenv.register(heavier)
    assert "MySleighVelocity-v0" in str(error.value)
    assert "another name" in str(error.value)
    assert gym.registry == before  # nor are the ids that were free
    exec(re.search(r"gymnasium\.registry\.pop\(.*?\)", str(error.value))[0], {"gymnasium": gym})  # what it says works
    assert nhenv.register(heavier) == IDS
    for other in ({**SLEIGH, "name": "snakeboard"}, {**SLEIGH, "name": "roller_Racer"}):
        with pytest.raises(ValueError, match="registered already"):
            nhenv.register(other)


def test_another_task_of_the_same_name():
    nhenv.register(SLEIGH, tasks=[STAY])
    with pytest.raises(ValueError, match="registered already"):
        nhenv.register(SLEIGH, tasks=[dataclasses.replace(STAY, max_episode_steps=21)])
    goal = dataclasses.replace(nhenv.TASKS[2], weights={**nhenv.TASKS[2].weights, "goal_radius": 0.3})
    assert nhenv.register(SLEIGH, tasks=[goal]) == IDS[2:]
    with gym.make(IDS[2], backend="numpy") as env:
        assert env.unwrapped.task.weights["goal_radius"] == 0.3
    with pytest.raises(ValueError, match="registered already"):
        nhenv.register(SLEIGH)


# -- what cannot be registered ------------------------------------------------------------------


REFUSED = {
    "no controls": ({"forces": {}}, None, ValueError, ["my_sleigh", "no controls", "declare forces"]),
    "no plane": ({"potential": "m*x"}, None, ValueError, ["my_sleigh", "'Forward'", "heading", "declare", "fibre"]),
    "no plane for this": ({"potential": "m*x"}, ["Goal"], ValueError, ["'Goal'", "heading", "fibre"]),
    "another name": ({}, [{**dataclasses.asdict(STAY), "info": {"r": "phi"}}], ValueError, ["'Stay'", "phi"]),
    "task misspelt": ({}, ["Gaol"], ValueError, ["'Gaol'", "mean 'Goal'"]),
    "one task": ({}, "Goal", TypeError, ["several", "'Goal'"]),
    "no tasks": ({}, [], ValueError, ["tasks", "at least one"]),
    "twice": ({}, ["Goal", "Forward", nhenv.TASKS[2]], ValueError, ["different names", "'Goal', 'Forward', 'Goal'"]),
}


@pytest.mark.parametrize(("changes", "tasks", "kind", "words"), REFUSED.values(), ids=REFUSED)
def test_what_cannot_be_registered(changes, tasks, kind, words):
    before = dict(gym.registry)
    with pytest.raises(kind) as error:
        nhenv.register({**SLEIGH, **changes}, tasks)
    assert not [word for word in words if word not in str(error.value)]
    assert gym.registry == before


@pytest.mark.parametrize(
    ("mechanism", "words"),
    [
        ("snakeboad", ["'snakeboad'", "mean 'snakeboard'"]),
        ("no/such/sleigh.toml", ["no/such/sleigh.toml"]),
        ({**SLEIGH, "inertias": []}, ["'inertias'", "mean 'inertia'"]),
        ({**SLEIGH, "parameters": {"m": object()}}, ["m", "number"]),
        (3, ["Mechanism", "3"]),
    ],
    ids=["misspelt", "no file", "bad key", "no data", "a number"],
)
def test_what_is_no_mechanism(mechanism, words):
    with pytest.raises((ValueError, TypeError, OSError)) as error:
        nhenv.register(mechanism)
    assert not [word for word in words if word not in str(error.value)]


def test_stops_need_a_joint_that_one_field_moves(sleigh):
    """The rotor turns against the body: in this frame two fields move it."""
    frame = [["cos(theta)", "sin(theta)", "0", "0"], ["0", "0", "1", "-1"], ["0", "0", "1", "1"]]
    nhenv.register(sleigh(joint_limits={"psi": 1.0}, frame=frame))
    with pytest.raises(ValueError, match="joint limit of 'psi'") as error:
        gym.make(IDS[0])
    assert "joint_limits=False" in str(error.value)
    gym.make(IDS[0], joint_limits=False, backend="numpy").close()

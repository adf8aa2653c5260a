"""The tasks Velocity and Goal against formulas written out by hand, and tasks of a user's own.

Kernels are interpreted here: that compiled ones agree is a test of `test_scene`.
"""

import dataclasses
import json
import math

import gymnasium as gym
import numpy as np
import pytest
from scipy.stats import kstest

import nhenv
from mechanics.expressions import ExpressionError
from nhenv import tasks
from nhenv.env import LocomotionEnv
from nhenv.tasks import Task

MECHANISMS = {"snakeboard": 1.0, "roller_racer": -1.0}  # and the way along x in which gaits drive them


@pytest.fixture(params=MECHANISMS)
def mechanism(request):
    return request.param


@pytest.fixture
def make_task():
    """Environment with an interpreted kernel."""

    def make_env(mechanism, task, **options):
        return LocomotionEnv(mechanism, task, backend="numpy", **options)

    return make_env


def _pose(env):
    """x, y and heading, from outside."""
    return env.q[:3]


def _rolling(env, speed, heading=0.0):
    """Coordinates and velocities of a mechanism that rolls straight on: all joints straight and at rest."""
    q, qdot = np.zeros(env.mechanism.n), np.zeros(env.mechanism.n)
    q[2] = heading
    qdot[:2] = speed * np.cos(heading), speed * np.sin(heading)
    return q, qdot


# -- Velocity -----------------------------------------------------------------------------------


def test_reward_of_the_velocity_task(mechanism, make_task, actions):
    """The documented formula, from the velocity of the model and the target."""
    weights = {"velocity_cost_weight": 1.7, "sideways_cost_weight": 0.4, "ctrl_cost_weight": 0.3}
    env = make_task(mechanism, "Velocity", **weights)
    q = np.linspace(-0.4, 0.9, env.mechanism.n)
    env.reset(seed=3, options={"q": q})
    command = env.targets["commanded_speed"]
    for action in actions(env, 60):
        observation, reward, terminated, truncated, info = env.step(action)
        vx, vy, *_ = env.qdot
        # Sums of a few terms of order one.
        assert info["x_velocity"] == pytest.approx(vx, rel=1e-12, abs=1e-14)
        assert info["y_velocity"] == pytest.approx(vy, rel=1e-12, abs=1e-14)
        velocity = 1 - 1.7 * abs(MECHANISMS[mechanism] * vx - command)
        assert info["reward_velocity"] == pytest.approx(velocity, rel=1e-12, abs=1e-13)
        assert info["reward_sideways"] == pytest.approx(-0.4 * abs(vy), rel=1e-12, abs=1e-14)
        assert info["reward_ctrl"] == pytest.approx(-0.3 * np.mean(action.astype(float) ** 2), rel=1e-14)
        assert reward == sum(info[key] for key in info if key.startswith("reward_"))
        assert observation[-3:] == pytest.approx([math.cos(env.q[2]), math.sin(env.q[2]), command], abs=1e-7)
        assert (terminated, truncated) == (False, False)


def test_rolling_at_the_commanded_speed_is_the_best_there_is(mechanism, make_task):
    """Forward is the way in which gaits drive the mechanism: backwards for the racer. The other way pays less."""
    env = make_task(mechanism, "Velocity")
    nothing, way = np.zeros(env.action_space.shape, np.float32), MECHANISMS[mechanism]
    rewards = []
    for side in (way, -way):
        q, qdot = _rolling(env, 0.7 * side)
        env.reset(options={"q": q, "qdot": qdot, "target": {"commanded_speed": 0.7}})
        rewards.append(env.step(nothing)[1])
    # Defaults of the documentation: 1 - |vx - cmd|/0.5, and -0.7 m/s is 1.4 m/s from 0.7 m/s.
    assert rewards == pytest.approx([1.0, 1 - 1.4 / 0.5], abs=1e-12)


def test_the_default_weights_are_those_of_the_documentation(mechanism, make_task):
    env = make_task(mechanism, "Velocity")
    q, qdot = _rolling(env, 0.5, heading=1.1)
    env.reset(options={"q": q, "qdot": qdot, "target": {"commanded_speed": 0.9}})
    action = np.full(env.action_space.shape, 0.5, np.float32)
    _, reward, *_ = env.step(action)
    vx, vy, *_ = env.qdot
    assert reward == pytest.approx(
        1 - abs(MECHANISMS[mechanism] * vx - 0.9) / 0.5 - 0.2 * abs(vy) - 0.02 * 0.25, rel=1e-12
    )


def test_velocity_never_integrates_the_position(mechanism, make_task):
    """What follows from no position is pruned, and is there all the same when asked for."""
    env, other = make_task(mechanism, "Velocity"), make_task(mechanism, "Forward")
    assert {"x", "y"} <= set(env._scene.kernel.PRUNED)
    for twin in (env, other):
        twin.reset(seed=1)
    for action in np.random.default_rng(0).uniform(-1, 1, (40, *env.action_space.shape)):
        env.step(action)
        other.step(action)
    # The same formulas, whose terms may be added in another order; forty holds.
    assert env.q == pytest.approx(other.q, rel=1e-11, abs=1e-12)


# -- Goal ---------------------------------------------------------------------------------------


def test_reward_and_observation_of_the_goal_task(mechanism, make_task, actions):
    """Direction and distance by complex numbers, from env.q; nothing of the kernel is used."""
    weights = {"progress_reward_weight": 1.5, "time_cost_weight": 0.7, "ctrl_cost_weight": 0.3}
    env = make_task(mechanism, "Goal", **weights)
    env.reset(seed=4, options={"q": np.linspace(-0.9, 0.8, env.mechanism.n)})
    goal = complex(env.targets["goal_x"], env.targets["goal_y"])
    x, y, heading = _pose(env)
    before = abs(goal - complex(x, y))
    for action in actions(env, 60):
        observation, reward, terminated, _, info = env.step(action)
        x, y, heading = _pose(env)
        offset = goal - complex(x, y)
        direction = offset / abs(offset) * np.exp(-1j * heading)
        # float32 rounds to 6e-8.
        assert observation[-3:] == pytest.approx([direction.real, direction.imag, abs(offset) / 2], rel=1e-7, abs=2e-7)
        # Differences of distances of order one over 0.05 s.
        assert info["reward_progress"] == pytest.approx(1.5 * (before - abs(offset)) / 0.05, rel=1e-12, abs=1e-12)
        assert info["reward_time"] == -0.7
        assert info["reward_ctrl"] == pytest.approx(-0.3 * np.mean(action.astype(float) ** 2), rel=1e-14)
        assert info["reward_goal"] == 0
        assert reward == sum(info[key] for key in info if key.startswith("reward_"))
        assert (info["x_position"], info["y_position"]) == (x, y)
        assert info["goal_distance"] == pytest.approx(abs(offset), rel=1e-15)
        assert terminated is False
        before = abs(offset)


def test_progress_adds_up_to_the_distance_gained(mechanism, make_task, actions):
    env = make_task(mechanism, "Goal")
    env.reset(seed=0)
    goal = env.targets["goal_x"], env.targets["goal_y"]
    first = math.dist(goal, _pose(env)[:2])
    progress = [env.step(action)[4]["reward_progress"] for action in actions(env, 200)]
    last = math.dist(goal, _pose(env)[:2])
    assert abs(first - last) > 1e-3  # it has moved
    # Two hundred differences of numbers of order one.
    assert sum(progress) * env.dt == pytest.approx(first - last, abs=1e-12)


@pytest.mark.parametrize("radius", [0.15, 0.4])
def test_the_goal_ends_the_episode_and_is_paid_once(mechanism, make_task, radius):
    """Rolling freely at 1 m/s the distance shrinks by 0.05 m a step: when it falls below the radius is known."""
    options = {} if radius == 0.15 else {"goal_radius": radius, "goal_reward_weight": 7.0}
    env = make_task(mechanism, "Goal", **options)
    nothing = np.zeros(env.action_space.shape, np.float32)
    q, qdot = _rolling(env, 1.0, heading=0.6)
    start = 1.02
    env.reset(options={"q": q, "qdot": qdot, "target": {"start_distance": start, "start_bearing": 0.0}})
    steps = next(k for k in range(100) if start - 0.05 * k < radius)
    for k in range(1, steps + 1):
        _, reward, terminated, truncated, info = env.step(nothing)
        assert info["goal_distance"] == pytest.approx(start - 0.05 * k, abs=1e-12)
        assert terminated is (k == steps)
        assert truncated is False
        assert info["is_success"] == (k == steps)
        assert info["reward_goal"] == (options.get("goal_reward_weight", 5.0) if k == steps else 0)
        # -(Δd)/dt - 0.5, as documented.
        assert reward == pytest.approx(1.0 - 0.5 + info["reward_goal"], abs=1e-11)
        assert "diverged" not in info


def test_the_distance_to_end_at_is_sharp(mechanism, make_task):
    """A hair outside the radius the episode goes on, a hair inside it ends."""
    env = make_task(mechanism, "Goal")
    nothing = np.zeros(env.action_space.shape, np.float32)
    for hair, over in ((1e-9, False), (-1e-9, True)):
        env.reset(options={"q": np.zeros(env.mechanism.n), "target": {"goal_x": 0.15 + hair, "goal_y": 0.0}})
        assert env.step(nothing)[2] is over  # at rest, it stays where it is


def test_the_goal_ends_the_episode_of_a_compiled_and_wrapped_environment(make):
    """Also through `gym.make`; and a new episode has a goal of its own."""
    env = make("nhenv/RollerRacerGoal-v0")
    nothing = np.zeros(env.action_space.shape, np.float32)
    q, qdot = _rolling(env.unwrapped, -1.0)
    env.reset(seed=0, options={"q": q, "qdot": qdot, "target": {"goal_x": -0.22, "goal_y": 0.0}})
    flags = [env.step(nothing)[2:4] for _ in range(2)]
    assert flags == [(False, False), (True, False)]
    _, info = env.reset()
    assert math.hypot(info["goal_x"], info["goal_y"]) >= 1
    assert env.step(nothing)[2:4] == (False, False)


def test_divergence_is_no_success(make_task):
    """A state that stops being finite inside the goal's radius would be one."""
    env = make_task("snakeboard", "Goal", torque_limits=1e308, dt=1e3, joint_limits=False, goal_radius=1e9)
    env.reset(seed=0)
    _, _, terminated, _, info = env.step(np.ones(2, np.float32))
    assert terminated is True
    assert info["diverged"] is True
    assert info["is_success"] == info["reward_goal"] == 0


def test_the_goal_itself_has_a_finite_direction(mechanism, make_task):
    env = make_task(mechanism, "Goal")
    target = {"goal_x": 0.0, "goal_y": 0.0}
    observation, _ = env.reset(options={"q": np.zeros(env.mechanism.n), "target": target})
    assert observation[-3:].tolist() == [0, 0, 0]
    assert np.isfinite(env.step(np.zeros(env.action_space.shape, np.float32))[0]).all()


def test_states_that_the_goal_does_not_need_are_known(make_task, actions):
    """The snakeboard's rotor angle is pruned; Forward prunes it too, and Velocity the position besides."""
    envs = [make_task("snakeboard", task) for task in ("Goal", "Forward", "Velocity")]
    assert envs[0]._scene.kernel.PRUNED == ("psi",)
    for env in envs:
        env.reset(seed=2)
    for action in actions(envs[0], 30):
        for env in envs:
            env.step(action)
    for env in envs[1:]:
        # The same formulas, whose terms may be added in another order; thirty holds.
        assert env.q == pytest.approx(envs[0].q, rel=1e-11, abs=1e-12)
        assert env.qdot == pytest.approx(envs[0].qdot, rel=1e-11, abs=1e-12)


# -- Turn and Park ------------------------------------------------------------------------------


def _apart(env, target_heading):
    """What is left to turn, by complex numbers."""
    return np.angle(np.exp(1j * (target_heading - env.q[2])))


def test_reward_and_observation_of_the_turn_task(make_task, actions):
    env = make_task(
        "snakeboard", "Turn", ctrl_cost_weight=0.3, offset_cost_weight=0.7, heading_tolerance=0.8, offset_tolerance=0.2,
        arrival_reward_weight=0.4,
    )  # fmt: skip
    # Half a turn away, so that the angle still to turn crosses the cut at ±π.
    env.reset(seed=4, options={"q": [0.3, -0.2, 2.9, 0.1, 0.0], "target": {"turn_size": np.pi, "turn_side": 0.2}})
    assert env.targets == {"target_heading": 2.9 + np.pi, "start_x": 0.3, "start_y": -0.2}
    signs = set()
    for action in actions(env, 120):
        observation, reward, terminated, _, info = env.step(action)
        e, offset = _apart(env, 2.9 + np.pi), complex(0.3, -0.2) - complex(*env.q[:2])
        seen = offset * np.exp(-1j * env.q[2])
        # float32 rounds to 6e-8 of numbers up to one, and there are numbers up to four behind a cosine.
        assert observation[-4:] == pytest.approx([seen.real, seen.imag, np.cos(e), np.sin(e)], rel=1e-7, abs=2e-7)
        assert info["heading_error"] == pytest.approx(e, abs=1e-14)
        assert info["offset"] == pytest.approx(abs(offset), rel=1e-12, abs=1e-15)
        assert info["reward_heading"] == pytest.approx(-abs(e) / np.pi, abs=1e-14)
        assert info["reward_offset"] == pytest.approx(-0.7 * abs(offset), rel=1e-12, abs=1e-15)
        # an exponent of tens
        arrival = 0.4 * np.exp(-((e / 0.8) ** 2) - (abs(offset) / 0.2) ** 2)
        assert info["reward_arrival"] == pytest.approx(arrival, rel=1e-10)
        assert info["reward_ctrl"] == pytest.approx(-0.3 * np.mean(action.astype(float) ** 2), rel=1e-14)
        assert reward == sum(info[key] for key in info if key.startswith("reward_"))
        assert terminated is False
        signs.add(np.sign(e))
    assert signs == {-1, 1}  # it crossed the cut, or this test shows less than it says


def test_reward_and_observation_of_the_park_task(make_task, actions):
    env = make_task("snakeboard", "Park", near_reward_weight=1.5, progress_reward_weight=0.6, offset_tolerance=0.3)
    env.reset(seed=4, options={"q": [0.3, -0.2, 0.9, 0.1, 0.4], "target": {"park_size": 0.25, "park_side": -0.2}})
    place = complex(0.3, -0.2) - 0.25 * np.exp(1j * (0.9 + np.pi / 2))
    # Places of order one.
    assert complex(env.targets["place_x"], env.targets["place_y"]) == pytest.approx(place, abs=1e-15)
    assert env.targets["target_heading"] == 0.9
    before = 0.25
    for action in actions(env, 60):
        observation, reward, terminated, _, info = env.step(action)
        e, offset = _apart(env, 0.9), place - complex(*env.q[:2])
        seen, d = offset * np.exp(-1j * env.q[2]), abs(offset)
        assert observation[-4:] == pytest.approx([seen.real, seen.imag, np.cos(e), np.sin(e)], rel=1e-7, abs=2e-7)
        assert (info["heading_error"], info["offset"]) == pytest.approx((e, d), rel=1e-12, abs=1e-14)
        # Differences of distances of order one over 0.05 s.
        assert info["reward_progress"] == pytest.approx(0.6 * (before - d) / 0.05, rel=1e-12, abs=1e-12)
        near = 1.5 * np.exp(-((d / 0.2) ** 2)) * (0.25 + 0.75 * ((1 + np.cos(e)) / 2) ** 2)
        assert info["reward_near"] == pytest.approx(near, rel=1e-11)
        assert info["reward_arrival"] == pytest.approx(np.exp(-((d / 0.3) ** 2) - (e / 0.15) ** 2), rel=1e-10)
        assert info["reward_ctrl"] == pytest.approx(-0.02 * np.mean(action.astype(float) ** 2), rel=1e-14)
        assert reward == sum(info[key] for key in info if key.startswith("reward_"))
        assert terminated is False
        before = d


@pytest.mark.parametrize(
    ("task", "target", "tolerance"),
    [("Turn", {"turn_side": 1.0, "start_x": 0.0}, 0.15), ("Park", {"place_x": 0.0, "place_y": 0.0}, 0.1)],
)
def test_what_counts_as_success(make_task, task, target, tolerance):
    """At rest a hair inside of both tolerances, and a hair outside of either."""
    env, nothing = make_task("snakeboard", task), np.zeros(2, np.float32)
    heading, hair = 0.3, 1e-9
    q = np.array([0, 0, heading, 0, 0.0])
    for turn, offset, success in ((-hair, -hair, 1), (hair, -hair, 0), (-hair, hair, 0), (hair, hair, 0)):
        place = "start_y" if task == "Turn" else "place_x"
        aim = {"target_heading": heading - 0.15 - turn, place: tolerance + offset}
        env.reset(options={"q": q, "target": {**target, **aim}})
        assert env.step(nothing)[4]["is_success"] == success


@pytest.mark.parametrize("task", ["Goal", "Turn", "Park"])
def test_targets_are_seen_from_the_start(make_task, task):
    """A displaced and turned start moves the targets with it; what is seen of them stays the same."""
    env = make_task("snakeboard", task)
    first, _ = env.reset(seed=6, options={"q": np.zeros(5)})
    second, _ = env.reset(seed=6, options={"q": [3.0, -2.0, 1.1, 0, 0]})
    # float32
    assert second == pytest.approx(first, rel=1e-6, abs=3e-7)


def test_targets_are_seen_from_a_start_that_is_drawn(make_task):
    """A disk has no joints: its heading is random."""
    env = make_task("vertical_rolling_disk", "Park", reset_noise_scale=1.0)
    for seed in range(5):
        env.reset(seed=seed)
        x, y, heading = _pose(env)
        assert env.targets["target_heading"] == heading != 0
        offset = complex(env.targets["place_x"] - x, env.targets["place_y"] - y) * np.exp(-1j * heading)
        assert offset.real == pytest.approx(0, abs=1e-15)  # straight to the side
        assert 0.3 <= abs(offset) <= 1


def test_turn_and_park_are_drawn_to_both_sides(make_task):
    turn, park = make_task("snakeboard", "Turn"), make_task("snakeboard", "Park")
    angles, places = [], []
    for seed in range(2000):
        angles.append(turn.reset(seed=seed)[1]["target_heading"])
        places.append(park.reset(seed=seed)[1]["place_y"])
    for values, low, high in ((angles, np.pi / 4, np.pi), (places, 0.3, 1.0)):
        assert _uniform(np.abs(values), low, high)
        # 2000 throws of a coin: a standard deviation of 0.011.
        assert abs(np.mean(np.sign(values) > 0) - 0.5) < 0.05


# -- targets ------------------------------------------------------------------------------------


def _uniform(values, low, high):
    """Whether values look uniform between two bounds, by Kolmogorov and Smirnov.

    The seeds are fixed, so a p-value says how lucky they are once and for all; with a range that is off by 5 % it would
    be below 1e-6 for 4000 values.
    """
    return low <= min(values) and max(values) <= high and kstest(values, "uniform", (low, high - low)).pvalue > 0.01


def test_targets_are_drawn_uniformly(make_task):
    goal, velocity = make_task("roller_racer", "Goal"), make_task("roller_racer", "Velocity")
    points, speeds = [], []
    for seed in range(4000):
        points.append(complex(*goal.reset(seed=seed)[1].values()))
        speeds.append(velocity.reset(seed=seed)[1]["commanded_speed"])
    assert _uniform(np.abs(points), 1.0, 3.0)
    assert _uniform(np.angle(points), -np.pi, np.pi)
    assert _uniform(speeds, 0.2, 1.0)
    # Independent: a correlation of 4000 pairs has a standard deviation of 0.016.
    assert abs(np.corrcoef(np.abs(points), np.angle(points))[0, 1]) < 0.05


def test_targets_are_drawn_after_the_start(mechanism, make_task):
    """The same seed starts the same motion in every task, and the first draws are the joints'."""
    starts = []
    for task in nhenv.TASKS:
        env = make_task(mechanism, task)
        env.reset(seed=8)
        starts.append(env.q)
    assert all(np.array_equal(q, starts[0]) for q in starts)
    joint = np.random.default_rng(8).uniform(-0.05, 0.05)
    assert starts[0][-1] == joint


def test_what_is_given_replaces_what_is_drawn_and_nothing_else(make_task):
    """Also by way of what it follows from; and the generator goes on as if nothing had been given."""
    env, free = make_task("snakeboard", "Goal"), make_task("snakeboard", "Goal")
    for options, expected in (
        ({"goal_x": 1.5, "goal_y": -2}, (1.5, -2.0)),
        ({"start_distance": 2.0, "start_bearing": np.pi / 2}, (2 * np.cos(np.pi / 2), 2.0)),
        ({"start_distance": 2.0, "goal_x": 0.25}, (0.25, None)),
    ):
        _, info = env.reset(seed=5, options={"target": options})
        _, drawn = free.reset(seed=5)
        assert info == env.targets
        assert list(info) == ["goal_x", "goal_y"]
        assert all(value == given for value, given in zip(info.values(), expected, strict=True) if given is not None)
        assert np.array_equal(env.q, free.q)
        assert env.reset()[1] == free.reset()[1]
        assert info != drawn
    _, info = env.reset(seed=5, options={"target": {"start_distance": 2.0}})
    assert math.hypot(*info.values()) == pytest.approx(2.0, rel=1e-15)
    assert math.atan2(*reversed(info.values())) == pytest.approx(math.atan2(*reversed(drawn.values())), rel=1e-14)


def test_targets_are_the_users_to_keep(make_task):
    """Neither the info of reset nor what `targets` returned is the environment's own."""
    env = make_task("snakeboard", "Velocity")
    options = {"target": {"commanded_speed": 0.5}}
    observation, info = env.reset(options=options)
    info["commanded_speed"] = env.targets["commanded_speed"] = 7.0
    options["target"]["commanded_speed"] = 8.0
    assert env.targets == {"commanded_speed": 0.5}
    assert observation[-1] == env.step(np.zeros(2, np.float32))[0][-1] == 0.5


@pytest.mark.parametrize(
    ("task", "target", "words"),
    [
        ("Goal", {"goal_z": 1.0}, ["'goal_z'", "start_distance", "mean 'goal_"]),
        ("Goal", {"goal_x": math.nan}, ["goal_x", "finite", "nan"]),
        ("Goal", {"goal_x": math.inf}, ["goal_x", "finite", "inf"]),
        ("Goal", {"goal_x": "far"}, ["goal_x", "number", "'far'"]),
        ("Goal", [1.0, 2.0], ["target", "map", "[1.0, 2.0]"]),
        ("Forward", {"goal_x": 1.0}, ["'goal_x'", "known: none"]),
    ],
)
def test_impossible_targets(make_task, task, target, words):
    env = make_task("snakeboard", task)
    env.reset(seed=0)
    before = env.q, env.targets
    with pytest.raises(ValueError, match="reset option 'target'") as error:
        env.reset(options={"target": target})
    assert not [word for word in words if word not in str(error.value)]
    assert np.array_equal(env.q, before[0])
    assert env.targets == before[1]


def test_no_targets_before_reset(make_task):
    with pytest.raises(gym.error.ResetNeeded, match="call reset"):
        _ = make_task("snakeboard", "Goal").targets


# -- tasks of one's own -------------------------------------------------------------------------

SPIN = Task(
    name="Spin",
    observation={"cos_error": "cos(heading - aim)", "sin_error": "sin(heading - aim)"},
    reward={"reward_turn": "gain*(error_before - error)/dt", "reward_end": "terminated"},
    info={"way": "abs(heading - heading_before)", "turning": "heading_dot", "coast": "drift*speed"},
    weights={"gain": 2.0},
    targets={"half": (0.5, 1.0), "aim": "2*half"},
    definitions={"error": "abs(heading - aim)"},
    terminated="0.02 - error",
    max_episode_steps=50,
)


def test_a_task_of_ones_own(make_task, actions):
    """Every word of the language, in a task that is none of the package's."""
    env = make_task("snakeboard", SPIN, gain=3.0)
    env.reset(seed=0)
    before, aim = env.q[2], env.targets["aim"]
    assert 1.0 <= aim <= 2.0
    for action in actions(env, 20):
        observation, reward, terminated, _, info = env.step(action)
        heading = env.q[2]
        assert observation[-2:] == pytest.approx([math.cos(heading - aim), math.sin(heading - aim)], abs=1e-7)
        gained = abs(before - aim) - abs(heading - aim)
        assert reward == pytest.approx(3.0 * gained / env.dt, rel=1e-12, abs=1e-12)
        assert info["way"] == abs(heading - before)
        assert info["turning"] == pytest.approx(env.qdot[2], rel=1e-12, abs=1e-15)
        assert info["coast"] == 0  # wheels do not slip: no drift
        assert terminated is False
        before = heading
    env.reset(options={"target": {"half": 0.015, "aim": 0.015}})
    assert env.step(np.zeros(2, np.float32))[1:3] == (1.0, True)


def test_what_only_the_end_depends_on_is_integrated(mechanism, make_task):
    """A state and a target that are neither observed nor rewarded."""
    line = Task(
        name="Line",
        reward={"reward_ctrl": "-effort"},
        targets={"line": (0.5, 0.6)},
        terminated="line - x",
        max_episode_steps=10,
    )
    env = make_task(mechanism, line)
    q, qdot = _rolling(env, -1.0)
    q[0] = 0.72
    env.reset(seed=0, options={"q": q, "qdot": qdot, "target": {"line": 0.55}})
    ends = [env.step(np.zeros(env.action_space.shape, np.float32))[2] for _ in range(4)]
    assert ends == [False, False, False, True]  # 0.67, 0.62, 0.57, 0.52


def test_tasks_are_plain_data():
    for task in (*nhenv.TASKS, SPIN):
        assert Task.from_dict(json.loads(json.dumps(dataclasses.asdict(task)))) == task
        assert tasks.get(dataclasses.asdict(task)) == tasks.get(task) == task


BASE = {"name": "Own", "reward": {"reward_x": "x_dot"}, "max_episode_steps": 10}
IMPOSSIBLE = {
    "name": ({"name": "my task"}, ["CamelCase", "'my task'"]),
    "no name": ({"name": None}, ["CamelCase", "None"]),
    "steps": ({"max_episode_steps": 0}, ["max_episode_steps", "positive whole", "0"]),
    "steps as text": ({"max_episode_steps": "many"}, ["max_episode_steps", "'many'"]),
    "unknown key": ({"rewards": {}}, ["'rewards'", "mean 'reward'"]),
    "bounds reversed": ({"targets": {"aim": [2, 1]}}, ["'aim'", "(low, high)", "(2, 1)"]),
    "bounds infinite": ({"targets": {"aim": [0, math.inf]}}, ["'aim'", "finite"]),
    "bounds NaN": ({"targets": {"aim": [math.nan, 1]}}, ["'aim'", "finite", "nan"]),
    "one bound": ({"targets": {"aim": [1]}}, ["'aim'", "two"]),
    "a number": ({"targets": {"aim": 1.0}}, ["'aim'", "(low, high)"]),
    "target of later targets": (
        {"targets": {"aim": "2*half", "half": [0, 1]}},
        ["targets, aim", "'half'", "known: x, y, heading"],
    ),
    "target of a state": ({"targets": {"half": [0, 1], "aim": "half*phi"}}, ["targets, aim", "'phi'", "known: half"]),
    "target with a taken name": ({"targets": {"speed": [0, 1]}}, ["'speed'", "meaning of its own"]),
    "target named as a rate": ({"targets": {"aim_dot": [0, 1]}}, ["'aim_dot'", "meaning of its own"]),
    "definition with a taken name": ({"definitions": {"v1": "x"}}, ["'v1'", "meaning of its own"]),
    "weight no name": ({"weights": {"a b": 1.0}}, ["'a b'", "identifier"]),
    "two things": ({"weights": {"aim": 1.0}, "targets": {"aim": [0, 1]}}, ["'aim'", "weight", "target"]),
    "two keys": ({"info": {"reward_x": "x"}}, ["'reward_x'", "both"]),
    "no expression": ({"terminated": "x <"}, ["'Own'", "terminated", "x <"]),
    "comparison": ({"terminated": "x < 1"}, ["terminated", "not allowed"]),
}


@pytest.mark.parametrize(("change", "words"), IMPOSSIBLE.values(), ids=IMPOSSIBLE)
def test_impossible_tasks(change, words):
    with pytest.raises(ValueError) as error:  # noqa: PT011 (the words are checked below)
        Task.from_dict({**BASE, **change})
    assert not [word for word in words if word not in str(error.value)]


@pytest.mark.parametrize("key", BASE)
def test_tasks_that_lack_something(key):
    with pytest.raises(ValueError, match=f"lacks '{key}'"):
        Task.from_dict({name: value for name, value in BASE.items() if name != key})


MISFITS = {
    "unknown name": ({"reward": {"r": "rotor_dot"}}, ["'Own'", "rotor_dot", "snakeboard"]),
    "effort observed": ({"observation": {"e": "effort"}}, ["observation:e", "effort"]),
    "past observed": ({"observation": {"e": "x - x_before"}}, ["observation:e", "_before"]),
    "ended by effort": ({"terminated": "effort - 1"}, ["terminated", "effort"]),
    "end observed": ({"terminated": "x", "observation": {"e": "terminated"}}, ["observation", "'terminated'"]),
    "end of no end": ({"reward": {"r": "terminated"}}, ["terminated", "snakeboard"]),
    "past of a rate": (
        {"definitions": {"e": "speed"}, "reward": {"r": "e_before"}},
        ["'Own'", "'e_before'"],
    ),
    "a word of the mechanism": ({"weights": {"J_r": 1.0}}, ["'J_r'", "tasks use", "rename"]),
    "a coordinate of the mechanism": ({"definitions": {"psi": "x"}}, ["'psi'", "tasks use", "rename"]),
    "a parameter of the mechanism": ({"targets": {"m": [0, 1]}}, ["'m'", "tasks use", "rename"]),
}


@pytest.mark.parametrize(("change", "words"), MISFITS.values(), ids=MISFITS)
def test_tasks_that_do_not_fit_a_mechanism(make_task, change, words):
    with pytest.raises((ValueError, ExpressionError)) as error:
        make_task("snakeboard", Task.from_dict({**BASE, **change}))
    assert not [word for word in words if word not in str(error.value)]


@pytest.mark.parametrize("kind", ["observation", "reward", "info", "weights", "targets", "definitions", "marker"])
@pytest.mark.parametrize("value", [3, "x", ["x"], None])
def test_parts_of_a_task_are_dictionaries(kind, value):
    spec = {"name": "Own", "reward": {"r": "effort"}, "max_episode_steps": 9, kind: value}
    for make in (lambda: Task(**spec), lambda: Task.from_dict(spec)):
        with pytest.raises(ValueError, match=f"task 'Own': {kind} must be a dictionary, got"):
            make()


def test_the_spec_of_a_task_is_a_dictionary():
    with pytest.raises(ValueError, match="a task's spec must be a dictionary, got None"):
        Task.from_dict(None)


@pytest.mark.parametrize("value", ["3", None, math.nan, math.inf, True])
def test_weights_are_finite_numbers(value):
    with pytest.raises(ValueError, match="task 'Own': weight 'w' must be a finite number, got"):
        Task(name="Own", reward={"r": "effort"}, weights={"w": value}, max_episode_steps=9)


def test_an_interval_as_wide_as_no_float_is_refused():
    with pytest.raises(ValueError, match="target 'a' must be"):
        Task(name="Own", reward={"r": "effort"}, targets={"a": (-1e308, 1e308)}, max_episode_steps=9)


@pytest.mark.parametrize(
    "spec",
    [
        {"reward": {"r": "d20"}, "definitions": {"d0": "x"} | {f"d{i + 1}": f"d{i}*d{i} + d{i}" for i in range(20)}},
        {"reward": {"r": "((((9.7**16)**16)**16)**16)**16"}},
        {"reward": {"r": "effort"}, "terminated": "(((x**16)**16)**16)**16"},
    ],
)
def test_expressions_that_nobody_could_work_with_are_refused_at_once(spec):
    with pytest.raises(ExpressionError, match="task 'Own', .* is too large"):
        Task(name="Own", max_episode_steps=9, **spec)

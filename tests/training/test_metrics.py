import dataclasses

import gymnasium as gym
import numpy as np
import pytest

from mechanics.mechanism import Mechanism
from nhenv import tasks
from training.metrics import METRICS, headline, joint_index, measure, metric_of, metrics_of
from training.rollout import rollout
from training.statistics import STATISTICS

SNAKEBOARD = "nhenv/SnakeboardVelocity-v0"
GOAL = "nhenv/RollerRacerGoal-v0"  # that scene follows every coordinate by itself


class Swing:
    """Torques that differ between episodes, the same in each rollout."""

    def __init__(self, controls):
        self.controls = controls

    def reset(self, episodes):
        self.step, self.phases = 0, np.linspace(0, 2, episodes)[:, None]

    def __call__(self, observations):
        self.step += 1
        return np.tile(np.sin(0.25 * self.step + self.phases), self.controls).astype(np.float32)


def names(task):
    return [metric.name for metric in metrics_of(tasks.get(task))]


def test_a_task_has_the_metrics_that_its_data_allow():
    assert names("Forward") == ["distance_m", "return", "energy_j", "cost_of_transport"]
    assert names("Goal") == ["time_s", "success", "return", "energy_j"]
    assert names("Velocity")[:3] == ["speed_error_mps", "settled_speed_error_mps", "distance_m"]
    bare = tasks.Task(name="Bare", reward={"r": "x"}, max_episode_steps=3)
    assert [metric.name for metric in metrics_of(bare)] == ["return", "energy_j"]
    # An end that is a failure, not a success, is nothing to be in time for.
    falls = tasks.Task(name="Falls", reward={"r": "1"}, terminated="x - 1", max_episode_steps=3)
    assert "time_s" not in [metric.name for metric in metrics_of(falls)]
    hold = dataclasses.replace(tasks.get("Goal"), terminated=None, reward={"r": "-to_goal"}, info={"is_success": "x"})
    assert headline(hold).name == "success"


def test_every_metric_has_a_name_of_its_own_and_a_statistic():
    assert len({metric.name for metric in METRICS}) == len(METRICS)
    assert {metric.statistic for metric in METRICS} <= STATISTICS.keys()
    assert all(metric_of(metric.name) is metric and abs(metric.better) == 1 for metric in METRICS)
    used = {metric.name for task in tasks.TASKS for metric in metrics_of(task)}
    assert used == {metric.name for metric in METRICS}


@pytest.mark.slow
def test_speed_error_is_what_the_environment_itself_says():
    count, options = 4, {"whole_state": True}
    envs = gym.make_vec(SNAKEBOARD, count, info="final", **options)
    told = gym.make_vec(SNAKEBOARD, count, info="all", **options)
    controller = Swing(2)
    episodes = rollout(controller, envs, range(count))
    controller.reset(count)
    observations, info = told.reset(seed=list(range(count)))
    errors = []
    for _ in range(300):
        observations, _, _, _, infos = told.step(controller(observations))
        errors.append(np.abs(infos["x_velocity"] - info["commanded_speed"]))
    numbers = measure(envs, episodes)
    assert list(numbers) == [metric.name for metric in metrics_of(envs.task)]
    # Two programs for the same product of sines and velocities.
    np.testing.assert_allclose(numbers["speed_error_mps"], np.mean(errors, axis=0), rtol=1e-12)
    np.testing.assert_allclose(numbers["settled_speed_error_mps"], np.mean(errors[100:], axis=0), rtol=1e-12)
    assert len({*numbers["speed_error_mps"], *numbers["settled_speed_error_mps"]}) == 2 * count


def test_time_ends_with_success_and_a_failure_lasts_to_the_end():
    # Some of these goals are reached by chance, others are not.
    envs = gym.make_vec(GOAL, 12, info="final", goal_radius=1.3)
    episodes = rollout(Swing(1), envs, range(12))
    numbers = measure(envs, episodes)
    reached = numbers["success"] == 1
    assert 0 < reached.sum() < 12
    bonus = 5.0
    np.testing.assert_array_equal(reached, episodes.steps < 300)
    np.testing.assert_allclose(numbers["time_s"], np.where(reached, episodes.steps * 0.05, 15.0))
    # The bonus is paid once, to those that succeed.
    effort = (episodes.torques / envs.torque_limits[:, None]) ** 2
    others = episodes.returns - bonus * reached + 0.02 * effort.mean(axis=2).sum(axis=1) + 0.5 * episodes.steps
    start = np.hypot(episodes.targets["goal_x"], episodes.targets["goal_y"])
    end = np.hypot(episodes.targets["goal_x"] - episodes.q[:, -1, 0], episodes.targets["goal_y"] - episodes.q[:, -1, 1])
    np.testing.assert_allclose(others * 0.05, start - end, atol=1e-6)
    np.testing.assert_allclose(episodes.final["goal_distance"], end, atol=1e-9)


def test_success_that_was_not_told_is_asked_for():
    envs = gym.make_vec(GOAL, 2)
    with pytest.raises(ValueError, match="info='final'"):
        measure(envs, rollout(Swing(1), envs, range(2)))


def test_joint_index_wants_torques_on_joints():
    pulley = Mechanism.from_dict(
        {
            "name": "pulley", "coordinates": ["a", "b"], "parameters": {}, "inertia": [["1", "0"], ["0", "1"]],
            "one_forms": [], "forces": {"u": ["1", "-1"]}, "frame": [["1", "0"], ["0", "1"]],
        }
    )  # fmt: skip
    with pytest.raises(ValueError, match=r"pulley: u is not the torque on one joint"):
        joint_index(pulley)

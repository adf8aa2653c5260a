import numpy as np
import pytest

from mechanics.mechanism import Mechanism
from training.config import COMPARED
from training.evaluate import Evaluate, joint_index, locomotion, make_envs, measure, rollout, summary

SNAKEBOARD = "nhenv/SnakeboardForward-v0"
every_environment = pytest.mark.parametrize("env_id", COMPARED)


class Constant:
    """The same action always."""

    def __init__(self, action):
        self.action = action

    def reset(self, episodes):
        self.episodes = episodes

    def __call__(self, observations):
        return np.full((self.episodes, self.action.size), self.action, dtype=np.float32)


class Noise:
    """Small random actions, the same in each rollout."""

    def __init__(self, size):
        self.size = size

    def reset(self, episodes):
        self.random = np.random.default_rng(5)

    def __call__(self, observations):
        return self.random.uniform(-0.2, 0.2, (len(observations), self.size)).astype(np.float32)


def controls(envs):
    return len(locomotion(envs[0]).mechanism.controls)


@every_environment
def test_doing_nothing_goes_nowhere_for_nothing(env_id):
    envs = make_envs(env_id, 2)
    episodes = rollout(Constant(np.zeros(controls(envs))), envs, [0, 1])
    assert episodes.torques.shape == (2, 300, controls(envs))
    assert episodes.q.shape == (2, 301, locomotion(envs[0]).mechanism.n)
    numbers = measure(locomotion(envs[0]), episodes)
    for name in ("distance_m", "energy_j", "return"):
        assert (numbers[name] == 0).all(), name
    assert np.isnan(numbers["cost_of_transport"]).all()


@every_environment
def test_same_seeds_give_the_same_numbers(env_id):
    envs = make_envs(env_id, 2)
    first = rollout(Noise(controls(envs)), envs, [4, 5])
    again = rollout(Noise(controls(envs)), make_envs(env_id, 2), [4, 5])
    other = rollout(Noise(controls(envs)), envs, [6, 7])
    for a, b, c in zip(vars(first).values(), vars(again).values(), vars(other).values(), strict=True):
        np.testing.assert_array_equal(a, b)
        assert a is first.torques or not np.array_equal(a, c)


@every_environment
def test_recorded_work_is_the_energy_gained(env_id):
    # Without drag, and short of the stops, work is kinetic energy. Exact, because torques are held.
    envs = make_envs(env_id, 2)
    weak = Constant(np.full(controls(envs), 1e-4))
    episodes = rollout(weak, envs, [0, 1])
    for i, env in enumerate(map(locomotion, envs)):
        q = episodes.q[i]
        for joint, stop in env.mechanism.joint_limits.items():
            assert np.abs(q[:, env.mechanism.coordinates.index(joint)]).max() < 0.99 * stop
        work = (episodes.torques[i] * np.diff(q[:, joint_index(env.mechanism)], axis=0)).sum()
        assert work == pytest.approx(env.energy, rel=1e-6)  # float32 actions keep 6e-8


@every_environment
def test_energy_counts_every_motor_for_itself(env_id):
    envs = make_envs(env_id, 1)
    episodes = rollout(Noise(controls(envs)), envs, [0])
    env = locomotion(envs[0])
    signed = (episodes.torques * np.diff(episodes.q[:, :, joint_index(env.mechanism)], axis=1)).sum()
    assert measure(env, episodes)["energy_j"][0] > abs(signed)
    assert measure(env, episodes)["energy_j"][0] >= env.energy


@every_environment
def test_distance_is_what_the_task_rewards(env_id):
    envs = make_envs(env_id, 2)
    env = locomotion(envs[0])
    episodes = rollout(Noise(controls(envs)), envs, [0, 1])
    numbers = measure(env, episodes)
    assert (np.abs(numbers["distance_m"]) > 1e-3).all()
    effort = ((episodes.torques / env.torque_limits) ** 2).mean(axis=2).sum(axis=1)
    np.testing.assert_allclose((episodes.returns + 0.02 * effort) * env.dt, numbers["distance_m"], rtol=1e-6)
    # Both mechanisms call their mass m.
    weight = 9.81 * env.params["m"]
    np.testing.assert_allclose(numbers["cost_of_transport"] * weight * numbers["distance_m"], numbers["energy_j"])


def test_torques_are_what_was_held_not_what_was_asked_for():
    envs = make_envs(SNAKEBOARD, 1)
    torques = rollout(Constant(np.array([5.0, -5.0])), envs, [0]).torques
    limits = locomotion(envs[0]).torque_limits
    np.testing.assert_array_equal(np.unique(torques[..., 0]), limits[0])
    np.testing.assert_array_equal(np.unique(torques[..., 1]), -limits[1])


def test_unrecorded_rollouts_return_the_same():
    envs = make_envs(SNAKEBOARD, 2)
    recorded, plain = (rollout(Noise(2), envs, [0, 1], record=record) for record in (True, False))
    np.testing.assert_array_equal(recorded.returns, plain.returns)
    assert plain.torques.shape == (2, 0, 2)


def test_joint_index_wants_torques_on_joints():
    pulley = Mechanism.from_dict(
        {
            "name": "pulley", "coordinates": ["a", "b"], "parameters": {}, "inertia": [["1", "0"], ["0", "1"]],
            "one_forms": [], "forces": {"u": ["1", "-1"]}, "frame": [["1", "0"], ["0", "1"]],
        }
    )  # fmt: skip
    with pytest.raises(ValueError, match=r"pulley: u is not the torque on one joint"):
        joint_index(pulley)


def test_summary():
    assert summary(np.array([1.0, 2.0, 3.0])) == {"mean": 2.0, "std": np.sqrt(2 / 3), "min": 1.0, "max": 3.0}


def test_options_name_what_is_missing(tmp_path):
    with pytest.raises(ValueError, match="there is no policy"):
        Evaluate(tmp_path / "policy.zip")
    (tmp_path / "policy.zip").touch()
    with pytest.raises(ValueError, match="give --env-id"):
        Evaluate(tmp_path / "policy.zip")


def test_help_warns_of_unpickling():
    assert "only load files that you trust" in Evaluate.__doc__

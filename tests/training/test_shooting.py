import numpy as np
import pytest

from training.config import COMPARED
from training.rollout import make_envs
from training.shooting import Shooting

every_environment = pytest.mark.parametrize("env_id", COMPARED)


@pytest.fixture(scope="module")
def shooting():
    """One for each environment: their kernels are compiled once."""
    made = {}

    def make(env_id):
        return made.setdefault(env_id, Shooting(env_id, trials=2))

    return make


def actions_of(shape, largest, seed=5):
    """Actions that swing, so that joints meet their stops now and then."""
    rng = np.random.default_rng(seed)
    turned = 0.4 * np.arange(shape[0])[:, None] + rng.uniform(0, 6, shape[1])
    return largest * (0.7 * np.sin(turned) + 0.3 * rng.uniform(-1, 1, shape))


@every_environment
def test_distance_is_what_an_episode_of_the_environment_covers(env_id, shooting):
    one = shooting(env_id)
    actions = actions_of(one.shape, 0.8)
    envs = make_envs(env_id, 1, whole_state=True)
    envs.reset(options={"q": one.start})
    rewards = sum(envs.step(action[None])[1][0] for action in actions)
    total = (rewards + 0.02 * (actions**2).mean(axis=1).sum()) * envs.dt  # what efforts cost is no distance
    assert one.distance(actions) == pytest.approx(total, abs=1e-9)
    assert abs(total) > 0.1


@every_environment
def test_gradient_is_that_of_whole_episodes(env_id, shooting):
    one = shooting(env_id)
    actions = actions_of(one.shape, 0.8)
    states, linear = one.linear(actions)
    np.testing.assert_array_equal(states, one.states(actions))
    gradient = linear.gradient()
    rng = np.random.default_rng(0)
    for _ in range(4):
        towards = rng.normal(size=one.shape)
        ahead, behind = one.distances(actions + 1e-6 * np.array([towards, -towards]))
        # Differences of single holds leave 1e-9 of each; a whole episode magnifies what is left of the second order.
        slope = (ahead - behind) / 2e-6
        assert np.sum(gradient * towards) == pytest.approx(slope, rel=1e-4, abs=1e-4 * np.abs(gradient).max())


@every_environment
def test_gradient_of_the_last_hold_is_what_it_covers_itself(env_id, shooting):
    """Little beside what early actions do, and lost in the sum over all of them."""
    one = shooting(env_id)
    actions = actions_of(one.shape, 0.8)
    gradient = one.linear(actions)[1].gradient()[-1]
    for control in range(one.shape[1]):
        step = np.zeros(one.shape)
        step[-1, control] = 1e-2
        ahead, behind = one.distances(actions + np.array([step, -step]))
        # What is left of the third order; derivatives of single holds have noise of 1e-10 / STEP.
        assert gradient[control] == pytest.approx((ahead - behind) / 2e-2, rel=1e-2, abs=2e-5)
    assert np.abs(gradient).max() > 1e-4


@every_environment
def test_gradient_at_a_limit_is_that_towards_the_inside(env_id, shooting):
    one = shooting(env_id)
    actions = np.sign(actions_of(one.shape, 1.0))
    gradient = one.linear(actions)[1].gradient()
    for step in (10, 150):
        inside = actions.copy()
        inside[step] *= 1 - 1e-6
        expected = (one.distance(inside) - one.distance(actions)) / -1e-6
        assert np.sum(gradient[step] * actions[step]) == pytest.approx(expected, rel=1e-3, abs=1e-4)


@every_environment
def test_only_states_on_which_something_depends_are_kept(env_id, shooting):
    one = shooting(env_id)
    _, linear = one.linear(actions_of(one.shape, 0.8))
    names = one.mechanism.coordinates
    kept = {names[i] for i in linear.kept if i < len(names)}
    assert kept == {"theta", *one.mechanism.joint_limits}  # neither x, y nor the rotor


def test_trials_are_what_each_would_be_alone(shooting):
    one = shooting(COMPARED[0])
    actions = np.stack([actions_of(one.shape, 0.8), actions_of(one.shape, 0.5, seed=6)])
    assert one.distances(actions).tolist() == [one.distance(alone) for alone in actions]


def test_episodes_begin_where_they_are_told(shooting):
    elsewhere, aside = (Shooting(COMPARED[1], start=[x, 2 * x, 0.0, 0.3]) for x in (1.0, 0.0))
    actions = actions_of(elsewhere.shape, 0.8)
    assert elsewhere.states(actions)[0, :4].tolist() == [1.0, 2.0, 0.0, 0.3]
    assert elsewhere.distance(actions) != pytest.approx(shooting(COMPARED[1]).distance(actions), abs=1e-3)
    # Where in the plane makes no difference to how far; the integrator's error is of the size of its numbers.
    assert elsewhere.distance(actions) == pytest.approx(aside.distance(actions), abs=1e-8)

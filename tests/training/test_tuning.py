import dataclasses
import json

import numpy as np
import pytest

from training.config import COMPARED, CONFIGS, EvaluationConfig, GaitConfig, LawConfig, TorqueConfig, for_env
from training.evaluate import evaluate
from training.laws import LAWS
from training.rollout import make_envs
from training.store import read_json
from training.tuning import FAMILIES, controller, family, gait_path, gait_settings, search_config, tune, tune_piece

SNAKEBOARD = "nhenv/SnakeboardForward-v0"
TINY = GaitConfig(population=16, generations=4, starts=1)
# A small budget of each kind.
KINDS = (TINY, TorqueConfig(population=16, generations=4, starts=1))
KINDS += (LawConfig(mechanism="snakeboard", law="bang-bang", population=16, generations=4, starts=1),)


def test_every_kind_of_settings_has_a_family():
    assert {type(config) for task in CONFIGS.values() for config in task.gaits.values()} == set(FAMILIES)
    assert {type(config) for config in KINDS} == set(FAMILIES)


def test_settings_name_laws_that_exist_and_every_law_is_compared():
    named = {(c.mechanism, c.law) for t in CONFIGS.values() for c in t.gaits.values() if isinstance(c, LawConfig)}
    assert named == {(mechanism, law) for mechanism, laws in LAWS.items() for law in laws}


def test_budgets_are_equal():
    for task in CONFIGS.values():
        budgets = {(c.population, c.generations, c.starts) for c in task.gaits.values()}
        assert len(budgets) == 1


@pytest.mark.parametrize("env_id", COMPARED)
def test_a_mechanism_is_given_the_gaits_that_fit_it(env_id):
    envs = make_envs(env_id, 1)
    for config in for_env(env_id).gaits.values():
        assert len(family(envs, config).ranges) > 0
    laws = {c.law for c in for_env(env_id).gaits.values() if isinstance(c, LawConfig)}
    assert laws == set(LAWS[envs.mechanism.name])


def test_misspelt_law_is_answered_with_the_right_one():
    with pytest.raises(ValueError, match="unknown law of snakeboard 'bang bang'.*Did you mean 'bang-bang'"):
        family(make_envs(SNAKEBOARD, 1), LawConfig(mechanism="snakeboard", law="bang bang"))


@pytest.mark.parametrize("config", KINDS, ids=lambda config: type(config).__name__)
def test_episodes_side_by_side_are_driven_as_alone(config):
    envs = make_envs(SNAKEBOARD, 3)
    searched = family(envs, config)
    rng = np.random.default_rng(1)
    vectors = rng.uniform(searched.bounds.lb, searched.bounds.ub, (3, len(searched.ranges)))
    together, alone = controller(envs, config, vectors), [controller(envs, config, vector) for vector in vectors]
    together.reset(3)
    for one in alone:
        one.reset(1)
    observations, _ = envs.reset(seed=5)
    for _ in range(40):
        actions = together(observations)
        assert np.abs(actions).max() <= 1
        for i, one in enumerate(alone):
            # The same operations, but NumPy may sum the few products of a linear solve in another order.
            np.testing.assert_allclose(one(observations[i : i + 1])[0], actions[i], atol=1e-6)
        observations, *_ = envs.step(actions)


def test_finished_gait_is_not_tuned_again(tmp_path):
    tune_piece(SNAKEBOARD, TINY, tmp_path)
    written = read_json(gait_path(SNAKEBOARD, TINY, tmp_path))
    assert written["settings"]["gait"]["population"] == TINY.population
    assert len(written["result"]["vector"]) == 7
    assert [*written["result"]["parameters"].values()] == written["result"]["vector"]
    tune_piece(SNAKEBOARD, TINY, tmp_path, lambda *message: pytest.fail("it tunes again"))


def test_a_gait_is_tuned_and_judged_in_the_environment_that_is_asked_for():
    weak = dataclasses.replace(TINY, generations=1, env_kwargs={"torque_limits": 0.01})
    strong = dataclasses.replace(weak, env_kwargs={})
    returns = [tune(SNAKEBOARD, config).history[-1] for config in (weak, strong)]
    assert returns[0] < 0.1 * returns[1]
    driver = controller(make_envs(SNAKEBOARD, 1), TINY, np.ones(7))
    judged = EvaluationConfig(episodes=2, env_kwargs={"torque_limits": 0.01})
    asked = evaluate(driver, SNAKEBOARD, judged)[0].torques[:, 0]
    plain = evaluate(driver, SNAKEBOARD, EvaluationConfig(episodes=2))[0].torques[:, 0]
    twice = evaluate(driver, SNAKEBOARD, judged, torque_limits=0.02)[0].torques[:, 0]
    assert asked == pytest.approx(plain * [0.01, 0.02])  # the same actions; by default 1 and 0.5 N m
    assert twice == pytest.approx(2 * asked)


@pytest.mark.parametrize("config", KINDS, ids=lambda config: type(config).__name__)
def test_tuning_improves_on_its_start_and_is_reproducible(config):
    heard = []
    tuned = tune(SNAKEBOARD, config, lambda *message: heard.append(message[:2]))
    assert tuned.history == sorted(tuned.history)
    assert tuned.history[-1] > tuned.history[0]
    assert heard == [(done, 5) for done in range(1, 6)]
    p = len(tuned.vector)
    assert tuned.episodes == 5 * (16 // p * p)  # 16 candidates are rounded down to a multiple of the parameters
    assert tune(SNAKEBOARD, config) == tuned
    driver = controller(make_envs(SNAKEBOARD, 1), config, tuned.vector)
    episodes, _ = evaluate(driver, SNAKEBOARD, for_env(SNAKEBOARD).evaluation)
    assert episodes.returns.mean() == pytest.approx(tuned.history[-1], rel=0.05)  # starts differ by 0.1 rad


@pytest.mark.parametrize("config", KINDS, ids=lambda config: type(config).__name__)
def test_settings_are_read_back(config):
    data = json.loads(json.dumps(gait_settings(SNAKEBOARD, config)))
    back = search_config(data)
    assert type(back) is type(config)
    assert gait_settings(SNAKEBOARD, back)["gait"].keys() == gait_settings(SNAKEBOARD, config)["gait"].keys()
    assert json.loads(json.dumps(gait_settings(SNAKEBOARD, back))) == data

import dataclasses
import json
import os

import pytest

import mechanics
import nhenv
from nhenv import tasks
from training import config as config_module
from training import levels, metrics, rollout, scaling, time_aware, train, tuning, wrappers
from training.config import (
    COMPARED,
    CONFIGS,
    EVALUATION_SEEDS,
    SEEDS_PER_RUN,
    TUNING_SEEDS,
    EvaluationConfig,
    GaitConfig,
    LawConfig,
    PPOConfig,
    TorqueConfig,
    check_env_id,
    for_env,
    quick,
    training_seed,
    within,
)
from training.store import digest, piece_path, read_json, settings, source_digest, write_bytes, write_json
from training.train import ppo_path, ppo_settings
from training.tuning import gait_path

SNAKEBOARD = "nhenv/SnakeboardForward-v0"


def changed(value):
    """Something else of the same kind."""
    if isinstance(value, bool):
        return not value
    if isinstance(value, dict):
        return {**value, "drag": True}
    if isinstance(value, str) or value is None:
        return f"{value} and more"
    return (*value[:-1], value[-1] + 1) if isinstance(value, tuple) else value + 1


def test_settings_are_for_tasks_that_exist():
    assert set(CONFIGS) <= {task.name for task in tasks.TASKS}
    assert all(for_env(env_id) for env_id in COMPARED)


def test_misspelt_id_is_answered_with_the_right_one():
    with pytest.raises(ValueError, match="Did you mean 'nhenv/SnakeboardForward-v0'"):
        check_env_id("nhenv/SnakebordForward-v0")


CHANGED = {"activation": "leaky_relu", "levels": 3}  # which cannot be anything


@pytest.mark.parametrize("name", [field.name for field in dataclasses.fields(PPOConfig)])
def test_path_of_a_run_depends_on_every_setting(tmp_path, name):
    config = PPOConfig()
    other = dataclasses.replace(config, **{name: CHANGED.get(name) or changed(getattr(config, name))})
    assert ppo_path(SNAKEBOARD, config, 0, tmp_path) != ppo_path(SNAKEBOARD, other, 0, tmp_path)


@pytest.mark.parametrize(
    ("config", "name"),
    [
        (config, field.name)
        for config in (GaitConfig(), TorqueConfig(), LawConfig(mechanism="roller_racer", law="relay"))
        for field in dataclasses.fields(config)
    ],
    ids=lambda value: value if isinstance(value, str) else type(value).__name__,
)
def test_path_of_a_gait_depends_on_every_setting(tmp_path, config, name):
    other = dataclasses.replace(config, **{name: changed(getattr(config, name))})
    assert gait_path(SNAKEBOARD, config, tmp_path) != gait_path(SNAKEBOARD, other, tmp_path)


def test_path_depends_on_seed_environment_and_code(tmp_path):
    config = PPOConfig()
    other_id = next(env_id for env_id in nhenv.environment_ids() if env_id != SNAKEBOARD)
    paths = {
        ppo_path(SNAKEBOARD, config, 0, tmp_path).name,
        ppo_path(SNAKEBOARD, config, 1, tmp_path).name.replace("seed1", "seed0"),
        ppo_path(other_id, config, 0, tmp_path).name,
    }
    assert len(paths) == 3
    assert digest(settings(SNAKEBOARD, "a")) != digest(settings(SNAKEBOARD, "b"))
    assert piece_path(tmp_path, settings(SNAKEBOARD, "a"), "x").parent == tmp_path / "SnakeboardForward-v0"


@pytest.mark.parametrize(
    ("module", "name"),
    [(config_module, "SEEDS_PER_RUN"), (train, "TUNING_SEEDS"), (tuning, "TUNING_SEEDS")],
    ids=lambda value: value if isinstance(value, str) else value.__name__,
)
def test_paths_depend_on_where_the_seeds_of_environments_begin(tmp_path, monkeypatch, module, name):
    def paths():
        return {ppo_path(SNAKEBOARD, PPOConfig(), 1, tmp_path), gait_path(SNAKEBOARD, GaitConfig(), tmp_path)}

    before = paths()
    monkeypatch.setattr(module, name, getattr(module, name) + 1)
    assert len(before | paths()) == 3


def test_code_of_a_result_is_that_of_all_modules_from_which_it_follows():
    modules = (train, wrappers, time_aware, levels, scaling, rollout, metrics)
    made_of = source_digest(*(module.__file__ for module in modules))
    assert ppo_settings(SNAKEBOARD, PPOConfig(), 0)["code"] == made_of


def test_digest_of_sources_changes_with_each_of_them(tmp_path):
    files = [tmp_path / name for name in ("a.py", "b.py", "c.py")]
    for file in files:
        file.write_text(f"# {file.name}")
    before = source_digest(*files)
    assert source_digest(*map(str, files)) == before
    for file in files:
        text = file.read_text()
        file.write_text(text + " changed")
        assert source_digest(*files) != before
        file.write_text(text)
    assert source_digest(*files) == before


def test_seeds_of_training_tuning_and_evaluation_never_meet():
    last_run = TUNING_SEEDS // SEEDS_PER_RUN - 1
    for config in CONFIGS.values():
        assert config.ppo.n_envs <= SEEDS_PER_RUN
        assert training_seed(last_run) + config.ppo.n_envs <= TUNING_SEEDS
        assert (
            TUNING_SEEDS + max([config.ppo.curve_episodes, *(gait.starts for gait in config.gaits.values())])
            <= EVALUATION_SEEDS
        )
    for run in (-1, last_run + 1):
        with pytest.raises(ValueError, match="seed of a run"):
            training_seed(run)


def test_quick_is_shorter():
    config = for_env(SNAKEBOARD)
    short = quick(config)
    assert short.ppo.timesteps < config.ppo.timesteps
    assert all(short.gaits[name].generations < gait.generations for name, gait in config.gaits.items())
    assert isinstance(short.evaluation, EvaluationConfig)


def test_an_experiment_within_an_environment_is_so_in_all_its_parts():
    config = for_env(SNAKEBOARD, drag=True)
    parts = [*config.gaits.values(), config.ppo, config.evaluation]
    assert [part.env_kwargs for part in parts] == [{"drag": True}] * len(parts)
    assert within(config) == dataclasses.replace(for_env(SNAKEBOARD), ppo=CONFIGS["Forward"].ppo_of["snakeboard, drag"])


def test_a_mechanism_has_settings_of_its_own_with_drag_and_without():
    forward = CONFIGS["Forward"]
    assert for_env(SNAKEBOARD).ppo == forward.ppo_of["snakeboard"] != forward.ppo
    with_drag = dataclasses.replace(forward.ppo_of["snakeboard, drag"], env_kwargs={"drag": True})
    assert for_env(SNAKEBOARD, drag=True).ppo == with_drag
    assert for_env("nhenv/CarForward-v0").ppo == forward.ppo


@pytest.mark.parametrize(("env_id", "times"), [(SNAKEBOARD, 6.9), ("nhenv/RollerRacerForward-v0", 10)])
def test_a_sprint_is_much_shorter(env_id, times):
    sprint, usual = (for_env(env_id, drag=True, sprint=sprint) for sprint in (True, False))
    assert sprint.ppo.timesteps < usual.ppo.timesteps / times
    assert sprint.ppo.env_kwargs == {"drag": True}
    assert sprint == dataclasses.replace(usual, ppo=sprint.ppo)


def test_a_sprint_is_refused_where_nobody_has_looked_for_it():
    racer, car, goal = (f"nhenv/{name}-v0" for name in ("RollerRacerForward", "CarForward", "RollerRacerGoal"))
    for env_id, drag in ((racer, False), (SNAKEBOARD, False), (car, True), (goal, True)):
        with pytest.raises(ValueError, match=f"no settings for a sprint on {env_id} with.* leave --sprint out"):
            for_env(env_id, drag=drag, sprint=True)


def test_settings_of_their_own_are_of_mechanisms_that_there_are():
    known = {f"{name}{drag}" for name in mechanics.names() for drag in ("", ", drag")}
    assert all({*config.ppo_of, *config.sprint_of} <= known for config in CONFIGS.values())


def test_files_appear_whole_or_not_at_all(tmp_path, monkeypatch):
    path = tmp_path / "folder" / "file"
    write_bytes(path, b"before")

    def broken(*arguments):
        raise OSError("disk full")

    monkeypatch.setattr(os, "replace", broken)
    with pytest.raises(OSError, match="disk full"):
        write_bytes(path, b"after")
    assert [(file.name, file.read_bytes()) for file in path.parent.iterdir()] == [("file", b"before")]


def test_json_has_no_nan(tmp_path):
    write_json(tmp_path / "file.json", {"a": [float("nan"), 1.5, {"b": float("inf")}], "c": ("x", None)})
    assert read_json(tmp_path / "file.json") == {"a": [None, 1.5, {"b": None}], "c": ["x", None]}
    json.loads((tmp_path / "file.json").read_text(), parse_constant=pytest.fail)

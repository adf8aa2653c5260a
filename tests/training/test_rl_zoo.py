"""The hyperparameter file says what the settings say, read as RL Baselines3 Zoo reads it."""

import dataclasses

import gymnasium as gym
import pytest
import yaml
from stable_baselines3 import PPO
from torch import nn

import mechanics
import nhenv
from nhenv.sb3 import make_sb3_vec_env
from training.config import COMPARED, CONFIGS, PPOConfig, check_env_id, for_env, task_name
from training.rl_zoo import FILE, entry, text
from training.train import make_model


def read():
    return yaml.safe_load(FILE.read_text(encoding="utf-8"))


def test_file_is_what_the_settings_make():
    assert FILE.read_text(encoding="utf-8") == text(), "run python -m training.rl_zoo"


def test_every_environment_with_settings_has_an_entry():
    ids = [name for name in nhenv.environment_ids() if gym.spec(name).kwargs["mechanism"] in mechanics.names()]
    known = {env_id for env_id in ids if task_name(env_id) in CONFIGS}
    assert {key for key in read() if key.startswith("nhenv/")} == known
    assert all(check_env_id(env_id) for env_id in known)


@pytest.mark.parametrize("env_id", COMPARED)
def test_an_entry_makes_the_same_model(env_id):
    given = read()[env_id]
    config = for_env(env_id).ppo
    assert given.pop("n_timesteps") == config.timesteps
    kind, rate = given.pop("learning_rate").split("_")
    assert (kind, float(rate)) == ("lin", config.learning_rate[0])
    envs = make_sb3_vec_env(env_id, given.pop("n_envs"))
    kwargs = eval(given.pop("policy_kwargs"), {"nn": nn, "dict": dict})
    theirs = PPO(given.pop("policy"), envs, learning_rate=float(rate), policy_kwargs=kwargs, device="cpu", **given)
    ours = make_model(env_id, dataclasses.replace(config, levels=0), 0)  # which the Zoo cannot choose from
    nets, own = theirs.policy.mlp_extractor, ours.policy.mlp_extractor
    assert str(nets.policy_net) == str(own.policy_net)
    assert str(nets.value_net[1:]) == str(own.value_net[1:])  # whose first layer sees the time here
    assert theirs.policy.optimizer.defaults == ours.policy.optimizer.defaults
    assert theirs.policy.log_std.tolist() == ours.policy.log_std.tolist()
    for name in ("n_envs", "n_steps", "batch_size", "n_epochs", "gamma", "gae_lambda", "target_kl", "ent_coef"):
        assert getattr(theirs, name) == getattr(ours, name), name
    assert theirs.clip_range(1.0) == ours.clip_range(1.0)
    assert theirs.lr_schedule(1.0) == ours.lr_schedule(1.0)


def test_settings_reach_the_entry():
    config = PPOConfig(
        n_envs=3, learning_rate=(0.5, 0.25), hidden=(7, 5), activation="leaky_relu", log_std=-2.0, gamma=0.5
    )
    written = yaml.safe_load("\n".join(f"{name}: {value}" for name, value in entry(config).items()))
    assert (written["n_envs"], written["gamma"], written["learning_rate"]) == (3, 0.5, "lin_0.5")
    assert eval(written["policy_kwargs"], {"nn": nn, "dict": dict}) == {
        "net_arch": {"pi": [7, 5], "vf": [7, 5]}, "activation_fn": nn.LeakyReLU, "log_std_init": -2.0,
        "optimizer_kwargs": {"eps": 1e-5, "fused": True},
    }  # fmt: skip

"""Write the settings of PPO as a hyperparameter file of RL Baselines3 Zoo, training/rl_zoo.yml.

python -m training.rl_zoo

The Zoo reads it by

python -m rl_zoo3.train --algo ppo --env nhenv/SnakeboardForward-v0 --gym-packages nhenv \
    --conf-file training/rl_zoo.yml
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gymnasium as gym

import nhenv
from training.config import CONFIGS, PPOConfig, for_env, task_name
from training.store import write_bytes
from training.train import Linear, arguments

__all__ = ["FILE", "text"]

FILE = Path(__file__).with_name("rl_zoo.yml")

HEADER = """\
# PPO for the environments of nhenv, in the format of RL Baselines3 Zoo. Written by `python -m training.rl_zoo`;
# do not edit. What the format cannot say: learning rates fall to zero there, here to {last}; the
# weight of the entropy falls to zero here; here the value function sees how much of an episode is over, and the time
# limit is an end; without that a smaller gamma may do better. First episodes have random lengths here, some begin in
# motion, rewards are scaled, for some tasks observations too, and torques are chosen from a few levels; the best policy
# of the learning curve is kept, and all environments are stepped by one call.
"""


def entry(config: PPOConfig) -> dict[str, str]:
    """Settings as the Zoo writes them."""
    plain = {"n_envs": config.n_envs, "n_timesteps": config.timesteps, "policy": "MlpPolicy", **arguments(config)}
    return {name: _written(value) for name, value in plain.items()}


def text() -> str:
    """Content of the file: settings by task, and the environments that have it."""
    written = [one for config in CONFIGS.values() for one in (config.ppo, *config.ppo_of.values())]
    last = sorted({one.learning_rate[1] for one in written})
    lines = [HEADER.format(last=" or ".join(f"{rate:g}" for rate in last))]
    for task, config in CONFIGS.items():
        lines += [f"{task}: &{task}", *(f"  {name}: {value}" for name, value in entry(config.ppo).items()), ""]
    for env_id in sorted(nhenv.environment_ids()):
        of_the_catalogue = isinstance(gym.spec(env_id).kwargs["mechanism"], str)
        if of_the_catalogue and (task := task_name(env_id)) in CONFIGS:
            own, shared = entry(for_env(env_id).ppo), entry(CONFIGS[task].ppo)
            changes = [f"  {name}: {value}" for name, value in own.items() if value != shared[name]]
            lines += [f"{env_id}:", f"  <<: *{task}", *changes]
    return "\n".join(lines) + "\n"


def _written(value: Any) -> str:
    """A value in YAML; what is no number stands as Python, which the Zoo evaluates."""
    match value:
        case Linear():
            return f"lin_{value.first!r}"
        case dict():
            return f'"{_python(value)}"'
    return str(value)


def _python(value: Any) -> str:
    if isinstance(value, dict):
        return f"dict({', '.join(f'{key}={_python(one)}' for key, one in value.items())})"
    return f"nn.{value.__name__}" if isinstance(value, type) else repr(value)


if __name__ == "__main__":
    write_bytes(FILE, text().encode())
    print(f"written to {FILE}")

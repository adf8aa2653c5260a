"""Train PPO on one environment.

python -m training.train --env-id nhenv/SnakeboardForward-v0 --seed 0

It may be interrupted, by Ctrl-C or worse: the same command goes on from the last checkpoint, and
the outcome is the same to the last bit as without the interruption.
"""

from __future__ import annotations

import dataclasses
import importlib.util
import io
import math
import pickle
import sys
import time
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
import tyro
from gymnasium.error import DependencyNotInstalled
from rich.console import Console
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import KVWriter, Logger, TensorBoardOutputFormat
from stable_baselines3.common.vec_env import VecEnv

from mechanics.expressions import unknown_name
from nhenv.sb3 import make_sb3_vec_env
from nhenv.vector_env import LocomotionVectorEnv
from training.config import TUNING_SEEDS, PPOConfig, check_env_id, for_env, training_seed
from training.levels import LevelPolicy
from training.metrics import headline, measure
from training.progress import Interrupted, Job, Report, ignore, run_jobs
from training.rollout import PolicyController, recorded, rollout
from training.scaling import Scaled
from training.store import piece_path, settings, source_digest, versions, write_bytes, write_json
from training.time_aware import TimeAwareCritic
from training.wrappers import Clock, MovingStarts, ScaledReward

__all__ = ["MODULES", "arguments", "check_tensorboard", "make_model", "ppo_path", "ppo_settings", "train_piece"]

# Whatever a trained policy follows from here: what it learns in, and by what the best of the curve is chosen.
_MODULES = ("train", "wrappers", "time_aware", "levels", "scaling", "rollout", "metrics")
_CODE = source_digest(*(Path(__file__).with_name(f"{name}.py") for name in _MODULES))

# By `PPOConfig.activation`.
MODULES: dict[str, type[torch.nn.Module]] = {"leaky_relu": torch.nn.LeakyReLU, "tanh": torch.nn.Tanh}


@dataclass(frozen=True)
class Linear:
    """Schedule of Stable-Baselines3, from `first` to `last`; a closure would not survive pickling."""

    first: float
    last: float

    def __call__(self, remaining: float) -> float:
        """Value when this fraction of the training remains."""
        return self.last + remaining * (self.first - self.last)


class Run(BaseCallback):
    """Draws the learning curve and keeps checkpoints and the best policy, between an update and the next rollout.

    There, the model, the environments and the random generators are all that there is to remember.

    Attributes:
        curve: points {"steps", "cpu_s", METRIC: mean} of the deterministic policy, with every metric of the task. The
            CPU seconds count from when kernels are compiled and modules imported; the drawing of the curve is in them.
        best: the policy's parameters at the point with the largest return, and that point's steps. Gaits are chosen on
            the same starts; nobody is judged on them.
    """

    def __init__(self, env_id: str, config: PPOConfig, checkpoint: Path, report: Report) -> None:
        super().__init__()
        self.config, self.checkpoint, self.report = config, checkpoint, report
        self.curve: list[dict[str, float]] = []
        self.best: dict[str, Any] = {"steps": 0, "return": -math.inf, "parameters": {}}
        self._envs = recorded(env_id, config.curve_episodes, **config.env_kwargs)
        self._headline = headline(self._envs.task)
        # Once on a machine and once in a process, so it is not what learning costs.
        _compile(self._envs, env_id, config)
        torch.optim.Adam([torch.zeros(1)])  # the first one imports a second's worth of modules
        self._before = {"wall_s": 0.0, "cpu_s": 0.0}  # spent before an interruption
        self._began = _clocks()

    @property
    def spent(self) -> dict[str, float]:
        """Wall and CPU seconds of this run, interrupted or not."""
        return {name: self._before[name] + now - self._began[name] for name, now in _clocks().items()}

    def _on_step(self) -> bool:
        return True

    def _on_rollout_start(self) -> None:
        steps = self.model.num_timesteps
        assert isinstance(self.model, PPO)
        self.model.ent_coef = Linear(*self.config.entropy)(1 - min(1, steps / self.config.timesteps))
        updates = steps // (self.config.n_envs * self.config.n_steps)
        if updates % self.config.curve_every == 0 and not (self.curve and self.curve[-1]["steps"] == steps):
            self.draw()
        try:
            text = f"{self.curve[-1][self._headline.name]:.{self._headline.digits}f}"
            self.report(steps, self.config.timesteps, text)
        except Interrupted:
            self.save()
            raise
        if updates and updates % self.config.checkpoint_every == 0:
            self.save()

    def draw(self) -> None:
        """Add a point to the learning curve."""
        assert isinstance(self.model, PPO)
        seeds = range(TUNING_SEEDS, TUNING_SEEDS + self._envs.num_envs)
        numbers = measure(self._envs, rollout(PolicyController(self.model), self._envs, seeds))
        point = {"steps": self.model.num_timesteps, "cpu_s": self.spent["cpu_s"]}
        means = {name: float(values.mean()) for name, values in numbers.items()}
        self.curve.append(point | means)
        for name, mean in means.items():
            self.logger.record(f"curve/{name}", mean)
        if means["return"] > self.best["return"]:
            parameters = {name: value.clone() for name, value in self.model.policy.state_dict().items()}
            self.best = {"steps": self.model.num_timesteps, "return": means["return"], "parameters": parameters}

    def save(self) -> None:
        """Write everything that the rest of the run depends on."""
        model = io.BytesIO()
        self.model.save(model)
        state = {
            "model": model.getvalue(),
            "envs": self.model.env,
            "torch": torch.get_rng_state(),
            "numpy": np.random.get_state(),  # noqa: NPY002 (SB3 shuffles its minibatches with it)
            "curve": self.curve,
            "best": self.best,
            "spent": self.spent,
        }
        write_bytes(self.checkpoint, pickle.dumps(state))

    def load(self) -> PPO:
        """Go on where `save` was called. This unpickles a file of our own."""
        state = pickle.loads(self.checkpoint.read_bytes())  # noqa: S301
        model = PPO.load(io.BytesIO(state["model"]), env=state["envs"], device="cpu", force_reset=False)
        self.curve, self.best, self._before = state["curve"], state["best"], state["spent"]
        torch.set_rng_state(state["torch"])  # last: making the model drew random numbers
        np.random.set_state(state["numpy"])  # noqa: NPY002
        return model


def make_envs_to_learn_in(env_id: str, config: PPOConfig, seed: int) -> VecEnv:
    """Environments with a clock, and with the starts and the scale of rewards that the settings ask for."""
    plain = make_sb3_vec_env(check_env_id(env_id), config.n_envs, **config.env_kwargs)
    envs: VecEnv = plain
    if config.start_energy:
        steps = round(config.start_share * config.timesteps)
        envs = MovingStarts(plain, config.start_energy, config.start_offset, steps, training_seed(seed))
    return Clock(ScaledReward(envs, config.reward_scale))


def _compile(envs: LocomotionVectorEnv, env_id: str, config: PPOConfig) -> None:
    """Have the code made of these environments and of those in which the policy learns, if it is not cached."""
    controls = len(envs.mechanism.controls)
    envs.reset()
    envs.step(np.zeros((envs.num_envs, controls), np.float32))
    # Others of its kind: a reset would use up the seeds.
    learning = make_envs_to_learn_in(env_id, dataclasses.replace(config, n_envs=1), 0)
    learning.reset()
    learning.step(np.zeros((1, controls), np.float32))


def arguments(config: PPOConfig) -> dict[str, Any]:
    """Arguments of Stable-Baselines3's PPO that these settings are."""
    return {
        "learning_rate": Linear(*config.learning_rate),
        "n_steps": config.n_steps,
        "batch_size": config.batch_size,
        "n_epochs": config.n_epochs,
        "gamma": config.gamma,
        "gae_lambda": config.gae_lambda,
        "clip_range": config.clip_range,
        "target_kl": config.target_kl,
        "ent_coef": config.entropy[0],
        "policy_kwargs": {
            "net_arch": {"pi": list(config.hidden), "vf": list(config.hidden)},
            "activation_fn": MODULES[config.activation],
            "log_std_init": config.log_std,
            "optimizer_kwargs": {"eps": 1e-5, "fused": True},  # Stable-Baselines3's, in one call for all parameters
        },
    }


def make_model(env_id: str, config: PPOConfig, seed: int) -> PPO:
    """An untrained model."""
    envs = make_envs_to_learn_in(env_id, config, seed)
    options = arguments(config)
    policy = LevelPolicy if config.levels else TimeAwareCritic
    if config.levels:
        options["policy_kwargs"]["levels"] = config.levels
    if config.observation_scale:
        options["policy_kwargs"] |= {
            "features_extractor_class": Scaled,
            "features_extractor_kwargs": {"factors": _factors(config, envs)},
        }
    return PPO(policy, envs, seed=training_seed(seed), device="cpu", **options)


def _factors(config: PPOConfig, envs: VecEnv) -> list[float]:
    """What each observation is multiplied by; the last one is the time."""
    (labels,) = envs.get_attr("observation_labels", 0)
    for name in config.observation_scale:
        if name not in labels:
            raise ValueError(f"observation_scale: {unknown_name('observation', name, labels)}")
    return [float(config.observation_scale.get(label, 1)) for label in labels] + [1.0]


def train_piece(
    env_id: str, config: PPOConfig, seed: int, out: Path, report: Report = ignore, tensorboard: Path | None = None
) -> None:
    """Train and write the policy (.zip) and its history (.json), unless that is done; go on from a checkpoint.

    Args:
        env_id: environment.
        config: settings.
        seed: number of the run.
        out: folder of the results.
        report: hears of every update.
        tensorboard: folder in which TensorBoard finds a folder of this run; None for none.
    """
    torch.set_num_threads(1)
    path = ppo_path(env_id, config, seed, out)
    if path.exists():
        return
    run = Run(env_id, config, path.with_suffix(".checkpoint"), report)
    model = run.load() if run.checkpoint.exists() else make_model(env_id, config, seed)
    model.set_logger(_logger(tensorboard and tensorboard / path.parent.name / path.stem))
    model.learn(config.timesteps - model.num_timesteps, callback=run, reset_num_timesteps=False)
    run.draw()
    model.policy.load_state_dict(run.best["parameters"])
    model.logger.dump(model.num_timesteps)
    model.logger.close()
    policy = io.BytesIO()
    model.save(policy)
    write_bytes(path.with_suffix(".zip"), policy.getvalue())
    steps = {"steps": model.num_timesteps, "best_steps": run.best["steps"]}
    result = {"curve": run.curve, **steps, **run.spent, "versions": versions()}
    write_json(path, {"settings": ppo_settings(env_id, config, seed), "result": result})
    run.checkpoint.unlink(missing_ok=True)


def check_tensorboard(folder: Path | None) -> None:
    """Raise DependencyNotInstalled if TensorBoard's files are asked for and there is nothing to write them."""
    if folder is not None and importlib.util.find_spec("tensorboard") is None:
        raise DependencyNotInstalled('--tensorboard needs TensorBoard: run pip install "nhenv[tensorboard]"')


def _logger(folder: Path | None) -> Logger:
    """Stable-Baselines3's logger to TensorBoard, or to nowhere: its own default leaves folders in the temporary one."""
    writers: list[KVWriter] = [] if folder is None else [TensorBoardOutputFormat(str(folder))]
    return Logger(None if folder is None else str(folder), writers)


def ppo_settings(env_id: str, config: PPOConfig, seed: int) -> dict[str, Any]:
    """All that a trained policy follows from."""
    seeds = {"training": training_seed(seed), "curve": TUNING_SEEDS}
    return settings(env_id, _CODE, ppo=config, seed=seed, seeds=seeds)


def ppo_path(env_id: str, config: PPOConfig, seed: int, out: Path) -> Path:
    """File of a finished run's history; the policy is beside it, as .zip."""
    return piece_path(out, ppo_settings(env_id, config, seed), f"ppo-seed{seed}")


def _clocks() -> dict[str, float]:
    return {"wall_s": time.perf_counter(), "cpu_s": time.process_time()}


@dataclass(frozen=True, kw_only=True)
class Train:
    """Train PPO on one environment; the same command again goes on after an interruption.

    Attributes:
        env_id: environment.
        seed: number of the run.
        timesteps: environment steps; None for the settings of the task.
        drag: let the mechanism's drag act.
        sprint: train for seconds instead of minutes, with what passes the steered gait soonest.
        out: folder of the results.
        tensorboard: folder of TensorBoard's files; None for none.
    """

    env_id: str
    seed: int = 0
    timesteps: int | None = None
    drag: bool = False
    sprint: bool = False
    out: Path = Path("runs/train")
    tensorboard: Path | None = None

    def __post_init__(self) -> None:
        for_env(self.env_id, self.drag, self.sprint)
        training_seed(self.seed)
        check_tensorboard(self.tensorboard)


def main(options: Train) -> None:
    """Train under a progress bar."""
    config = for_env(options.env_id, options.drag, options.sprint).ppo
    if options.timesteps is not None:
        config = dataclasses.replace(config, timesteps=options.timesteps)
    path = ppo_path(options.env_id, config, options.seed, options.out).with_suffix(".zip")
    train = partial(train_piece, tensorboard=options.tensorboard)
    job = Job(f"{options.env_id} seed {options.seed}", train, (options.env_id, config, options.seed, options.out))
    console = Console()
    try:
        run_jobs([job], 1, console)
    except KeyboardInterrupt:
        sys.exit("interrupted; the same command goes on from the checkpoint")
    console.print(f"policy: {path}\njudge it: python -m training.evaluate {path}", soft_wrap=True)


if __name__ == "__main__":
    # Under its own name, so that what a checkpoint pickles is found by other programs too.
    from training.train import Train, main

    main(tyro.cli(Train, prog="python -m training.train"))

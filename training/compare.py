"""Compare PPO with a tuned gait, on the two mechanisms of the paper.

python -m training.compare

tunes the gaits, trains the policies (in parallel, and from where it was interrupted), judges all of
them in one harness and writes results.json, results.md and a figure for each environment.
"""

from __future__ import annotations

import dataclasses
import os
import shlex
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import tyro
from rich.console import Console

from training import config as settings_of
from training.config import EVALUATION_SEEDS, SEEDS_PER_RUN, TUNING_SEEDS, TaskConfig, check_env_id, training_seed
from training.evaluate import METRICS, Controller, Rollout, evaluate, load_policy, make_envs, summary
from training.gaits import gait_path, sinusoid, tune_piece
from training.plots import GAITS, POLICY, Shown, draw
from training.progress import Job, run_jobs
from training.report import markdown, tables
from training.store import machine, read_json, versions, write_bytes, write_json
from training.train import ppo_path, train_piece

__all__ = ["Compare", "compare", "judge"]


@dataclass(frozen=True, kw_only=True)
class Compare:
    """Compare PPO with a tuned gait; the same command again goes on after an interruption.

    Attributes:
        env_ids: environments.
        seeds: numbers of the PPO runs on each.
        timesteps: environment steps of a PPO run; None for the settings of the task.
        drag: let the mechanisms' drag act.
        out: folder of the results. What is finished in it is used again if its settings are the same.
        processes: processes side by side.
        quick: far too short runs, to see that everything works.
    """

    env_ids: tuple[str, ...] = settings_of.COMPARED
    seeds: tuple[int, ...] = (0, 1, 2)
    timesteps: int | None = None
    drag: bool = False
    out: Path = Path("runs/compare")
    processes: int = os.cpu_count() or 1
    quick: bool = False

    def __post_init__(self) -> None:
        for env_id in self.env_ids:
            check_env_id(env_id)
        for seed in self.seeds:
            training_seed(seed)
        if self.processes < 1:
            raise ValueError(f"processes must be at least 1, got {self.processes}")
        if not self.seeds or len(set(self.seeds)) < len(self.seeds):
            raise ValueError(f"seeds must be different numbers, at least one, got {self.seeds}")

    def config(self, env_id: str) -> TaskConfig:
        """Settings for an environment."""
        config = settings_of.for_env(env_id)
        if self.quick:
            config = settings_of.quick(config)
        if self.drag:
            config = settings_of.within(config, drag=True)
        if self.timesteps is not None:
            config = dataclasses.replace(config, ppo=dataclasses.replace(config.ppo, timesteps=self.timesteps))
        return config

    def jobs(self) -> list[Job]:
        """What is not done yet."""
        gaits, runs = [], []
        for env_id in self.env_ids:
            config, name = self.config(env_id), env_id.rpartition("/")[2]
            for label, gait in config.gaits.items():
                if not gait_path(env_id, gait, self.out).exists():
                    gaits.append(Job(f"{name} {label}", tune_piece, (env_id, gait, self.out)))
            for seed in self.seeds:
                if not ppo_path(env_id, config.ppo, seed, self.out).exists():
                    runs.append(Job(f"{name} PPO seed {seed}", train_piece, (env_id, config.ppo, seed, self.out)))
        return gaits + runs


def compare(options: Compare, command: Sequence[str], console: Console) -> dict[str, Any]:
    """Do what is left to do, judge everything, write it, and return what results.json holds."""
    began = time.perf_counter()
    torch.set_num_threads(1)
    run_jobs(options.jobs(), options.processes, console)
    with console.status("judging"):
        environments = {env_id: judge(env_id, options) for env_id in options.env_ids}
    pieces = [piece for one in environments.values() for piece in (*one["gaits"].values(), *one["ppo"])]
    results = {
        "command": shlex.join(command),
        "wall_s": time.perf_counter() - began,
        "cpu_s": sum(piece["cpu_s"] for piece in pieces) + time.process_time(),
        "machine": machine(),
        "versions": versions(),
        "environments": environments,
    }
    write_json(options.out / "results.json", results)
    write_bytes(options.out / "results.md", markdown(results).encode())
    console.print(*tables(results), sep="\n")
    console.print(f"written to {options.out}: results.json, results.md and a figure for each environment")
    return results


def judge(env_id: str, options: Compare) -> dict[str, Any]:
    """Evaluate the gaits and the policies on one environment, and draw its figure."""
    config, out, name = options.config(env_id), options.out, env_id.rpartition("/")[2]
    envs = make_envs(env_id, 1)
    shown: list[Shown] = []
    gaits, policies, curves = {}, [], {}
    for label, gait in config.gaits.items():
        path = gait_path(env_id, gait, out)
        tuned = read_json(path)["result"]
        controller = sinusoid(make_envs(env_id, 1, **gait.env_kwargs), gait, tuned["vector"])
        episodes, gaits[label] = _judged(controller, env_id, config, path, tuned)
        shown.append(Shown(label, GAITS[len(shown)], episodes))
    for seed in options.seeds:
        path = ppo_path(env_id, config.ppo, seed, out)
        trained = read_json(path)["result"]
        episodes, policy = _judged(load_policy(path.with_suffix(".zip")), env_id, config, path, trained)
        policies.append({"seed": seed} | policy)
        curves[f"PPO, seed {seed}"] = trained["curve"]
        if len(policies) == 1:  # the first seed, not the best one
            shown.append(Shown(f"PPO, seed {seed}", POLICY, episodes))
    reached = {label: gait["distance_m"]["mean"] for label, gait in gaits.items()}
    draw(out / f"{name}.png", name, envs, shown, curves, reached)
    distances = [policy["distance_m"]["mean"] for policy in policies]
    return {
        "config": dataclasses.asdict(config),
        "seeds": {
            "ppo": options.seeds,
            "seeds_per_run": SEEDS_PER_RUN,
            "tuning": TUNING_SEEDS,
            "evaluation": EVALUATION_SEEDS,
        },
        "gaits": gaits,
        "ppo": policies,
        "ppo_over_seeds": {
            metric: summary(np.array([policy[metric]["mean"] for policy in policies])) for metric in METRICS
        },
        "seeds_farther_than": {label: sum(d > limit for d in distances) for label, limit in reached.items()},
    }


def _judged(
    controller: Controller, env_id: str, config: TaskConfig, path: Path, result: Mapping[str, Any]
) -> tuple[Rollout, dict[str, Any]]:
    """Recorded episodes, and the numbers of a controller next to how it came about."""
    episodes, numbers = evaluate(controller, env_id, config.evaluation)
    _, fine = evaluate(controller, env_id, config.evaluation, substeps=config.evaluation.fine_substeps)
    report = {metric: summary(values) for metric, values in numbers.items()}
    report["distance_m_finely_integrated"] = summary(fine["distance_m"])
    return episodes, {**report, **result, "file": path.relative_to(path.parents[1]).as_posix()}


def main(options: Compare) -> None:
    """Run from the command line."""
    try:
        compare(options, ["python", "-m", "training.compare", *sys.argv[1:]], Console())
    except KeyboardInterrupt:
        sys.exit("interrupted; what is finished is kept, and the same command goes on from there")


if __name__ == "__main__":
    main(tyro.cli(Compare, prog="python -m training.compare"))

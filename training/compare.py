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
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
import tyro
from rich.console import Console

from training import config as settings_of
from training.config import EVALUATION_SEEDS, SEEDS_PER_RUN, TUNING_SEEDS, TaskConfig
from training.evaluate import evaluate, load_policy
from training.metrics import headline, metrics_of
from training.optimal import reference
from training.options import Seeds, check_seeds
from training.plots import GAITS, POLICY, Shown, draw
from training.progress import Job, run_jobs
from training.report import markdown, tables
from training.rollout import Controller, Rollout, make_envs
from training.statistics import median_run, seconds_to_pass, summary
from training.store import machine, read_json, versions, write_bytes, write_json
from training.train import check_tensorboard, ppo_path, train_piece
from training.tuning import controller, gait_path, tune_piece

__all__ = ["Compare", "compare", "judge", "strongest_known"]


@dataclass(frozen=True, kw_only=True)
class Compare:
    """Compare PPO with a tuned gait; the same command again goes on after an interruption.

    Attributes:
        env_ids: environments.
        seeds: numbers of the PPO runs on each; 0-9 is short for ten of them.
        timesteps: environment steps of a PPO run; None for the settings of the task.
        drag: let the mechanisms' drag act.
        sprint: train for seconds instead of minutes, with what passes the steered gait soonest.
        out: folder of the results. What is finished in it is used again if its settings are the same.
        processes: processes side by side.
        tensorboard: folder of TensorBoard's files; None for none.
        quick: far too short runs, to see that everything works.
    """

    env_ids: tuple[str, ...] = settings_of.COMPARED
    seeds: Seeds = (0, 1, 2)
    timesteps: int | None = None
    drag: bool = False
    sprint: bool = False
    out: Path = Path("runs/compare")
    processes: int = os.cpu_count() or 1
    tensorboard: Path | None = None
    quick: bool = False

    def __post_init__(self) -> None:
        for env_id in self.env_ids:
            settings_of.for_env(env_id, self.drag, self.sprint)
        check_seeds(self.seeds)
        check_tensorboard(self.tensorboard)
        if self.processes < 1:
            raise ValueError(f"processes must be at least 1, got {self.processes}")

    def config(self, env_id: str) -> TaskConfig:
        """Settings for an environment."""
        config = settings_of.for_env(env_id, self.drag, self.sprint)
        if self.quick:
            config = settings_of.quick(config)
        if self.timesteps is not None:
            config = dataclasses.replace(config, ppo=dataclasses.replace(config.ppo, timesteps=self.timesteps))
        return config

    def jobs(self) -> list[Job]:
        """What is not done yet."""
        gaits, runs = [], []
        train = partial(train_piece, tensorboard=self.tensorboard)
        for env_id in self.env_ids:
            config, name = self.config(env_id), env_id.rpartition("/")[2]
            for label, gait in config.gaits.items():
                if not gait_path(env_id, gait, self.out).exists():
                    gaits.append(Job(f"{name} {label}", tune_piece, (env_id, gait, self.out)))
            for seed in self.seeds:
                if not ppo_path(env_id, config.ppo, seed, self.out).exists():
                    runs.append(Job(f"{name} PPO seed {seed}", train, (env_id, config.ppo, seed, self.out)))
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


def strongest_known(env_id: str, env_kwargs: Mapping[str, Any]) -> float | None:
    """Distance in m that direct optimal control reaches; None where it was not asked, or in another environment."""
    if set(env_kwargs) - {"drag"} or not isinstance(env_kwargs.get("drag", False), bool):
        return None
    return reference(env_id, env_kwargs.get("drag", False))


def judge(env_id: str, options: Compare) -> dict[str, Any]:
    """Evaluate the gaits and the policies on one environment, and draw its figure."""
    config, out, name = options.config(env_id), options.out, env_id.rpartition("/")[2]
    envs = make_envs(env_id, 1, **config.evaluation.env_kwargs)
    first, metrics = headline(envs.task), metrics_of(envs.task)
    shown: list[Shown] = []
    # A gait is passed where a curve shows more than it would of the gait: the same starts, and their mean.
    on_curve, marks = dataclasses.replace(config.evaluation, episodes=config.ppo.curve_episodes), {}
    gaits, policies, curves, rollouts, scores = {}, [], [], [], []
    for label, gait in config.gaits.items():
        path = gait_path(env_id, gait, out)
        tuned = read_json(path)["result"]
        driver = controller(make_envs(env_id, 1, **gait.env_kwargs), gait, tuned["vector"])
        episodes, gaits[label], _ = _judged(driver, env_id, config, path, tuned)
        shown.append(Shown(label, GAITS[len(shown) % len(GAITS)], episodes))
        marks[label] = float(evaluate(driver, env_id, on_curve, seeds=TUNING_SEEDS)[1][first.name].mean())
    for seed in options.seeds:
        path = ppo_path(env_id, config.ppo, seed, out)
        trained = read_json(path)["result"]
        episodes, policy, numbers = _judged(load_policy(path.with_suffix(".zip")), env_id, config, path, trained)
        policies.append({"seed": seed} | policy)
        curves.append(trained["curve"])
        rollouts.append(episodes)
        scores.append(numbers)
    estimates = [policy[first.name]["estimate"] for policy in policies]
    middle = median_run(estimates, first.better)
    shown.append(Shown(f"PPO, seed {options.seeds[middle]}", POLICY, rollouts[middle]))
    reached = {label: gait[first.name]["estimate"] for label, gait in gaits.items()}
    best = max(reached, key=lambda label: first.better * reached[label])
    title = f"{name}{', with drag' if options.drag else ''}{', sprint' if options.sprint else ''}"
    draw(out / f"{name}.png", title, envs, shown, list(reached).index(best), curves, marks)
    over_seeds = {
        metric.name: summary(np.array([numbers[metric.name] for numbers in scores]), metric.statistic)
        for metric in metrics
    }
    fine = summary(np.array([numbers["finely_integrated"] for numbers in scores]), first.statistic)
    return {
        "config": dataclasses.asdict(config),
        "seeds": {
            "ppo": options.seeds,
            "seeds_per_run": SEEDS_PER_RUN,
            "tuning": TUNING_SEEDS,
            "evaluation": EVALUATION_SEEDS,
        },
        "headline": first.name,
        "statistics": {metric.name: metric.statistic for metric in metrics},
        "reference": strongest_known(env_id, config.evaluation.env_kwargs) if first.name == "distance_m" else None,
        "gaits": gaits,
        "ppo": policies,
        "ppo_over_seeds": over_seeds | {"finely_integrated": fine},
        "median_seed": options.seeds[middle],
        "seeds_better_than": {
            label: sum(first.better * estimate > first.better * mark for estimate in estimates)
            for label, mark in reached.items()
        },
        "cpu_s_to_pass": {
            label: seconds_to_pass(curves, first.name, mark, first.better) for label, mark in marks.items()
        },
    }


def _judged(
    controller: Controller, env_id: str, config: TaskConfig, path: Path, result: Mapping[str, Any]
) -> tuple[Rollout, dict[str, Any], dict[str, Any]]:
    """Recorded episodes, the numbers of a controller next to how it came about, and those of each episode."""
    envs = make_envs(env_id, 1, **config.evaluation.env_kwargs)
    first = headline(envs.task)
    substeps = config.evaluation.fine_substeps * envs.substeps
    episodes, numbers = evaluate(controller, env_id, config.evaluation)
    _, fine = evaluate(controller, env_id, config.evaluation, substeps=substeps)
    scores = {**numbers, "finely_integrated": fine[first.name]}
    report: dict[str, Any] = {
        **{metric.name: summary(scores[metric.name], metric.statistic) for metric in metrics_of(envs.task)},
        "finely_integrated": summary(scores["finely_integrated"], first.statistic),
        **result,
        "file": path.relative_to(path.parents[1]).as_posix(),
    }
    return episodes, report, scores


def main(options: Compare) -> None:
    """Run from the command line."""
    try:
        compare(options, ["python", "-m", "training.compare", *sys.argv[1:]], Console())
    except KeyboardInterrupt:
        sys.exit("interrupted; what is finished is kept, and the same command goes on from there")


if __name__ == "__main__":
    main(tyro.cli(Compare, prog="python -m training.compare"))

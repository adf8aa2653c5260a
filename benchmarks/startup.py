"""Time from process start to the first step of an environment, with a cold and a warm kernel cache.

    python -m benchmarks.startup

Each run is a fresh interpreter that imports Gymnasium and nhenv, makes the environment, resets it and
takes one step; the cold runs start with an empty cache directory of their own. For comparison: the
same with CartPole-v1.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass

import numpy as np
import tyro
from rich.console import Console
from rich.progress import track
from rich.table import Table

__all__ = ["main"]

PROGRAM = """
import gymnasium, nhenv
env = gymnasium.make({env_id!r})
env.reset(seed=0)
env.step(env.action_space.sample())
"""


@dataclass
class Arguments:
    """Size of the benchmark."""

    env_ids: tuple[str, ...] = ("nhenv/SnakeboardForward-v0", "nhenv/RollerRacerForward-v0")
    """environments"""
    cold: int = 3
    """processes with an empty cache"""
    warm: int = 10
    """processes with a full one"""


def main(arguments: Arguments) -> None:
    """Print seconds to the first step."""
    table = Table("environment", "cache", "seconds", caption="to the first step: medians and quartiles")
    jobs: list[tuple[str, str, int]] = [
        (env_id, cache, getattr(arguments, cache)) for env_id in arguments.env_ids for cache in ("cold", "warm")
    ]
    jobs.append(("CartPole-v1", "-", arguments.warm))
    for env_id, cache, runs in track(jobs, "environments", console=Console(stderr=True)):
        low, middle, high = np.percentile(_times(env_id, runs, cold=cache == "cold"), [25, 50, 75])
        table.add_row(env_id, cache, f"{middle:.2f} ({low:.2f}-{high:.2f})")
    Console().print(table)


def _times(env_id: str, runs: int, *, cold: bool) -> list[float]:
    with tempfile.TemporaryDirectory() as shared:
        if not cold:
            _time(env_id, shared)
        times = []
        for _ in range(runs):
            with tempfile.TemporaryDirectory() as fresh:
                times.append(_time(env_id, fresh if cold else shared))
    return times


def _time(env_id: str, cache: str) -> float:
    start = time.perf_counter()
    environment = {**os.environ, "NHENV_CACHE_DIR": cache}
    subprocess.run([sys.executable, "-c", PROGRAM.format(env_id=env_id)], check=True, env=environment)
    return time.perf_counter() - start


if __name__ == "__main__":
    main(tyro.cli(Arguments, description=__doc__))

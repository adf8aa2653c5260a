"""Time from process start to the first step of an environment or of many, with a cold and a warm kernel cache.

    python -m benchmarks.startup

Each run is a fresh interpreter that imports Gymnasium and nhenv, makes the environment or a vector of
them, resets it and takes one step; the cold runs start with an empty cache directory of their own. For
comparison: the same with CartPole-v1.
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
env = gymnasium.{make}
env.reset(seed=0)
env.step(env.action_space.sample())
"""
REFERENCE = "CartPole-v1"


@dataclass
class Arguments:
    """Size of the benchmark."""

    env_ids: tuple[str, ...] = ("nhenv/SnakeboardForward-v0", "nhenv/RollerRacerForward-v0")
    """environments"""
    num_envs: int = 1024
    """size of the vector environments; 0 for none"""
    cold: int = 3
    """processes with an empty cache"""
    warm: int = 10
    """processes with a full one"""


def main(arguments: Arguments) -> None:
    """Print seconds to the first step."""
    table = Table("environment", "N", "cache", "seconds", caption="to the first step: medians and quartiles")
    sizes = dict.fromkeys((1, arguments.num_envs or 1))
    jobs: list[tuple[str, int, str, int]] = [
        (env_id, size, cache, getattr(arguments, cache))
        for env_id in arguments.env_ids
        for size in sizes
        for cache in ("cold", "warm")
    ]
    jobs += [(REFERENCE, size, "-", arguments.warm) for size in sizes]
    for env_id, size, cache, runs in track(jobs, "environments", console=Console(stderr=True)):
        low, middle, high = np.percentile(_times(_make(env_id, size), runs, cold=cache == "cold"), [25, 50, 75])
        table.add_row(env_id, f"{size}", cache, f"{middle:.2f} ({low:.2f}-{high:.2f})")
    Console().print(table)


def _make(env_id: str, size: int) -> str:
    """Call of Gymnasium for one environment, or for several at their quickest."""
    if size == 1:
        return f"make({env_id!r})"
    mode = ", vectorization_mode='vector_entry_point'" if env_id == REFERENCE else ""
    return f"make_vec({env_id!r}, num_envs={size}{mode})"


def _times(make: str, runs: int, *, cold: bool) -> list[float]:
    with tempfile.TemporaryDirectory() as shared:
        if not cold:
            _time(make, shared)
        times = []
        for _ in range(runs):
            with tempfile.TemporaryDirectory() as fresh:
                times.append(_time(make, fresh if cold else shared))
    return times


def _time(make: str, cache: str) -> float:
    start = time.perf_counter()
    environment = {**os.environ, "NHENV_CACHE_DIR": cache}
    subprocess.run([sys.executable, "-c", PROGRAM.format(make=make)], check=True, env=environment)
    return time.perf_counter() - start


if __name__ == "__main__":
    main(tyro.cli(Arguments, prog="python -m benchmarks.startup", description=__doc__))

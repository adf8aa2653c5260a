"""Time of one stepped environment through `gym.make`, against Gymnasium's CartPole-v1.

    python -m benchmarks.single_env

Each contender gets the same seeded random actions and resets when an episode ends. Contenders take
turns in short rounds, so that a slow moment of the machine hits all of them; the ratio is formed
within a round, and its median and quartiles over the rounds are printed. What is not installed is named.
"""

from __future__ import annotations

import time
from collections.abc import Iterable
from dataclasses import dataclass

import gymnasium as gym
import numpy as np
import tyro
from gymnasium.error import DependencyNotInstalled
from rich.console import Console
from rich.progress import track
from rich.table import Table

import nhenv  # noqa: F401 (registers the environments)

__all__ = ["main"]

REFERENCE = "CartPole-v1"


@dataclass
class Arguments:
    """Size of the benchmark."""

    env_ids: tuple[str, ...] = ("nhenv/SnakeboardForward-v0", "nhenv/RollerRacerForward-v0")
    """environments"""
    peers: tuple[str, ...] = ("Pendulum-v1", "HalfCheetah-v5", "Swimmer-v5")
    """environments of Gymnasium beside CartPole-v1; those of MuJoCo need the extra `bench`"""
    rounds: int = 30
    """turns of each contender"""
    seconds: float = 0.1
    """length of a turn"""


class Contender:
    """An environment, its actions drawn beforehand."""

    def __init__(self, env_id: str) -> None:
        self.env = gym.make(env_id)
        self.env.action_space.seed(0)
        self.actions = [self.env.action_space.sample() for _ in range(1024)]
        self.env.reset(seed=0)

    def run(self, steps: int) -> float:
        """Seconds a step, resets included."""
        env, actions = self.env, self.actions
        env.reset()
        start = time.perf_counter()
        for i in range(steps):
            observation, _, terminated, truncated, _ = env.step(actions[i & 1023])
            if terminated or truncated:
                env.reset()
        elapsed = time.perf_counter() - start
        assert np.isfinite(observation).all()
        return elapsed / steps


def installed(names: Iterable[str]) -> tuple[dict[str, Contender], list[str]]:
    """Contenders by name, and why others are not there."""
    contenders, skipped = {}, []
    for name in names:
        try:
            contenders[name] = Contender(name)
        except (ImportError, DependencyNotInstalled) as error:
            skipped.append(f"skipped: {name} ({error})")
    return contenders, skipped


def main(arguments: Arguments) -> None:
    """Print microseconds a step, and how many times faster than CartPole-v1 each environment is."""
    contenders, skipped = installed([REFERENCE, *arguments.peers, *arguments.env_ids])
    # Warm-up: compilation and caches; then turns of equal length, a thousand steps or a hundred thousand.
    steps = [max(round(arguments.seconds / min(c.run(300), c.run(300))), 1) for c in contenders.values()]
    turns = list(zip(contenders.values(), steps, strict=True))
    rounds = track(range(arguments.rounds), "rounds", console=Console(stderr=True))
    times = np.array([[contender.run(count) for contender, count in turns] for _ in rounds])
    table = Table("environment", "µs a step", f"times {REFERENCE}", caption="medians and quartiles")
    for name, column in zip(contenders, times.T, strict=True):
        low, middle, high = np.percentile(column * 1e6, [25, 50, 75])
        ratio = np.percentile(times[:, 0] / column, [25, 50, 75])
        table.add_row(name, f"{middle:.2f} ({low:.2f}-{high:.2f})", f"{ratio[1]:.2f} ({ratio[0]:.2f}-{ratio[2]:.2f})")
    console = Console()
    console.print(table)
    for line in skipped:
        console.print(line, markup=False)


if __name__ == "__main__":
    main(tyro.cli(Arguments, prog="python -m benchmarks.single_env", description=__doc__))

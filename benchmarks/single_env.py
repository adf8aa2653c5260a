"""Time of one stepped environment through `gym.make`, against Gymnasium's CartPole-v1.

    python -m benchmarks.single_env

Each contender gets the same seeded random actions and resets when an episode ends. Contenders take
turns in short rounds, so that a slow moment of the machine hits all of them; the ratio is formed
within a round, and its median and quartiles over the rounds are printed.
"""

from __future__ import annotations

import time
from dataclasses import dataclass

import gymnasium as gym
import numpy as np
import tyro
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
    rounds: int = 30
    """turns of each contender"""
    steps: int = 10_000
    """steps in a turn"""


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


def main(arguments: Arguments) -> None:
    """Print microseconds a step, and how many times faster than CartPole-v1 each environment is."""
    names = [REFERENCE, *arguments.env_ids]
    contenders = [Contender(name) for name in names]
    for contender in contenders:
        contender.run(arguments.steps)  # warm-up: compilation and caches
    rounds = track(range(arguments.rounds), "rounds", console=Console(stderr=True))
    times = np.array([[contender.run(arguments.steps) for contender in contenders] for _ in rounds])
    table = Table("environment", "µs a step", f"times {REFERENCE}", caption="medians and quartiles")
    for name, column in zip(names, times.T, strict=True):
        low, middle, high = np.percentile(column * 1e6, [25, 50, 75])
        ratio = np.percentile(times[:, 0] / column, [25, 50, 75])
        table.add_row(name, f"{middle:.2f} ({low:.2f}-{high:.2f})", f"{ratio[1]:.2f} ({ratio[0]:.2f}-{ratio[2]:.2f})")
    Console().print(table)


if __name__ == "__main__":
    main(tyro.cli(Arguments, description=__doc__))

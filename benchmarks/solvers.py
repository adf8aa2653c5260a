"""Those that integrate the motions of a `Problem`: our environments, and the solvers they are compared with.

Every contender stops at the end of each hold, where the torque jumps and a policy wants to see the state. One with a
setting, such as a tolerance, is made for one problem, which compiles it; then it can be asked for its motions, and for
the time that some of them take.

To add one of ours: a row in `OURS`. Others: `benchmarks.solver_peers`.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

import nhenv  # noqa: F401 (registers the environments)
from benchmarks.motions import Problem

__all__ = ["BATCHED", "OURS", "PEER", "SINGLE", "Contender", "Point", "Solver", "States", "ours", "pair"]

Array = NDArray[np.float64]
States = tuple[Array, Array]  # coordinates and velocities (T + 1, B, n)

SINGLE, BATCHED, PEER = "single", "batched", "peer"


@dataclass(frozen=True)
class Solver:
    """A contender with one setting, ready for one problem.

    Attributes:
        motions: all motions of the problem.
        turn: number of the turn -> seconds taken for a simulated second of one environment.
    """

    motions: Callable[[], States]
    turn: Callable[[int], float]


@dataclass(frozen=True)
class Contender:
    """A point of the figure, on the line of all contenders of the same name.

    Attributes:
        name: of the line.
        setting: as tables print it.
        kind: "single" or "batched" for ours, "peer" for others.
        environments: how many are integrated side by side.
        make: makes it for a problem; an ImportError if it is not installed, a ValueError if it can't do this.
        mechanism: the only one that this is for, if not all.
    """

    name: str
    setting: str
    kind: str
    environments: int
    make: Callable[[Problem], Solver]


# -- ours ------------------------------------------------------------------------------------------

# Mechanism -> name of the line -> arguments of the environment, one point each.
OURS: dict[str, dict[str, tuple[dict[str, Any], ...]]] = {
    "snakeboard": {
        "default": ({},),
        "lobatto": tuple({"integrator": f"lobatto{nodes}"} for nodes in (4, 5, 6, 7)),
        "rk4": tuple({"integrator": "rk4", "substeps": count} for count in (1, 4, 16)),
    },
    "roller_racer": {
        "default": ({},),
        "verner9": tuple({"integrator": "verner9", "substeps": count} for count in (1, 2, 3, 4)),
        "dop853": tuple({"integrator": "dop853", "substeps": count} for count in (1, 2)),
        "rk4": tuple({"integrator": "rk4", "substeps": count} for count in (1, 4, 16)),
    },
}

COMMON: dict[str, Any] = {"joint_limits": False, "whole_state": True}
SHORTEST = 0.02  # s, of a turn


@dataclass(frozen=True)
class Point:
    """What is known of a contender on a mechanism.

    Attributes:
        mechanism: its name.
        contender: who.
        errors: kind of torque -> largest error.
        times: seconds for a simulated second of one environment, in each turn.
    """

    mechanism: str
    contender: Contender
    errors: dict[str, float]
    times: list[float] = field(default_factory=list)

    @property
    def error(self) -> float:
        """Largest of all."""
        return max(self.errors.values())

    @property
    def time(self) -> float:
        """Median."""
        return float(np.median(self.times))


def single(options: Mapping[str, Any]) -> Callable[[Problem], Solver]:
    """One environment of `gym.make`, one call a step."""

    def make(problem: Problem) -> Solver:
        env = gym.make(problem.env_id, max_episode_steps=problem.holds + 1, **COMMON, **options)
        bare: Any = env.unwrapped
        actions = [list(problem.actions[:, row].copy()) for row in range(problem.count)]

        def start(row: int) -> None:
            env.reset(options={"q": problem.q[row], "qdot": problem.qdot[row]})

        def motion(row: int) -> States:
            start(row)
            states = [(bare.q, bare.qdot)]
            for action in actions[row]:
                env.step(action)
                states.append((bare.q, bare.qdot))
            q, qdot = zip(*states, strict=True)
            return np.array(q), np.array(qdot)

        def motions() -> States:
            q, qdot = zip(*(motion(row) for row in range(problem.count)), strict=True)
            return np.stack(q, axis=1), np.stack(qdot, axis=1)

        def turn(number: int) -> float:
            seconds, passes = 0.0, 0
            while seconds < SHORTEST:
                for row in pair(problem, number + passes):
                    start(row)
                    begun = time.perf_counter()
                    for action in actions[row]:
                        env.step(action)
                    seconds += time.perf_counter() - begun
                passes += 1
            return seconds / (passes * 2 * problem.seconds)

        return Solver(motions, turn)

    return make


def batched(options: Mapping[str, Any], size: int) -> Callable[[Problem], Solver]:
    """As many environments as wanted, of `gym.make_vec`: copies of the problem's motions."""

    def make(problem: Problem) -> Solver:
        never: dict[str, Any] = {"max_episode_steps": None}
        envs = gym.make_vec(problem.env_id, num_envs=size, **COMMON, **never, **options)
        bare: Any = envs.unwrapped
        rows = np.arange(size) % problem.count
        actions = [np.ascontiguousarray(action[rows]) for action in problem.actions]

        def start() -> None:
            envs.reset(options={"q": problem.q[rows], "qdot": problem.qdot[rows]})

        def motions() -> States:
            start()
            states = [(bare.q[: problem.count], bare.qdot[: problem.count])]
            for action in actions:
                envs.step(action)
                states.append((bare.q[: problem.count], bare.qdot[: problem.count]))
            q, qdot = zip(*states, strict=True)
            return np.array(q), np.array(qdot)

        def turn(number: int) -> float:
            start()
            begun = time.perf_counter()
            for action in actions:
                envs.step(action)
            return (time.perf_counter() - begun) / (size * problem.seconds)

        return Solver(motions, turn)

    return make


def pair(problem: Problem, number: int) -> tuple[int, int]:
    """Rows of one motion with either kind of torque, another in each turn."""
    half = problem.count // 2
    return number % half, half + number % half


def ours(mechanism: str, sizes: tuple[int, ...]) -> list[Contender]:
    """Our points: each method alone, and side by side in these numbers."""
    found = []
    for name, row in OURS[mechanism].items():
        for options in row:
            setting = ", ".join(str(value) for value in options.values() if value != name)
            found.append(Contender(f"nhenv {name}", setting, SINGLE, 1, single(options)))
            for size in sizes:
                found.append(Contender(f"nhenv {name}, {size} at once", setting, BATCHED, size, batched(options, size)))
    return found

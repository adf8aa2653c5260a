"""Largest error of `mechanics.simulate` and of the stepped environments on the reference trajectories.

    python -m benchmarks.accuracy

The references (tests/data/reference) integrate the same mechanisms with Lagrange multipliers in
quadruple precision. Errors are the largest over all stored times and all components; environments
run with default settings where the torque is held for their control period. Their actions are
float32: the torque limit is a power of two times 1e-6 N m, in which the recorded torques are whole,
so that no action is rounded.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

import mechanics
from nhenv.env import LocomotionEnv

__all__ = ["main"]

REFERENCE = Path(__file__).parents[1] / "tests" / "data" / "reference"
RESOLUTION = 1e-6  # N m, of the recorded torques


def main() -> None:
    """Print the table."""
    table = Table("record", "s", "torque", "simulate q", "q̇", "energy", "env q", "q̇", caption="largest errors")
    for path in sorted(REFERENCE.glob("*.json")):
        name = path.stem
        for record in json.loads(path.read_text(encoding="utf-8")):
            held = record["inputs"][0]["type"] == "zoh"
            q, qdot = (np.array([state[key] for state in record["states"]]) for key in ("q", "qdot"))
            run = mechanics.simulate(
                mechanics.get(name),
                [state["t"] for state in record["states"]],
                record["q0"],
                qdot0=record["qdot0"],
                controls=_torque(record["inputs"]),
                params=record["params"],
            )
            balance = np.abs(run.energy - run.energy[0] - run.work).max()
            errors = [np.abs(run.q - q).max(), np.abs(run.qdot - qdot).max(), balance]
            cells = [f"{error:.0e}" for error in errors]
            cells += [f"{error:.0e}" for error in _stepped(name, record, q, qdot)] if held else ["", ""]
            table.add_row(record["id"], f"{record['horizon']:g}", "held" if held else "smooth", *cells)
    Console().print(table)


def _torque(inputs: list[dict[str, Any]]) -> Callable[[float], list[float]]:
    def one(spec: dict[str, Any], t: float) -> float:
        if spec["type"] == "zoh":
            return spec["values"][min(int(t / spec["dt"]), len(spec["values"]) - 1)]
        terms = zip(spec["amp"], spec["omega"], spec["phase"], strict=True)
        return spec["const"] + sum(a * math.sin(w * t + p) for a, w, p in terms)

    return lambda t: [one(spec, t) for spec in inputs]


def _stepped(name: str, record: dict[str, Any], q: NDArray[np.float64], qdot: NDArray[np.float64]) -> list[float]:
    """Errors in q and q̇ of the environment at the stored times."""
    torques = np.array([spec["values"] for spec in record["inputs"]]).T
    limit = RESOLUTION * 2 ** math.ceil(math.log2(np.abs(torques).max() / RESOLUTION))
    env = LocomotionEnv(name, params=record["params"], joint_limits=False, torque_limits=limit)
    env.reset(options={"q": record["q0"], "qdot": record["qdot0"]})
    stored = {state["t_steps_of_0_05"]: index for index, state in enumerate(record["states"])}
    errors = [0.0, 0.0]
    for step, action in enumerate((torques / limit).astype(np.float32), start=1):
        env.step(action)
        if step in stored:
            now = (env.q - q[stored[step]], env.qdot - qdot[stored[step]])
            errors = [max(error, float(np.abs(new).max())) for error, new in zip(errors, now, strict=True)]
    return errors


if __name__ == "__main__":
    tyro.cli(main, prog="python -m benchmarks.accuracy", description=__doc__)

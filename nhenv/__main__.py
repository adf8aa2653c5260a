"""What a scene computes, and what it leaves out: `python -m nhenv nhenv/SnakeboardForward-v0`.

Without an id, a line on each registered environment.
"""

from __future__ import annotations

import ast
import dataclasses
import sys
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Annotated

import gymnasium as gym
import tyro

from nhenv.configuration import Configuration
from nhenv.registration import environment_ids
from nhenv.scene import Scene

__all__ = ["Cost", "cost", "main", "operations"]

# Of the functions that a scene's kernels share: those that every step goes through.
STEP = ("advance_states", "observe", "judge", "ends")


@dataclass(frozen=True)
class Cost:
    """What one step of a scene takes.

    Attributes:
        layers: (kind, states) in the order in which they are integrated.
        pruned: the states that nothing observed, rewarded or reported depends on.
        method: how those are integrated that are not exact.
        operations: additions, multiplications, divisions, roots and functions of a step without events.
    """

    layers: tuple[tuple[str, tuple[str, ...]], ...]
    pruned: tuple[str, ...]
    method: str
    operations: int


def main(ids: Annotated[tuple[str, ...], tyro.conf.Positional] = (), drag: bool = False) -> None:
    """Print the states that environments integrate, those that they leave out, and the operations of a step.

    Args:
        ids: environments, such as nhenv/SnakeboardForward-v0; all that are registered if left out.
        drag: let the mechanism's drag act.
    """
    from rich.console import Console
    from rich.progress import track
    from rich.table import Table

    for name in ids:
        if name not in environment_ids():
            print(f"error: no environment {name!r}; python -m nhenv lists those that there are", file=sys.stderr)
            raise SystemExit(2)
    console = Console(width=None if sys.stdout.isatty() else 140)
    table = Table(title="operations of a step, of the scene and of its whole state", title_justify="left")
    for heading in ("environment", "integrated", "left out", "method", "scene", "whole", "share"):
        table.add_column(heading, justify="right" if heading in ("scene", "whole", "share") else "left")
    for name in track(ids or environment_ids(), "deriving", console=console, transient=True):
        scene = scene_of(name, drag=drag)
        own, whole = cost(scene), cost(dataclasses.replace(scene, whole_state=True))
        kinds = "\n".join(f"{kind}: {' '.join(states)}" for kind, states in own.layers)
        share = f"{100 * own.operations / whole.operations:.0f} %"
        table.add_row(name, kinds, " ".join(own.pruned), own.method, str(own.operations), str(whole.operations), share)
    console.print(table)


def scene_of(environment_id: str, **arguments: object) -> Scene:
    """The scene of a registered environment with these arguments."""
    kwargs = {**gym.spec(environment_id).kwargs, **{name: value for name, value in arguments.items() if value}}
    return Configuration(**kwargs).scene


def cost(scene: Scene) -> Cost:
    """Derive what one step of a scene takes, from the text of its kernel."""
    from mechanics.compiler.backends import BACKENDS
    from nhenv.generate import Generator

    generator = Generator(scene)
    source = "\n\n".join(generator.functions(BACKENDS["numpy"], 1))
    count = operations(source, STEP) + (generator.substeps - 1) * operations(source, STEP[:1])
    layers: list[tuple[str, tuple[str, ...]]] = []
    for layer in generator.flow.layers:
        states = tuple(state.name for state in layer.states)
        if layers and layers[-1][0] == layer.kind != "core":
            states = (*layers.pop()[1], *states)
        layers.append((layer.kind, states))
    pruned = tuple(state.name for state in generator.flow.pruned)
    return Cost(tuple(layers), pruned, f"{generator.method.name} x {generator.substeps}", count)


def operations(source: str, functions: Iterable[str]) -> int:
    """Number of operations in the text of some functions: arithmetic, and calls of anything."""
    wanted = set(functions)
    found = [node for node in ast.parse(source).body if isinstance(node, ast.FunctionDef) and node.name in wanted]
    return sum(_operates(node) for function in found for node in ast.walk(function))


def _operates(node: ast.AST) -> bool:
    return isinstance(node, ast.Call) or (isinstance(node, ast.BinOp) and not isinstance(node.op, ast.BitAnd))


if __name__ == "__main__":
    tyro.cli(main, prog="python -m nhenv")

"""Steps a second of vector environments, one to a million at once, against those of others.

    python -m benchmarks.throughput
    python -m benchmarks.throughput --quick

Whole steps: random actions drawn beforehand, observations, rewards, and resets, which come at a steady rate; the
arrays that a step returns are dropped with the next, as a training loop does. Contenders warm up, then take turns in
short rounds, so that a slow moment of the machine hits all of them; a ratio is formed within a round. What is not
finite is not timed, and what is not installed is named.

Beside each of our rows stand its errors (`benchmarks.errors`: of one control period, and within ten seconds) and the
memory that an environment takes beyond the arrays that are returned (`benchmarks.memory`). The last table counts the
instructions of the compiled kernels, and says what share of a whole step they would take if all arithmetic ran at the
machine's rate of fused multiply-adds and nothing else took time (`benchmarks.floor`).

The peers solve CartPole, by one step of Euler's method: a few operations, with an error that nobody asks for.
"""

from __future__ import annotations

import csv
import gc
import shlex
import sys
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from gymnasium.error import DependencyNotInstalled
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

import nhenv  # noqa: F401 (registers the environments)
from benchmarks.errors import Errors, errors
from benchmarks.floor import Part, fma_rate, kernel_parts
from benchmarks.memory import Memory, memory
from benchmarks.peers import PEERS, Contender, Run, ours, sync

__all__ = ["Arguments", "main"]

WIDTH = 150
SYNC = "SyncVectorEnv"


@dataclass
class Arguments:
    """Size of the benchmark."""

    env_ids: tuple[str, ...] = ("nhenv/SnakeboardForward-v0", "nhenv/RollerRacerForward-v0")
    """environments"""
    sizes: tuple[int, ...] = (1, 64, 1024, 16384, 131072, 1048576)
    """numbers of environments"""
    threads: tuple[int, ...] = (1, 2)
    """threads of ours"""
    dtypes: tuple[str, ...] = ("float64",)
    """numbers of ours"""
    peers: tuple[str, ...] = (*PEERS, SYNC)
    """whom ours are compared with"""
    rounds: int = 20
    """turns of each contender"""
    seconds: float = 0.2
    """length of a turn, at least one step"""
    floor: bool = True
    """compile the kernels once more, to count what they do"""
    quick: bool = False
    """under a minute: three sizes, a few short rounds, few errors, no kernels compiled once more"""
    csv: Path | None = None
    """file for the numbers"""


@dataclass(frozen=True)
class Ours:
    """One of our rows: an environment, and how it is made."""

    env_id: str
    threads: int
    dtype: str

    @property
    def options(self) -> dict[str, Any]:
        """Arguments of `gym.make_vec` that are not the default."""
        options: dict[str, Any] = {"threads": self.threads} if self.threads > 1 else {}
        return options | ({"dtype": self.dtype} if self.dtype != "float64" else {})

    @property
    def name(self) -> str:
        """As tables print it."""
        name = self.env_id.split("/")[-1].removesuffix("-v0")
        name += f", {self.dtype}" if self.dtype != "float64" else ""
        return f"{name}, {self.threads} thread{'s' * (self.threads > 1)}"

    @property
    def alone(self) -> Ours:
        """The same on one thread."""
        return Ours(self.env_id, 1, self.dtype)


@dataclass
class Results:
    """What is known.

    Attributes:
        seconds: a step of (number of environments, contender), in each round.
        errors, memory, parts: of our rows; errors and parts of those on one thread.
        rates: fused multiply-adds a second by dtype.
        skipped: peer -> why it is not there.
    """

    seconds: dict[tuple[int, Contender], list[float]] = field(default_factory=dict)
    errors: dict[Ours, Errors] = field(default_factory=dict)
    memory: dict[Ours, Memory | None] = field(default_factory=dict)
    parts: dict[Ours, list[Part]] = field(default_factory=dict)
    rates: dict[str, float] = field(default_factory=dict)
    skipped: dict[str, str] = field(default_factory=dict)


# -- measuring -------------------------------------------------------------------------------------


def rows(arguments: Arguments) -> dict[Ours, Contender]:
    """Our rows and how they are run."""
    chosen = [
        Ours(env_id, threads, dtype)
        for env_id in arguments.env_ids
        for dtype in arguments.dtypes
        for threads in arguments.threads
    ]
    return {row: ours(row.name, row.env_id, row.options) for row in chosen}


def run(arguments: Arguments, contenders: Iterable[Contender], results: Results) -> None:
    """Time all contenders, one number of environments after another."""
    contenders = list(contenders)
    with Progress(console=Console(stderr=True)) as progress:
        task = progress.add_task("", total=len(arguments.sizes) * arguments.rounds)
        for size in arguments.sizes:
            progress.update(task, description=f"{size}: warm-up")
            runs = dict(_ready(size, contenders, arguments.seconds, results))
            for _ in range(arguments.rounds):
                progress.update(task, advance=1, description=f"{size}")
                for contender, (turn, steps) in runs.items():
                    results.seconds.setdefault((size, contender), []).append(turn(steps))
            del runs
            gc.collect()


def _ready(
    size: int, contenders: Iterable[Contender], seconds: float, results: Results
) -> Iterator[tuple[Contender, tuple[Run, int]]]:
    """Contenders that can be had, warmed up, with the steps of a turn."""
    for contender in contenders:
        if size > contender.largest or contender.kind in results.skipped:
            continue
        try:
            turn = contender.make(size)
        except (ImportError, DependencyNotInstalled) as error:
            results.skipped[contender.kind] = str(error)
            continue
        estimate = turn(1)
        estimate = turn(max(round(seconds / 10 / estimate), 1))
        yield contender, (turn, max(round(seconds / estimate), 1))


def judge(arguments: Arguments, chosen: Iterable[Ours], results: Results) -> None:
    """Measure what does not depend on the moment: errors, memory, and what the kernels do."""
    for row in chosen:
        results.memory[row] = memory(row.env_id, row.options, max(arguments.sizes))
        alone = row.alone
        if alone not in results.errors:
            effort = {"runs": 2} if arguments.quick else {}
            results.errors[alone] = errors(alone.env_id, alone.options, **effort)
        if arguments.floor and alone not in results.parts:
            results.parts[alone] = kernel_parts(alone.env_id, alone.options)
            results.rates[row.dtype] = fma_rate(double=row.dtype == "float64")


# -- reporting -------------------------------------------------------------------------------------

Quartiles = tuple[float, float, float]


def quartiles(values: NDArray[np.float64] | list[float]) -> Quartiles:
    """First quartile, median and third quartile."""
    low, middle, high = np.percentile(values, [25, 50, 75])
    return float(low), float(middle), float(high)


def ratios(results: Results, size: int, contender: Contender, chosen: Mapping[Ours, Contender]) -> dict[str, Quartiles]:
    """How many times faster this contender is than each peer at its best, and than itself on one thread."""
    mine = np.array(results.seconds[size, contender])
    kinds: dict[str, list[list[float]]] = {}
    for (other_size, other), seconds in results.seconds.items():
        if other_size == size and other not in chosen.values():
            kinds.setdefault(other.kind, []).append(seconds)
    found = {kind: quartiles(np.min(seconds, axis=0) / mine) for kind, seconds in kinds.items()}
    for row, candidate in chosen.items():
        alone = chosen.get(row.alone)
        if candidate == contender and row.threads > 1 and alone and (size, alone) in results.seconds:
            found["one thread"] = quartiles(np.array(results.seconds[size, alone]) / mine)
    return found


def tables(results: Results, chosen: Mapping[Ours, Contender]) -> Iterator[Table | str]:
    """What was measured."""
    row_of = {contender: row for row, contender in chosen.items()}
    caption = "medians and quartiles; error: largest after one control period, and within 10 s"
    speed = Table("N", "", "µs a step", "ns an env", "10⁶ env-steps/s", "error", "B/env kept, peak", caption=caption)
    kinds = list(dict.fromkeys(kind for size, c in results.seconds for kind in ratios(results, size, c, chosen)))
    faster = Table("N", "times as fast as", *kinds, caption="medians and quartiles of ratios within a round")
    for table in (speed, faster):
        table.columns[1].no_wrap = True
    previous = 0
    for (size, contender), seconds in results.seconds.items():
        if previous not in (0, size):
            speed.add_section()
            faster.add_section()
        previous = size
        low, middle, high = quartiles(seconds)
        cells = [f"{size}", contender.name, f"{middle * 1e6:.1f} ({low * 1e6:.1f}-{high * 1e6:.1f})"]
        cells += [f"{middle / size * 1e9:.1f}", f"{size / middle / 1e6:.3g}"]
        if contender not in row_of:
            speed.add_row(*cells)
            continue
        row = row_of[contender]
        error, bytes_ = results.errors[row.alone], results.memory[row]
        cells += [f"{error.hold:.1e}, {error.run:.1e}", f"{bytes_.kept:.0f}, {bytes_.peak:.0f}" if bytes_ else ""]
        speed.add_row(*cells)
        ratio = ratios(results, size, contender, chosen)
        faster.add_row(f"{size}", contender.name, *(_ratio(ratio.get(kind)) for kind in kinds))
    yield speed
    if kinds:
        yield faster
    if results.parts:
        yield _floor(results, chosen)
    for kind, reason in results.skipped.items():
        yield f"skipped: {kind} ({reason})"


def _ratio(found: Quartiles | None) -> str:
    return f"{found[1]:.3g} ({found[0]:.3g}-{found[2]:.3g})" if found else ""


def _floor(results: Results, chosen: Mapping[Ours, Contender]) -> Table:
    """What each kernel does with a register of rows, and what its floor is of the quickest whole step."""
    rates = ", ".join(f"{dtype} {rate / 1e9:.0f}" for dtype, rate in results.rates.items())
    caption = f"instructions a pass, of {rates} · 10⁹ fused multiply-adds/s; impacts and resets not counted"
    kinds = ("fused", "multiply", "add", "divide", "root", "round", "gather", "other")
    table = Table("", "passes", "rows", *kinds, "moved B", "spilled B", "floor ns/env", "share", caption=caption)
    for row, parts in results.parts.items():
        floor = sum(part.floor(results.rates[row.dtype]) for part in parts)
        times = [np.median(s) / size for (size, c), s in results.seconds.items() if c == chosen.get(row)]
        share = f"{floor / min(times):.0%}" if times and parts else ""
        table.add_row(row.name, *[""] * (len(kinds) + 4), f"{floor * 1e9:.2f}", share)
        for part in parts:
            loop = part.loop
            counts = [f"{loop.counts.get(kind, 0)}" for kind in kinds]
            own = f"{part.floor(results.rates[row.dtype]) * 1e9:.2f}"
            sizes = [f"{loop.moved}", f"{loop.spilled}", own]
            table.add_row(f"  {part.name}", f"{part.passes}", f"{loop.lanes * part.streams}", *counts, *sizes)
    table.columns[0].no_wrap = True
    return table


def write(path: Path, results: Results, chosen: Mapping[Ours, Contender]) -> None:
    """One line for each row of the tables, in SI units."""
    row_of = {contender: row for row, contender in chosen.items()}
    lines: list[dict[str, Any]] = []
    for (size, contender), seconds in results.seconds.items():
        line: dict[str, Any] = {"environments": size, "contender": contender.name, "rounds": len(seconds)}
        line |= dict(zip(("seconds_q1", "seconds", "seconds_q3"), quartiles(seconds), strict=True))
        if row := row_of.get(contender):
            line |= {"hold_error": results.errors[row.alone].hold, "run_error": results.errors[row.alone].run}
            if bytes_ := results.memory[row]:
                line |= {"bytes_kept": bytes_.kept, "bytes_peak": bytes_.peak}
            for kind, ratio in ratios(results, size, contender, chosen).items():
                names = (f"times {kind} q1", f"times {kind}", f"times {kind} q3")
                line |= dict(zip(names, ratio, strict=True))
        lines.append(line)
    columns = list(dict.fromkeys(name for line in lines for name in line))
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, columns, lineterminator="\n")
        writer.writeheader()
        writer.writerows(lines)


def main(arguments: Arguments) -> None:
    """Print the tables."""
    if arguments.quick:
        arguments.sizes, arguments.rounds, arguments.seconds, arguments.floor = (1, 64, 1024), 5, 0.05, False
    chosen, results = rows(arguments), Results()
    peers = [contender for name in arguments.peers if name in PEERS for contender in PEERS[name]]
    if SYNC in arguments.peers:
        peers += [sync(env_id) for env_id in arguments.env_ids[:1]]
    run(arguments, [*chosen.values(), *peers], results)
    judge(arguments, chosen, results)
    if arguments.csv:
        write(arguments.csv, results, chosen)
    console = Console()
    console.width = max(console.width, WIDTH)  # a file or a pipe would get names cut short
    for item in tables(results, chosen):
        console.print(item, markup=False)
    command = ["python", "-m", "benchmarks.throughput", *sys.argv[1:]]
    console.print(shlex.join(command), highlight=False, soft_wrap=True)


if __name__ == "__main__":
    main(tyro.cli(Arguments, prog="python -m benchmarks.throughput", description=__doc__))

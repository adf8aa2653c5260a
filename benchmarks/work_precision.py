"""Time against error: our environments beside SciPy, diffrax, torchdiffeq, multipliers and MuJoCo.

    python -m benchmarks.work_precision
    python -m benchmarks.work_precision --quick
    python -m benchmarks.work_precision --parts holds runs

curves  Both mechanisms, eight initial conditions, 10 s; the torque is held for 0.05 s, smooth or bang-bang. Error:
        the largest over all coordinates, velocities, ends of holds and motions. Time: µs for a simulated second of one
        environment. Contenders are compiled before, then take turns, so that a slow moment of the machine hits all of
        them; medians. One that is slow takes fewer turns; what is not installed is named.
holds   Errors of single holds with default settings, from states that policies reach (`benchmarks.default_errors`).
runs    Errors after 10 s with default settings, open and closed loop, and how much the motions amplify.

The truth is the formulation with multipliers in long double (`benchmarks.reference`). A table and a CSV file for
each part, and the figure, are written to a folder.
"""

from __future__ import annotations

import csv
import multiprocessing
import os
import shlex
import sys
import time
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from gymnasium.error import DependencyNotInstalled
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

import mechanics
from benchmarks.default_errors import HoldErrors, RunErrors, hold_errors, run_errors
from benchmarks.motions import MECHANISMS, Problem, problem
from benchmarks.reference import Reference
from benchmarks.solver_peers import PEERS, peers
from benchmarks.solvers import BATCHED, PEER, SINGLE, Contender, Point, Solver, ours

__all__ = ["Arguments", "least", "main"]

WIDTH = 150
PARTS = ("curves", "holds", "runs")
LEVELS = tuple(10.0**-exponent for exponent in range(4, 12))
FEWEST_TURNS = 3
# Lines that our single environment is compared with by name.
RIVAL = "SciPy DOP853"


@dataclass
class Arguments:
    """Size of the benchmark."""

    mechanisms: tuple[str, ...] = tuple(MECHANISMS)
    """what moves"""
    parts: tuple[str, ...] = PARTS
    """what is measured"""
    peers: tuple[str, ...] = PEERS
    """whom ours are compared with"""
    sizes: tuple[int, ...] = (256, 1024)
    """numbers of our environments side by side"""
    conditions: int = 8
    """initial conditions, and runs of each policy"""
    seconds: float = 10.0
    """length of a motion"""
    turns: int = 8
    """of each contender, which goes through the initial conditions with them"""
    budget: float = 4.0
    """seconds after which a contender takes no more turns, once it had three"""
    rows: int = 64
    """environments whose holds are looked at, for each policy"""
    quick: bool = False
    """a minute: two conditions, 1 s, few peers' turns, few holds"""
    out: Path = Path("runs/work_precision")
    """folder for tables, CSV files and the figure"""


@dataclass
class Sheet:
    """A table, for the terminal and for Markdown."""

    title: str
    columns: tuple[str, ...]
    rows: list[tuple[str, ...]]

    def rich(self) -> Table:
        """For the terminal."""
        table = Table(*self.columns, caption=self.title)
        for row in self.rows:
            table.add_row(*row)
        for column in table.columns[:2]:
            column.no_wrap = True
        return table

    def markdown(self) -> str:
        """For a file."""
        lines = [self.columns, ("---",) * len(self.columns), *self.rows]
        return f"{self.title}\n\n" + "".join(f"| {' | '.join(line)} |\n" for line in lines)


# -- curves ----------------------------------------------------------------------------------------


def truth(motions: Problem) -> tuple[NDArray[Any], NDArray[Any], float]:
    """Coordinates and velocities (T + 1, B, n), and what halving the steps of the reference changes."""
    coarse, fine = (
        Reference(mechanics.get(motions.mechanism), refinement=refinement).motion(
            motions.q, motions.qdot, lambda hold, *_: motions.torques[hold], motions.dt, motions.holds
        )
        for refinement in (1, 2)
    )
    return *fine, max(float(np.abs(a - b).max()) for a, b in zip(coarse, fine, strict=True))


def compile_ours(motions: Problem, sizes: tuple[int, ...]) -> None:
    """Fill the cache of kernels; those for many serve any number."""
    for contender in ours(motions.mechanism, sizes[:1]):
        contender.make(motions).turn(0)


def curves(
    motions: Problem,
    true: tuple[NDArray[Any], NDArray[Any]],
    contenders: Iterable[Contender],
    arguments: Arguments,
    skipped: dict[str, str],
) -> list[Point]:
    """Errors, then times in turns."""
    solvers: dict[int, Solver] = {}
    points: list[Point] = []
    contenders = list(contenders)
    with Progress(console=Console(stderr=True)) as progress:
        task = progress.add_task("", total=len(contenders) + arguments.turns)
        for contender in contenders:
            progress.update(task, advance=1, description=f"{motions.mechanism}: {contender.name} {contender.setting}")
            try:
                solver = contender.make(motions)
                found = solver.motions()
            except (ImportError, DependencyNotInstalled, ValueError) as error:
                skipped[contender.name] = str(error)
                continue
            solvers[len(points)] = solver
            points.append(Point(motions.mechanism, contender, errors_by_kind(motions, found, true)))
        spent = dict.fromkeys(solvers, 0.0)
        for number in range(arguments.turns):
            progress.update(task, advance=1, description=f"{motions.mechanism}: turn {number + 1}")
            for i, solver in solvers.items():
                if number < FEWEST_TURNS or spent[i] < arguments.budget:
                    begun = time.perf_counter()
                    points[i].times.append(solver.turn(number))
                    spent[i] += time.perf_counter() - begun
    return points


def errors_by_kind(
    motions: Problem, found: tuple[NDArray[Any], NDArray[Any]], true: tuple[NDArray[Any], NDArray[Any]]
) -> dict[str, float]:
    """Largest error for each kind of torque; infinite if anything is not finite."""
    distance = np.maximum(*(np.abs(a - b).max(axis=(0, 2)) for a, b in zip(found, true, strict=True))).astype(float)
    distance = np.where(np.isfinite(distance), distance, np.inf)
    kinds = np.array(motions.kinds)
    return {kind: float(distance[kinds == kind].max()) for kind in dict.fromkeys(motions.kinds)}


def least(points: Sequence[tuple[float, float]], level: float, *, between: bool) -> float:
    """Least time with which points (error, time) get below an error; infinite if none does.

    Args:
        points: of one contender, in the order of its settings.
        level: the error.
        between: whether a setting between two of the points counts too, on the straight line in the logarithms.
    """
    times = [time for error, time in points if error <= level]
    if between:
        for (e, t), (finer, longer) in zip(points, points[1:], strict=False):
            if finer < level < e < np.inf and t < longer:
                share = np.log(e / level) / np.log(e / finer)
                times.append(float(t * (longer / t) ** share))
    return min(times, default=np.inf)


def lines(points: Iterable[Point], *kinds: str) -> dict[str, list[tuple[float, float]]]:
    """Name of a line of these kinds -> its points (error, time)."""
    found: dict[str, list[tuple[float, float]]] = {}
    for point in points:
        if point.contender.kind in kinds:
            found.setdefault(point.contender.name, []).append((point.error, point.time))
    return found


def curve_sheets(points: Sequence[Point]) -> Iterator[Sheet]:
    """All points, and who is how much faster at which error."""
    for mechanism in dict.fromkeys(point.mechanism for point in points):
        chosen = [point for point in points if point.mechanism == mechanism]
        rows = []
        for point in chosen:
            errors = [f"{point.errors[kind]:.1e}" for kind in point.errors]
            low, middle, high = np.percentile(point.times, [25, 50, 75]) * 1e6
            who = point.contender
            rows.append(
                (who.name, who.setting, f"{who.environments}", *errors, f"{middle:.3g}", f"{low:.3g}-{high:.3g}")
            )
        kinds = [f"error, {kind}" for kind in chosen[0].errors]
        title = (
            f"{mechanism}: largest error after 10 s, µs for a simulated second of one environment (median, quartiles)"
        )
        yield Sheet(title, ("solver", "setting", "N", *kinds, "µs", ""), rows)
        yield _ratios(mechanism, chosen)


def _ratios(mechanism: str, points: Sequence[Point]) -> Sheet:
    """At each error: ours as measured, others also between two of their settings, which is in their favour."""

    def best(level: float, found: dict[str, list[tuple[float, float]]], between: bool) -> tuple[float, str]:
        return min(((least(line, level, between=between), name) for name, line in found.items()), default=(np.inf, ""))

    def ratio(a: float, b: float) -> str:
        return "" if np.isinf(b) else "nobody else" if np.isinf(a) else f"{a / b:.0f}"

    def cell(time: float, name: str = "") -> str:
        return "" if np.isinf(time) else f"{time * 1e6:.3g}" + f" ({name})" * bool(name)

    others = lines(points, PEER)
    rows: list[tuple[str, ...]] = []
    rival = {name: line for name, line in others.items() if name == RIVAL}
    for level in LEVELS:
        many, one = (best(level, lines(points, kind), False)[0] for kind in (BATCHED, SINGLE))
        peer, theirs = best(level, others, True), best(level, rival, True)[0]
        rows.append(
            (f"{level:.0e}", cell(many), cell(*peer), ratio(peer[0], many), cell(one), cell(theirs), ratio(theirs, one))
        )
    columns = ("error", "nhenv, batched", "best peer", "ratio", "nhenv, one call a step", RIVAL, "ratio")
    return Sheet(f"{mechanism}: least µs for a simulated second with at most this error", columns, rows)


# -- errors of the default settings ----------------------------------------------------------------


def hold_sheet(found: dict[str, list[HoldErrors]]) -> Sheet:
    """A row for each policy."""
    rows = []
    for mechanism, results in found.items():
        for one in results:
            cells = ["", "", ""]
            if len(one.errors):
                cells = [f"{value:.1e}" for value in np.quantile(one.errors, [0.5, 0.99, 1])]
            counts = f"{len(one.errors)}", f"{one.left_out:.0%}" if one.stops else ""
            rows.append((mechanism, one.policy, "yes" if one.stops else "no", *counts, f"{one.rate:.0f}", *cells))
    columns = ("mechanism", "policy", "stops", "holds", "left out", "rad/s", "median", "99 %", "largest")
    return Sheet(
        "error of one hold, default settings; largest rate of a coordinate; holds near a stop left out", columns, rows
    )


def run_sheet(found: dict[str, list[RunErrors]]) -> Sheet:
    """A row for each policy."""
    rows = []
    for mechanism, results in found.items():
        for one in results:
            errors = [f"{value:.1e}" for value in np.quantile(one.errors, [0.5, 1])]
            growth = [f"{value:.1e}" for value in np.quantile(one.amplification, [0.5, 1])]
            loop = "closed" if one.closed else "open"
            rows.append((mechanism, one.policy, loop, f"{len(one.errors)}", *errors, *growth))
    columns = ("mechanism", "policy", "loop", "runs", "error, median", "largest", "growth, median", "largest")
    title = "error within 10 s, default settings, no stops; growth of 1e-8 rad in the joint's first angle"
    return Sheet(title, columns, rows)


# -- files -----------------------------------------------------------------------------------------


def write(path: Path, rows: Sequence[dict[str, Any]]) -> None:
    """A CSV file, one line each, SI units."""
    with path.open("w", newline="", encoding="utf-8") as file:
        names = list(dict.fromkeys(name for row in rows for name in row))
        writer = csv.DictWriter(file, names, lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


def _curve_rows(points: Iterable[Point]) -> list[dict[str, Any]]:
    rows = []
    for point in points:
        who, (low, middle, high) = point.contender, np.percentile(point.times, [25, 50, 75])
        row: dict[str, Any] = {
            "mechanism": point.mechanism,
            "solver": who.name,
            "setting": who.setting,
            "kind": who.kind,
        }
        row |= {"environments": who.environments} | {f"error {kind}": error for kind, error in point.errors.items()}
        row |= {"turns": len(point.times), "seconds_q1": low, "seconds": middle, "seconds_q3": high}
        rows.append(row)
    return rows


def _hold_rows(found: dict[str, list[HoldErrors]]) -> list[dict[str, Any]]:
    return [
        {"mechanism": mechanism, "policy": one.policy, "stops": one.stops, "holds": len(one.errors)}
        | {"left out": one.left_out, "largest rate": one.rate}
        | {f"quantile {q}": float(np.quantile(one.errors, q)) for q in (0.5, 0.9, 0.99, 0.999, 1) if len(one.errors)}
        for mechanism, results in found.items()
        for one in results
    ]


def _run_rows(found: dict[str, list[RunErrors]]) -> list[dict[str, Any]]:
    return [
        {"mechanism": mechanism, "policy": one.policy, "loop": "closed" if one.closed else "open", "run": i}
        | {"error": float(error), "amplification": float(growth)}
        for mechanism, results in found.items()
        for one in results
        for i, (error, growth) in enumerate(zip(one.errors, one.amplification, strict=True))
    ]


# -- all -------------------------------------------------------------------------------------------


def main(arguments: Arguments) -> None:
    """Measure, print and write."""
    if arguments.quick:
        arguments.conditions, arguments.seconds, arguments.turns, arguments.budget = 2, 1.0, 3, 0.2
        arguments.rows, arguments.sizes = 4, (64,)
    for part in arguments.parts:
        if part not in PARTS:
            raise SystemExit(f"no part {part!r}; there are {', '.join(PARTS)}")
    arguments.out.mkdir(parents=True, exist_ok=True)
    problems = [problem(name, arguments.conditions, arguments.seconds) for name in arguments.mechanisms]
    console = Console()
    console.width = max(console.width, WIDTH)  # a file or a pipe would get names cut short
    sheets: dict[str, list[Sheet]] = {}  # by the name of the file
    notes: list[str] = []
    # What is not timed shares the cores; what is, has them alone.
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(os.cpu_count(), mp_context=context) as pool, console.status("references"):
        jobs: dict[str, list[Any]] = {part: [] for part in PARTS}
        if "curves" in arguments.parts:
            jobs["curves"] = [pool.submit(truth, motions) for motions in problems]
            compiling = [pool.submit(compile_ours, motions, arguments.sizes) for motions in problems]
        if "runs" in arguments.parts:
            jobs["runs"] = [
                pool.submit(run_errors, name, {}, arguments.conditions, arguments.seconds)
                for name in arguments.mechanisms
            ]
        if "holds" in arguments.parts:
            for name in arguments.mechanisms:
                jobs["holds"] += [pool.submit(hold_errors, name, stops, {}, arguments.rows) for stops in (False, True)]
        results = {part: [job.result() for job in jobs[part]] for part in PARTS}
        if "curves" in arguments.parts:
            [job.result() for job in compiling]
    if "curves" in arguments.parts:
        points, skipped = [], dict[str, str]()
        for motions, (q, qdot, doubt) in zip(problems, results["curves"], strict=True):
            notes.append(f"{motions.mechanism}: halving the steps of the reference changes it by {doubt:.0e}")
            contenders = [*ours(motions.mechanism, arguments.sizes), *peers(arguments.peers)]
            points += curves(motions, (q, qdot), contenders, arguments, skipped)
        notes += [f"skipped: {name} ({reason})" for name, reason in skipped.items()]
        sheets["work_precision"] = list(curve_sheets(points))
        write(arguments.out / "work_precision.csv", _curve_rows(points))
        _draw(points, arguments.out / "work_precision.png", notes)
    if "holds" in arguments.parts:
        pairs = zip(results["holds"][::2], results["holds"][1::2], strict=True)
        holds = {name: [*a, *b] for name, (a, b) in zip(arguments.mechanisms, pairs, strict=True)}
        sheets["holds"] = [hold_sheet(holds)]
        write(arguments.out / "holds.csv", _hold_rows(holds))
    if "runs" in arguments.parts:
        runs = dict(zip(arguments.mechanisms, results["runs"], strict=True))
        sheets["runs"] = [run_sheet(runs)]
        write(arguments.out / "runs.csv", _run_rows(runs))
    for sheet in (sheet for written in sheets.values() for sheet in written):
        console.print(sheet.rich(), markup=False)
    command = shlex.join(["python", "-m", "benchmarks.work_precision", *sys.argv[1:]])
    for note in [*notes, command]:
        console.print(note, markup=False, highlight=False, soft_wrap=True)
    for name, written in sheets.items():
        head = [f"`{command}`\n", *(f"{note}\n" for note in notes)]
        text = "\n".join([*head, *(sheet.markdown() for sheet in written)])
        (arguments.out / f"{name}.md").write_text(text, encoding="utf-8")


def _draw(points: Sequence[Point], path: Path, notes: list[str]) -> None:
    try:
        from benchmarks.work_precision_figure import draw
    except ImportError as error:
        notes.append(f"skipped: figure ({error})")
        return
    draw(points, path)


if __name__ == "__main__":
    main(tyro.cli(Arguments, prog="python -m benchmarks.work_precision", description=__doc__))

"""What was tried to break the environments, and what held.

    python -m benchmarks.stability
    python -m benchmarks.stability --quick

Long runs without torque; single holds in singular configurations and with extreme parameters, rates, torques and
periods (`benchmarks.extreme_holds`), each against Lagrange multipliers in long double and extrapolation
(`benchmarks.multipliers`), alone and as a row of many; orders, symmetries, energy balances, drag and stops
(`benchmarks.invariants`); random episodes (`benchmarks.fuzz`).

The error of a hold is that of every coordinate and velocity over 1 + its size, in SI units. Its bound is 1e-9 where a
relative change of the state does not grow during the hold, and that many times more where it does. Verdicts are

held       every number within its bound
flagged    wherever it is not, the environment says so: `info["diverged"]`, or a refusal to begin
unchecked  too fast for the reference; energy and work agree, and so do 64 shorter holds
stated     a number without a bound
FAILED     beyond its bound and nothing said, or flagged where nothing is extreme; printed below, to be pasted

It exits with 1 if anything failed.
"""

from __future__ import annotations

import csv
import math
import shlex
import sys
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, fields
from pathlib import Path

import numpy as np
import tyro
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

import mechanics
import nhenv
from benchmarks import invariants
from benchmarks.extreme_holds import Family, families
from benchmarks.extremes import BOUND, FAILED, FLAGGED, HELD, UNCHECKED, Outcome, judge
from benchmarks.fuzz import Report, fuzz, fuzz_rows
from benchmarks.invariants import SKIP, Found
from benchmarks.multipliers import DIGITS
from mechanics.compiler.integrators import method_names

__all__ = ["Arguments", "Row", "main"]

WIDTH = 150
MECHANISMS = ("snakeboard", "roller_racer")
STATED = "stated"
KINDS = ("runs", "holds", "invariants", "fuzz")
COMPILED = ("nhenv/SnakeboardForward-v0", "nhenv/RollerRacerForward-v0")
FEWER = 18.0  # digits that a long double has where it is longer than a double


@dataclass
class Arguments:
    """Size of the benchmark."""

    kinds: tuple[str, ...] = KINDS
    """what is tried: runs, holds, invariants, fuzz"""
    steps: int = invariants.MILLION
    """of a long run"""
    holds: int = 16
    """of a kind, where they are drawn"""
    episodes: int = 100_000
    """random ones, over all ids"""
    vector: bool = True
    """do every hold as a row of many too; compiles two more kernels for each mechanism"""
    quick: bool = False
    """some seconds and no more kernels than need be: short runs, few holds and episodes"""
    csv: Path | None = None
    """file for the numbers"""


@dataclass(frozen=True)
class Row:
    """One line of the table.

    Attributes:
        tried: in words.
        error: the worst that was not flagged; NaN if there is none.
        bound: what it may be, NaN if it is only stated.
        held, flagged, unchecked, failed: how many.
        note: more words.
        verdict: HELD, FLAGGED, UNCHECKED, STATED, FAILED or SKIP.
        failures: to be pasted.
    """

    tried: str
    error: float
    bound: float
    held: int
    flagged: int
    unchecked: int
    failed: int
    note: str
    verdict: str
    failures: tuple[str, ...] = field(default=(), repr=False)


# -- rows ------------------------------------------------------------------------------------------


def _number(tried: str, found: Found) -> Row:
    """Row of one number."""
    if found.note.startswith(SKIP):
        return Row(tried, math.nan, math.nan, 0, 0, 0, 0, found.note, SKIP)
    bound = math.nan if found.bound is None else found.bound
    verdict = (STATED if found.bound is None else HELD) if found.held else FAILED
    note = found.note + (f"; {found.flagged} flagged" if found.flagged else "")
    failures = () if found.held else (f"{found.error:.1e} beyond {bound:.1e}: {note}",)
    return Row(
        tried, found.error, bound, int(found.held), found.flagged, 0, int(not found.held), note, verdict, failures
    )


def _family(family: Family, outcomes: list[Outcome]) -> Row:
    """Row of some holds."""
    failures = [outcome.why for outcome in outcomes if outcome.verdict == FAILED]
    count = {verdict: sum(o.verdict == verdict for o in outcomes) for verdict in (HELD, FLAGGED, UNCHECKED, FAILED)}
    if family.calm and count[FLAGGED]:  # nothing here is beyond what can be computed
        for hold, outcome in zip(family.holds, outcomes, strict=True):
            if outcome.verdict == FLAGGED:
                failures.append(f"flagged without need: {hold.script(hold.qdot)}")
        count[FAILED], count[FLAGGED] = count[FAILED] + count[FLAGGED], 0
    errors = [outcome.error for outcome in outcomes if not math.isnan(outcome.error)]
    bound = max((o.bound for o in outcomes if not math.isnan(o.error)), default=BOUND)
    verdict = next((v for v in (FAILED, UNCHECKED, FLAGGED) if count[v]), HELD)
    note = f"bound times {bound / BOUND:.0f}, as the motion amplifies" if bound > 1.5 * BOUND else ""
    return Row(
        family.name, max(errors, default=math.nan), bound, count[HELD], count[FLAGGED], count[UNCHECKED],
        count[FAILED], note, verdict, tuple(failures),
    )  # fmt: skip


def runs(arguments: Arguments, track: invariants.Track) -> Iterator[Row]:
    """Motions of a million steps."""
    steps = arguments.steps
    words = f"{steps:,} steps of 0.05 s unforced, 3 starts"
    board = invariants.long_run("snakeboard", steps, track)
    racer = invariants.long_run("roller_racer", steps, track)
    for name, run in (("snakeboard", board), ("roller_racer", racer)):
        lost = math.nan if not run.finite else 0.0
        yield _number(f"{name}, {words}: constraints", Found(run.residual + lost, 1e-12, "over the speed or 1 m/s"))
        for momentum, change in run.momenta.items():
            yield _number(f"{name}, {words}: momentum {momentum}", Found(change + lost, 1e-12, "flat frame"))
    yield _number(f"snakeboard, {words}: energy", Found(board.energy, 1e-12))
    yield _number(f"roller_racer, {words}: energy, default", Found(racer.energy, None, "what it drifts"))
    kept = invariants.long_run("roller_racer", steps, track, {"keep_energy": True})
    found = Found(kept.energy if kept.finite else math.nan, 1e-10, "keep_energy=True")
    yield _number(f"roller_racer, {words}: energy, kept", found)


def holds(arguments: Arguments, track: invariants.Track) -> Iterator[Row]:
    """Single holds."""
    if DIGITS < FEWER:
        words = "long doubles are no longer than doubles here, so that there is no reference"
        yield Row("single holds", math.nan, math.nan, 0, 0, 0, 0, f"{SKIP}: {words}", SKIP)
        return
    chosen = [*families(arguments.holds)]
    if arguments.quick:
        chosen = [family for family in chosen if family.calm]
    for i in track(range(len(chosen)), "holds"):
        yield _family(chosen[i], judge(chosen[i].holds, vector=arguments.vector))


def symmetries(arguments: Arguments, track: invariants.Track) -> Iterator[Row]:
    """Orders, symmetries, energy, drag and stops."""
    few = 10 if arguments.quick else 100
    for name in MECHANISMS:
        methods = method_names()
        if arguments.quick:
            methods = ("rk4", "lobatto3", "gauss2")
        for i in track(range(len(methods)), f"{name}, orders"):
            yield _number(f"{name}, order of {methods[i]}", invariants.observed_order(name, methods[i]))
        yield _number(f"{name}, turned round", invariants.reversal(name, few))
        yield _number(f"{name}, elsewhere", invariants.equivariance(name, 3 * few))
        beyond, rise = invariants.impacts(name, 20 * few)
        yield _number(f"{name}, beyond its stop, rad", beyond)
        yield _number(f"{name}, energy gained through impacts", rise)
    names = MECHANISMS if arguments.quick else mechanics.names(in_the_plane=True)
    every = MECHANISMS if arguments.quick else mechanics.names()
    yield _number("energy gained is work, environments", invariants.work_energy(names, 3 * few, track))
    yield _number("energy gained is work, simulate", invariants.simulated_balance(every, track))
    yield _number("energy gained unforced with drag, simulate", invariants.drag_in_simulate(every, track))
    yield _number("energy gained unforced with drag, environments", invariants.drag_in_environments(names, 3 * few))


def episodes(arguments: Arguments, track: invariants.Track) -> Iterator[Row]:
    """Random episodes: a part in single environments of every id, interpreted, the others in rows."""
    ids = nhenv.environment_ids()
    if arguments.quick:
        ids = tuple(env_id for env_id in ids if "Snakeboard" in env_id or "RollerRacer" in env_id)
    alone, total = max(arguments.episodes // 5 // len(ids), 1), Report()
    for i in track(range(len(ids)), "random episodes of each id"):
        total += fuzz(ids[i], alone, backend="numpy")
    yield _report(f"{len(ids)} ids, single environments", total)
    many = Report()
    left = [env_id for env_id in COMPILED for _ in range(8)] if arguments.vector else []
    for i in track(range(len(left)), "random episodes of many rows"):
        many += fuzz_rows(left[i], (arguments.episodes - total.episodes) // len(left), seed=i)
    if left:
        yield _report("rows with parameters of their own", many)


def _report(tried: str, report: Report) -> Row:
    verdict = FAILED if report.problems else HELD
    note = f"{report.steps:,} steps, {report.refused:,} calls refused"
    good = report.episodes - report.flagged - len(report.problems)
    return Row(
        f"{report.episodes:,} random episodes: {tried}", math.nan, math.nan, good, report.flagged, 0,
        len(report.problems), note, verdict, tuple(report.problems),
    )  # fmt: skip


# -- reporting -------------------------------------------------------------------------------------


def table(rows: Iterable[Row]) -> Table:
    """What was found."""
    caption = "error: the worst that was not flagged; bound: what it may be"
    made = Table(
        "tried", "error", "bound", "held", "flagged", "unchecked", "FAILED", "verdict", "note", caption=caption
    )
    for row in rows:
        numbers = ["" if math.isnan(value) else f"{value:.1e}" for value in (row.error, row.bound)]
        counts = [str(count or "") for count in (row.held, row.flagged, row.unchecked, row.failed)]
        made.add_row(row.tried, *numbers, *counts, row.verdict, row.note)
    return made


def write(path: Path, rows: Iterable[Row]) -> None:
    """One line for each row of the table."""
    columns = [column.name for column in fields(Row) if column.name != "failures"]
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(columns)
        writer.writerows([getattr(row, column) for column in columns] for row in rows)


def main(arguments: Arguments) -> int:
    """Print the table; return how many rows failed."""
    if arguments.quick:
        arguments.steps, arguments.holds, arguments.vector = min(arguments.steps, 10_000), 2, False
        arguments.episodes = min(arguments.episodes, 600)
    for kind in arguments.kinds:
        if kind not in KINDS:
            raise ValueError(f"unknown kind {kind!r}; known: {', '.join(KINDS)}")
    parts = dict(zip(KINDS, (runs, holds, symmetries, episodes), strict=True))
    found: list[Row] = []
    with Progress(console=Console(stderr=True)) as progress, np.errstate(all="ignore"):

        def track(work: Iterable[int], words: str) -> Iterator[int]:
            items = [*work]
            task = progress.add_task(words, total=len(items))
            for item in items:
                yield item
                progress.update(task, advance=1)
            progress.remove_task(task)

        for kind in arguments.kinds:
            found += parts[kind](arguments, track)
    if arguments.csv:
        write(arguments.csv, found)
    console = Console()
    console.width = max(console.width, WIDTH)  # a file or a pipe would get names cut short
    console.print(table(found), markup=False)
    for row in found:
        for failure in row.failures[:3]:
            console.print(f"{FAILED}, {row.tried}: {failure}", markup=False, highlight=False, soft_wrap=True)
    command = ["python", "-m", "benchmarks.stability", *sys.argv[1:]]
    console.print(shlex.join(command), highlight=False, soft_wrap=True)
    return sum(row.verdict == FAILED for row in found)


if __name__ == "__main__":
    sys.exit(min(main(tyro.cli(Arguments, prog="python -m benchmarks.stability", description=__doc__)), 1))

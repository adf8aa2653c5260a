"""What it costs to derive equations of motion, and how compact they are: Theorem 3.2 against the alternatives.

    python -m benchmarks.derivation

Thm 3.2     `derive` in the mechanism's default frame; it numbers its steps where the exact algebra's products
            would be too long
found       the same in the frame that is found where none is given
eq. (6)     equations (5) and (6) over the coordinates, with ∇P⊥, and the same simplifier
Kane        SymPy's `KanesMethod.rhs()` over q̇, the dependent rates chosen so that all zero is no pole
shortest    the same with whichever dependent rates give the fewest operations; its time is that of trying all
in frame    `KanesMethod.rhs()` over the pseudo-velocities of the default frame
Lagrange    SymPy's `LagrangesMethod.rhs()` with multipliers

Seconds are of processor time, from the mechanism to the formulas, in a fresh process that has imported what it
needs and whose SymPy has nothing cached. Operations are those of all rates together, of coordinates and of speeds,
with common subexpressions shared and what depends on parameters alone computed before, by one counter for all.
Nothing is printed of equations that disagree with numerical Lagrange multipliers at a random state.

Contenders take turns within a round. Ctrl-C prints what there is. Processes are limited as POSIX systems can.
"""

from __future__ import annotations

import gc
import math
import multiprocessing
import re
import resource
import shlex
import signal
import sys
import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from multiprocessing.connection import Connection

import numpy as np
import tyro
from rich.console import Console
from rich.progress import Progress
from rich.table import Table
from sympy.core.cache import clear_cache

import mechanics
from benchmarks.contenders import CONTENDERS, Equations, NotApplicable, reference
from mechanics.catalog.snake import n_link_snake
from mechanics.mechanism import Mechanism, MechanismError

__all__ = ["Result", "main", "measure", "tables", "verdict"]

# Right-hand sides written by hand.
BY_HAND = {"snakeboard": 24, "roller_racer": 53}
OURS = "Thm 3.2"
KANE = ("Kane", "shortest", "in frame")
GROWTH = (OURS, "eq. (6)", "Kane", "Lagrange")

# Methods agree to 1e-11 of the largest acceleration, by rounding; a wrong sign in a small term leaves 1e-3.
TOLERANCE = 1e-7
MEMORY = 4 << 30  # bytes; a derivation of seconds takes a tenth of it
# What takes longer is timed once: it is steady enough, and the whole ends in minutes.
ONCE = 4.0
WARM_UP = "knife_edge_incline"
WIDTH = 120
NOT_TRIED = "not tried: fewer links were too many"


@dataclass
class Arguments:
    """Size of the benchmark."""

    mechanisms: tuple[str, ...] = mechanics.names()
    """which of the catalogue"""
    links: tuple[int, ...] = (2, 3, 4, 5, 6, 7, 8)
    """snakes of so many links, to see how the cost grows"""
    repeats: int = 3
    """processes for each time"""
    limit: float = 30.0
    """most seconds of processor time for a derivation, and once more for judging it"""


@dataclass
class Result:
    """What is known of one contender on one mechanism.

    Attributes:
        seconds: of the derivations so far.
        operations: of the equations.
        steps: whether they use definitions, numbered steps.
        failure: why there is no result, else empty.
    """

    seconds: list[float] = field(default_factory=list)
    operations: int | None = None
    steps: bool = False
    failure: str = ""


Results = dict[tuple[str, str], Result]  # by mechanism and contender


def mechanism(subject: str) -> Mechanism:
    """Mechanism of the catalogue, or a snake such as snake_5."""
    snake = re.fullmatch(r"snake_(\d+)", subject)
    return n_link_snake(int(snake[1])) if snake else mechanics.get(subject)


# -- one derivation --------------------------------------------------------------------------------


def measure(result: Result, subject: str, contender: str, limit: float) -> None:
    """Add to a result what one more derivation takes, in a process of its own; judge the equations of the first.

    Args:
        result: of this contender on this mechanism so far.
        subject: name of the mechanism, as `mechanism` takes it.
        contender: one of `CONTENDERS`.
        limit: most seconds of processor time for the derivation, and once more for judging it.
    """
    context = multiprocessing.get_context("forkserver")
    # So that a new process has little to import
    context.set_forkserver_preload(["benchmarks.contenders", "rich.progress", "rich.table", "scipy.optimize", "tyro"])
    receiver, sender = context.Pipe(duplex=False)
    arguments = (sender, subject, contender, limit, result.operations is None)
    process = context.Process(target=_work, args=arguments, daemon=True)
    process.start()
    sender.close()
    try:
        report = receiver.recv()
    except EOFError:
        process.join()
        killed = f"> {limit:g} s" if process.exitcode == -signal.SIGXCPU else f"died with {process.exitcode}"
        report = Result(failure=killed)
    finally:
        process.kill()  # it waits for nothing but Ctrl-C
        process.join()
    result.seconds += report.seconds
    result.failure = report.failure
    if report.operations is not None:
        result.operations, result.steps = report.operations, report.steps


def _work(sender: Connection, subject: str, contender: str, limit: float, judge: bool) -> None:
    """Derive, perhaps judge, and send a `Result`."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the parent
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY, resource.getrlimit(resource.RLIMIT_AS)[1]))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    sys.setrecursionlimit(20_000)  # for the long sums of those who do not simplify
    derive, subjected, report = CONTENDERS[contender], mechanism(subject), Result()
    try:
        derive(mechanism(WARM_UP))  # what is imported on the way
        clear_cache()
        gc.collect()
        _allow(limit)
        start = time.process_time()
        equations = derive(subjected)
        report.seconds = [time.process_time() - start]
        _allow(limit)
        report.steps = bool(equations.definitions)
        if judge:
            report.operations, report.failure = equations.operations, verdict(equations)
    except NotApplicable as e:
        report.failure = f"not applicable: {e}"
    except MemoryError:
        report.failure = f"> {MEMORY >> 30} GiB"
    except Exception as e:
        report.failure = f"{type(e).__name__}: {e}"
    sender.send(report)


def _allow(seconds: float) -> None:
    """End this process after so much more processor time."""
    hard = resource.getrlimit(resource.RLIMIT_CPU)[1]
    resource.setrlimit(resource.RLIMIT_CPU, (math.ceil(time.process_time() + seconds), hard))


def verdict(equations: Equations) -> str:
    """How far the accelerations at a random state are from those with multipliers; empty if they agree."""
    m, rng = equations.mechanism, np.random.default_rng(0)
    values = {name: value * rng.uniform(0.9, 1.1) for name, value in m.parameters.items()}
    values |= dict(zip(m.coordinates, rng.uniform(0.1, 1, m.n), strict=True))
    forms = m.numeric(m.one_forms, values)
    allowed = np.linalg.svd(forms)[2][len(forms) :] if len(forms) else np.eye(m.n)
    qdot, u = rng.normal(size=m.rank) @ allowed, rng.normal(size=len(m.controls))
    expected = reference(m, values, qdot, u)
    with np.errstate(all="ignore"):
        error = np.abs(equations.acceleration(values, qdot, u) - expected).max() / np.abs(expected).max()
    return "" if error <= TOLERANCE else f"wrong by {error:.0e}"


# -- all of them -----------------------------------------------------------------------------------


def run(arguments: Arguments, results: Results) -> None:
    """Fill in the results, round after round."""
    jobs = [(subject, contender) for subject in arguments.mechanisms for contender in CONTENDERS]
    jobs += [(f"snake_{n}", contender) for n in sorted(set(arguments.links)) for contender in GROWTH]
    exploded: set[str] = set()
    with Progress(console=Console(stderr=True)) as progress:
        task = progress.add_task("", total=len(jobs) * arguments.repeats)
        for _ in range(arguments.repeats):
            for subject, contender in jobs:
                progress.update(task, advance=1, description=f"{subject}, {contender}")
                result = results.setdefault((subject, contender), Result())
                growing = subject.startswith("snake_")
                if growing and contender in exploded and not (result.seconds or result.failure):
                    result.failure = NOT_TRIED
                if result.failure or max(result.seconds, default=0) > ONCE:
                    continue
                measure(result, subject, contender, arguments.limit)
                if growing and result.failure:
                    exploded.add(contender)


def tables(arguments: Arguments, results: Results) -> Iterator[Table | str]:
    """What is known so far."""

    def row(subject: str, contenders: Iterable[str]) -> list[Result]:
        return [results.get((subject, contender), Result()) for contender in contenders]

    caption = f"medians of {arguments.repeats}, of one above {ONCE:g} s"
    if spreads := [max(r.seconds) / min(r.seconds) - 1 for r in results.values() if len(r.seconds) > 1]:
        caption += f"; from the quickest to the slowest {np.median(spreads):.0%} (median) to {max(spreads):.0%}"
    seconds = Table("mechanism", *CONTENDERS, title="seconds", caption=caption)
    caption = "* numbered steps; ours/Kane: with the shortest of Kane's"
    operations = Table("mechanism", *CONTENDERS, "by hand", "ours/Kane", title="operations", caption=caption)
    for subject in arguments.mechanisms:
        seconds.add_row(subject, *map(_seconds, row(subject, CONTENDERS)))
        counts = [r.operations for r in row(subject, KANE) if r.operations and not r.failure]
        (ours,) = row(subject, [OURS])
        ratio = f"{ours.operations / min(counts):.2f}" if ours.operations and not ours.failure and counts else ""
        by_hand = str(BY_HAND.get(subject, ""))
        operations.add_row(subject, *map(_operations, row(subject, CONTENDERS)), by_hand, ratio)
    growth = Table("links", *GROWTH, title="snakes: seconds, operations")
    for n in sorted(set(arguments.links)):
        cells = (f"{_seconds(r):>6} {_operations(r):>6}" for r in row(f"snake_{n}", GROWTH))
        growth.add_row(str(n), *cells)
    yield from (seconds, operations) if arguments.mechanisms else ()
    yield from (growth,) if arguments.links else ()
    for (subject, contender), result in results.items():
        if result.failure and not result.failure.startswith((">", NOT_TRIED)):
            yield f"{subject}, {contender}: {result.failure}"


def _seconds(result: Result) -> str:
    if result.failure:
        return result.failure if result.failure.startswith(">") else "-"
    return f"{np.median(result.seconds):.2f}" if result.seconds else ""


def _operations(result: Result) -> str:
    return "" if result.failure or result.operations is None else f"{result.operations}{'*' if result.steps else ''}"


def main(arguments: Arguments) -> None:
    """Print the tables."""
    try:
        for subject in (*arguments.mechanisms, *(f"snake_{n}" for n in arguments.links)):
            mechanism(subject)
    except MechanismError as error:
        sys.exit(f"error: {error}")
    results: Results = {}
    try:
        run(arguments, results)
    except KeyboardInterrupt:
        print("interrupted: what there is so far", file=sys.stderr)
    console = Console()
    console.width = max(console.width, WIDTH)  # a file or a pipe would get names cut short
    for item in tables(arguments, results):
        console.print(item)
    console.print(shlex.join(["python", "-m", "benchmarks.derivation", *sys.argv[1:]]), highlight=False, soft_wrap=True)


if __name__ == "__main__":
    main(tyro.cli(Arguments, prog="python -m benchmarks.derivation", description=__doc__))

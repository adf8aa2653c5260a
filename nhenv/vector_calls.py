"""How a kernel's step of many rows is called: what it takes within reach, the rows shared out among threads."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from types import ModuleType
from typing import Any

import numpy as np

__all__ = ["Crew", "stepper"]

Step = Callable[..., int]  # (actions, observations, rewards, terminated, truncated) -> what happened, as bits


def stepper(
    kernel: ModuleType, blocks: Any, streams: Any, numbers: Any, written: Sequence[Any], threads: int
) -> Step | Crew:
    """The kernel's `step_rows` on these arrays, the blocks shared out among so many threads.

    Args:
        kernel: the module that has it.
        blocks: what lasts of the rows.
        streams: their random streams.
        numbers: what holds for all rows.
        written: what it writes to besides: `StepInfo.written`.
        threads: no more of them work than there are blocks.
    """
    entries: dict[str, Step] = {}  # by the letter of the actions' type

    def part(first: int, last: int) -> Step:
        scratch = np.zeros((5, max(kernel.SCRATCH, kernel.SIZE)))

        def run(actions: Any, observations: Any, rewards: Any, terminated: Any, truncated: Any) -> int:
            arguments = (
                blocks, streams, scratch, numbers, actions, observations, rewards, terminated, truncated,
                finals, judged, flags, first, last,
            )  # fmt: skip
            letter = actions.dtype.char
            if letter not in entries:
                entries[letter] = _entry(kernel.step_rows, arguments)
            return entries[letter](*arguments)

        return run

    finals, judged, flags = written
    parts = min(threads, len(blocks))
    edges = [len(blocks) * i // parts for i in range(parts + 1)]
    runs = [part(*edge) for edge in zip(edges[:-1], edges[1:], strict=True)]
    return Crew(runs) if parts > 1 else runs[0]


class Crew:
    """Functions that are called side by side: the first by the caller, each other by a thread of its own."""

    def __init__(self, runs: Sequence[Step]) -> None:
        self._runs, self._process = runs, -1
        self._pool: ThreadPoolExecutor | None = None

    def __call__(self, *arguments: Any) -> int:
        """All their results, joined by |."""
        if self._pool is None or self._process != os.getpid():  # threads do not survive a fork
            self._pool, self._process = ThreadPoolExecutor(len(self._runs) - 1, "nhenv"), os.getpid()
        others = [self._pool.submit(run, *arguments) for run in self._runs[1:]]
        events = self._runs[0](*arguments)
        for other in others:
            events |= other.result()
        return events

    def dismiss(self) -> None:
        """End the threads, until the next call."""
        if self._pool is not None and self._process == os.getpid():
            self._pool.shutdown()
        self._pool = None


def _entry(function: Any, arguments: tuple[Any, ...]) -> Step:
    """A kernel's function for arguments of these types; what a dispatcher looks up at every call, once."""
    if not hasattr(function, "compile"):  # interpreted, whose numbers warn where compiled ones do not
        return np.errstate(all="ignore")(function)
    from numba import typeof

    return function.compile(tuple(typeof(argument) for argument in arguments))

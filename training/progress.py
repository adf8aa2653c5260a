"""Jobs in parallel processes under one progress display, which stop cleanly when asked to."""

from __future__ import annotations

import multiprocessing
import os
import queue
import signal
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor, wait
from dataclasses import dataclass
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

__all__ = ["Interrupted", "Job", "Report", "ignore", "run_jobs"]

# A job calls report(done, total, text) now and then; it raises `Interrupted` when the job should save and end.
Report = Callable[[int, int, str], None]


def ignore(done: int, total: int, text: str) -> None:
    """Report to nobody."""


class Interrupted(Exception):  # noqa: N818 (not an error)
    """The user wants the job to end; what it has saved is where it goes on."""


@dataclass(frozen=True)
class Job:
    """Something to do in another process.

    Attributes:
        label: what the display calls it.
        function: called with the arguments and a keyword `report`; it saves its own results.
        arguments: what `function` is called with.
    """

    label: str
    function: Callable[..., None]
    arguments: tuple[Any, ...]


def run_jobs(jobs: Sequence[Job], processes: int, console: Console) -> None:
    """Do all jobs; on Ctrl-C, or when one fails, let the running ones save and raise."""
    if not jobs:
        return
    # One thread a process: the nets are small, and threads of several processes would fight for the cores.
    os.environ["OMP_NUM_THREADS"] = "1"
    context = multiprocessing.get_context("spawn")  # a fork copies locks that threads of PyTorch may hold
    messages, stop = context.Queue(), context.Event()
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.fields[text]:>14}"),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
    )
    with (
        Progress(*columns, console=console) as progress,
        ProcessPoolExecutor(
            min(processes, len(jobs)), mp_context=context, initializer=_begin, initargs=(messages, stop)
        ) as pool,
    ):
        bars = [progress.add_task(job.label, start=False, total=None, text="waiting") for job in jobs]
        bar_of = {pool.submit(_work, i, job): bars[i] for i, job in enumerate(jobs)}
        futures = set(bar_of)
        try:
            while futures:
                finished, futures = wait(futures, timeout=0.2, return_when=FIRST_COMPLETED)
                _show(progress, bars, messages)
                for future in finished:
                    future.result()
                    progress.update(bar_of[future], total=1, completed=1)
        except BaseException:
            stop.set()
            pool.shutdown(wait=False, cancel_futures=True)
            raise


def _show(progress: Progress, bars: Sequence[Any], messages: Any) -> None:
    while True:
        try:
            job, done, total, text = messages.get_nowait()
        except queue.Empty:
            return
        progress.start_task(bars[job])
        progress.update(bars[job], completed=done, total=total, text=text)


_channel: tuple[Any, Any] | None = None  # (messages, stop) of this worker process, set once by _begin
_working = threading.Lock()  # while this worker process is at a job


def _begin(messages: Any, stop: Any) -> None:
    global _channel
    # Ctrl-C reaches every process of the terminal; the first one passes it on in good order.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    _channel = messages, stop
    threading.Thread(target=_follow, args=(multiprocessing.parent_process(), stop), daemon=True).start()


def _follow(parent: Any, stop: Any) -> None:
    """End with the process that gave the jobs, however it ended: nobody else would tell this one to."""
    parent.join()
    stop.set()
    with _working:  # once what is at work has been saved
        os._exit(1)


def _work(number: int, job: Job) -> None:
    assert _channel is not None
    messages, stop = _channel
    if stop.is_set():  # it was already handed to this process when the others were called off
        raise Interrupted

    def report(done: int, total: int, text: str) -> None:
        messages.put((number, done, total, text))
        if stop.is_set():
            raise Interrupted

    with _working:
        job.function(*job.arguments, report=report)

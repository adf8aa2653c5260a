"""Jobs end with whoever gave them."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

# Two processes for three jobs: two are at work and one is waiting when the first process is killed.
PROGRAM = """
import os, sys, time
from pathlib import Path
from rich.console import Console
from training.progress import Interrupted, Job, run_jobs

def work(folder, number, report):
    (folder / f"begun-{number}-{os.getpid()}").touch()
    try:
        while True:
            report(0, 1, "")
            time.sleep(0.02)
    except Interrupted:
        (folder / f"saved-{number}").touch()
        raise

if __name__ == "__main__":
    run_jobs([Job("x", work, (Path(sys.argv[1]), i)) for i in range(3)], 2, Console(quiet=True))
"""


@pytest.mark.skipif(sys.platform == "win32", reason="signals")
@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGTERM])
def test_killing_the_first_process_has_the_jobs_saved_and_ended(tmp_path, how):
    program = tmp_path / "program.py"
    program.write_text(PROGRAM)
    root = Path(__file__).parents[2]
    environment = os.environ | {"PYTHONPATH": str(root)}
    with subprocess.Popen([sys.executable, str(program), str(tmp_path)], cwd=root, env=environment) as process:
        _until(lambda: len(list(tmp_path.glob("begun-*"))) == 2)
        workers = [int(path.name.rpartition("-")[2]) for path in tmp_path.glob("begun-*")]
        assert all(map(_runs, workers))
        process.send_signal(how)
    _until(lambda: not any(map(_runs, workers)))
    assert {path.name for path in tmp_path.glob("saved-*")} == {"saved-0", "saved-1"}


def _until(condition):
    deadline = time.monotonic() + 60
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.05)


def _runs(pid):
    """Whether there is such a process; one that only waits to be buried does not count."""
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    state = Path(f"/proc/{pid}/stat")
    return not (state.exists() and state.read_text().rpartition(")")[2].split()[0] == "Z")

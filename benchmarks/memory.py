"""Memory that a vector environment takes beyond the arrays it returns, seen from a fresh process."""

from __future__ import annotations

import gc
import multiprocessing
import re
from collections.abc import Mapping
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

import nhenv  # noqa: F401 (registers the environments)
from benchmarks.peers import actions

__all__ = ["SMALLEST", "Memory", "memory"]

STATUS, CLEAR = Path("/proc/self/status"), Path("/proc/self/clear_refs")
FEW = 64
SMALLEST = 1 << 14  # pages, allocators and garbage of a megabyte are 64 bytes an environment of these


@dataclass(frozen=True)
class Memory:
    """Bytes an environment.

    Attributes:
        kept: between steps.
        peak: at most within a step or the reset, what it returns not counted.
    """

    kept: float
    peak: float


def memory(env_id: str, options: Mapping[str, Any], size: int) -> Memory | None:
    """Memory of `size` environments; None where the system does not tell, or below `SMALLEST`."""
    if size < SMALLEST or not (STATUS.exists() and CLEAR.exists()):
        return None
    with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as pool:
        return pool.submit(_measure, env_id, dict(options), size).result()


def _measure(env_id: str, options: dict[str, Any], size: int) -> Memory:
    def use(count: int) -> tuple[gym.vector.VectorEnv[Any, Any, Any], float]:
        """Environments after some steps, and the bytes that a step returns."""
        envs = gym.make_vec(env_id, num_envs=count, **options)
        envs.reset(seed=0)
        for _ in range(3):
            returned = envs.step(action[:count])
        rows = np.arange(count) % 2 == 0
        envs.reset(options={"reset_mask": rows})
        envs.step(action[:count])
        return envs, sum(array.nbytes for array in returned[:4])

    space = gym.make_vec(env_id, num_envs=1, **options).single_action_space
    action = next(actions(space, size)).copy()
    few = use(FEW)  # libraries, kernels and their threads are not the environments'
    gc.collect()
    before = _resident("VmRSS")
    CLEAR.write_text("5", encoding="ascii")  # forget the peak so far
    envs, returned = use(size)
    peak = _resident("VmHWM")
    gc.collect()
    after = _resident("VmRSS")
    del envs, few
    return Memory((after - before) / size, (peak - before - returned) / size)


def _resident(field: str) -> int:
    """Bytes that this process has in memory, now (VmRSS) or at most (VmHWM)."""
    found = re.search(rf"^{field}:\s+(\d+) kB$", STATUS.read_text(encoding="ascii"), re.MULTILINE)
    assert found
    return int(found[1]) * 1024

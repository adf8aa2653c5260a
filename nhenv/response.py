"""From a kernel to what an environment's step returns, in plain Python.

A kernel `kernel(memory, action) -> (status, reward, *info, *observation)` deals in numbers alone. Its
`respond(memory, action)` returns what Gymnasium's step does, all of it fresh:

    (observation (d,) float32, reward, status or False, False, info)

The place of `terminated` has the status if that is not RUNNING: the rare cases are the environment's
business. `nhenv.entry` has the same for compiled kernels, ten times as fast.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["Kernel", "Respond", "plain"]

Kernel = Callable[[NDArray[np.float64], Sequence[float]], Sequence[float]]
Respond = Callable[[NDArray[np.float64], Any], tuple[NDArray[np.float32], float, float | bool, bool, dict[str, Any]]]


def plain(*, actions: int, info: tuple[str, ...]) -> Callable[[Kernel], Respond]:
    """Decorator that makes `respond` of a kernel.

    Args:
        actions: number of elements of an action.
        info: names of the entries of `info`, in the order of the kernel.

    `respond` raises TypeError for what is not an array of shape (actions,).
    """

    def decorate(kernel: Kernel) -> Respond:
        def respond(memory: NDArray[np.float64], action: Any) -> Any:
            if getattr(action, "shape", None) != (actions,):
                raise TypeError("not an array of the right shape")
            with np.errstate(all="ignore"):  # compiled numbers do not warn either
                status, reward, *rest = map(float, kernel(memory, tuple(map(float, action.tolist()))))
            observation = np.array(rest[len(info) :], np.float32)
            return observation, reward, status or False, False, dict(zip(info, rest, strict=False))

        return respond

    return decorate

"""Where the numbers of rows lie, and how they are read and written by name."""

from __future__ import annotations

from collections.abc import Sequence
from types import ModuleType

import numpy as np
from numpy.typing import ArrayLike, NDArray

__all__ = ["RowMemory"]

Array = NDArray[np.float64]


class RowMemory:
    """What lasts of N rows from step to step, in blocks of rows as `nhenv.rows` has them.

    Args:
        kernel: the module whose functions work on it.
        size: number N of rows.

    Attributes:
        blocks: what the kernel takes, a row for each block.
    """

    def __init__(self, kernel: ModuleType, size: int) -> None:
        self.blocks = np.zeros((-(-size // kernel.ROWS), kernel.SIZE))
        self._size, self._stretch, self._places = size, kernel.ROWS, dict(kernel.LASTING)

    def __getitem__(self, name: str) -> Array:
        """One number of every row, shape (N,), copied."""
        place = self._places[name]
        return self.blocks[:, place : place + self._stretch].reshape(-1)[: self._size].copy()

    def put(self, name: str, chosen: NDArray[np.int64], values: ArrayLike) -> None:
        """Write one number of each of the chosen rows."""
        block, place = np.divmod(chosen, self._stretch)
        self.blocks[block, self._places[name] + place] = values

    def states(self, names: Sequence[str]) -> Array:
        """States of every row by name, shape (N, len(names)); NaN for those that it does not have."""
        states = np.full((self._size, len(names)), np.nan)
        for i, name in enumerate(names):
            if f"s_{name}__p" in self._places:
                states[:, i] = self[f"s_{name}__p"]
        return states

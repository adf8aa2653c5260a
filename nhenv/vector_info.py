"""What a vector environment tells beside observations and rewards."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from types import ModuleType
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray

from nhenv import rows

__all__ = ["Infos", "StepInfo", "masked"]

Bools = NDArray[np.bool_]
Infos = dict[str, Any]

_FLAGS = {"bad_action": rows.BAD_ROW, "diverged": rows.DIVERGED_ROW}


class StepInfo:
    """Makes the info of steps of what the kernel writes besides.

    Args:
        level: "none", "final" or "all", as for `LocomotionVectorEnv`.
        mode: when episodes begin anew.
        kernel: the module that writes.
        size: number N of rows.

    Attributes:
        level: as given.
        written: arrays that the kernel writes to: last observations, rewards and info in parts, flags.
    """

    def __init__(self, level: str, mode: AutoresetMode, kernel: ModuleType, size: int) -> None:
        self.level, self._same_step = level, mode is AutoresetMode.SAME_STEP
        self._terms = kernel.JUDGEMENT
        finals = np.zeros((size * self._same_step, len(kernel.OBSERVATION)), np.float32)
        judged = np.zeros((len(self._terms), size * (level != "none")))
        self.written = finals, judged, np.zeros(size, np.uint8)

    def due(self, events: int) -> bool:
        """Whether a step in which this happened has anything to tell: in time, for to tell it takes longer."""
        rare = rows.BAD_ROW | rows.DIVERGED_ROW | rows.DONE * self._same_step
        return self.level != "none" or bool(events & rare)

    def of_step(self, events: int, done: Bools, fresh: Bools, targets: Mapping[str, NDArray[Any]]) -> Infos:
        """Info of a step.

        Args:
            events: what happened, as bits.
            done: rows whose episode has ended.
            fresh: rows whose episode has not had a step.
            targets: name -> (N,).
        """
        finals, judged, flags = self.written
        stepped = np.ones_like(done) if self._same_step else ~fresh
        told = {"none": np.zeros_like(done), "final": done, "all": stepped}[self.level]
        news = [(name, values, told) for name, values in zip(self._terms, judged, strict=True)]
        if events & (rows.BAD_ROW | rows.DIVERGED_ROW):
            for key, bit in _FLAGS.items():
                flagged = (flags & bit) != 0
                news.append((key, flagged, flagged))
            flags[:] = 0
        infos: Infos = {}
        if self._same_step and events & rows.DONE:
            final = np.full(len(done), None, object)
            for row, observation in zip(np.flatnonzero(done).tolist(), finals[done], strict=True):
                final[row] = observation
            infos |= {"final_obs": final, "_final_obs": done.copy()}
            last = masked((name, values, mask & done) for name, values, mask in news)
            if last or self.level != "none":
                infos |= {"final_info": last, "_final_info": done.copy()}
            news = [(name, values, mask & ~done) for name, values, mask in news]
        if self.level != "none":
            infos |= masked((name, values, fresh) for name, values in targets.items())
        return infos | masked(news)


def masked(entries: Iterable[tuple[str, NDArray[Any], Bools]]) -> Infos:
    """Info of (key, values, mask of the rows that have it), as Gymnasium has it; all arrays are new."""
    infos: Infos = {}
    for key, values, mask in entries:
        if mask.any():
            infos |= {key: np.where(mask, values, values.dtype.type(0)), f"_{key}": mask.copy()}
    return infos

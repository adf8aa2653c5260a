"""`CompiledScene`: a scene with the kernels that environments run.

A kernel works on a flat float64 memory, whose parts its table MEMORY names:

    step(memory, observation, *action) -> (status, reward, *reward terms, *info)

It clips the action, integrates one hold through every impact on a stop, and judges the outcome.
States that nothing observed, rewarded or reported depends on are not in it. What is drawn for an
episode, the task's targets, has a place in the memory too.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping
from functools import cached_property
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mechanics.compiler import kernels
from nhenv.scene import Scene

__all__ = ["CompiledScene"]

# Source files of this package that a kernel follows from.
_DERIVING = (
    *("scene", "compiled", "generate", "one_kernel", "entry", "response"),
    *("rows_kernel", "rows", "random_streams", "observation"),
)


class CompiledScene(Scene):
    """A scene whose kernels are derived, or found in the cache, when they are first needed."""

    @cached_property
    def kernel(self) -> ModuleType:
        """The compiled module for one environment, from the cache if possible."""
        return self._load("one")

    @cached_property
    def rows_kernel(self) -> ModuleType:
        """The compiled module for many environments side by side that have the same parameters."""
        return self._load("rows")

    @cached_property
    def varied_kernel(self) -> ModuleType:
        """The compiled module for many environments side by side, each with parameters of its own."""
        return self._load("varied")

    def _load(self, kind: str) -> ModuleType:
        specification = self.__getstate__()
        specification["mechanism"] = self.mechanism.to_dict(drawing=False)
        specification["task"] = self.task.to_dict(drawing=False) if self.task else None
        specification["kind"] = kind
        name = f"{self.mechanism.name}_{self.task.name if self.task else 'state'}_{kind}_{self.backend}"
        deriving = tuple(Path(__file__).with_name(f"{part}.py") for part in _DERIVING)
        return kernels.load(name, specification, lambda: self.source(kind), deriving=deriving)

    @cached_property
    def whole(self) -> CompiledScene:
        """The same motion with nothing left out and nothing judged."""
        return dataclasses.replace(self, task=None)

    def new_memory(
        self, numbers: Mapping[str, float], torque_limits: Iterable[float], stops: Iterable[float]
    ) -> NDArray[np.float64]:
        """Memory for one environment.

        Args:
            numbers: a value for each of `parameters`.
            torque_limits: (m,) largest torques.
            stops: (joints,) largest angles.
        """
        memory, places = np.zeros(self.kernel.SIZE), self.kernel.MEMORY
        memory[slice(*places["k"])] = self.kernel.constants([numbers[name] for name in self.parameters])
        memory[slice(*places["dt"])] = numbers["dt"]
        memory[slice(*places["limit"])] = list(torque_limits)
        memory[slice(*places["stop"])] = list(stops)
        return memory

    def put(self, memory: NDArray[np.float64], q: NDArray[np.float64], v: NDArray[np.float64]) -> None:
        """Write a state, q (n,) and v (k,), into a memory."""
        values = dict(zip(self.states, (*q, *v), strict=True))
        memory[slice(*self.kernel.MEMORY["state"])] = [values[name] for name in self.kernel.STATES]

    def aim(self, memory: NDArray[np.float64], targets: Mapping[str, float]) -> None:
        """Write the targets of an episode, as `Task.draw` returns them, into a memory."""
        if self.targets:
            memory[slice(*self.kernel.MEMORY["target"])] = [targets[name] for name in self.targets]

    def values(self, memory: NDArray[np.float64]) -> dict[str, float]:
        """Value of each state that this scene follows, by name."""
        return dict(zip(self.kernel.STATES, memory[slice(*self.kernel.MEMORY["state"])].tolist(), strict=True))

    @property
    def targets(self) -> tuple[str, ...]:
        """Names of the task's targets that the kernel uses, in the order of their places."""
        return self.kernel.TARGETS

    def __getstate__(self) -> dict[str, Any]:
        """Everything but the kernel, which is loaded again."""
        return {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}

    def source(self, kind: str = "one") -> str:
        """Derive the source of a kernel, "one", "rows" or "varied"; called when the cache has none."""
        # What does not act leaves no trace: not in symmetries, not in what is observed by default.
        scene = self if self.drag else dataclasses.replace(self, mechanism=self.mechanism.without_drag())
        if kind == "one":
            from nhenv.one_kernel import OneKernel

            return OneKernel(scene).module()
        from nhenv.rows_kernel import RowsKernel

        return RowsKernel(scene, varied=kind == "varied").module()

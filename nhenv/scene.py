"""`Scene`: a mechanism, a task and options, compiled to the one kernel that environments run.

The kernel works on a flat float64 memory, whose parts its table MEMORY names:

    step(memory, observation, *action) -> (status, reward, *reward terms, *info)

It clips the action, integrates one hold through every impact on a stop, and judges the outcome.
States that nothing observed, rewarded or reported depends on are not in it. What is drawn for an
episode, the task's targets, has a place in the memory too.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mechanics.compiler import kernels
from mechanics.compiler.integrators import method_names
from mechanics.expressions import unknown_name
from mechanics.mechanism import Mechanism
from nhenv.tasks import START, Task

__all__ = ["BACKENDS", "BAD_ACTION", "DIVERGED", "HISTORY_FULL", "LARGEST", "RUNNING", "TERMINATED", "Scene"]

RUNNING, BAD_ACTION, DIVERGED, HISTORY_FULL, TERMINATED = 0.0, 1.0, 2.0, 3.0, 4.0

# A state beyond this, in SI units, has diverged; sines of angles below it are still exact.
LARGEST = 2.0**40

BACKENDS = ("numba", "numpy")  # those of `mechanics.compiler.codegen`, which loads SymPy


# Source files of this package that a kernel follows from.
_DERIVING = (
    *("scene", "generate", "one_kernel", "entry", "response"),
    *("rows_kernel", "rows", "random_streams", "observation"),
)


@dataclass(frozen=True)
class Scene:
    """What is simulated, observed and rewarded.

    Attributes:
        mechanism: what moves.
        task: what it is for; None for a scene that only integrates the whole state.
        frame: frame in which the reduced equations are integrated; None for the default.
        stops: whether joint limits act.
        drag: whether the mechanism's drag acts; if not, the kernel is that of a mechanism without any.
        integrator: name of a method, or "auto".
        substeps: steps of the method in a hold; None for the default.
        tolerance: what no hold may get wrong by the method's own estimate, of a state z in (1 + |z|); it is divided
            into as many flights as that takes, each with its share if the integrator is "auto". Infinite: whatever the
            method gives.
        keep_energy: whether every step of the method ends with velocities that have the energy which the held controls
            and the potential leave them.
        backend: "numba" or "numpy".
        whole_state: whether states are followed that nothing observed, rewarded or reported depends on.
    """

    mechanism: Mechanism
    task: Task | None
    frame: str | None = None
    stops: bool = True
    drag: bool = False
    integrator: str = "auto"
    substeps: int | None = None
    tolerance: float = math.inf
    keep_energy: bool = False
    backend: str = "numba"
    whole_state: bool = False

    def __post_init__(self) -> None:
        if self.integrator not in ("auto", *method_names()):
            raise ValueError(unknown_name("integrator", str(self.integrator), ("auto", *method_names())))
        if self.backend not in BACKENDS:
            raise ValueError(unknown_name("backend", str(self.backend), BACKENDS))
        self.mechanism.frame_rows(self.frame)  # refuses a name that is not there

    @cached_property
    def parameters(self) -> tuple[str, ...]:
        """Names of the numbers that `constants` of the kernel takes, in order."""
        weights = self.task.weights if self.task else ()
        drag = self.mechanism.drag if self.drag else ()
        return (*self.mechanism.parameters, *weights, "dt", "forward", *drag)

    @property
    def targets(self) -> tuple[str, ...]:
        """Names of the task's targets that the kernel uses, in the order of their places."""
        return self.kernel.TARGETS

    @cached_property
    def noisy(self) -> tuple[str, ...]:
        """Coordinates that are random at reset: the joints with stops, or else the heading."""
        return tuple(self.mechanism.joint_limits) or self.mechanism.fibre[2:]

    @cached_property
    def givable(self) -> tuple[str, ...]:
        """What the beginning of an episode takes as given: targets, then what they need of the pose at the start."""
        return (*self.task.targets, *self.task.start) if self.task else ()

    @cached_property
    def start(self) -> dict[str, str]:
        """What of the pose at the start the targets need, of x, y and heading -> the coordinate that it is."""
        roles = dict(zip(START, self.mechanism.fibre, strict=False))
        return {name: roles[name] for name in (self.task.start if self.task else ())}

    @cached_property
    def start_places(self) -> list[int]:
        """Coordinates that the last of `givable` are."""
        return [self.mechanism.coordinates.index(name) for name in self.start.values()]

    @cached_property
    def draws(self) -> int:
        """Uniform numbers that the beginning of an episode takes: for coordinates, then for targets."""
        rules = self.task.targets.values() if self.task else ()
        return len(self.noisy) + sum(not isinstance(rule, str) for rule in rules)

    @cached_property
    def joints(self) -> tuple[str, ...]:
        """Coordinates that have stops in this scene."""
        return tuple(self.mechanism.joint_limits) if self.stops else ()

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
    def whole(self) -> Scene:
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

    @cached_property
    def states(self) -> tuple[str, ...]:
        """Names of all states of the mechanism: coordinates, then pseudo-velocities."""
        return (*self.mechanism.coordinates, *(f"v{i + 1}" for i in range(self.mechanism.rank)))

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

"""`Scene`: a mechanism, a task and options; `nhenv.compiled` makes kernels of it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

from mechanics.compiler.integrators import method_names
from mechanics.expressions import unknown_name
from mechanics.mechanism import Mechanism
from nhenv.tasks import START, Task

__all__ = ["BACKENDS", "BAD_ACTION", "DIVERGED", "HISTORY_FULL", "LARGEST", "RUNNING", "TERMINATED", "Scene"]

RUNNING, BAD_ACTION, DIVERGED, HISTORY_FULL, TERMINATED = 0.0, 1.0, 2.0, 3.0, 4.0

# A state beyond this, in SI units, has diverged; sines of angles below it are still exact.
LARGEST = 2.0**40

BACKENDS = ("numba", "numpy")  # those of `mechanics.compiler.codegen`, which loads SymPy


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
    def states(self) -> tuple[str, ...]:
        """Names of all states of the mechanism: coordinates, then pseudo-velocities."""
        return (*self.mechanism.coordinates, *(f"v{i + 1}" for i in range(self.mechanism.rank)))

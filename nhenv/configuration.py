"""What environments are made from: their arguments, checked and completed, and what `reset` may be given."""

from __future__ import annotations

import inspect
import math
import reprlib
from collections.abc import Callable, Mapping
from functools import cached_property
from typing import Any, TypeVar

import gymnasium as gym
import numpy as np
from numpy.typing import ArrayLike, NDArray

from mechanics.compiler.integrators import method
from mechanics.expressions import unknown_name
from mechanics.model import Model
from nhenv import checks, tasks
from nhenv.compiled import CompiledScene
from nhenv.registration import MechanismLike, TaskLike, as_mechanism, in_the_plane, unfit
from nhenv.render import Screen, View, marker_of

__all__ = ["MODES", "Configuration", "passes_arguments_on"]

Array = NDArray[np.float64]
Init = TypeVar("Init", bound=Callable[..., None])

TOLERANCE = 1e-10
SMALLEST_TOLERANCE = 1e-13
SHORTEST_PERIOD = 1e-9
MODES = ("human", "rgb_array")
SMALLEST_PICTURE, LARGEST_PICTURE = 32, 2048  # pixels; shapes are drawn four times as large


class Configuration:
    """A scene and the numbers in it: see `LocomotionEnv` for the arguments.

    Attributes:
        mechanism: what moves.
        task: what for.
        params: name -> value.
        drag: name -> coefficient of the drag that acts; None if none does.
        dt: control period in s.
        torque_limits: (m,) largest torques.
        joint_limits: name -> angle.
        reset_noise_scale: half-width of the initial angles.
        scene: what is compiled.
        weights: name -> value.
        render_mode: None, "human" or "rgb_array".
        render_size: width and height of a picture, in pixels.
    """

    def __init__(
        self,
        mechanism: MechanismLike,
        task: TaskLike = "Forward",
        *,
        params: Mapping[str, float] | None = None,
        drag: bool | Mapping[str, float] | None = None,
        dt: float = 0.05,
        torque_limits: Mapping[str, float] | ArrayLike | None = None,
        joint_limits: bool | Mapping[str, float] = True,
        frame: str | None = None,
        integrator: str = "auto",
        substeps: int | None = None,
        tolerance: float | None = None,
        keep_energy: bool = False,
        reset_noise_scale: float = 0.05,
        backend: str = "numba",
        whole_state: bool = False,
        render_mode: str | None = None,
        render_size: tuple[int, int] = (640, 400),
        **weights: float,
    ) -> None:
        if render_mode is not None and render_mode not in MODES:
            raise ValueError(f"render_mode must be None or one of {', '.join(MODES)}, got {render_mode!r}")
        for name, value in {"keep_energy": keep_energy, "whole_state": whole_state}.items():
            if not isinstance(value, bool | np.bool_):
                raise ValueError(f"{name} must be True or False, got {value!r}")
        self.mechanism = in_the_plane(as_mechanism(mechanism))
        self.task = tasks.get(task)
        if problem := unfit(self.mechanism, self.task):
            raise ValueError(problem)
        self.params = self.mechanism.resolve(params)
        self.drag = self.mechanism.drag_coefficients(drag)
        self.dt = checks.positive("dt", dt)
        if self.dt < SHORTEST_PERIOD:
            raise ValueError(f"dt must be at least {SHORTEST_PERIOD} s, lest rates of change be roundings, got {dt!r}")
        self.torque_limits = self._torque_limits(torque_limits)
        self.joint_limits = self._joint_limits(joint_limits)
        self.reset_noise_scale = self._noise(reset_noise_scale)
        self.weights = self._weights(weights)
        self.render_mode, self.render_size = render_mode, _size(render_size)
        self.scene = CompiledScene(
            self.mechanism,
            self.task,
            frame=frame,
            stops=bool(self.joint_limits),
            drag=self.drag is not None,
            integrator=integrator,
            substeps=None if substeps is None else checks.whole("substeps", substeps),
            tolerance=_tolerance(tolerance, integrator),
            keep_energy=bool(keep_energy),
            backend=backend,
            whole_state=bool(whole_state),
        )
        self.numbers(self.params, self.drag)  # refuses parameters with which the mechanism has no forward

    def numbers(self, params: Mapping[str, float], drag: Mapping[str, float] | None) -> dict[str, float]:
        """A value for each of the scene's parameters, for these parameters and drag coefficients of the mechanism."""
        forward = self.mechanism.direction(params)
        if forward not in (1, -1):
            raise ValueError(
                f"{self.mechanism.name}: with these parameters {self.mechanism.forward} = {forward:g}, and its gaits "
                "drive it neither way; change a parameter"
            )
        return {**self.weights, **params, "dt": self.dt, "forward": forward, **(drag or {})}

    def screen(self) -> Screen | None:
        """Where the environments are drawn; None without a render mode."""
        if self.render_mode is None:
            return None
        return Screen(self.render_mode, self.render_size, self.title, self.fps)

    def view(self, params: Mapping[str, float]) -> View:
        """What is seen of one environment with these parameters."""
        return View(self.mechanism, params, self.dt, self.title)

    def marker(self, targets: Mapping[str, float]) -> dict[str, float]:
        """Where to draw these targets of an episode."""
        return marker_of(self.task, {**self.weights, **targets})

    @property
    def title(self) -> str:
        """Mechanism and task in words."""
        return f"{self.mechanism.name.replace('_', ' ')}, {self.task.name}"

    @property
    def fps(self) -> float:
        """Control periods a second."""
        rate = 1 / self.dt
        return round(rate) if math.isclose(rate, round(rate)) else rate

    @cached_property
    def model(self) -> Model:
        """The mechanism's functions in the scene's frame, with the drag that acts."""
        return Model(self.mechanism, self.params, self.scene.frame, self.drag)

    @property
    def action_space(self) -> gym.Space[NDArray[np.float32]]:
        """Of one environment."""
        return gym.spaces.Box(-1.0, 1.0, (len(self.mechanism.controls),), np.float32)

    def __getstate__(self) -> dict[str, Any]:
        """Everything but the model, which is made again."""
        return {name: value for name, value in self.__dict__.items() if name != "model"}

    # -- resets --------------------------------------------------------------------------------

    def targets_given(self, options: Mapping[str, Any], mask: NDArray[np.bool_] | None = None) -> dict[str, Array]:
        """Targets in the `options` of a reset, by name, each shape ().

        With a `mask` of rows (N,), each may also be given as (N,); then it is returned for the rows of the mask.
        """
        given = options.get("target", {})
        if not isinstance(given, Mapping):
            raise ValueError(f"reset option 'target' must map targets to numbers, got {given!r}")
        values = {}
        for name, value in given.items():
            if name not in self.task.targets:
                raise ValueError(f"reset option 'target': {unknown_name('target', str(name), self.task.targets)}")
            values[name] = checks.array(f"reset option 'target': {name}", value, (), mask)
        return values

    def state_given(self, options: Mapping[str, Any], key: str, mask: NDArray[np.bool_] | None = None) -> Array:
        """Coordinates or velocities in the `options` of a reset, shape (n,); with a mask as for targets."""
        names = ", ".join(self.mechanism.coordinates)
        return checks.array(f"reset option {key!r} ({names})", options[key], (self.mechanism.n,), mask)

    def check_stops(self, q: Array) -> None:
        """Refuse coordinates (..., n) beyond a stop."""
        for joint, limit in self.joint_limits.items():
            angles = q[..., self.mechanism.coordinates.index(joint)]
            if (np.abs(angles) > limit).any():
                angle = float(np.ravel(angles)[np.argmax(np.abs(angles))])
                raise ValueError(
                    f"reset option 'q' has {joint} = {angle}, beyond its stop at {limit} rad; "
                    "make the environment with joint_limits=False to go there"
                )

    # -- arguments -----------------------------------------------------------------------------

    def _weights(self, given: Mapping[str, float]) -> dict[str, float]:
        values = dict(self.task.weights)
        for name, value in given.items():
            if name not in values:
                known = [*inspect.signature(Configuration).parameters][:-1] + [*values]  # the last stands for weights
                raise TypeError(f"{self.mechanism.name}, {self.task.name}: {unknown_name('argument', name, known)}")
            values[name] = checks.number(name, value)
            if not math.isfinite(values[name]):
                raise ValueError(f"{name} must be finite, got {value}")
        return values

    def _torque_limits(self, given: Mapping[str, float] | ArrayLike | None) -> Array:
        controls = self.mechanism.controls
        values = {control: self.mechanism.torque_limits.get(control, 1.0) for control in controls}
        if isinstance(given, Mapping):
            for name, value in given.items():
                if name not in values:
                    raise ValueError(f"torque_limits: {unknown_name('control', str(name), controls)}")
                values[name] = value
        elif given is not None:
            try:
                array = np.asarray(given, dtype=float)
            except (TypeError, ValueError, OverflowError):
                array = np.empty((0,))
            if array.shape not in ((), (len(controls),)):
                raise ValueError(
                    f"torque_limits must be one number for each of {', '.join(controls)}, got {reprlib.repr(given)}"
                )
            values = dict(zip(controls, np.broadcast_to(array, len(controls)), strict=True))
        return np.array([checks.positive(f"torque limit of {name}", value) for name, value in values.items()])

    def _joint_limits(self, given: bool | Mapping[str, float]) -> dict[str, float]:
        values = dict(self.mechanism.joint_limits)
        if isinstance(given, bool | np.bool_):
            return values if given else {}
        if not isinstance(given, Mapping):
            raise ValueError(f"joint_limits must be True, False or a mapping of angles in rad, got {given!r}")
        for name, value in given.items():
            if name not in values:
                raise ValueError(f"joint_limits: {unknown_name('joint', str(name), values)}")
            values[name] = checks.positive(f"joint limit of {name}", value)
        return values

    def _noise(self, scale: float) -> float:
        smallest, number = min(self.joint_limits.values(), default=math.inf), checks.number("reset_noise_scale", scale)
        if not 0 <= number < smallest:
            raise ValueError(f"reset_noise_scale must be at least 0 and below the stops at {smallest} rad, got {scale}")
        return number


def passes_arguments_on(init: Init) -> Init:
    """Decorator of an `__init__` whose `**arguments` go to `Configuration`: its signature shows them by name."""
    own = inspect.signature(init)
    named = [given for given in own.parameters.values() if given.kind is not given.VAR_KEYWORD]
    others = inspect.signature(Configuration).parameters.values()
    everything = [*named, *(other for other in others if other.name not in own.parameters)]
    init.__signature__ = own.replace(parameters=everything)  # type: ignore[attr-defined]
    return init


def _size(given: Any) -> tuple[int, int]:
    try:
        width, height = given
    except (TypeError, ValueError):
        raise ValueError(f"render_size must be (width, height) in pixels, got {given!r}") from None
    size = checks.whole("render_size: width", width), checks.whole("render_size: height", height)
    if not SMALLEST_PICTURE <= min(size) <= max(size) <= LARGEST_PICTURE:
        raise ValueError(
            f"render_size must be from {SMALLEST_PICTURE} to {LARGEST_PICTURE} pixels each way, got {given!r}"
        )
    return size


def _tolerance(given: float | None, integrator: str) -> float:
    """The tolerance that a scene takes: without one, methods that are asked for by name step as they are."""
    if given is None:
        return TOLERANCE if integrator == "auto" else math.inf
    number = checks.positive("tolerance", given)
    if not SMALLEST_TOLERANCE <= number < 1:
        raise ValueError(
            f"tolerance must be at least {SMALLEST_TOLERANCE}, because of roundings, and below 1, got {given!r}"
        )
    if integrator != "auto":
        try:
            method(integrator).estimates  # noqa: B018 (it says what is wrong with the method)
        except ValueError as error:
            raise ValueError(f"tolerance={given!r}: {error}, or tolerance=None") from None
    return number

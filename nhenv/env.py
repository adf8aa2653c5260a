"""The single environment: one class for every mechanism and task."""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import cached_property
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.error import ResetNeeded
from numpy.typing import ArrayLike, NDArray

from mechanics.expressions import evaluate, unknown_name
from mechanics.model import Model
from nhenv import tasks
from nhenv.registration import MechanismLike, TaskLike, as_mechanism, in_the_plane, unfit
from nhenv.replay import Replay
from nhenv.scene import BAD_ACTION, HISTORY_FULL, TERMINATED, Scene

__all__ = ["LocomotionEnv"]

Array = NDArray[np.float64]
Response = tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]
Options = Mapping[str, Any]


class LocomotionEnv(gym.Env[NDArray[np.float32], NDArray[np.float32]]):
    """A mechanism that rolls without slipping, driven by forces and torques.

    ## Description
    Each step holds the torques for `dt` seconds and integrates the reduced equations of Bullo and
    Zefran, q̇ = X(q) v and v̇ = -Γ̃(q) v v + Y(q) u, which satisfy the rolling constraints by
    construction. Where a mechanism has no drive at its wheels, it moves by steering and swinging.

    Ids are nhenv/MECHANISM TASK-v0, such as nhenv/RollerRacerGoal-v0: `nhenv.environment_ids()` lists
    them, `nhenv.register(mechanism)` adds those of a mechanism of your own.

    ## Action space
    `Box(-1, 1, (m,), float32)`: each control of the mechanism, in its order, over its limit; clipped,
    held over the step. A control without a declared limit has 1.0.

    | mechanism | index | action | control | limit |
    |---|---|---|---|---|
    | snakeboard | 0 | torque on the rotor | `u_psi` | 1.0 N m |
    | | 1 | torque on the steering | `u_phi` | 0.5 N m |
    | roller racer | 0 | torque on the joint | `u_psi` | 0.4 N m |

    `env.unwrapped.mechanism.controls` and `.torque_limits` are those of any other.

    ## Observation space
    `Box(-inf, inf, (d,), float32)`: what the mechanism declares, then what the task adds. Position, the
    snakeboard's rotor angle and time are not observed.

    | mechanism | index | observation | unit |
    |---|---|---|---|
    | snakeboard | 0 | steering angle `phi` | 1.2 rad |
    | | 1 | its rate | 10 rad/s |
    | | 2 | the rotor's rate `psi_dot` | 10 rad/s |
    | | 3 | speed along the heading | m/s |
    | roller racer | 0 | joint angle `psi` | 1.2 rad |
    | | 1 | its rate | 10 rad/s |
    | | 2 | speed along the heading | m/s |

    | task | added observations | unit |
    |---|---|---|
    | Forward | cosine and sine of the heading | |
    | Velocity | cosine and sine of the heading; commanded speed | 1, 1; m/s |
    | Goal | direction of the goal, ahead and to the left (a unit vector in the body's axes); its distance | 1, 1; 2 m |

    A mechanism that declares no observation shows, in SI units: each shape coordinate that anything
    depends on (over its stop if it has one, as cosine and sine if a full turn changes nothing, else its
    value), the rates of all shape coordinates, and speed along the heading, drift across it and
    turning rate as far as the constraints allow them. `env.unwrapped.observation_labels` names the elements.

    ## Targets
    Drawn at reset after the starting state, from the same generator; returned in the `info` of `reset`
    and as `env.unwrapped.targets`. `reset(options={"target": {...}})` replaces any of them by name.

    | task | target | drawn |
    |---|---|---|
    | Velocity | `commanded_speed` | uniform in 0.2 to 1 m/s |
    | Goal | `goal_x`, `goal_y` | from the origin, `start_distance` uniform in 1 to 3 m, `start_bearing` in ±π |

    ## Rewards
    A sum of terms, all reported in `info`. s is the mechanism's own forward: +1 for the snakeboard, the
    sign of l_1 I_2 - l_2 I_1 for the roller racer (-1 by default: a heavy body is driven away from its
    light front link). d is the distance to the goal.

    | task | term | value |
    |---|---|---|
    | Forward | `reward_forward` | `forward_reward_weight * s * (x - x_before) / dt` |
    | Velocity | `reward_velocity` | `1 - velocity_cost_weight * abs(s * x_dot - commanded_speed)` |
    | | `reward_sideways` | `-sideways_cost_weight * abs(y_dot)` |
    | Goal | `reward_progress` | `progress_reward_weight * (d_before - d) / dt` |
    | | `reward_time` | `-time_cost_weight` |
    | | `reward_goal` | `goal_reward_weight` on the step that reaches the goal, else 0 |
    | all | `reward_ctrl` | `-ctrl_cost_weight * mean(action**2)` |

    `info` also has, for Forward, `x_position` and `x_velocity`, the mean over the step; for Velocity,
    `x_velocity` and `y_velocity` at its end; for Goal, `x_position`, `y_position`, `goal_distance` d, and
    `is_success`, 1.0 on the step that reaches the goal, else 0.0.

    Velocity asks for the velocity (s * commanded_speed, 0) in the plane, at the end of each step: along
    the x axis, not along the heading, the way in which the gaits drive the mechanism.

    ## Starting state
    At rest at the origin, each joint with stops uniform in ± `reset_noise_scale`, or the heading if
    there is none. Or as given: `reset(options={"q": ..., "qdot": ...})`, coordinates and velocities in
    the order of `env.unwrapped.mechanism.coordinates`; a velocity must satisfy the rolling constraints.

    ## Episode end
    Truncated after 300 steps (by the TimeLimit that `gym.make` adds). Terminated in Goal with the step
    after which d < `goal_radius`; in every task if the state stops being finite: then
    `info["diverged"]` is True and the last finite observation is returned.

    ## Arguments
    Args:
        mechanism: a `Mechanism`, the name of one in the catalogue, its plain data or the path of its file.
        task: a `Task`, the name of one, or its plain data.
        params: values that replace the mechanism's default parameters, by name.
        dt: control period in s.
        torque_limits: largest torques in N m: by name, or one for each control.
        joint_limits: True for the mechanism's own stops, False for none, or angles in rad by name.
        frame: frame in which the equations are integrated; None for the one that computes best.
        integrator: "auto", or a method of `mechanics.compiler.integrators`.
        substeps: steps of the method in a control period; None for the default.
        reset_noise_scale: half-width of the initial angles, in rad.
        backend: "numba", or "numpy" for kernels that are interpreted: nothing is compiled, each step
            takes some fifty times as long, and a debugger can walk through it.
        render_mode: None; these environments do not draw.
        **weights: the task's weights. Forward: `forward_reward_weight=1.0`. Velocity: `velocity_cost_weight=2.0`,
            `sideways_cost_weight=0.2`. Goal: `progress_reward_weight=1.0`, `time_cost_weight=0.5`,
            `goal_reward_weight=5.0`, `goal_radius=0.15`. All: `ctrl_cost_weight=0.02`.

    ## Version history
    * v0: initial version.
    """

    metadata: dict[str, Any] = {"render_modes": []}  # noqa: RUF012 (Gymnasium's own declaration)

    def __init__(
        self,
        mechanism: MechanismLike,
        task: TaskLike = "Forward",
        *,
        params: Mapping[str, float] | None = None,
        dt: float = 0.05,
        torque_limits: Mapping[str, float] | ArrayLike | None = None,
        joint_limits: bool | Mapping[str, float] = True,
        frame: str | None = None,
        integrator: str = "auto",
        substeps: int | None = None,
        reset_noise_scale: float = 0.05,
        backend: str = "numba",
        render_mode: str | None = None,
        **weights: float,
    ) -> None:
        if render_mode is not None:
            raise ValueError(f"render_mode must be None, got {render_mode!r}: these environments do not draw")
        if substeps is not None and (isinstance(substeps, bool) or not isinstance(substeps, int) or substeps < 1):
            raise ValueError(f"substeps must be a positive whole number or None, got {substeps!r}")
        self.mechanism = in_the_plane(as_mechanism(mechanism))
        self.task = tasks.get(task)
        if problem := unfit(self.mechanism, self.task):
            raise ValueError(problem)
        self.params = self.mechanism.resolve(params)
        self.dt = _positive("dt", dt)
        self.torque_limits = self._torque_limits(torque_limits)
        self.joint_limits = self._joint_limits(joint_limits)
        self.reset_noise_scale = self._noise(reset_noise_scale)
        self.frame = frame
        self._scene = Scene(
            self.mechanism,
            self.task,
            frame=frame,
            stops=bool(self.joint_limits),
            integrator=integrator,
            substeps=substeps,
            backend=backend,
        )
        self._numbers = self._kernel_parameters(weights)
        kernel = self._scene.kernel
        self.action_space = gym.spaces.Box(-1.0, 1.0, (len(self.mechanism.controls),), np.float32)
        self.observation_space = gym.spaces.Box(-np.inf, np.inf, (len(kernel.OBSERVATION),), np.float32)
        self._blank = self._memory = self._new_memory(self._scene)
        self._start: tuple[Array, Array] | None = None  # (q, v) at reset
        self._targets: dict[str, float] = {}
        self._replay: Replay | None = None
        self._bind()

    # -- Gymnasium -----------------------------------------------------------------------------

    def reset(
        self, *, seed: int | None = None, options: Options | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Start an episode at rest near the origin, or at `options` "q" and "qdot", for the `options` "target"."""
        super().reset(seed=seed)
        for key in options or {}:
            if key not in ("q", "qdot", "target"):
                raise ValueError(f"reset options: {unknown_name('option', str(key), ('q', 'qdot', 'target'))}")
        q = np.zeros(self.mechanism.n)
        q[self._noisy] = self.np_random.uniform(-self.reset_noise_scale, self.reset_noise_scale, len(self._noisy))
        v = np.zeros(self.mechanism.rank)
        targets = self.task.draw(self.np_random, self._given_targets(options) if options else {})
        if options:
            q = self._given(options, "q", q)
            self._check_stops(q)
            if "qdot" in options:
                v = self._model.feasible(q, self._given(options, "qdot", np.zeros_like(q)))
        self._memory, self._start = self._blank.copy(), (q, v)
        self._targets = {name: targets[name] for name in self._scene.targets}
        self._scene.put(self._memory, q, v)
        self._scene.aim(self._memory, self._targets)
        self._replay = None
        self._bind()
        return self._observation(), dict(self._targets)

    def step(self, action: NDArray[Any]) -> Response:
        """Hold the torques `action * torque_limits` for `dt` seconds."""
        try:
            response = self._respond(self._memory, action)
        except (AttributeError, TypeError, ValueError):  # not an array of m numbers: say so, or make it one
            response = self._respond(self._memory, self._as_action(action))
        return self._exception(response, action) if response[2] else response

    # -- state ---------------------------------------------------------------------------------

    @property
    def targets(self) -> dict[str, float]:
        """The task's targets in this episode, by name: those that something depends on."""
        self._started()
        return dict(self._targets)

    @property
    def observation_labels(self) -> tuple[str, ...]:
        """Name of each element of the observation."""
        return self._scene.kernel.OBSERVATION

    @property
    def q(self) -> Array:
        """Coordinates, shape (n,), in the order of `mechanism.coordinates`."""
        return self._whole_state()[0]

    @property
    def v(self) -> Array:
        """Pseudo-velocities, shape (k,), in the scene's frame."""
        return self._whole_state()[1]

    @property
    def qdot(self) -> Array:
        """Velocities q̇ = X(q) v, shape (n,)."""
        return self._model.velocity(*self._whole_state())

    @property
    def energy(self) -> float:
        """Kinetic plus potential energy in J."""
        return float(self._model.energy(*self._whole_state()))

    @cached_property
    def _model(self) -> Model:
        return Model(self.mechanism, self.params, self.frame)

    def _whole_state(self) -> tuple[Array, Array]:
        """(q, v), with what the scene prunes worked out from what happened since reset."""
        self._started()
        values = self._scene.values(self._memory)
        if self._scene.kernel.PRUNED:
            values = self._followed().values(self._memory) | values
        state = np.array([values[name] for name in self._scene.states])
        return state[: self.mechanism.n], state[self.mechanism.n :]

    def _started(self) -> None:
        if self._start is None:
            raise ResetNeeded("the environment has no state before reset(); call reset() first")

    def _followed(self) -> Replay:
        """The replay of this episode, begun when first asked for."""
        if self._replay is None:
            assert self._start is not None
            memory = self._new_memory(self._scene.whole)
            self._scene.whole.put(memory, *self._start)
            self._replay = Replay(self._scene, memory)
        return self._replay

    # -- kernel --------------------------------------------------------------------------------

    def _bind(self) -> None:
        """Keep what `step` needs within reach; before reset that is a refusal."""
        kernel = self._scene.kernel
        self._respond = kernel.respond if self._start is not None else _refuse

    def __getstate__(self) -> dict[str, Any]:
        """Everything but the compiled kernel, which is loaded again."""
        state = dict(self.__dict__)
        del state["_respond"]
        state.pop("_model", None)
        return state

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Continue where the pickled environment was."""
        self.__dict__.update(state)
        self._bind()

    def _new_memory(self, scene: Scene) -> Array:
        return scene.new_memory(self._numbers, self.torque_limits, self.joint_limits.values())

    def _observation(self) -> NDArray[np.float32]:
        kernel = self._scene.kernel
        state = self._memory[slice(*kernel.MEMORY["state"])].tolist()
        observe = getattr(kernel.observe, "py_func", kernel.observe)  # compiling it alone would take longer
        constants = self._memory[slice(*kernel.MEMORY["k"])]
        return np.array(observe(*state, *self._targets.values(), constants), dtype=np.float32)

    def _as_action(self, action: ArrayLike) -> Array:
        shape, controls = self.action_space.shape, ", ".join(self.mechanism.controls)
        try:
            array = np.asarray(action, dtype=float)
        except (TypeError, ValueError):
            raise ValueError(f"action must be an array of shape {shape} ({controls}), got {action!r}") from None
        if array.shape != shape:
            raise ValueError(f"action must have shape {shape} ({controls}), got shape {array.shape}") from None
        return array

    def _exception(self, response: Response, action: Any) -> Response:
        """Deal with what happens rarely."""
        observation, reward, status, _, info = response
        if status == BAD_ACTION:
            raise ValueError(
                f"action {np.asarray(action).tolist()} is not a number; a policy that returns NaN has usually diverged"
            )
        if status == HISTORY_FULL:  # nothing was done: make room and do it
            self._followed().make_room(self._memory)
            return self.step(action)
        if status == TERMINATED:
            return observation, reward, True, False, info
        info["diverged"] = True
        return observation, reward, True, False, info

    # -- arguments -----------------------------------------------------------------------------

    @cached_property
    def _noisy(self) -> list[int]:
        """Coordinates that are random at reset: the joints with stops, or else the heading."""
        names = tuple(self.mechanism.joint_limits) or self.mechanism.fibre[2:]
        return [self.mechanism.coordinates.index(name) for name in names]

    def _kernel_parameters(self, weights: Mapping[str, float]) -> dict[str, float]:
        values = dict(self.task.weights)
        for name, value in weights.items():
            if name not in values:
                raise TypeError(f"{type(self).__name__}: {unknown_name('argument', name, values)}")
            values[name] = _number(name, value)
            if not math.isfinite(values[name]):
                raise ValueError(f"{name} must be finite, got {value}")
        forward = float(np.sign(evaluate(self.mechanism.forward, self.params)))
        if forward == 0:
            raise ValueError(
                f"{self.mechanism.name}: with these parameters {self.mechanism.forward} = 0, and its gaits drive it "
                "neither way; change a parameter"
            )
        return values | self.params | {"dt": self.dt, "forward": forward}

    def _torque_limits(self, given: Mapping[str, float] | ArrayLike | None) -> Array:
        controls = self.mechanism.controls
        values = {control: self.mechanism.torque_limits.get(control, 1.0) for control in controls}
        if isinstance(given, Mapping):
            for name, value in given.items():
                if name not in values:
                    raise ValueError(f"torque_limits: {unknown_name('control', str(name), controls)}")
                values[name] = value
        elif given is not None:
            array = np.asarray(given, dtype=float)
            if array.shape not in ((), (len(controls),)):
                raise ValueError(f"torque_limits must be one number for each of {', '.join(controls)}, got {given!r}")
            values = dict(zip(controls, np.broadcast_to(array, len(controls)), strict=True))
        return np.array([_positive(f"torque limit of {name}", value) for name, value in values.items()])

    def _joint_limits(self, given: bool | Mapping[str, float]) -> dict[str, float]:
        values = dict(self.mechanism.joint_limits)
        if isinstance(given, bool | np.bool_):
            return values if given else {}
        if not isinstance(given, Mapping):
            raise ValueError(f"joint_limits must be True, False or a mapping of angles in rad, got {given!r}")
        for name, value in given.items():
            if name not in values:
                raise ValueError(f"joint_limits: {unknown_name('joint', str(name), values)}")
            values[name] = _positive(f"joint limit of {name}", value)
        return values

    def _noise(self, scale: float) -> float:
        smallest, number = min(self.joint_limits.values(), default=math.inf), _number("reset_noise_scale", scale)
        if not 0 <= number < smallest:
            raise ValueError(f"reset_noise_scale must be at least 0 and below the stops at {smallest} rad, got {scale}")
        return number

    def _given_targets(self, options: Options) -> dict[str, float]:
        given = options.get("target", {})
        if not isinstance(given, Mapping):
            raise ValueError(f"reset option 'target' must map targets to numbers, got {given!r}")
        values = {}
        for name, value in given.items():
            if name not in self.task.targets:
                raise ValueError(f"reset option 'target': {unknown_name('target', str(name), self.task.targets)}")
            values[name] = _number(f"reset option 'target': {name}", value)
            if not math.isfinite(values[name]):
                raise ValueError(f"reset option 'target': {name} must be finite, got {value}")
        return values

    def _given(self, options: Options, key: str, default: Array) -> Array:
        values = np.array(options.get(key, default), dtype=float)
        names = ", ".join(self.mechanism.coordinates)
        if values.shape != default.shape:
            raise ValueError(f"reset option {key!r} must have shape {default.shape} ({names}), got {values.shape}")
        if not np.isfinite(values).all():
            raise ValueError(f"reset option {key!r} must be finite, got {values.tolist()}")
        return values

    def _check_stops(self, q: Array) -> None:
        for joint, limit in self.joint_limits.items():
            angle = q[self.mechanism.coordinates.index(joint)]
            if abs(angle) > limit:
                raise ValueError(
                    f"reset option 'q' has {joint} = {angle}, beyond its stop at {limit} rad; "
                    "make the environment with joint_limits=False to go there"
                )


def _refuse(memory: Array, action: Any) -> Response:
    raise ResetNeeded("step() was called before reset(); call reset() to start an episode")


def _number(name: str, value: Any) -> float:
    try:
        return float(value)
    except (TypeError, ValueError):
        raise ValueError(f"{name} must be a number, got {value!r}") from None


def _positive(name: str, value: Any) -> float:
    number = _number(name, value)
    if not (math.isfinite(number) and number > 0):
        raise ValueError(f"{name} must be positive and finite, got {value!r}")
    return number

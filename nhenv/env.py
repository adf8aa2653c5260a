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

import mechanics
from mechanics.expressions import evaluate, unknown_name
from mechanics.mechanism import Mechanism
from mechanics.model import Model
from nhenv import tasks
from nhenv.replay import Replay
from nhenv.scene import BAD_ACTION, HISTORY_FULL, Scene

__all__ = ["LocomotionEnv"]

Array = NDArray[np.float64]
Response = tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]


class LocomotionEnv(gym.Env[NDArray[np.float32], NDArray[np.float32]]):
    """A mechanism that rolls without slipping, driven by torques on its joints.

    ## Description
    Each step holds the torques for `dt` seconds and integrates the reduced equations of Bullo and
    Zefran, q̇ = X(q) v and v̇ = -Γ̃(q) v v + Y(q) u, which satisfy the rolling constraints by
    construction. The mechanism has no drive at its wheels: it moves by steering and swinging.

    ## Action space
    `Box(-1, 1, (m,), float32)`: torque over its limit, clipped, held over the step.

    | mechanism | index | action | control | limit |
    |---|---|---|---|---|
    | snakeboard | 0 | torque on the rotor | `u_psi` | 1.0 N m |
    | | 1 | torque on the steering | `u_phi` | 0.5 N m |
    | roller racer | 0 | torque on the joint | `u_psi` | 0.4 N m |

    ## Observation space
    `Box(-inf, inf, (d,), float32)`. Position, the rotor's angle and time are not observed.

    | mechanism | index | observation | unit |
    |---|---|---|---|
    | snakeboard | 0 | steering angle `phi` | 1.2 rad |
    | | 1 | its rate | 10 rad/s |
    | | 2 | the rotor's rate `psi_dot` | 10 rad/s |
    | | 3 | speed along the heading | m/s |
    | roller racer | 0 | joint angle `psi` | 1.2 rad |
    | | 1 | its rate | 10 rad/s |
    | | 2 | speed along the heading | m/s |
    | both, Forward | last two | cosine and sine of the heading `theta` | |

    ## Rewards
    Forward: `reward_forward + reward_ctrl`, both reported in `info`, with
    `reward_forward = forward_reward_weight * s * (x - x_before) / dt` and
    `reward_ctrl = -ctrl_cost_weight * mean(action**2)`. s is the mechanism's own forward: +1 for
    the snakeboard, the sign of l_1 I_2 - l_2 I_1 for the roller racer (-1 by default: a heavy body
    is driven away from its light front link). `info` also has `x_position` and `x_velocity`.

    ## Starting state
    At rest at the origin, each joint with stops uniform in ± `reset_noise_scale`. Or as given:
    `reset(options={"q": ..., "qdot": ...})`, coordinates and velocities in the order of
    `env.unwrapped.mechanism.coordinates`; a velocity must satisfy the rolling constraints.

    ## Episode end
    Truncated after 300 steps (by the TimeLimit that `gym.make` adds). Terminated only if the state
    stops being finite: then `info["diverged"]` is True and the last finite observation is returned.

    ## Arguments
    Args:
        mechanism: a `Mechanism`, or the name of one in the catalogue.
        task: a `Task`, or the name of one.
        params: values that replace the mechanism's default parameters, by name.
        dt: control period in s.
        torque_limits: largest torques in N m: by name, or one for each control.
        joint_limits: True for the mechanism's own stops, False for none, or angles in rad by name.
        frame: frame in which the equations are integrated; None for the one that computes best.
        integrator: "auto", or a method of `mechanics.compiler.integrators`.
        substeps: steps of the method in a control period; None for the default.
        reset_noise_scale: half-width of the joints' initial angles, in rad.
        render_mode: None; these environments do not draw.
        **weights: the task's weights: `forward_reward_weight=1.0`, `ctrl_cost_weight=0.02`.

    ## Version history
    * v0: initial version.
    """

    metadata: dict[str, Any] = {"render_modes": []}  # noqa: RUF012 (Gymnasium's own declaration)

    def __init__(
        self,
        mechanism: str | Mechanism,
        task: str | tasks.Task = "Forward",
        *,
        params: Mapping[str, float] | None = None,
        dt: float = 0.05,
        torque_limits: Mapping[str, float] | ArrayLike | None = None,
        joint_limits: bool | Mapping[str, float] = True,
        frame: str | None = None,
        integrator: str = "auto",
        substeps: int | None = None,
        reset_noise_scale: float = 0.05,
        render_mode: str | None = None,
        **weights: float,
    ) -> None:
        if render_mode is not None:
            raise ValueError(f"render_mode must be None, got {render_mode!r}: these environments do not draw")
        if substeps is not None and (isinstance(substeps, bool) or not isinstance(substeps, int) or substeps < 1):
            raise ValueError(f"substeps must be a positive whole number or None, got {substeps!r}")
        self.mechanism = mechanics.get(mechanism) if isinstance(mechanism, str) else mechanism
        self.task = tasks.get(task) if isinstance(task, str) else task
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
        )
        self._numbers = self._kernel_parameters(weights)
        kernel = self._scene.kernel
        self.action_space = gym.spaces.Box(-1.0, 1.0, (len(self.mechanism.controls),), np.float32)
        self.observation_space = gym.spaces.Box(-np.inf, np.inf, (len(kernel.OBSERVATION),), np.float32)
        self._blank = self._memory = self._new_memory(self._scene)
        self._start: tuple[Array, Array] | None = None  # (q, v) at reset
        self._replay: Replay | None = None
        self._bind()

    # -- Gymnasium -----------------------------------------------------------------------------

    def reset(
        self, *, seed: int | None = None, options: Mapping[str, ArrayLike] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Start an episode at rest near the origin, or at `options` "q" and "qdot"."""
        super().reset(seed=seed)
        for key in options or {}:
            if key not in ("q", "qdot"):
                raise ValueError(f"reset options: {unknown_name('option', str(key), ('q', 'qdot'))}")
        q = np.zeros(self.mechanism.n)
        noise = self.np_random.uniform(
            -self.reset_noise_scale, self.reset_noise_scale, len(self.mechanism.joint_limits)
        )
        for joint, angle in zip(self.mechanism.joint_limits, noise, strict=True):
            q[self.mechanism.coordinates.index(joint)] = angle
        v = np.zeros(self.mechanism.rank)
        if options:
            q = self._given(options, "q", q)
            self._check_stops(q)
            if "qdot" in options:
                v = self._model.feasible(q, self._given(options, "qdot", np.zeros_like(q)))
        self._memory, self._start = self._blank.copy(), (q, v)
        self._scene.put(self._memory, q, v)
        self._replay = None
        self._bind()
        return self._observation(), {}

    def step(self, action: NDArray[Any]) -> Response:
        """Hold the torques `action * torque_limits` for `dt` seconds."""
        try:
            response = self._respond(self._memory, action)
        except (AttributeError, TypeError, ValueError):  # not an array of m numbers: say so, or make it one
            response = self._respond(self._memory, self._as_action(action))
        return self._exception(response, action) if response[2] else response

    # -- state ---------------------------------------------------------------------------------

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
        if self._start is None:
            raise ResetNeeded("the environment has no state before reset(); call reset() first")
        values = self._scene.values(self._memory)
        if self._scene.kernel.PRUNED:
            values = self._followed().values(self._memory) | values
        state = np.array([values[name] for name in self._scene.states])
        return state[: self.mechanism.n], state[self.mechanism.n :]

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
        return np.array(observe(*state, self._memory[slice(*kernel.MEMORY["k"])]), dtype=np.float32)

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
        info["diverged"] = True
        return observation, reward, True, False, info

    # -- arguments -----------------------------------------------------------------------------

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

    def _given(self, options: Mapping[str, ArrayLike], key: str, default: Array) -> Array:
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

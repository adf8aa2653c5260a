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

from mechanics.expressions import unknown_name
from mechanics.model import Model
from nhenv.compiled import CompiledScene
from nhenv.configuration import MODES, Configuration, passes_arguments_on
from nhenv.registration import MechanismLike, TaskLike
from nhenv.render import Screen
from nhenv.replay import Replay
from nhenv.scene import BAD_ACTION, HISTORY_FULL, RUNNING, TERMINATED

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
    | Turn | where the start is, ahead and to the left; cosine and sine of the angle still to turn | m; 1, 1 |
    | Park | where the place is, ahead and to the left; cosine and sine of the angle still to turn | m; 1, 1 |

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
    | Goal | `goal_x`, `goal_y` | seen from the start, `start_distance` uniform in 1 to 3 m, `start_bearing` in ±π |
    | Turn | `target_heading` | `turn_size` uniform in π/4 to π, to the left or right as `turn_side` in ±1 is signed |
    | | `start_x`, `start_y` | where the episode starts |
    | Park | `place_x`, `place_y` | `park_size` uniform in 0.3 to 1 m, to the side of the start; `park_side` as above |
    | | `target_heading` | the heading at the start |

    ## Rewards
    A sum of terms, all reported in `info`. s is the mechanism's own forward: +1 for the snakeboard, the
    sign of l_1 I_2 - l_2 I_1 for the roller racer (-1 by default: a heavy body is driven away from its
    light front link). d is the distance to the goal, start or place, e the angle still to turn, in ±π.

    | task | term | value |
    |---|---|---|
    | Forward | `reward_forward` | `forward_reward_weight * s * (x - x_before) / dt` |
    | Velocity | `reward_velocity` | `1 - velocity_cost_weight * abs(s * x_dot - commanded_speed)` |
    | | `reward_sideways` | `-sideways_cost_weight * abs(y_dot)` |
    | Goal | `reward_progress` | `progress_reward_weight * (d_before - d) / dt` |
    | | `reward_time` | `-time_cost_weight` |
    | | `reward_goal` | `goal_reward_weight` on the step that reaches the goal, else 0 |
    | Turn | `reward_heading` | `-heading_cost_weight * abs(e) / pi` |
    | | `reward_offset` | `-offset_cost_weight * d` |
    | | `reward_arrival` | `arrival_reward_weight * exp(-(d/offset_tolerance)**2 - (e/heading_tolerance)**2)` |
    | Park | `reward_progress` | `progress_reward_weight * (d_before - d) / dt` |
    | | `reward_near` | `near_reward_weight * exp(-(d/0.2)**2) * (0.25 + 0.75*((1 + cos(e))/2)**2)` |
    | | `reward_arrival` | `arrival_reward_weight * exp(-(d/offset_tolerance)**2 - (e/heading_tolerance)**2)` |
    | all | `reward_ctrl` | `-ctrl_cost_weight * mean(action**2)` |

    `info` also has, for Forward, `x_position` and `x_velocity`, the mean over the step; for Velocity,
    `x_velocity` and `y_velocity` at its end; for Goal, `x_position`, `y_position`, `goal_distance` d, and
    `is_success`, 1.0 on the step that reaches the goal, else 0.0; for Turn and Park, `heading_error` e, `offset` d, and
    `is_success`, 1.0 after a step with |e| < `heading_tolerance` and d < `offset_tolerance`, else 0.0.

    Velocity asks for the velocity (s * commanded_speed, 0) in the plane, at the end of each step: along
    the x axis, not along the heading, the way in which the gaits drive the mechanism.

    ## Starting state
    At rest at the origin, each joint with stops uniform in ± `reset_noise_scale`, or the heading if
    there is none. Or as given: `reset(options={"q": ..., "qdot": ...})`, coordinates and velocities in
    the order of `env.unwrapped.mechanism.coordinates`; a velocity must satisfy the rolling constraints.

    ## Episode end
    Truncated after 300 steps, Turn after 160 and Park after 240 (by the TimeLimit that `gym.make`
    adds). Terminated in Goal with the step after which d < `goal_radius`; in every task if the state
    stops being finite: then `info["diverged"]` is True and the last finite observation is returned.

    ## Arguments
    Args:
        mechanism: a `Mechanism`, the name of one in the catalogue, its plain data or the path of its file.
        task: a `Task`, the name of one, or its plain data.
        params: values that replace the mechanism's default parameters, by name.
        drag: None or False for none, True for the mechanism's own drag at wheels and joints, or coefficients by name
            that replace some of its defaults, such as {"C": 0.5}; as in `mechanics.simulate`.
        dt: control period in s.
        torque_limits: largest torques in N m: by name, or one for each control.
        joint_limits: True for the mechanism's own stops, False for none, or angles in rad by name.
        frame: frame in which the equations are integrated; None for the one that computes best.
        integrator: "auto", or a method of `mechanics.compiler.integrators`.
        substeps: steps of the method in a control period; None for the default.
        tolerance: largest error of a control period, by the method's own estimate: of a state z, tolerance (1 + |z|).
            One that is estimated to be worse is halved until it is not. Each part may take its share of the tolerance
            (all of it with an integrator that is named), and less near a pole of the frame; where nothing helps, the
            episode ends with info["diverged"]. None: 1e-10 with integrator "auto", no control with one that is named.
        keep_energy: whether every step of the method ends by scaling the pseudo-velocities, by 1 up to the step's own
            error, so that the energy changes by the work of the held torques and, but for roundings, by nothing else:
            for long unforced runs. Stops still take energy away. Needs controls with constant covectors, such as
            torques on joints. So near to rest that this would move a velocity by more than ten times the tolerance,
            the velocities stay as they are.
        reset_noise_scale: half-width of the initial angles, in rad.
        backend: "numba", or "numpy" for kernels that are interpreted: nothing is compiled, each step
            takes some fifty times as long, and a debugger can walk through it.
        whole_state: whether every coordinate is integrated in every step, not only those that something depends on;
            `q` is complete either way, but worked out when asked for without this.
        render_mode: None; "rgb_array", then `render` returns the present picture, uint8 of shape (height, width, 3); or
            "human", then a window shows every step at the pace of real time. Both need the extra `render`. The physics
            is the same to the last bit, but what the scene leaves out is integrated beside it.
        render_size: width and height of a picture, in pixels.
        **weights: the task's weights. Forward: `forward_reward_weight=1.0`. Velocity: `velocity_cost_weight=2.0`,
            `sideways_cost_weight=0.2`. Goal: `progress_reward_weight=1.0`, `time_cost_weight=0.5`,
            `goal_reward_weight=5.0`, `goal_radius=0.15`. Turn: `heading_cost_weight=1.0`, `offset_cost_weight=0.5`,
            `arrival_reward_weight=1.0`, `heading_tolerance=0.15`, `offset_tolerance=0.15`. Park:
            `progress_reward_weight=1.0`, `near_reward_weight=1.0`, `arrival_reward_weight=1.0`,
            `heading_tolerance=0.15`, `offset_tolerance=0.1`. All: `ctrl_cost_weight=0.02`.

    ## Version history
    * v0: initial version.
    """

    metadata: dict[str, Any] = {"render_modes": [*MODES], "render_fps": 20}  # noqa: RUF012 (Gymnasium's own declaration)
    _screen: Screen | None = None  # closing an environment that could not be made looks for it

    @passes_arguments_on
    def __init__(self, mechanism: MechanismLike, task: TaskLike = "Forward", **arguments: Any) -> None:
        self._configuration = configuration = Configuration(mechanism, task, **arguments)
        self.render_mode, self._screen = configuration.render_mode, configuration.screen()
        self.mechanism, self.task = configuration.mechanism, configuration.task
        self.params, self.drag, self.dt = configuration.params, configuration.drag, configuration.dt
        self.torque_limits, self.joint_limits = configuration.torque_limits, configuration.joint_limits
        self.reset_noise_scale, self.frame = configuration.reset_noise_scale, configuration.scene.frame
        self._scene = configuration.scene
        self.action_space = configuration.action_space
        self.observation_space = gym.spaces.Box(-np.inf, np.inf, (len(self._scene.kernel.OBSERVATION),), np.float32)
        self._blank = self._memory = self._new_memory(self._scene)
        self._start: tuple[Array, Array] | None = None  # (q, v) at reset
        self._targets: dict[str, float] = {}
        self._replay: Replay | None = None
        self.metadata = {**self.metadata, "render_fps": configuration.fps}
        self._view = configuration.view(self.params) if self._screen else None
        self._bind()

    # -- Gymnasium -----------------------------------------------------------------------------

    def reset(
        self, *, seed: int | None = None, options: Options | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Start an episode at rest near the origin, or at `options` "q" and "qdot", for the `options` "target"."""
        if not isinstance(options, Mapping | None):
            raise ValueError(f"reset options must be a dictionary, got {options!r}")
        for key in options or {}:
            if key not in ("q", "qdot", "target"):
                raise ValueError(f"reset options: {unknown_name('option', str(key), ('q', 'qdot', 'target'))}")
        given = self._configuration.targets_given(options) if options else {}
        values = [given.get(name, math.nan) for name in self._scene.givable]
        start = None
        if options and "q" in options:
            start = self._configuration.state_given(options, "q")
            self._configuration.check_stops(start)
            values[len(self.task.targets) :] = start[self._scene.start_places]
        qdot = self._configuration.state_given(options, "qdot") if options and "qdot" in options else None
        v = np.zeros(self.mechanism.rank)
        if start is not None and qdot is not None:  # here already: what is refused draws nothing
            v = self._model.feasible(start, qdot)
        super().reset(seed=seed)
        drawn = self.np_random.random(self._scene.draws)
        begun = self._scene.kernel.begin(drawn, self.reset_noise_scale, np.array(values), self._constants(self._blank))
        q = start
        if q is None:
            q = np.zeros(self.mechanism.n)
            q[self._noisy] = begun[: len(self._noisy)]
            if qdot is not None:
                v = self._model.feasible(q, qdot)
        self._memory, self._start = self._blank.copy(), (q, v)
        self._targets = dict(zip(self._scene.targets, map(float, begun[len(self._noisy) :]), strict=True))
        self._scene.put(self._memory, q, v)
        self._scene.aim(self._memory, self._targets)
        self._replay = None
        self._bind()
        if self._view is not None:
            self._view.begin(q, self._configuration.marker(self._targets))
            self._play()
        return self._observation(), dict(self._targets)

    def step(self, action: NDArray[Any]) -> Response:
        """Hold the torques `action * torque_limits` for `dt` seconds."""
        try:
            response = self._respond(self._memory, action)
        except TypeError:  # not an array of m numbers: say so, or make it one
            response = self._respond(self._memory, self._as_action(action))
        return self._exception(response, action) if response[2] else response

    def render(self) -> NDArray[np.uint8] | None:
        """The present picture, shape (height, width, 3), in the mode "rgb_array"; "human" shows it in the window."""
        if self._screen is None or self._view is None:
            name = self.spec.id if self.spec else "..."
            gym.logger.warn(
                "render() shows nothing without a render mode; choose one when the environment is made, such as "
                f'gym.make("{name}", render_mode="rgb_array")'
            )
            return None
        self._started()
        return self._screen.show(self._view)

    def close(self) -> None:
        """Close the window, if there is one."""
        if self._screen is not None:
            self._screen.close()

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

    @property
    def _model(self) -> Model:
        return self._configuration.model

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
        if self._start is not None and self._view is not None:
            self._respond = self._respond_and_follow

    def _respond_and_follow(self, memory: Array, action: Any) -> Response:
        """What the kernel does, and the view of it."""
        response = self._scene.kernel.respond(memory, action)
        if self._view is not None and response[2] in (RUNNING, TERMINATED):  # something was done, and it is finite
            self._view.follow(self.q)
            self._play()
        return response

    def _play(self) -> None:
        """In the mode "human", show what is there."""
        if self.render_mode == "human":
            self.render()

    def __getstate__(self) -> dict[str, Any]:
        """Everything but the compiled kernel, which is loaded again."""
        state = dict(self.__dict__)
        del state["_respond"]
        return state

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Continue where the pickled environment was."""
        self.__dict__.update(state)
        self._bind()

    def _new_memory(self, scene: CompiledScene) -> Array:
        numbers = self._configuration.numbers(self.params, self.drag)
        return scene.new_memory(numbers, self.torque_limits, self.joint_limits.values())

    def _constants(self, memory: Array) -> Array:
        return memory[slice(*self._scene.kernel.MEMORY["k"])]

    def _observation(self) -> NDArray[np.float32]:
        observation = np.empty(len(self._scene.kernel.OBSERVATION), np.float32)
        self._scene.kernel.look(self._memory, observation)
        return observation

    @cached_property
    def _noisy(self) -> list[int]:
        return [self.mechanism.coordinates.index(name) for name in self._scene.noisy]

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


def _refuse(memory: Array, action: Any) -> Response:
    raise ResetNeeded("step() was called before reset(); call reset() to start an episode")

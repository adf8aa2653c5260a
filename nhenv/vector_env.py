"""Many environments of one scene side by side, stepped by one compiled call."""

from __future__ import annotations

import reprlib
from collections.abc import Mapping
from copy import deepcopy
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.error import ResetNeeded
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space
from numpy.typing import ArrayLike, NDArray

from mechanics.expressions import unknown_name
from mechanics.mechanism import MechanismError
from nhenv import checks, random_streams, rows, vector_input
from nhenv.configuration import Configuration, passes_arguments_on
from nhenv.registration import MechanismLike, TaskLike
from nhenv.vector_calls import Crew, stepper
from nhenv.vector_info import Infos, StepInfo, masked
from nhenv.vector_input import FLOATS, Seeds
from nhenv.vector_memory import RowMemory
from nhenv.vector_params import RowParameters

__all__ = ["LocomotionVectorEnv"]

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]
Response = tuple[NDArray[np.float32], Array, Bools, Bools, Infos]

_MODES = {
    AutoresetMode.NEXT_STEP: rows.NEXT_STEP,
    AutoresetMode.SAME_STEP: rows.SAME_STEP,
    AutoresetMode.DISABLED: rows.DISABLED,
}
_OPTIONS = ("q", "qdot", "target", "reset_mask")

_FLOAT32, _BOOL = np.dtype(np.float32), np.dtype(np.bool_)


class LocomotionVectorEnv(gym.vector.VectorEnv[NDArray[np.float32], NDArray[np.float32], NDArray[Any]]):
    """Environments of one mechanism and task, a row each: what `gymnasium.make_vec` makes of the ids of this package.

    Row i does to the last bit what `LocomotionEnv`, reset with seed + i, does in a `SyncVectorEnv`: the same source is
    compiled for both, every rounding is spelled out in it, and each row has a random generator of its own.

    Spaces, targets, rewards, starting states and episode ends are those of `LocomotionEnv`, with a leading N. Arrays
    that are returned are never written to again.

    A row whose action is not a number is stepped without torque, and `infos["bad_action"]` tells; one that diverges
    terminates with its last finite observation, and `infos["diverged"]` tells. Its neighbours notice nothing.

    ## Reset
    `reset(seed=s)` seeds row i with s + i; a list has a seed or None for each row. `options` may have "reset_mask", the
    rows to reset, shape (N,); and as for one environment "q" and "qdot", (n,) or (N, n), and "target", whose values may
    be arrays (N,).

    ## Autoreset
    In the mode NEXT_STEP a row whose episode is over is reset by the next step, whose action and reward (0) do not
    count; in SAME_STEP by the step that ends it, which has the last observation in `infos["final_obs"]`; in DISABLED by
    nobody: `step` refuses until `reset(options={"reset_mask": terminated | truncated})`.

    ## Info
    Arrays with one element a row, and beside each "_KEY" the mask of rows that have it, as Gymnasium's vector
    environments do it. At a reset, the targets. In a step, as `info` says: with "none" only "final_obs", "bad_action"
    and "diverged"; with "final" also the info of steps that end an episode (in SAME_STEP under "final_info"), and the
    targets of rows reset; with "all" the info of every step, as `SyncVectorEnv` has it, at several times the cost.

    Args:
        mechanism: as for `LocomotionEnv`.
        task: as for `LocomotionEnv`.
        num_envs: number N of rows.
        max_episode_steps: steps after which an episode is truncated; None or -1 for never. `make_vec` passes that of
            the id.
        autoreset_mode: "NextStep", "SameStep" or "Disabled", or Gymnasium's `AutoresetMode`.
        info: "none", "final" or "all".
        threads: how many threads share the rows. More than one pays from some 10,000 rows on.
        params: as for `LocomotionEnv`; a value may be an array (N,), one for each row.
        drag: as for `LocomotionEnv`; a coefficient may be an array (N,).
        torque_limits: as for `LocomotionEnv`; by name, a value may be an array (N,).
        **arguments: the other arguments of `LocomotionEnv`, the same for all rows. Without `whole_state=True`,
            coordinates that nothing depends on are not followed, and are NaN in `q`. With render_mode="rgb_array",
            which implies it, `render` returns a picture of each row; "human" is for one environment.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 20}  # noqa: RUF012 (Gymnasium's own)
    _running: Any = None  # closing an environment that could not be made looks for it

    @passes_arguments_on
    def __init__(
        self,
        mechanism: MechanismLike,
        task: TaskLike = "Forward",
        num_envs: int = 1,
        *,
        max_episode_steps: int | None = None,
        autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP,
        info: str = "none",
        threads: int = 1,
        params: Mapping[str, ArrayLike] | None = None,
        drag: bool | Mapping[str, ArrayLike] | None = None,
        torque_limits: Mapping[str, ArrayLike] | ArrayLike | None = None,
        **arguments: Any,
    ) -> None:
        self.num_envs = size = checks.whole("num_envs", num_envs)
        endless = max_episode_steps is None or max_episode_steps == -1
        self.max_episode_steps = None if endless else checks.whole("max_episode_steps", max_episode_steps)
        self.threads = checks.whole("threads", threads)
        self.autoreset_mode = vector_input.autoreset_mode(autoreset_mode)
        self.info = vector_input.info_level(info)
        own_params = vector_input.arrays("params", params or {}, size)
        own_drag = vector_input.arrays("drag", drag, size) if isinstance(drag, Mapping) else {}
        own_limits: dict[str, Array] = {}
        if isinstance(torque_limits, Mapping):
            own_limits = vector_input.arrays("torque_limits", torque_limits, size)
            torque_limits = vector_input.first(torque_limits, own_limits)
        if arguments.get("render_mode") is not None:
            if arguments["render_mode"] not in self.metadata["render_modes"]:
                raise ValueError(
                    f"render_mode must be None or 'rgb_array', got {arguments['render_mode']!r}; one environment, of "
                    "gymnasium.make, can be watched in the mode 'human'"
                )
            arguments["whole_state"] = True
        # What is made of the first row's numbers serves for all, or checks what they have in common.
        self._configuration = configuration = Configuration(
            mechanism,
            task,
            params=vector_input.first(params or {}, own_params),
            drag=vector_input.first(drag, own_drag) if isinstance(drag, Mapping) else drag,
            torque_limits=torque_limits,
            **arguments,
        )
        self.render_mode, self._screen = configuration.render_mode, configuration.screen()
        self.mechanism, self.task = configuration.mechanism, configuration.task
        self.dt, self.joint_limits = configuration.dt, configuration.joint_limits
        self.reset_noise_scale, self.frame = configuration.reset_noise_scale, configuration.scene.frame
        self.metadata = {**self.metadata, "autoreset_mode": self.autoreset_mode, "render_fps": configuration.fps}
        self._parameters = RowParameters(configuration, size, varied=bool(own_params or own_drag or own_limits))
        kernel = self._kernel
        self._observed = (size, len(kernel.OBSERVATION))
        self.single_action_space = configuration.action_space
        self.single_observation_space = gym.spaces.Box(-np.inf, np.inf, self._observed[1:], np.float32)
        self.action_space = batch_space(self.single_action_space, size)
        self.observation_space = batch_space(self.single_observation_space, size)
        self._shape = (size, len(self.mechanism.controls))
        self._memory = RowMemory(kernel, size)
        self._streams = np.zeros((4, size), np.uint64)
        self._seeds = np.full(size, -1, object)
        self._numbers = self._shared_numbers()
        self._step_info = StepInfo(info, self.autoreset_mode, kernel, size)
        if self._parameters.varied:
            self._parameters.change(own_params, own_drag, own_limits, np.arange(size), kernel, self._memory)
        self._seeded = self._started = False
        self._views = [configuration.view(self._params_of(i)) for i in range(size)] if self._screen else []
        self._bind()

    # -- Gymnasium -----------------------------------------------------------------------------

    def reset(
        self, *, seed: Seeds = None, options: Mapping[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], Infos]:
        """Start an episode in every row, or in those of `options` "reset_mask"."""
        options = {} if options is None else options
        if not isinstance(options, Mapping):
            raise ValueError(f"reset options must be a dictionary, got {options!r}")
        for key in options:
            if key not in _OPTIONS:
                raise ValueError(f"reset options: {unknown_name('option', str(key), _OPTIONS)}")
        mask = vector_input.mask("reset option 'reset_mask'", options.get("reset_mask"), self.num_envs)
        if not (self._started or mask.all()):
            raise ResetNeeded("the first reset must be of all rows; leave out the option 'reset_mask'")
        chosen = np.flatnonzero(mask)
        given = np.full((self.num_envs, len(self._configuration.scene.givable)), np.nan)
        for name, values in self._configuration.targets_given(options, mask).items():
            given[mask, list(self.task.targets).index(name)] = values
        seeds = vector_input.seeds(seed, chosen, self.num_envs)
        # Nothing of the present episodes is changed before all is known to be right.
        streams = self._new_streams(seeds)
        q, v = self._state_given(options, mask, streams, given)
        if q is not None:
            given[mask, len(self.task.targets) :] = q[..., self._configuration.scene.start_places]
        self._kernel.begin_rows(self._memory.blocks, streams, self._numbers, mask, given)
        self._streams[:] = streams
        for row, number in seeds.items():
            self._seeds[row] = number
        self._seeded = self._started = True
        n = self.mechanism.n
        for i, name in enumerate(self._configuration.scene.states):
            part, place = (q, i) if i < n else (v, i - n)
            if part is not None and name in self._kernel.STATES:
                self._memory.put(f"s_{name}__p", chosen, part[..., place])
        self._choose()
        self._begin_views(mask)
        return self._observations(), masked((name, values, mask) for name, values in self.targets.items())

    def step(self, actions: NDArray[Any]) -> Response:
        """Hold the torques `actions * torque_limits`, shape (N, m), for `dt` seconds in every row."""
        if not (
            type(actions) is np.ndarray
            and actions.dtype in FLOATS
            and actions.shape == self._shape
            and actions.flags.carray  # for any other layout, Numba would compile the kernel again
        ):
            actions = vector_input.actions(actions, self._shape, self.mechanism.controls)
        observations, rewards = np.empty(self._observed, _FLOAT32), np.empty(self.num_envs)
        terminated, truncated = np.zeros(self.num_envs, _BOOL), np.zeros(self.num_envs, _BOOL)
        events = self._run(actions, observations, rewards, terminated, truncated)
        infos = self._infos(events, terminated | truncated) if events or self.info == "all" else {}
        return observations, rewards, terminated, truncated, infos

    def render(self) -> tuple[NDArray[np.uint8], ...] | None:
        """A picture of each row, shape (height, width, 3), in the mode "rgb_array"."""
        if self._screen is None:
            name = self.spec.id if self.spec else "..."
            gym.logger.warn(
                "render() shows nothing without a render mode; choose one when the environments are made, such as "
                f'gym.make_vec("{name}", {self.num_envs}, render_mode="rgb_array")'
            )
            return None
        self._require_start()
        for i, view in enumerate(self._views):
            view.params = self._params_of(i)  # they may have been changed
        return tuple(self._screen.show(view) for view in self._views)  # type: ignore[misc]

    def close_extras(self, **kwargs: Any) -> None:
        """Let the threads go."""
        if isinstance(self._running, Crew):
            self._running.dismiss()

    @property  # type: ignore[misc]
    def np_random(self) -> tuple[np.random.Generator, ...]:  # type: ignore[override]
        """A generator in the state of each row's own; drawing from it does not change the row."""
        if not self._seeded:
            self._streams[:], self._seeded = self._new_streams({}), True
        return tuple(random_streams.generator(self._streams, i) for i in range(self.num_envs))

    @property
    def np_random_seed(self) -> tuple[int, ...]:  # type: ignore[override]
        """Seed of each row, -1 where none was given."""
        return tuple(self._seeds)

    # -- state ---------------------------------------------------------------------------------

    @property
    def params(self) -> dict[str, Any]:
        """Parameters by name: a number, or an array (N,) where rows differ."""
        return _copied(self._parameters.values)

    @property
    def drag(self) -> dict[str, Any] | None:
        """Coefficients of the drag that acts, by name: a number, or an array (N,) where rows differ; None if none."""
        return None if self._parameters.drag is None else _copied(self._parameters.drag)

    @property
    def torque_limits(self) -> Array:
        """Largest torques, shape (N, m)."""
        return self._parameters.torque_limits.copy()

    @property
    def observation_labels(self) -> tuple[str, ...]:
        """Name of each element of an observation."""
        return self._kernel.OBSERVATION

    @property
    def substeps(self) -> int:
        """Steps of the integrator in a hold, where its error needs no more."""
        return int(self._kernel.SUBSTEPS)

    @property
    def targets(self) -> dict[str, Array]:
        """The task's targets in the present episodes, by name, shape (N,): those that something depends on."""
        self._require_start()
        return {name: self._memory[f"t_{name}__p"] for name in self._kernel.TARGETS}

    def marker(self, row: int) -> dict[str, float]:
        """Where pictures show the target of a row's present episode: the numbers of the task's marker, by name."""
        return self._configuration.marker({name: float(values[row]) for name, values in self.targets.items()})

    @property
    def elapsed_steps(self) -> NDArray[np.int64]:
        """Steps of each row since its reset, shape (N,)."""
        self._require_start()
        return self._memory["steps__p"].astype(np.int64)

    @elapsed_steps.setter
    def elapsed_steps(self, steps: ArrayLike) -> None:
        """Say how long the present episodes have lasted; the time limit comes that much sooner."""
        self._require_start()
        whole = np.asarray(steps)
        if not np.issubdtype(whole.dtype, np.integer) or (whole < 0).any():
            raise ValueError(f"elapsed_steps must be whole numbers that are not negative, got {reprlib.repr(steps)}")
        self._memory.put("steps__p", np.arange(self.num_envs), np.broadcast_to(steps, self.num_envs))

    @property
    def q(self) -> Array:
        """Coordinates, shape (N, n); NaN for those that the scene does not follow, unless made with `whole_state`."""
        return self._state()[0]

    @property
    def v(self) -> Array:
        """Pseudo-velocities, shape (N, k), in the scene's frame; NaN for those that the scene does not follow."""
        return self._state()[1]

    @property
    def qdot(self) -> Array:
        """Velocities q̇ = X(q) v, shape (N, n); NaN for those that depend on what the scene does not follow."""
        return self._parameters.evaluate("velocity", *self._state(), np.arange(self.num_envs))

    @property
    def energy(self) -> Array:
        """Kinetic plus potential energy in J, shape (N,); NaN if it depends on what the scene does not follow."""
        return self._parameters.evaluate("energy", *self._state(), np.arange(self.num_envs))

    def set_params(
        self,
        params: Mapping[str, ArrayLike] | None = None,
        torque_limits: Mapping[str, ArrayLike] | None = None,
        mask: Bools | None = None,
        *,
        drag: Mapping[str, ArrayLike] | None = None,
    ) -> None:
        """Give rows other parameters; nothing is compiled, and states (q, v) stay as they are.

        Args:
            params: name -> a number, or an array (N,).
            torque_limits: the same for the largest torques.
            mask: rows, shape (N,); None for all. Only an environment that was made with an array in `params`, `drag` or
                `torque_limits` has parameters for each row.
            drag: the same for the coefficients of the drag, in an environment that was made with drag.
        """
        if not self._parameters.varied:
            raise ValueError(
                "all rows share their parameters: make the environment with an array for at least one of them, such as "
                f"params={{{next(iter(self._parameters.values))!r}: np.full(num_envs, ...)}}"
            )
        if drag is not None and not isinstance(drag, Mapping):
            raise ValueError(f"drag must be coefficients by name, got {drag!r}: whether drag acts cannot change")
        self._parameters.change(
            vector_input.arrays("params", params or {}, self.num_envs, numbers=True),
            vector_input.arrays("drag", drag or {}, self.num_envs, numbers=True),
            vector_input.arrays("torque_limits", torque_limits or {}, self.num_envs, numbers=True),
            np.flatnonzero(vector_input.mask("mask", mask, self.num_envs)),
            self._kernel,
            self._memory,
        )
        if self._started:
            self._observations()  # brings what a kernel keeps beside its states up to date

    # -- kernel --------------------------------------------------------------------------------

    @property
    def _kernel(self) -> Any:
        scene = self._configuration.scene
        return scene.varied_kernel if self._parameters.varied else scene.rows_kernel

    def _bind(self) -> None:
        """Make what runs the kernel: whatever it takes beside what a step brings is within its reach."""
        self._running = stepper(
            self._kernel, self._memory.blocks, self._streams, self._numbers, self._step_info.written, self.threads
        )
        self._choose()

    def _choose(self) -> None:
        """Choose what the next step is: the kernel, or where it may not run a refusal."""
        if not self._started:
            self._run = _refuse
        elif self.autoreset_mode is AutoresetMode.DISABLED and self._memory["over__p"].any():
            self._run = _refuse_over
        else:
            self._run = self._run_and_follow if self._views else self._running

    def _run_and_follow(self, *arguments: Any) -> int:
        """What the kernel does, and the views of it."""
        events = self._running(*arguments)
        begun, q = self._memory["steps__p"] == 0, self.q
        for i in np.flatnonzero(~begun & np.isfinite(q).all(axis=1)).tolist():
            self._views[i].follow(q[i])
        self._begin_views(begun)
        return events

    def _begin_views(self, begun: Bools) -> None:
        """Tell the views of these rows that an episode begins."""
        if self._views:
            q = self.q
            for i in np.flatnonzero(begun).tolist():
                self._views[i].begin(q[i], self.marker(i))

    def _params_of(self, row: int) -> dict[str, float]:
        """Parameters of one row."""
        return {name: float(v[row] if np.ndim(v) else v) for name, v in self._parameters.values.items()}

    def __getstate__(self) -> dict[str, Any]:
        """Everything but the compiled kernel and the threads, which are made again."""
        return {name: value for name, value in self.__dict__.items() if name not in ("_run", "_running")}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Continue where the pickled environment was."""
        self.__dict__.update(state)
        self._bind()

    def _shared_numbers(self) -> Array:
        kernel, configuration = self._kernel, self._configuration
        steps = np.inf if self.max_episode_steps is None else self.max_episode_steps
        shared = [configuration.dt, configuration.reset_noise_scale, steps, _MODES[self.autoreset_mode]]
        shared += [np.nan] * len(configuration.scene.givable)
        if self._parameters.varied:
            return np.array(shared, float)
        numbers = configuration.numbers(configuration.params, configuration.drag)
        constants = kernel.constants([numbers[name] for name in configuration.scene.parameters])
        stops = configuration.joint_limits.values()
        return np.array([*constants, *configuration.torque_limits, *stops, *shared], float)

    # -- rows ----------------------------------------------------------------------------------

    def _state(self) -> tuple[Array, Array]:
        """(q, v) of every row, NaN for what the scene does not follow."""
        self._require_start()
        state = self._memory.states(self._configuration.scene.states)
        return state[:, : self.mechanism.n], state[:, self.mechanism.n :]

    def _observations(self) -> NDArray[np.float32]:
        observations = np.empty(self._observed, _FLOAT32)
        self._kernel.look_rows(self._memory.blocks, self._numbers, observations)
        return observations

    def _require_start(self) -> None:
        if not self._started:
            raise ResetNeeded("the environments have no state before reset(); call reset() first")

    # -- resets --------------------------------------------------------------------------------

    def _new_streams(self, seeds: Mapping[int, int]) -> NDArray[np.uint64]:
        """Random streams with some rows seeded; as they are for the others, or fresh the first time."""
        streams = self._streams.copy()
        if not self._seeded and len(seeds) < self.num_envs:
            random_streams.entropy_streams(streams, np.arange(self.num_envs))
        random_streams.seed_streams(streams, np.array([*seeds], int), [*seeds.values()])
        return streams

    def _state_given(
        self, options: Mapping[str, Any], mask: Bools, streams: NDArray[np.uint64], given: Array
    ) -> tuple[Array | None, Array | None]:
        """(q, v) of the rows of a mask as the `options` of a reset say; None for what they do not."""
        configuration, kernel, chosen = self._configuration, self._kernel, np.flatnonzero(mask)
        q = configuration.state_given(options, "q", mask) if "q" in options else None
        if q is not None:
            configuration.check_stops(q)
        if "qdot" not in options:
            return q, None  # episodes begin at rest
        qdot = configuration.state_given(options, "qdot", mask)
        if q is None:  # whether it is possible depends on where the episodes will begin: rehearse that
            if unknown := set(configuration.scene.noisy) - set(kernel.STATES):
                raise ValueError(
                    f"reset option 'qdot' needs 'q' here, because {', '.join(sorted(unknown))} is drawn but not "
                    "followed; give 'q', or make the environment with whole_state=True"
                )
            rehearsal = deepcopy(self._memory)
            kernel.begin_rows(rehearsal.blocks, streams.copy(), self._numbers, mask, given)
            q = np.zeros((len(chosen), self.mechanism.n))
            for name in configuration.scene.noisy:
                q[:, self.mechanism.coordinates.index(name)] = rehearsal[f"s_{name}__p"][mask]
        q, qdot = (np.broadcast_to(array, (len(chosen), self.mechanism.n)) for array in (q, qdot))
        try:
            return q, self._parameters.evaluate("feasible", q, qdot, chosen)
        except MechanismError:
            for i, row in enumerate(chosen.tolist()):  # which one is it?
                try:
                    self._parameters.evaluate("feasible", q[i : i + 1], qdot[i : i + 1], chosen[i : i + 1])
                except MechanismError as error:
                    raise MechanismError(f"row {row}: {error}") from None
            raise

    # -- steps ---------------------------------------------------------------------------------

    def _infos(self, events: int, done: Bools) -> Infos:
        """What happened rarely, and what the level of info asks for."""
        if events & rows.DONE and self.autoreset_mode is AutoresetMode.DISABLED:
            self._choose()
        if not self._step_info.due(events):
            return {}
        return self._step_info.of_step(events, done, self._memory["steps__p"] == 0, self.targets)


def _copied(values: Mapping[str, Any]) -> dict[str, Any]:
    """Numbers, and copies of arrays."""
    return {name: np.copy(value) if np.ndim(value) else value for name, value in values.items()}


def _refuse(*arguments: Any) -> int:
    raise ResetNeeded("step() was called before reset(); call reset() to start episodes")


def _refuse_over(*arguments: Any) -> int:
    raise ResetNeeded(
        "step() was called with episodes that are over, and the autoreset mode is DISABLED; call "
        "reset(options={'reset_mask': terminated | truncated}) first"
    )

"""Many environments of one scene side by side, stepped by one compiled call."""

from __future__ import annotations

import operator
import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.error import ResetNeeded
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space
from numpy.typing import ArrayLike, NDArray

from mechanics.expressions import unknown_name
from mechanics.mechanism import MechanismError
from mechanics.model import Model
from nhenv import random_streams, rows
from nhenv.configuration import Configuration, passes_arguments_on
from nhenv.registration import MechanismLike, TaskLike

__all__ = ["LocomotionVectorEnv"]

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]
Rows = NDArray[np.int64]  # numbers of rows
Infos = dict[str, Any]
Response = tuple[NDArray[np.float32], Array, Bools, Bools, Infos]
Seeds = int | Sequence[int | None] | None

INFO_LEVELS = ("none", "final", "all")

_MODES = {
    AutoresetMode.NEXT_STEP: rows.NEXT_STEP,
    AutoresetMode.SAME_STEP: rows.SAME_STEP,
    AutoresetMode.DISABLED: rows.DISABLED,
}
_OPTIONS = ("q", "qdot", "target", "reset_mask")
_FLAGS = {"bad_action": rows.BAD_ROW, "diverged": rows.DIVERGED_ROW}

_FLOAT32, _BOOL = np.dtype(np.float32), np.dtype(np.bool_)
_FLOATS = {_FLOAT32, np.dtype(np.float64)}  # in the machine's own byte order


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
        torque_limits: as for `LocomotionEnv`; by name, a value may be an array (N,).
        **arguments: the other arguments of `LocomotionEnv`, the same for all rows. Without `whole_state=True`,
            coordinates that nothing depends on are not followed, and are NaN in `q`.
    """

    metadata: dict[str, Any] = {"render_modes": []}  # noqa: RUF012 (Gymnasium's own declaration)
    _crew: _Crew | None = None  # closing an environment that could not be made looks for it

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
        torque_limits: Mapping[str, ArrayLike] | ArrayLike | None = None,
        **arguments: Any,
    ) -> None:
        self.num_envs = size = _whole("num_envs", num_envs)
        endless = max_episode_steps is None or max_episode_steps == -1
        self.max_episode_steps = None if endless else _whole("max_episode_steps", max_episode_steps)
        self.threads = _whole("threads", threads)
        self.autoreset_mode = _mode(autoreset_mode)
        if info not in INFO_LEVELS:
            raise ValueError(unknown_name("info level", str(info), INFO_LEVELS))
        self.info = info
        own_params = _arrays("params", params or {}, size)
        own_limits = _arrays("torque_limits", torque_limits, size) if isinstance(torque_limits, Mapping) else {}
        if isinstance(torque_limits, Mapping):
            torque_limits = {**torque_limits, **{name: values[0] for name, values in own_limits.items()}}
        # What is made of the first row's numbers serves for all, or checks what they have in common.
        self._configuration = configuration = Configuration(
            mechanism,
            task,
            params={**(params or {}), **{name: float(values[0]) for name, values in own_params.items()}},  # type: ignore[dict-item]
            torque_limits=torque_limits,  # type: ignore[arg-type]
            **arguments,
        )
        self.mechanism, self.task = configuration.mechanism, configuration.task
        self.dt, self.joint_limits = configuration.dt, configuration.joint_limits
        self.reset_noise_scale, self.frame = configuration.reset_noise_scale, configuration.scene.frame
        self.metadata = {**self.metadata, "autoreset_mode": self.autoreset_mode}
        self._varied = bool(own_params or own_limits)
        self._params: dict[str, Any] = dict(configuration.params)
        self._torque_limits = np.tile(configuration.torque_limits, (size, 1))
        kernel = self._kernel
        self._observed = (size, len(kernel.OBSERVATION))
        self.single_action_space = configuration.action_space
        self.single_observation_space = gym.spaces.Box(-np.inf, np.inf, self._observed[1:], np.float32)
        self.action_space = batch_space(self.single_action_space, size)
        self.observation_space = batch_space(self.single_observation_space, size)
        self._shape = self.action_space.shape
        self._blocks = np.zeros((-(-size // kernel.ROWS), kernel.SIZE))
        self._streams = np.zeros((4, size), np.uint64)
        self._seeds = np.full(size, -1, object)
        self._numbers = self._shared_numbers()
        same_step = self.autoreset_mode is AutoresetMode.SAME_STEP
        # What a step says beside what it returns: last observations, rewards and info in parts, flags.
        self._finals = np.zeros((size * same_step, *self._observed[1:]), np.float32)
        self._judged = np.zeros((len(kernel.JUDGEMENT), size * (info != "none")))
        self._flags = np.zeros(size, np.uint8)
        if self._varied:
            self._set_own(own_params, own_limits, np.arange(size))
        self._seeded = self._started = False
        self._bind()

    # -- Gymnasium -----------------------------------------------------------------------------

    def reset(
        self, *, seed: Seeds = None, options: Mapping[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], Infos]:
        """Start an episode in every row, or in those of `options` "reset_mask"."""
        options = options or {}
        for key in options:
            if key not in _OPTIONS:
                raise ValueError(f"reset options: {unknown_name('option', str(key), _OPTIONS)}")
        mask = self._mask("reset option 'reset_mask'", options.get("reset_mask"))
        if not (self._started or mask.all()):
            raise ResetNeeded("the first reset must be of all rows; leave out the option 'reset_mask'")
        chosen = np.flatnonzero(mask)
        given = np.full((self.num_envs, len(self.task.targets)), np.nan)
        for name, values in self._configuration.targets_given(options, mask).items():
            given[mask, list(self.task.targets).index(name)] = values
        seeds = self._seeds_given(seed, chosen)
        # Nothing of the present episodes is changed before all is known to be right.
        streams = self._new_streams(seeds)
        q, v = self._state_given(options, mask, streams, given)
        self._kernel.begin_rows(self._blocks, streams, self._numbers, mask, given)
        self._streams[:] = streams
        for row, number in seeds.items():
            self._seeds[row] = number
        self._seeded = self._started = True
        n = self.mechanism.n
        for i, name in enumerate(self._configuration.scene.states):
            part, place = (q, i) if i < n else (v, i - n)
            if part is not None and name in self._kernel.STATES:
                self._set_field(f"s_{name}__p", chosen, part[..., place])
        self._choose()
        return self._observations(), self._target_infos(mask)

    def step(self, actions: NDArray[Any]) -> Response:
        """Hold the torques `actions * torque_limits`, shape (N, m), for `dt` seconds in every row."""
        if not (
            type(actions) is np.ndarray
            and actions.dtype in _FLOATS
            and actions.shape == self._shape
            and actions.flags.carray  # for any other layout, Numba would compile the kernel again
        ):
            actions = self._as_actions(actions)
        observations, rewards = np.empty(self._observed, _FLOAT32), np.empty(self.num_envs)
        terminated, truncated = np.zeros(self.num_envs, _BOOL), np.zeros(self.num_envs, _BOOL)
        events = self._run(actions, observations, rewards, terminated, truncated)
        infos = self._infos(events, terminated | truncated) if events or self.info == "all" else {}
        return observations, rewards, terminated, truncated, infos

    def close_extras(self, **kwargs: Any) -> None:
        """Let the threads go."""
        if self._crew is not None:
            self._crew.dismiss()

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
        return {name: np.copy(value) if np.ndim(value) else value for name, value in self._params.items()}

    @property
    def torque_limits(self) -> Array:
        """Largest torques, shape (N, m)."""
        return self._torque_limits.copy()

    @property
    def observation_labels(self) -> tuple[str, ...]:
        """Name of each element of an observation."""
        return self._kernel.OBSERVATION

    @property
    def targets(self) -> dict[str, Array]:
        """The task's targets in the present episodes, by name, shape (N,): those that something depends on."""
        self._require_start()
        return {name: self._field(f"t_{name}__p") for name in self._kernel.TARGETS}

    @property
    def elapsed_steps(self) -> NDArray[np.int64]:
        """Steps of each row since its reset, shape (N,)."""
        self._require_start()
        return self._field("steps__p").astype(np.int64)

    @elapsed_steps.setter
    def elapsed_steps(self, steps: ArrayLike) -> None:
        """Say how long the present episodes have lasted; the time limit comes that much sooner."""
        self._require_start()
        self._set_field("steps__p", np.arange(self.num_envs), np.broadcast_to(steps, self.num_envs))

    @property
    def q(self) -> Array:
        """Coordinates, shape (N, n); NaN for those that the scene does not follow, unless made with `whole_state`."""
        return self._state(self._blocks)[0]

    @property
    def v(self) -> Array:
        """Pseudo-velocities, shape (N, k), in the scene's frame; NaN for those that the scene does not follow."""
        return self._state(self._blocks)[1]

    @property
    def qdot(self) -> Array:
        """Velocities q̇ = X(q) v, shape (N, n); NaN for those that depend on what the scene does not follow."""
        return self._per_row("velocity", *self._state(self._blocks), np.arange(self.num_envs))

    @property
    def energy(self) -> Array:
        """Kinetic plus potential energy in J, shape (N,); NaN if it depends on what the scene does not follow."""
        return self._per_row("energy", *self._state(self._blocks), np.arange(self.num_envs))

    def set_params(
        self,
        params: Mapping[str, ArrayLike] | None = None,
        torque_limits: Mapping[str, ArrayLike] | None = None,
        mask: Bools | None = None,
    ) -> None:
        """Give rows other parameters; nothing is compiled, and states (q, v) stay as they are.

        Args:
            params: name -> a number, or an array (N,).
            torque_limits: the same for the largest torques.
            mask: rows, shape (N,); None for all. Only an environment that was made with an array in `params` or
                `torque_limits` has parameters for each row.
        """
        if not self._varied:
            raise ValueError(
                "all rows share their parameters: make the environment with an array for at least one of them, such as "
                f"params={{{next(iter(self._params))!r}: np.full(num_envs, ...)}}"
            )
        chosen = np.flatnonzero(self._mask("mask", mask))
        self._set_own(
            _arrays("params", params or {}, self.num_envs, numbers=True),
            _arrays("torque_limits", torque_limits or {}, self.num_envs, numbers=True),
            chosen,
        )
        if self._started:
            self._observations()  # brings what a kernel keeps beside its states up to date

    # -- kernel --------------------------------------------------------------------------------

    @property
    def _kernel(self) -> Any:
        scene = self._configuration.scene
        return scene.varied_kernel if self._varied else scene.rows_kernel

    def _bind(self) -> None:
        """Make what runs the kernel: whatever it takes beside what a step brings is within its reach."""
        kernel, blocks, streams, numbers = self._kernel, self._blocks, self._streams, self._numbers
        finals, judged, flags = self._finals, self._judged, self._flags
        entries: dict[str, Callable[..., int]] = {}  # by the letter of the actions' type

        def part(first: int, last: int) -> Callable[..., int]:
            scratch = np.zeros((5, max(kernel.SCRATCH, kernel.SIZE)))

            def run(actions: Any, observations: Any, rewards: Any, terminated: Any, truncated: Any) -> int:
                arguments = (
                    blocks, streams, scratch, numbers, actions, observations, rewards, terminated, truncated,
                    finals, judged, flags, first, last,
                )  # fmt: skip
                letter = actions.dtype.char
                if letter not in entries:
                    entries[letter] = _entry(kernel.step_rows, arguments)
                return entries[letter](*arguments)

            return run

        parts = min(self.threads, len(blocks))
        edges = [len(blocks) * i // parts for i in range(parts + 1)]
        runs = [part(*edge) for edge in zip(edges[:-1], edges[1:], strict=True)]
        self._crew = _Crew(runs) if parts > 1 else None
        self._running: Callable[..., int] = self._crew or runs[0]
        self._choose()

    def _choose(self) -> None:
        """Choose what the next step is: the kernel, or where it may not run a refusal."""
        if not self._started:
            self._run = _refuse
        elif self.autoreset_mode is AutoresetMode.DISABLED and self._field("over__p").any():
            self._run = _refuse_over
        else:
            self._run = self._running

    def __getstate__(self) -> dict[str, Any]:
        """Everything but the compiled kernel and the threads, which are made again."""
        return {name: value for name, value in self.__dict__.items() if name not in ("_run", "_running", "_crew")}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Continue where the pickled environment was."""
        self.__dict__.update(state)
        self._bind()

    def _shared_numbers(self) -> Array:
        kernel, configuration = self._kernel, self._configuration
        steps = np.inf if self.max_episode_steps is None else self.max_episode_steps
        shared = [configuration.dt, configuration.reset_noise_scale, steps, _MODES[self.autoreset_mode]]
        shared += [np.nan] * len(self.task.targets)
        if self._varied:
            return np.array(shared, float)
        numbers = configuration.numbers(configuration.params)
        constants = kernel.constants([numbers[name] for name in configuration.scene.parameters])
        stops = configuration.joint_limits.values()
        return np.array([*constants, *configuration.torque_limits, *stops, *shared], float)

    def _set_own(self, params: Mapping[str, Array], limits: Mapping[str, Array], chosen: Rows) -> None:
        """Check and write what each of the chosen rows has of its own."""
        configuration, kernel, controls = self._configuration, self._kernel, self.mechanism.controls
        torque_limits = self._torque_limits.copy()
        for name, values in limits.items():
            if name not in controls:
                raise ValueError(f"torque_limits: {unknown_name('control', name, controls)}")
            if not (np.isfinite(values[chosen]) & (values[chosen] > 0)).all():
                raise ValueError(f"torque_limits: those of {name} must be positive and finite, got {values[chosen]}")
            torque_limits[chosen, controls.index(name)] = values[chosen]
        new = dict(self._params)
        for name, values in params.items():
            if name not in new:
                raise ValueError(f"params: {unknown_name('parameter', name, new)}")
            new[name] = np.array(np.broadcast_to(new[name], self.num_envs))
            new[name][chosen] = values[chosen]
        constants = np.empty((len(chosen), sum(name.startswith("k_") for name in kernel.LASTING)))
        for place, row in enumerate(chosen.tolist()):
            try:
                numbers = configuration.numbers(self.mechanism.resolve(_row(new, row)))
            except ValueError as error:
                raise type(error)(f"row {row}: {error}") from None
            constants[place] = kernel.constants([numbers[name] for name in configuration.scene.parameters])
        k = (name for name in kernel.LASTING if name.startswith("k_"))
        for i, field in enumerate(k):
            self._set_field(field, chosen, constants[:, i])
        for i, control in enumerate(controls):
            self._set_field(f"limit_{control}__p", chosen, torque_limits[chosen, i])
        for joint, limit in configuration.joint_limits.items():
            self._set_field(f"stop_{joint}__p", chosen, limit)
        self._params, self._torque_limits = new, torque_limits

    # -- rows ----------------------------------------------------------------------------------

    def _field(self, name: str, blocks: Array | None = None) -> Array:
        """One number of every row, shape (N,)."""
        place, blocks = self._kernel.LASTING[name], self._blocks if blocks is None else blocks
        return blocks[:, place : place + self._kernel.ROWS].reshape(-1)[: self.num_envs].copy()

    def _set_field(self, name: str, chosen: Rows, values: ArrayLike) -> None:
        block, place = np.divmod(chosen, self._kernel.ROWS)
        self._blocks[block, self._kernel.LASTING[name] + place] = values

    def _state(self, blocks: Array) -> tuple[Array, Array]:
        """(q, v) of every row, NaN for what the scene does not follow."""
        self._require_start()
        states = self._configuration.scene.states
        state = np.full((self.num_envs, len(states)), np.nan)
        for i, name in enumerate(states):
            if name in self._kernel.STATES:
                state[:, i] = self._field(f"s_{name}__p", blocks)
        return state[:, : self.mechanism.n], state[:, self.mechanism.n :]

    def _observations(self) -> NDArray[np.float32]:
        observations = np.empty(self._observed, _FLOAT32)
        self._kernel.look_rows(self._blocks, self._numbers, observations)
        return observations

    def _require_start(self) -> None:
        if not self._started:
            raise ResetNeeded("the environments have no state before reset(); call reset() first")

    def _per_row(self, function: str, q: Array, other: Array, chosen: Rows) -> Array:
        """A function of the mechanism's model, of q and v or q̇ in the chosen rows."""
        if not self._varied:
            return getattr(self._configuration.model, function)(q, other)
        models = (Model(self.mechanism, _row(self._params, i), self.frame) for i in chosen.tolist())
        return np.array([getattr(model, function)(*of_row) for model, *of_row in zip(models, q, other, strict=True)])

    # -- resets --------------------------------------------------------------------------------

    def _mask(self, what: str, given: Bools | None) -> Bools:
        """A mask of rows, (N,): as given, or all."""
        if given is None:
            return np.ones(self.num_envs, _BOOL)
        if not isinstance(given, np.ndarray) or given.dtype != _BOOL or given.shape != (self.num_envs,):
            found = f"{given.dtype} {given.shape}" if isinstance(given, np.ndarray) else repr(given)
            raise ValueError(f"{what} must be a NumPy array of bool of shape ({self.num_envs},), got {found}")
        if not given.any():
            raise ValueError(f"{what} selects no row; leave it out for all rows")
        return np.array(given)

    def _seeds_given(self, seed: Seeds, chosen: Rows) -> dict[int, int]:
        """Seed of each of the chosen rows that gets one."""
        if seed is None:
            return {}
        each: Sequence[int | None] | range
        if isinstance(seed, int | np.integer) and not isinstance(seed, bool):
            each = range(int(seed), int(seed) + self.num_envs)
        elif isinstance(seed, Sequence | np.ndarray) and not isinstance(seed, str | bytes):
            each = seed
        else:
            raise ValueError(f"seed must be None, a whole number or one for each row, got {seed!r}")
        if len(each) != self.num_envs:
            raise ValueError(f"seed must be None, a whole number or {self.num_envs} of them, got {len(each)}")
        try:
            seeds = {row: operator.index(each[row]) for row in chosen.tolist() if each[row] is not None}
        except TypeError:
            raise ValueError(f"seeds must be whole numbers or None, got {seed!r}") from None
        if seeds and min(seeds.values()) < 0:
            raise gym.error.Error(f"a seed must not be negative, got {min(seeds.values())}")
        return seeds

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
            blocks = self._blocks.copy()
            kernel.begin_rows(blocks, streams.copy(), self._numbers, mask, given)
            q = np.zeros((len(chosen), self.mechanism.n))
            for name in configuration.scene.noisy:
                q[:, self.mechanism.coordinates.index(name)] = self._field(f"s_{name}__p", blocks)[mask]
        q, qdot = (np.broadcast_to(array, (len(chosen), self.mechanism.n)) for array in (q, qdot))
        try:
            return q, self._per_row("feasible", q, qdot, chosen)
        except MechanismError:
            for i, row in enumerate(chosen.tolist()):  # which one is it?
                try:
                    self._per_row("feasible", q[i : i + 1], qdot[i : i + 1], chosen[i : i + 1])
                except MechanismError as error:
                    raise MechanismError(f"row {row}: {error}") from None
            raise

    # -- steps ---------------------------------------------------------------------------------

    def _as_actions(self, actions: ArrayLike) -> NDArray[Any]:
        """Actions as the kernel takes them: floats one after the other, which it could write to."""
        controls = ", ".join(self.mechanism.controls)
        try:
            array = np.asarray(actions)
            if array.dtype.kind not in "biufO":
                raise TypeError
            array = array.astype(_FLOAT32 if array.dtype == _FLOAT32 else float)
        except (TypeError, ValueError):
            raise ValueError(f"actions must be an array of shape {self._shape} ({controls}), got {actions!r}") from None
        if array.shape != self._shape:
            raise ValueError(f"actions must have shape {self._shape} (rows; {controls}), got shape {array.shape}")
        return np.array(array, order="C")

    def _infos(self, events: int, done: Bools) -> Infos:
        """What happened rarely, and what the level of info asks for."""
        if events & rows.DONE and self.autoreset_mode is AutoresetMode.DISABLED:
            self._choose()
        same_step = self.autoreset_mode is AutoresetMode.SAME_STEP
        if self.info == "none" and not events & (rows.BAD_ROW | rows.DIVERGED_ROW | rows.DONE * same_step):
            return {}  # in time: what follows takes as long as a step of a thousand rows
        fresh = self._field("steps__p") == 0
        stepped = np.ones_like(done) if same_step else ~fresh
        told = {"none": np.zeros_like(done), "final": done, "all": stepped}[self.info]
        news = [(name, values, told) for name, values in zip(self._kernel.JUDGEMENT, self._judged, strict=True)]
        if events & (rows.BAD_ROW | rows.DIVERGED_ROW):
            for key, bit in _FLAGS.items():
                flagged = (self._flags & bit) != 0
                news.append((key, flagged, flagged))
            self._flags[:] = 0
        infos: Infos = {}
        if same_step and events & rows.DONE:
            final = np.full(self.num_envs, None, object)
            for row, observation in zip(np.flatnonzero(done).tolist(), self._finals[done], strict=True):
                final[row] = observation
            infos |= {"final_obs": final, "_final_obs": done.copy()}
            last = _masked((name, values, mask & done) for name, values, mask in news)
            if last or self.info != "none":
                infos |= {"final_info": last, "_final_info": done.copy()}
            news = [(name, values, mask & ~done) for name, values, mask in news]
        if self.info != "none":
            infos |= self._target_infos(fresh)
        return infos | _masked(news)

    def _target_infos(self, mask: Bools) -> Infos:
        return _masked((name, values, mask) for name, values in self.targets.items())


class _Crew:
    """Functions that are called side by side: the first by the caller, each other by a thread of its own."""

    def __init__(self, runs: Sequence[Callable[..., int]]) -> None:
        self._runs, self._process = runs, -1
        self._pool: ThreadPoolExecutor | None = None

    def __call__(self, *arguments: Any) -> int:
        """All their results, joined by |."""
        if self._pool is None or self._process != os.getpid():  # threads do not survive a fork
            self._pool, self._process = ThreadPoolExecutor(len(self._runs) - 1, "nhenv"), os.getpid()
        others = [self._pool.submit(run, *arguments) for run in self._runs[1:]]
        events = self._runs[0](*arguments)
        for other in others:
            events |= other.result()
        return events

    def dismiss(self) -> None:
        """End the threads, until the next call."""
        if self._pool is not None and self._process == os.getpid():
            self._pool.shutdown()
        self._pool = None


def _entry(function: Any, arguments: tuple[Any, ...]) -> Callable[..., int]:
    """A kernel's function for arguments of these types; what a dispatcher looks up at every call, once."""
    if not hasattr(function, "compile"):  # interpreted, whose numbers warn where compiled ones do not
        return np.errstate(all="ignore")(function)
    from numba import typeof

    return function.compile(tuple(typeof(argument) for argument in arguments))


def _refuse(*arguments: Any) -> int:
    raise ResetNeeded("step() was called before reset(); call reset() to start episodes")


def _refuse_over(*arguments: Any) -> int:
    raise ResetNeeded(
        "step() was called with episodes that are over, and the autoreset mode is DISABLED; call "
        "reset(options={'reset_mask': terminated | truncated}) first"
    )


def _masked(entries: Iterable[tuple[str, NDArray[Any], Bools]]) -> Infos:
    """Info of (key, values, mask of the rows that have it), as Gymnasium has it; all arrays are new."""
    infos: Infos = {}
    for key, values, mask in entries:
        if mask.any():
            infos |= {key: np.where(mask, values, values.dtype.type(0)), f"_{key}": mask.copy()}
    return infos


def _mode(mode: str | AutoresetMode) -> AutoresetMode:
    try:
        return AutoresetMode(mode)
    except ValueError:
        raise ValueError(unknown_name("autoreset_mode", str(mode), [known.value for known in AutoresetMode])) from None


def _whole(name: str, value: Any) -> int:
    if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < 1:
        raise ValueError(f"{name} must be a positive whole number, got {value!r}")
    return int(value)


def _row(values: Mapping[str, Any], row: int) -> dict[str, float]:
    """Numbers of one row, of numbers or arrays (N,)."""
    return {name: float(value[row]) if np.ndim(value) else value for name, value in values.items()}


def _arrays(what: str, given: Mapping[str, ArrayLike], size: int, *, numbers: bool = False) -> dict[str, Array]:
    """Those of some values by name that are arrays, shape (N,); or `numbers` too, made arrays."""
    arrays = {}
    for name, value in given.items():
        try:
            array = np.asarray(value, dtype=float)
        except (TypeError, ValueError):
            if np.ndim(np.asarray(value, dtype=object)) == 0 and not numbers:
                continue  # whoever takes single numbers will say what is wrong with this one
            raise ValueError(f"{what}: {name} must be a number or {size} of them, got {value!r}") from None
        if array.shape not in ((), (size,)):
            raise ValueError(f"{what}: {name} must be a number or have shape ({size},), got shape {array.shape}")
        if array.shape or numbers:
            arrays[str(name)] = np.array(np.broadcast_to(array, size))
    return arrays

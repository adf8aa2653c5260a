"""Environments for Stable-Baselines3: its `VecEnv` on top of a Gymnasium vector environment.

from nhenv.sb3 import make_sb3_vec_env

model = PPO("MlpPolicy", make_sb3_vec_env("nhenv/SnakeboardForward-v0", 64), seed=0)

This module, and no other of the package, imports Stable-Baselines3 and with it PyTorch.
"""

from __future__ import annotations

import functools
import importlib
import warnings
from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.envs.registration import EnvSpec
from gymnasium.error import DependencyNotInstalled
from gymnasium.vector import AutoresetMode, SyncVectorEnv, VectorEnv
from numpy.typing import NDArray

try:
    from stable_baselines3.common.env_util import is_wrapped
    from stable_baselines3.common.vec_env import VecEnv
    from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices, VecEnvStepReturn
except ImportError as problem:
    raise DependencyNotInstalled(
        f'nhenv.sb3 needs Stable-Baselines3 ({problem}): run pip install "nhenv[train]"'
    ) from problem

from nhenv import checks
from nhenv.registration import VECTOR_ENTRY_POINT
from nhenv.vector_env import LocomotionVectorEnv

__all__ = ["SB3VecEnv", "make_sb3_vec_env"]

Flags = NDArray[np.bool_]
Info = dict[str, Any]

_FINAL = ("final_obs", "_final_obs", "final_info", "_final_info")  # Gymnasium's names for the last step of an episode
_DECIDED_HERE = ("num_envs", "autoreset_mode", "vectorization_mode", "vector_kwargs", "wrappers")
_STAGGER = 0x57A6  # beside the seed, so that this generator is none of the rows'


def make_sb3_vec_env(
    env_id: str, n_envs: int, seed: int | None = None, *, staggered: bool = True, **env_kwargs: Any
) -> SB3VecEnv:
    """Environments side by side, as Stable-Baselines3 wants them.

    Args:
        env_id: id known to Gymnasium. Those of this package are stepped by one compiled call, any other in a loop.
        n_envs: number of environments.
        seed: row i is reset with `seed + i`, as those of `DummyVecEnv` are; `env.seed(seed)`, which a model with a
            seed calls, does the same. Used once, by the next `reset`: later episodes draw from the same generators.
            None for random starts. The lengths of `staggered` have a generator of their own, seeded by it too.
        staggered: whether the first episode of each row after `reset` is cut at a random step, uniform from 1 to the
            time limit, and reported as truncated. Without it, all rows of a task that only ends by time are always
            in the same phase of an episode. For training: `evaluate_policy` would count the cut episodes.
        **env_kwargs: arguments of the environment, among them `max_episode_steps`; of `LocomotionVectorEnv` for the ids
            of this package. There `info="all"` fills the infos of every step, at a cost.

    Raises:
        gymnasium.error.Error: the id is unknown.
        ValueError: an argument has a value that cannot be.
    """
    spec = _spec(env_id)
    n_envs = checks.whole("n_envs", n_envs)
    for name in _DECIDED_HERE:
        if name in env_kwargs:
            raise ValueError(
                f"make_sb3_vec_env decides on {name} itself, got {env_kwargs[name]!r}: leave it out, or give a vector "
                "environment of your own to SB3VecEnv"
            )
    longest = _time_limit(spec, env_kwargs.get("max_episode_steps")) if staggered else None
    vector_env: VectorEnv[Any, Any, Any]
    if spec.vector_entry_point == VECTOR_ENTRY_POINT:
        mode = {"autoreset_mode": AutoresetMode.SAME_STEP.value}
        vector_env = gym.make_vec(env_id, n_envs, **{"info": "final"} | env_kwargs | mode)
    else:  # as make_vec does, but so that it can be pickled. Not every vector environment has this mode of autoreset
        make = functools.partial(gym.make, env_id, **env_kwargs)
        vector_env = SyncVectorEnv([make] * n_envs, autoreset_mode=AutoresetMode.SAME_STEP)
        vector_env.spec = spec
    env = SB3VecEnv(vector_env, longest_first_episode=longest)
    if seed is not None:
        env.seed(seed)
    return env


class SB3VecEnv(VecEnv):
    """A Gymnasium vector environment, in the shape of a `VecEnv` of Stable-Baselines3.

    What it returns equals what `DummyVecEnv` returns of the same single environments, with one exception: the `infos`
    of rows whose episode goes on are what the vector environment says of them, which may be nothing; they never have
    "TimeLimit.truncated", which Stable-Baselines3 takes for False.

    It can be pickled in the middle of an episode if the vector environment can.

    Args:
        vector_env: in the autoreset mode SAME_STEP, with arrays as observations.
        longest_first_episode: after `reset`, cut the first episode of each row at a random step, uniform from 1 to
            this. The cut row is reset by the option "reset_mask", so its generator goes on as after any other episode.
            None to cut nothing.
    """

    def __init__(self, vector_env: VectorEnv[Any, Any, Any], *, longest_first_episode: int | None = None) -> None:
        mode = vector_env.metadata.get("autoreset_mode")
        if mode is not AutoresetMode.SAME_STEP:
            raise ValueError(
                f"Stable-Baselines3 needs {AutoresetMode.SAME_STEP}: a row is reset in the step that ends its episode; "
                f"got {vector_env} with {mode}. Make it with autoreset_mode='SameStep', which Gymnasium's own classes "
                "take in vector_kwargs"
            )
        if longest_first_episode is not None and longest_first_episode < 1:
            raise ValueError(f"longest_first_episode must be at least 1 step, or None, got {longest_first_episode}")
        self.vector_env = vector_env
        self.spec = vector_env.spec
        super().__init__(vector_env.num_envs, vector_env.single_observation_space, vector_env.single_action_space)
        self.metadata = dict(vector_env.metadata)
        self._actions: Any = None
        self._longest = longest_first_episode
        self._cutter = np.random.default_rng()
        self._left: NDArray[np.int64] | None = None  # steps until a row's first episode is cut; None if all have ended
        self._has_begun = False

    # -- episodes ------------------------------------------------------------------------------

    def reset(self) -> NDArray[Any]:
        """Reset all rows, with the seeds and options that were set since the last time."""
        seeds = list(self._seeds) if any(seed is not None for seed in self._seeds) else None
        observations = self._reset_all(seeds)
        if self._longest is not None:
            if seeds is not None and seeds[0] is not None:
                self._cutter = np.random.default_rng([seeds[0], _STAGGER])
            left = self._cutter.integers(1, self._longest, size=self.num_envs, endpoint=True)
            bare = self.vector_env.unwrapped
            if isinstance(bare, LocomotionVectorEnv) and bare.max_episode_steps == self._longest:
                bare.elapsed_steps = self._longest - left  # its own time limit cuts, and reports the last step too
            else:
                self._left = left
        self._reset_seeds()
        self._reset_options()
        return np.array(observations, order="C")

    def step_async(self, actions: NDArray[Any]) -> None:
        """Keep the actions, shape (n_envs, m), for `step_wait`."""
        self._actions = actions

    def step_wait(self) -> VecEnvStepReturn:
        """Step all rows.

        Returns:
            observations: shape (n_envs, d); of a row that is done, the first one of its next episode.
            rewards: shape (n_envs,), float32.
            dones: shape (n_envs,).
            infos: one dictionary a row. That of a row that is done has "terminal_observation", whether it was
                truncated as "TimeLimit.truncated", and what the environment says of the last step.
        """
        observations, rewards, terminated, truncated, info = self.vector_env.step(self._actions)
        dones = np.logical_or(terminated, truncated)
        infos: list[Info] = [{} for _ in range(self.num_envs)]  # not one for all: whoever gets them may write
        if info:
            self._report(info, dones, truncated & ~terminated, infos)
        if self._left is not None:
            observations = self._stagger(self._left, observations, dones, infos)
        # Copies, because Stable-Baselines3 keeps the observations over the next step and adds to the rewards.
        return np.array(observations, order="C"), np.array(rewards, np.float32), dones, infos

    def close(self) -> None:
        """Close the vector environment."""
        self.vector_env.close()

    def _reset_all(self, seeds: list[int | None] | None) -> NDArray[Any]:
        # `set_options` gives all rows one dictionary, or each its own: by identity, since they may hold arrays.
        groups = {id(options): options for options in self._options}
        if not any(self._options) or len(groups) == 1:
            observations, info = self.vector_env.reset(seed=seeds, options=dict(self._options[0]) or None)  # type: ignore[arg-type]
            self._note_reset(info, np.arange(self.num_envs))
        else:
            if not self._has_begun:  # a vector environment cannot begin with some of its rows
                self.vector_env.reset(seed=seeds)  # type: ignore[arg-type]
            for identity, options in groups.items():
                mask = np.array([id(own) == identity for own in self._options])
                observations, info = self.vector_env.reset(seed=seeds, options={**options, "reset_mask": mask})  # type: ignore[arg-type]
                self._note_reset(info, np.flatnonzero(mask))
        self._has_begun = True
        return observations

    def _note_reset(self, info: Mapping[str, Any], rows: NDArray[np.int64]) -> None:
        for i in rows.tolist():
            self.reset_infos[i] = {}
        _distribute(info, rows, self.reset_infos)

    def _report(self, info: Info, dones: Flags, timeouts: Flags, infos: list[Info]) -> None:
        """Write what the vector environment says of a step into the rows' dictionaries."""
        ended = np.flatnonzero(dones)
        _distribute({key: value for key, value in info.items() if key not in _FINAL}, np.arange(len(infos)), infos)
        if not len(ended):
            return
        if "final_obs" not in info:
            raise ValueError(
                f"{self.vector_env} says nothing of the last observation of rows that are done, info['final_obs'], "
                "which Stable-Baselines3 needs"
            )
        for i in ended.tolist():  # what it says of them beside "final_info" is about their next episode
            self.reset_infos[i], infos[i] = infos[i], {}
        _distribute(info.get("final_info", {}), ended, infos)
        last = info["final_obs"][ended]
        for i, observation, timeout in zip(ended.tolist(), last, timeouts[ended].tolist(), strict=True):
            infos[i]["TimeLimit.truncated"] = timeout
            infos[i]["terminal_observation"] = observation

    def _stagger(
        self, left: NDArray[np.int64], observations: NDArray[Any], dones: Flags, infos: list[Info]
    ) -> NDArray[Any]:
        """Cut the first episodes whose time has come: change `dones` and `infos`, return the observations."""
        left -= 1
        left[dones] = 0  # ended by itself; from now on below zero
        cut = (left == 0) & ~dones
        if left.max() <= 0:
            self._left = None
        if not cut.any():
            return observations
        rows = np.flatnonzero(cut)
        for i in rows.tolist():
            infos[i]["TimeLimit.truncated"] = True
            infos[i]["terminal_observation"] = np.array(observations[i])
        observations, info = self.vector_env.reset(options={"reset_mask": cut.copy()})
        self._note_reset(info, rows)
        dones |= cut
        return observations

    # -- attributes and methods ----------------------------------------------------------------

    @property
    def _envs(self) -> Sequence[gym.Env[Any, Any]] | None:
        """The single environments, if the vector environment is made of some in this process."""
        return getattr(self.vector_env.unwrapped, "envs", None)

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """Value of an attribute for each row: a row of an array that has one for each, else the same for all."""
        rows = self._get_indices(indices)
        if self._envs is not None:
            return [self._envs[i].get_wrapper_attr(attr_name) for i in rows]
        bare = self.vector_env.unwrapped
        if hasattr(bare, "get_attr"):  # it knows best
            values = bare.get_attr(attr_name)
        else:
            of_one = attr_name in ("observation_space", "action_space")
            value = getattr(bare, f"single_{attr_name}" if of_one else attr_name)
            per_row = isinstance(value, np.ndarray) and value.shape[:1] == (self.num_envs,)
            values = value if per_row else [value] * self.num_envs
        return [values[i] for i in rows]

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """Set an attribute of single environments; refused where there are none."""
        for env in self._single_envs(f"set {attr_name!r} of", indices):
            env.set_wrapper_attr(attr_name, value)

    def env_method(
        self, method_name: str, *method_args: Any, indices: VecEnvIndices = None, **method_kwargs: Any
    ) -> list[Any]:
        """Call a method of single environments; refused where there are none, and where it would break the rollout."""
        if method_name in ("reset", "step", "close"):
            raise ValueError(
                f"env_method({method_name!r}) would go behind the back of the vector environment: call "
                f"{method_name}() of all rows; seed() and set_options() say how to reset"
            )
        envs = self._single_envs(f"call {method_name!r} of", indices)
        return [env.get_wrapper_attr(method_name)(*method_args, **method_kwargs) for env in envs]

    def env_is_wrapped(
        self, wrapper_class: type[gym.Wrapper[Any, Any, Any, Any]], indices: VecEnvIndices = None
    ) -> list[bool]:
        """Whether each row is a single environment inside such a wrapper."""
        envs = self._envs
        return [envs is not None and is_wrapped(envs[i], wrapper_class) for i in self._get_indices(indices)]

    def _single_envs(self, purpose: str, indices: VecEnvIndices) -> list[gym.Env[Any, Any]]:
        if self._envs is None:
            raise NotImplementedError(
                f"cannot {purpose} single rows: {self.vector_env} steps them all at once and is not made of single "
                "environments. Give settings to make_sb3_vec_env, and read values by get_attr"
            )
        return [self._envs[i] for i in self._get_indices(indices)]

    # -- pictures ------------------------------------------------------------------------------

    def get_images(self) -> Sequence[Any]:
        """A picture of each row, if the render mode is "rgb_array"."""
        if self.render_mode != "rgb_array":
            warnings.warn(
                f"the render mode is {self.render_mode!r}; make the environments with render_mode='rgb_array' to get "
                "pictures",
                stacklevel=2,
            )
            return [None] * self.num_envs
        return list(self.vector_env.render() or ())


def _distribute(info: Mapping[str, Any], rows: NDArray[np.int64], into: list[Info] | dict[int, Info]) -> None:
    """Write what a vector environment says of some rows into their dictionaries, as plain Python values.

    Args:
        info: arrays with N elements, beside each `key` a mask `_key` of those that count; or the same one level down.
        rows: numbers of the rows, shape (k,).
        into: the dictionary of each row, by its number.
    """
    for key, values in info.items():
        if key.startswith("_") and key[1:] in info:
            continue
        mask = info.get(f"_{key}")
        those = rows if mask is None else rows[mask[rows]]
        if isinstance(values, Mapping):
            inner: dict[int, Info] = {i: {} for i in those.tolist()}
            _distribute(values, those, inner)
            picked = list(inner.values())
        else:
            picked = values[those].tolist() if values.ndim == 1 else list(values[those])
        for i, value in zip(those.tolist(), picked, strict=True):
            into[i][key] = value


def _spec(env_id: str) -> EnvSpec:
    """What Gymnasium knows of an id, which may name the module that registers it: "module:id"."""
    if not isinstance(env_id, str):
        raise ValueError(f"env_id must be an id such as 'nhenv/SnakeboardForward-v0', got {env_id!r}")
    module, _, name = env_id.rpartition(":")
    if module:
        importlib.import_module(module)
    return gym.spec(name)


def _time_limit(spec: EnvSpec, given: int | None) -> int:
    limit = spec.max_episode_steps if given is None else given
    if limit is None or limit < 1:  # -1 is Gymnasium's way to ask for no limit
        raise ValueError(
            f"staggered=True cuts first episodes at a random step up to the time limit, and {spec.id} has none "
            f"(max_episode_steps is {limit}): give max_episode_steps, or staggered=False"
        )
    return limit

"""Vector environments that `benchmarks.throughput` times: ours, and those that they are compared with.

A contender makes any number of environments, warmed up: episodes end at a steady rate from then on. What it
makes takes a number of steps and returns seconds a step. Except gymnax, which draws its own within the scan, all
get random actions drawn beforehand, and resets are part of a step.
"""

from __future__ import annotations

import itertools
import os
import time
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np

__all__ = ["PEERS", "Contender", "Run", "actions", "ours", "sync"]

Run = Callable[[int], float]  # steps -> seconds a step

CARTPOLE = "CartPole-v1"
# Random actions end an episode of CartPole after 22 steps, and of a hundred environments one after 60.
CARTPOLE_WARM_UP = 100


@dataclass(frozen=True)
class Contender:
    """A kind of vector environment.

    Attributes:
        name: as tables print it.
        kind: contenders of one kind are one peer, whose best time counts.
        make: number of environments -> `Run`; an ImportError or DependencyNotInstalled if it is not installed.
        largest: most environments for which a turn stays short.
    """

    name: str
    kind: str
    make: Callable[[int], Run]
    largest: int = 1 << 20


def actions(space: gym.Space[Any], size: int) -> Iterator[np.ndarray]:
    """Random actions of `size` environments, for ever: some arrays and their opposites, so that no row drifts."""
    rng = np.random.default_rng(0)
    count = _drawn(size)
    if isinstance(space, gym.spaces.Discrete):
        drawn = [rng.integers(space.n, size=size) for _ in range(count)]
        opposite = [space.n - 1 - action for action in drawn]
    else:
        assert space.shape is not None
        drawn = [rng.uniform(-1, 1, (size, *space.shape)).astype(np.float32) for _ in range(count)]
        opposite = [-action for action in drawn]
    return itertools.cycle([*drawn, *opposite])


def _drawn(size: int) -> int:
    """How many arrays of actions are drawn: megabytes of them, not gigabytes."""
    return min(max((1 << 22) // size, 4), 64)


def _cast(sequence: Iterator[np.ndarray], dtype: type) -> Iterator[np.ndarray]:
    """The same `actions` in numbers that a peer takes without conversion."""
    first = next(sequence)
    rest = itertools.islice(sequence, 2 * _drawn(len(first)) - 1)
    return itertools.cycle([array.astype(dtype) for array in (first, *rest)])


def _stepping(step: Callable[[Any], tuple[Any, ...]], sequence: Iterator[Any]) -> Run:
    """`Run` of a function from actions to (observations, rewards, ...)."""

    def run(steps: int) -> float:
        start = time.perf_counter()
        for action in itertools.islice(sequence, steps):
            observations, rewards, *_ = step(action)
        elapsed = time.perf_counter() - start
        assert np.isfinite(observations).all()
        assert np.isfinite(rewards).all()
        return elapsed / steps

    return run


# -- ours ------------------------------------------------------------------------------------------


def ours(name: str, env_id: str, options: Mapping[str, Any]) -> Contender:
    """Environments of this package, as `gym.make_vec` makes them with these options."""

    def make(size: int) -> Run:
        return _staggered(gym.make_vec(env_id, num_envs=size, **options), env_id)

    return Contender(name, name, make)


def sync(env_id: str) -> Contender:
    """Gymnasium's loop over our single environments."""

    def make(size: int) -> Run:
        return _staggered(gym.make_vec(env_id, num_envs=size, vectorization_mode="sync"), env_id)

    return Contender(f"SyncVectorEnv of {env_id.split('/')[-1]}", "SyncVectorEnv", make, largest=1024)


def _staggered(envs: gym.vector.VectorEnv[Any, Any, Any], env_id: str) -> Run:
    """Environments whose episodes, all of one length, end at different steps."""
    size, episode = envs.num_envs, gym.spec(env_id).max_episode_steps
    assert episode is not None
    envs.reset(seed=0)
    sequence = actions(envs.single_action_space, size)
    when = np.arange(size) * episode // size if size < episode else np.arange(size) % episode
    for moment in range(episode):
        envs.step(next(sequence))
        if (rows := when == moment).any():
            envs.reset(options={"reset_mask": rows})
    return _stepping(envs.step, sequence)


# -- peers -----------------------------------------------------------------------------------------


def cartpole(size: int) -> Run:
    """Gymnasium's CartPole in NumPy."""
    envs = gym.make_vec(CARTPOLE, num_envs=size, vectorization_mode="vector_entry_point")
    envs.reset(seed=0)
    run = _stepping(envs.step, actions(envs.single_action_space, size))
    run(CARTPOLE_WARM_UP)
    return run


def envpool(size: int, threads: int) -> Run:
    """EnvPool's CartPole in C++, synchronous."""
    import envpool as pool

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # Gymnasium's, of spaces whose bounds are rounded
        envs = pool.make(CARTPOLE, env_type="gymnasium", num_envs=size, num_threads=threads, seed=0)
        envs.reset()
    run = _stepping(envs.step, _cast(actions(gym.spaces.Discrete(2), size), np.int32))
    run(CARTPOLE_WARM_UP)
    return run


def gymnax(size: int) -> Run:
    """The CartPole of gymnax under jit, vmap and scan, with its own autoreset; all but final observations are kept."""
    with _on_one_cpu():
        import gymnax as nax
        import jax

        jax.block_until_ready(jax.numpy.zeros(1))
    env, params = nax.make(CARTPOLE)
    length = max((1 << 17) // size, 8)  # longer ones are no faster a step, and fill the memory

    def one(carry: tuple[Any, Any], _: None) -> tuple[tuple[Any, Any], tuple[Any, ...]]:
        key, state = carry
        key, drawing, stepping = jax.random.split(key, 3)
        action = jax.random.randint(drawing, (size,), 0, 2)
        step = jax.vmap(env.step, in_axes=(0, 0, 0, None))
        observation, state, *rest = step(jax.random.split(stepping, size), state, action, params)
        return (key, state), (observation, *rest[:-1])  # the last is info

    scan = jax.jit(lambda carry: jax.lax.scan(one, carry, None, length=length))
    key, start = jax.random.split(jax.random.PRNGKey(0))
    _, state = jax.vmap(env.reset, in_axes=(0, None))(jax.random.split(start, size), params)
    carry = key, state

    def run(steps: int) -> float:
        nonlocal carry
        scans = -(-steps // length)
        start = time.perf_counter()
        for _ in range(scans):
            carry, outcome = jax.block_until_ready(scan(carry))
        elapsed = time.perf_counter() - start
        assert np.isfinite(outcome[0]).all()
        return elapsed / (scans * length)

    run(CARTPOLE_WARM_UP)
    return run


@contextmanager
def _on_one_cpu() -> Iterator[None]:
    """JAX starts a thread for each CPU that it sees, once: let it see one, where the system can.

    With two threads it is up to twice as slow at 1024 environments, and a third faster at 16384.
    """
    if not hasattr(os, "sched_setaffinity"):
        yield
        return
    cpus = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {max(cpus)})
    try:
        yield
    finally:
        for thread in os.listdir("/proc/self/task"):
            os.sched_setaffinity(int(thread), cpus)


# A cart-pole without a track's end, one step of Euler's method a control period as in the others.
MUJOCO = """
<mujoco>
  <option timestep="0.02"><flag contact="disable"/></option>
  <worldbody>
    <body>
      <joint name="cart" type="slide" axis="1 0 0"/>
      <geom type="box" size=".1 .1 .1" mass="1"/>
      <body>
        <joint type="hinge" axis="0 1 0"/>
        <geom type="capsule" fromto="0 0 0 0 0 1" size=".02" mass=".1"/>
      </body>
    </body>
  </worldbody>
  <actuator><motor joint="cart" gear="10"/></actuator>
</mujoco>
"""


def mujoco(size: int) -> Run:
    """MuJoCo's batch of rollouts, one step long: physics alone, no reward and no episode ends."""
    import mujoco as mj
    from mujoco.rollout import Rollout

    model = mj.MjModel.from_xml_string(MUJOCO)
    rollout, data = Rollout(nthread=0), mj.MjData(model)
    states = np.zeros((size, mj.mj_stateSize(model, mj.mjtState.mjSTATE_FULLPHYSICS)))

    def step(controls: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        nonlocal states
        outcome, sensors = rollout.rollout(model, data, states, controls, nstep=1)
        states = outcome[:, -1]
        return states, sensors

    run = _stepping(step, _cast(actions(gym.spaces.Box(-1, 1, (1, 1)), size), np.float64))
    run(1)
    return run


PEERS: Mapping[str, tuple[Contender, ...]] = {
    "CartPoleVectorEnv": (Contender("CartPoleVectorEnv", "CartPoleVectorEnv", cartpole),),
    "gymnax": (Contender("gymnax CartPole, scan", "gymnax", gymnax),),
    "EnvPool": tuple(
        Contender(
            f"EnvPool CartPole, {threads} thread{'s' * (threads > 1)}",
            "EnvPool",
            partial(envpool, threads=threads),
            largest=1 << 14,
        )
        for threads in (1, 2)
    ),
    "MuJoCo": (Contender("MuJoCo rollout, cart-pole", "MuJoCo", mujoco, largest=1 << 14),),
}

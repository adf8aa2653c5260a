"""Errors of stepped vector environments, against `mechanics.simulate` at its tightest.

hold    one control period: from states on the way of random actions, the ones that the throughput is measured with
run     ten seconds: under the torques of random gaits, the same that are then given to `simulate`

Both are the largest over all velocities and the coordinates that the environment follows, times and environments, in
SI units and radians. Joint limits act as in the timed environments, but `simulate` has none: holds and runs that come
near one are left out.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

import mechanics
from benchmarks.peers import actions
from nhenv.env import LocomotionEnv
from training.config import GaitConfig
from training.gaits import Joints, sinusoids
from training.tuning import controller

__all__ = ["Errors", "errors"]

Array = NDArray[np.float64]

RTOL, ATOL = 1e-13, 1e-14
# One episode; the errors of holds span five decades, so take many.
HOLD_ENVS, HOLD_STEPS = 64, 299
RUNS, RUN_SECONDS = 8, 10.0
CANDIDATES = 4 * RUNS
# Within half the joints' range few gaits come near a stop.
AMPLITUDE = 0.5


@dataclass(frozen=True)
class Errors:
    """Largest errors.

    Attributes:
        hold: after one control period.
        run: within ten seconds; NaN if no gait drives this mechanism, or none stays clear of the stops.
    """

    hold: float
    run: float


def errors(env_id: str, options: Mapping[str, Any], *, runs: int = RUNS, every: int = 10) -> Errors:
    """Errors of `gym.make_vec(env_id, ..., **options)`.

    Args:
        env_id: environment.
        options: how it is made.
        runs: initial conditions and gaits.
        every: steps from one hold that is looked at to the next.
    """
    single = gym.make(env_id).unwrapped
    assert isinstance(single, LocomotionEnv)
    return Errors(_hold(single, env_id, options, every), _run(single, env_id, options, runs))


def _hold(single: LocomotionEnv, env_id: str, options: Mapping[str, Any], every: int) -> float:
    envs = gym.make_vec(env_id, num_envs=HOLD_ENVS, **options)
    envs.reset(seed=0)
    drawn = actions(envs.single_action_space, HOLD_ENVS)
    largest = 0.0
    for step, action in zip(range(HOLD_STEPS), drawn, strict=False):
        looking = step % every == every - 1
        q, qdot = _state(envs) if looking else (np.empty(0),) * 2
        envs.step(action)
        if not looking:
            continue
        for i, (q_after, qdot_after) in enumerate(zip(*_state(envs), strict=True)):
            torques = action[None, i] * single.torque_limits
            q_true, qdot_true = _simulate(single, np.array([0.0, single.dt]), q[i], qdot[i], torques)
            if _clear(single, q_true, qdot_true):
                largest = max(largest, _distance(q_after, q_true[1]), _distance(qdot_after, qdot_true[1]))
    return largest


def _run(single: LocomotionEnv, env_id: str, options: Mapping[str, Any], runs: int) -> float:
    try:
        gait = controller(gym.make(env_id), GaitConfig(), _gaits(single))
    except ValueError:  # not driven by torques on its joints
        return np.nan
    envs = gym.make_vec(env_id, num_envs=CANDIDATES, **options)
    observations, _ = envs.reset(seed=0)
    steps = round(RUN_SECONDS / single.dt)
    states, torques = [_state(envs)], []
    for _ in range(steps):
        action = gait(observations)
        torques.append(action * single.torque_limits)
        observations, *_ = envs.step(action)
        states.append(_state(envs))
    q, qdot = (np.stack(part, axis=1) for part in zip(*states, strict=True))
    clear = [i for i in range(CANDIDATES) if _clear(single, q[i], qdot[i])][:runs]
    largest = np.nan
    for i in clear:
        times = np.linspace(0, steps * single.dt, steps + 1)
        true = _simulate(single, times, q[i, 0], qdot[i, 0], np.stack(torques, axis=1)[i])
        largest = float(np.fmax(largest, max(_distance(q[i], true[0]), _distance(qdot[i], true[1]))))
    return largest


def _distance(found: Array, true: Array) -> float:
    """Largest difference; NaN is found where a coordinate is not followed."""
    return float(np.nanmax(np.abs(found - true)))


def _gaits(single: LocomotionEnv) -> Array:
    """Random gaits (N, p)."""
    joints = Joints(single)
    ranges = sinusoids(single, GaitConfig(), RUN_SECONDS).bounds
    low, high = np.asarray(ranges.lb), np.asarray(ranges.ub)
    drawn = np.random.default_rng(0).uniform(low, high, (CANDIDATES, len(low)))
    drawn[:, : len(joints.index)] *= AMPLITUDE
    return drawn


def _simulate(single: LocomotionEnv, times: Array, q: Array, qdot: Array, torques: Array) -> tuple[Array, Array]:
    """True motion (T + 1, n) and its velocities under the torques (T, m) of the holds between `times`."""

    def controls(t: float) -> Array:
        hold = int(np.searchsorted(times, t, side="right")) - 1
        return torques[min(hold, len(torques) - 1)]

    q = np.nan_to_num(q, nan=0.0)  # what is not followed makes no difference to the rest
    motion = mechanics.simulate(
        single.mechanism, times, q, qdot0=qdot, controls=controls, params=single.params, rtol=RTOL, atol=ATOL
    )
    return motion.q, motion.qdot


def _clear(single: LocomotionEnv, q: Array, qdot: Array) -> bool:
    """Whether a motion (T + 1, n) stays within the stops between its times as well: rates hardly turn in a hold."""
    for joint, stop in single.joint_limits.items():
        i = single.mechanism.coordinates.index(joint)
        if np.abs(q[:, i]).max() + single.dt * np.abs(qdot[:, i]).max() >= stop:
            return False
    return True


def _state(envs: gym.vector.VectorEnv[Any, Any, Any]) -> tuple[Array, Array]:
    """Coordinates and velocities (N, n)."""
    if isinstance(envs, gym.vector.SyncVectorEnv):
        return np.stack(envs.get_attr("q")), np.stack(envs.get_attr("qdot"))
    return envs.unwrapped.q.copy(), envs.unwrapped.qdot.copy()  # type: ignore[attr-defined]

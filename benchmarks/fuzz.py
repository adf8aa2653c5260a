"""Random episodes of any environment: whatever is thrown at it, numbers come back or a documented ValueError.

Options, parameters, resets and actions are drawn at random, bounds and what lies beyond them included: torques and
control periods over many decades, masses near zero, states anywhere, actions that are huge, tiny, infinite or not
numbers. An episode is a few steps long, as most goes wrong at once or in the step after.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from mechanics.mechanism import Mechanism
from nhenv.env import LocomotionEnv
from nhenv.vector_env import LocomotionVectorEnv

__all__ = ["ACTIONS", "Report", "check", "fuzz", "fuzz_rows", "options"]

Array = NDArray[np.float64]

STEPS = 4  # of an episode, at most
BATCH = 40  # episodes with the same options
# Elements of an action, beside those drawn evenly.
ACTIONS = (
    0.0, -0.0, 1.0, -1.0, 5e-324, -5e-324, 1e-300, 1e-45, 1.0000001, -1.5, 1e30, -1e300, np.inf, -np.inf,
)  # fmt: skip
LONG = 1e3  # s
SPEEDS = 8.0  # decades of starting velocities above and below 1
FARTHEST = 12.0  # decades of starting coordinates above 1


@dataclass
class Report:
    """What happened.

    Attributes:
        episodes, steps: how many.
        refused: calls that were answered by a documented error.
        flagged: episodes that ended by divergence.
        problems: what should not have happened, and how to see it.
    """

    episodes: int = 0
    steps: int = 0
    refused: int = 0
    flagged: int = 0
    problems: list[str] = field(default_factory=list)

    def __iadd__(self, other: Report) -> Report:
        self.episodes += other.episodes
        self.steps += other.steps
        self.refused += other.refused
        self.flagged += other.flagged
        self.problems += other.problems
        return self


def options(mechanism: Mechanism, rng: np.random.Generator) -> dict[str, Any]:
    """Random arguments of an environment, of which nothing needs a kernel of its own."""

    def decades(low: float, high: float) -> float:
        return float(10 ** rng.uniform(low, high))

    given: dict[str, Any] = {}
    if rng.random() < 0.5:  # near the bounds too: most of these are no body's, and refused
        given["params"] = {
            name: value * decades(*((-0.2, 0.2) if rng.random() < 0.7 else (-9, 9)))
            for name, value in mechanism.parameters.items()
            if rng.random() < 0.5
        }
    if rng.random() < 0.7:
        given["torque_limits"] = [
            float(rng.choice([decades(-3, 3), decades(-12, 12), 5e-324, 1e308])) for _ in mechanism.controls
        ]
    if rng.random() < 0.5:
        given["dt"] = float(rng.choice([decades(-4, 0), decades(-12, 3), 5e-324, 1e-300, LONG]))
    limits = {joint: float(rng.choice([limit, decades(-9, 2)])) for joint, limit in mechanism.joint_limits.items()}
    if limits and rng.random() < 0.5:
        given["joint_limits"] = limits
    if rng.random() < 0.5:
        smallest = min({**mechanism.joint_limits, **given.get("joint_limits", {})}.values(), default=3.0)
        given["reset_noise_scale"] = float(rng.choice([0.0, np.nextafter(smallest, 0), rng.uniform(0, smallest)]))
    elif limits:
        given["reset_noise_scale"] = 0.5 * min(0.1, *limits.values())
    if rng.random() < 0.3:
        given["ctrl_cost_weight"] = float(rng.choice([0.0, -1.0, decades(-9, 9)]))
    return given


def check(env: gym.Env[Any, Any], observation: Any, reward: Any = 0.0, info: Mapping[str, Any] | None = None) -> str:
    """What is wrong with what an environment returned, or nothing."""
    space = env.observation_space
    if type(observation) is not np.ndarray or observation.dtype != np.float32 or not space.contains(observation):
        return f"observation {observation!r} is not in {space}"
    if not np.isfinite(observation).all():
        return f"observation {observation!r} is not finite"
    if not (type(reward) is float and np.isfinite(reward)):
        return f"reward {reward!r}"
    numbers = {key: value for key, value in (info or {}).items() if not np.isfinite(value)}
    return f"info {numbers!r}" if numbers else ""


def _action(rng: np.random.Generator, shape: tuple[int, ...], *, numbers: bool = False) -> Array:
    """Actions of any kind; with `numbers`, none that is not a number."""
    drawn = rng.uniform(-1.5, 1.5, shape)
    strange = rng.choice(ACTIONS if numbers or rng.random() < 0.8 else (*ACTIONS, np.nan), shape)
    action = np.where(rng.random(shape) < 0.4, strange, drawn)
    with np.errstate(over="ignore"):
        return action.astype(np.float32) if rng.random() < 0.5 else action


def _start(env: LocomotionEnv, rng: np.random.Generator) -> dict[str, Any]:
    """Options of a reset: a state anywhere, perhaps one that is refused."""
    mechanism = env.mechanism
    size = 10 ** rng.uniform(-SPEEDS, FARTHEST) if rng.random() < 0.3 else 1.0
    q = rng.uniform(-size, size, mechanism.n)
    for joint, limit in env.joint_limits.items():
        place = mechanism.coordinates.index(joint)
        if rng.random() < 0.9:
            q[place] = rng.choice([limit, -limit, np.clip(q[place], -limit, limit), limit * rng.uniform(-1, 1)])
    if rng.random() < 0.3:
        return {"q": q}
    speed = 10 ** rng.uniform(-SPEEDS, SPEEDS) if rng.random() < 0.5 else 1.0
    with np.errstate(all="ignore"):
        qdot = env._model.velocity(q, rng.uniform(-speed, speed, mechanism.rank))
    return {"q": q, "qdot": qdot}


def fuzz(env_id: str, episodes: int, seed: int = 0, **fixed: Any) -> Report:
    """Episodes of single environments, with options drawn anew now and then, beside some that are `fixed`."""
    report, rng = Report(), np.random.default_rng([seed, *env_id.encode()])
    mechanism = gym.make(env_id, **fixed).unwrapped.mechanism  # type: ignore[attr-defined]
    while report.episodes < episodes:
        given = {**options(mechanism, rng), **fixed}
        try:
            env = gym.make(env_id, **given)
        except ValueError:  # parameters of no body
            report.refused += 1
            continue
        for _ in range(min(BATCH, episodes - report.episodes)):
            report.episodes += 1
            story = [f"env = gym.make({env_id!r}, **{given!r})"]
            try:
                problem = _episode(env, rng, report, story)
            except Exception as error:  # noqa: BLE001 (whatever it is, it is a finding)
                problem = f"{type(error).__name__}: {error}"
            if problem:
                report.problems.append(f"{problem}: {'; '.join(story)}")
        env.close()
    return report


def _episode(env: gym.Env[Any, Any], rng: np.random.Generator, report: Report, story: list[str]) -> str:
    """One episode; what was wrong with it, or nothing."""
    bare = env.unwrapped
    assert isinstance(bare, LocomotionEnv)
    seed = int(rng.integers(2**32))
    start = _start(bare, rng) if rng.random() < 0.5 else None
    story.append(f"env.reset(seed={seed}, options={_plain(start)})")
    try:
        observation, info = env.reset(seed=seed, options=start)
    except ValueError:  # beyond a stop, or a velocity that rounding takes off the constraints
        report.refused += 1
        observation, info = env.reset(seed=seed)
        story[-1] = f"env.reset(seed={seed})"
    if problem := check(env, observation, 0.0, info):
        return problem
    for _ in range(int(rng.integers(1, STEPS + 1))):
        action = _action(rng, env.action_space.shape or ())
        story.append(f"env.step(np.array({action.tolist()}, np.{action.dtype}))")
        report.steps += 1
        try:
            observation, reward, terminated, _, info = env.step(action)
        except ValueError:
            if not np.isnan(action).any():
                raise
            report.refused += 1
            continue
        if problem := check(env, observation, reward, info):
            return problem
        if info.get("diverged"):
            report.flagged += 1
            if not terminated:
                return "diverged, but not terminated"
        if terminated:
            break
    state = [*bare.q, *bare.v]
    return "" if np.isfinite(state).all() else f"state {state}"


def _plain(start: dict[str, Any] | None) -> dict[str, Any] | None:
    return None if start is None else {key: value.tolist() for key, value in start.items()}


def fuzz_rows(
    env_id: str, episodes: int, seed: int = 0, rows: int = 500, tick: Callable[[int], None] | None = None, **fixed: Any
) -> Report:
    """Episodes of a vector environment, each row with parameters and torque limits of its own.

    Args:
        env_id: environment.
        episodes: at least so many.
        seed: of everything.
        rows: side by side.
        tick: told of every number of episodes that are done.
        **fixed: options.
    """
    report, rng = Report(), np.random.default_rng([seed, *env_id.encode()])
    single = gym.make(env_id, **fixed).unwrapped
    assert isinstance(single, LocomotionEnv)
    mechanism = single.mechanism
    params: dict[str, list[float]] = {name: [] for name in mechanism.parameters}
    while len(params[next(iter(params))]) < rows:
        own = {**mechanism.parameters, **options(mechanism, rng).get("params", {})}
        try:
            mechanism.resolve(own)
            single._configuration.numbers(own, None)
        except ValueError:
            report.refused += 1
            continue
        for name, values in params.items():
            values.append(own[name])
    envs = LocomotionVectorEnv(
        mechanism, single.task, num_envs=rows, autoreset_mode="SameStep", info="all", max_episode_steps=STEPS,
        params={name: np.array(values) for name, values in params.items()},
        torque_limits={name: 10 ** rng.uniform(-9, 9, rows) for name in mechanism.controls}, **fixed,
    )  # fmt: skip
    observations, infos = envs.reset(seed=seed)
    before = "reset"
    while report.episodes < episodes:
        if problem := _rows_problem(envs, observations, infos):
            report.problems.append(f"{env_id}, {fixed}, seed {seed}, {before}: {problem}")
            break
        if rng.random() < 0.2:
            mask = rng.random(rows) < 0.2
            mask[0] = True
            observations, infos = envs.reset(options={"reset_mask": mask})
            report.episodes += int(mask.sum())
            before = f"masked reset after {report.steps} steps"
            continue
        actions = _action(rng, envs.action_space.shape or ())
        observations, rewards, terminated, truncated, infos = envs.step(actions)
        before = f"after {report.steps} steps"
        done = terminated | truncated
        report.steps += rows
        report.episodes += int(done.sum())
        last = infos.get("final_info", {})
        report.flagged += int(np.sum(last.get("diverged", 0)))
        if not np.isfinite(rewards).all():
            row = int(np.flatnonzero(~np.isfinite(rewards))[0])
            own = {name: values[row] for name, values in params.items()}
            report.problems.append(f"{env_id}, {fixed}, {before}: reward {rewards[row]} of row {row}, {own}")
            break
        if tick is not None:
            tick(int(done.sum()))
    envs.close()
    return report


def _rows_problem(envs: LocomotionVectorEnv, observations: Any, infos: Mapping[str, Any]) -> str:
    if not (observations.dtype == np.float32 and envs.observation_space.contains(observations)):
        return "observations are not in their space"
    if not np.isfinite(observations).all():
        return f"observations of rows {np.flatnonzero(~np.isfinite(observations).all(axis=1))[:5]} are not finite"
    for where in (infos, infos.get("final_info", {})):
        for key, values in where.items():
            if isinstance(values, np.ndarray) and values.dtype != object and not np.isfinite(values).all():
                return f"{key} is not finite in rows {np.flatnonzero(~np.isfinite(values))[:5]}"
    for values in infos.get("final_obs", ()):
        if values is not None and not np.isfinite(values).all():
            return f"a last observation is {values}"
    return ""

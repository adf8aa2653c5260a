"""Errors of the environments' default settings: of single holds, and of ten seconds.

hold    from states that policies reach in 15 s, with joint stops and without, one hold; holds that come near a stop
        are left out, because the reference has none
run     ten seconds without stops under the same policies. Open loop, the reference gets the same torques; closed
        loop, the policy acts on the state of the reference there, and on that of the environment here. Beside the
        error stands the amplification: how much 1e-8 in the first angle of the joint grows, the policy acting.

Errors are the largest over all coordinates and velocities, in SI units and radians; actions are float64, of which
nothing is rounded.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from benchmarks.motions import DT, MECHANISMS, POLICIES, Law, Policy, configuration, starts
from benchmarks.reference import Reference
from nhenv.configuration import Configuration

__all__ = ["HoldErrors", "RunErrors", "hold_errors", "run_errors"]

Array = NDArray[Any]

EPISODE = 300  # holds
MARGIN = 0.01  # rad; the way of a joint within a hold is known to less
CHUNK = 4096  # states that the reference integrates at once
PERTURBATION = 1e-8  # rad
WITHOUT_STOPS = ("constant torque",)  # spins the snakeboard's axles at 500 rad/s after 10 s: not in runs


@dataclass(frozen=True)
class HoldErrors:
    """Of one policy.

    Attributes:
        policy: its name.
        stops: whether the joint had stops.
        errors: of each hold looked at.
        rate: largest rate of a coordinate at the beginning of these, in SI units.
        left_out: share of holds that came near a stop.
    """

    policy: str
    stops: bool
    errors: NDArray[np.float64]
    rate: float
    left_out: float


@dataclass(frozen=True)
class RunErrors:
    """Of one policy.

    Attributes:
        policy: its name.
        closed: whether it looks at the state.
        errors: of each run.
        amplification: of each run.
    """

    policy: str
    closed: bool
    errors: NDArray[np.float64]
    amplification: NDArray[np.float64]


def hold_errors(
    mechanism: str, stops: bool, options: Mapping[str, Any], rows: int = 64, every: int = 20
) -> list[HoldErrors]:
    """Errors of single holds of `rows` environments for each policy, every so many holds of an episode."""
    single = configuration(mechanism)
    reference = Reference(single.mechanism)
    found = []
    for policy in POLICIES:
        before, after, torques = _visited(single, policy, stops, options, rows, every)
        q, qdot = _held(reference, before, torques)
        near = _near(single, before, (q, qdot)) if stops else np.zeros(len(q), bool)
        errors = np.maximum(_distance(after[0], q), _distance(after[1], qdot))[~near]
        rate = float(np.abs(before[1][~near]).max(initial=0.0))
        found.append(HoldErrors(policy.name, stops, errors, rate, float(near.mean())))
    return found


def run_errors(mechanism: str, options: Mapping[str, Any], count: int = 8, seconds: float = 10.0) -> list[RunErrors]:
    """Errors of `count` runs for each policy."""
    single = configuration(mechanism)
    holds, size = round(seconds / DT), count * len(_policies())
    q, qdot = starts(mechanism, size, np.random.default_rng(1))
    envs = _envs(mechanism, size, False, options)
    envs.reset(options={"q": q, "qdot": qdot})
    bare: Any = envs.unwrapped
    law, states = _laws(single, count), [(bare.q, bare.qdot)]
    for hold in range(holds):
        envs.step(law(hold, *states[-1]))
        states.append((bare.q, bare.qdot))
    own = [np.stack(part) for part in zip(*states, strict=True)]
    shifted = q.copy()
    shifted[:, _joint(single)] += PERTURBATION
    # The motion, and its neighbour, each with policies of its own.
    laws = _laws(single, count), _laws(single, count)

    def torques(hold: int, q: Array, qdot: Array) -> Array:
        both = [
            law(hold, *(part.astype(float)[i * size : (i + 1) * size] for part in (q, qdot)))
            for i, law in enumerate(laws)
        ]
        return np.concatenate(both) * single.torque_limits

    true = Reference(single.mechanism).motion(
        np.concatenate([q, shifted]), np.concatenate([qdot, qdot]), torques, DT, holds
    )
    error, growth = (
        np.maximum(*(np.abs(a - b[:, :size]).max(axis=(0, 2)).astype(float) for a, b in zip(states, true, strict=True)))
        for states in (own, [part[:, size:] for part in true])
    )
    found = []
    for i, policy in enumerate(_policies()):
        part = slice(i * count, (i + 1) * count)
        amplification = growth[part] / PERTURBATION
        found.append(RunErrors(policy.name, policy.closed, error[part], amplification))
    return found


# -- environments ----------------------------------------------------------------------------------


def _envs(mechanism: str, size: int, stops: bool, options: Mapping[str, Any]) -> gym.vector.VectorEnv[Any, Any, Any]:
    never: dict[str, Any] = {"max_episode_steps": None}
    return gym.make_vec(MECHANISMS[mechanism], num_envs=size, joint_limits=stops, whole_state=True, **never, **options)


def _visited(
    single: Configuration, policy: Policy, stops: bool, options: Mapping[str, Any], rows: int, every: int
) -> tuple[tuple[Array, Array], tuple[Array, Array], Array]:
    """States before and after the holds that are looked at, (N, n), and the torques (N, m) in them."""
    envs = _envs(single.mechanism.name, rows, stops, options)
    envs.reset(seed=0)
    bare: Any = envs.unwrapped
    law = policy.make(rows, len(single.mechanism.controls), np.random.default_rng(2))
    kept = []
    for hold in range(EPISODE):
        q, qdot = bare.q, bare.qdot
        action = law(hold, *_driven(single, q, qdot))
        envs.step(action)
        if hold % every == every - 1:
            kept.append((q, qdot, bare.q, bare.qdot, action * single.torque_limits))
    q, qdot, q_after, qdot_after, torques = (np.concatenate(part) for part in zip(*kept, strict=True))
    return (q, qdot), (q_after, qdot_after), torques


def _policies() -> list[Policy]:
    """Those of runs."""
    return [policy for policy in POLICIES if policy.name not in WITHOUT_STOPS]


def _laws(single: Configuration, count: int) -> Law:
    """All policies side by side, `count` rows of each, in terms of coordinates and velocities (N, n)."""
    m = len(single.mechanism.controls)
    laws = [policy.make(count, m, np.random.default_rng([3, i])) for i, policy in enumerate(_policies())]

    def law(hold: int, q: Array, qdot: Array) -> Array:
        angle, rate = _driven(single, q, qdot)
        parts = [slice(i * count, (i + 1) * count) for i in range(len(laws))]
        return np.concatenate([law(hold, angle[part], rate[part]) for law, part in zip(laws, parts, strict=True)])

    return law


def _driven(single: Configuration, q: Array, qdot: Array) -> tuple[Array, Array]:
    """Angles and rates (N, m) of the coordinates that the controls, "u_" and a name, drive."""
    places = [single.mechanism.coordinates.index(name.removeprefix("u_")) for name in single.mechanism.controls]
    return q[:, places], qdot[:, places]


def _joint(single: Configuration) -> int:
    return single.mechanism.coordinates.index(next(iter(single.joint_limits)))


# -- truth -----------------------------------------------------------------------------------------


def _held(reference: Reference, before: tuple[Array, Array], torques: Array) -> tuple[Array, Array]:
    """Coordinates and velocities (N, n) a hold later."""
    q, qdot = reference.start(*before)
    parts = [slice(first, first + CHUNK) for first in range(0, len(q), CHUNK)]
    after = [reference.hold(q[part], qdot[part], torques[part], DT)[:2] for part in parts]
    return np.concatenate([part[0] for part in after]), np.concatenate([part[1] for part in after])


def _near(single: Configuration, before: tuple[Array, Array], after: tuple[Array, Array]) -> NDArray[np.bool_]:
    """Whether a joint comes near its stop, on the cubic through both ends (N,)."""
    s = np.linspace(0, 1, 21)[:, None]
    near = np.zeros(len(before[0]), bool)
    for joint, stop in single.joint_limits.items():
        i = single.mechanism.coordinates.index(joint)
        (a, b), (da, db) = ((before[k][:, i], after[k][:, i].astype(float)) for k in (0, 1))
        way = a * (1 + 2 * s) * (1 - s) ** 2 + b * s**2 * (3 - 2 * s)
        way = way + DT * (da * s * (1 - s) ** 2 - db * s**2 * (1 - s))
        near |= np.abs(way).max(axis=0) > stop - MARGIN
    return near


def _distance(found: Array, true: Array) -> NDArray[np.float64]:
    return np.abs(found - true).max(axis=1).astype(float)

"""Single holds of the environments against `benchmarks.multipliers`, however extreme, one by one and side by side.

A hold is "held" if its error stays within the bound, "flagged" if the environment says that it diverged or refuses to
begin, "unchecked" if it is too fast for the reference and keeps its energy, and "FAILED" in every other case: an error
beyond the bound and nothing said, a number that is not finite, an energy that is not what the torques did, a joint
beyond its stop, a row of many that is not what the single environment is, a hold that is not what its parts are.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

import mechanics
from benchmarks.multipliers import Motion, Multipliers
from mechanics.mechanism import Mechanism, MechanismError
from nhenv.env import LocomotionEnv
from nhenv.vector_env import LocomotionVectorEnv

__all__ = ["BOUND", "CROSSING", "FAILED", "FLAGGED", "HELD", "UNCHECKED", "Hold", "Outcome", "judge"]

Array = NDArray[np.float64]

HELD, FLAGGED, UNCHECKED, FAILED = "held", "flagged", "unchecked", "FAILED"

# Of a state's error over 1 + |state| after one hold; times what the motion itself makes of a change of its start.
BOUND = 1e-9
# Energy less work, of the energies that were there: where there is nothing else to judge by, and where that is enough
# to call it wrong.
BALANCE, GROSS = 1e-8, 1e-3
CROSSING = 1e-12  # rad beyond a stop
# A change of the start, over 1 + |state|, and in how many directions, to see how it grows.
NUDGE, NUDGES = 1e-8, 3
PARTS = 64  # of a hold, where there is no reference
SHORTEST = 8  # steps of the reference where there are stops


@dataclass(frozen=True)
class Hold:
    """One control period.

    Attributes:
        mechanism: name.
        q: coordinates at the start, shape (n,).
        qdot: velocities, shape (n,), of which what violates the constraints is taken away.
        torques: held, shape (m,).
        params: those that are not the default.
        dt: control period in s.
        stops: whether joint limits act.
        options: other arguments of the environment.
        digits: of the reference; None for long doubles.
    """

    mechanism: str
    q: Sequence[float]
    qdot: Sequence[float]
    torques: Sequence[float]
    params: Mapping[str, float] = field(default_factory=dict)
    dt: float = 0.05
    stops: bool = False
    options: Mapping[str, Any] = field(default_factory=dict)
    digits: int | None = None

    @property
    def scene(self) -> tuple[Any, ...]:
        """What holds that can be done side by side have in common."""
        return self.mechanism, self.dt, self.stops, tuple(sorted(self.options.items())), self.digits

    @property
    def limits(self) -> list[float]:
        """Torque limits with which the actions are -1, 0 and 1."""
        return [float(abs(torque)) or 1.0 for torque in self.torques]

    @property
    def action(self) -> NDArray[np.float32]:
        """Action, shape (m,)."""
        return np.sign(self.torques).astype(np.float32)

    @property
    def arguments(self) -> dict[str, Any]:
        """What the environment is made with."""
        params = {name: float(value) for name, value in self.params.items()}
        return {
            "params": params, "dt": self.dt, "torque_limits": self.limits, "joint_limits": self.stops,
            "whole_state": True, **self.options,
        }  # fmt: skip

    def script(self, qdot: ArrayLike) -> str:
        """What reproduces it, where q̇ satisfies the constraints."""
        arguments = "".join(f", {name}={value!r}" for name, value in self.arguments.items())
        start = {"q": list(map(float, self.q)), "qdot": np.asarray(qdot, float).tolist()}
        return (
            f"env = LocomotionEnv({self.mechanism!r}{arguments}); env.reset(options={start}); "
            f"print(env.step(np.array({self.action.tolist()}, np.float32)), env.q, env.qdot)"
        )


@dataclass(frozen=True)
class Outcome:
    """What came of a hold.

    Attributes:
        verdict: HELD, FLAGGED, UNCHECKED or FAILED.
        error: largest of all coordinates and velocities, over 1 + |value|; NaN if it is not known.
        bound: what it may be.
        why: what failed, in words, and how to see it.
    """

    verdict: str
    error: float
    bound: float
    why: str = ""


def judge(holds: Sequence[Hold], *, vector: bool = True) -> list[Outcome]:
    """What comes of each of some holds; those of one scene are done side by side too, unless not wanted."""
    scenes: dict[tuple[Any, ...], list[int]] = {}
    for i, hold in enumerate(holds):
        scenes.setdefault(hold.scene, []).append(i)
    outcomes: dict[int, Outcome] = {}
    for chosen in scenes.values():
        outcomes |= dict(zip(chosen, _Scene([holds[i] for i in chosen]).outcomes(vector=vector), strict=True))
    return [outcomes[i] for i in range(len(holds))]


@cache
def reference(mechanism: str, digits: int | None) -> Multipliers:
    """The stranger, derived once."""
    return Multipliers(mechanics.get(mechanism), digits)


def scaled(difference: ArrayLike, value: ArrayLike) -> Array:
    """Largest difference (N,) over 1 + |value| of arrays (N, d)."""
    found = np.abs(np.asarray(difference)) / (1 + np.abs(np.asarray(value)))
    with np.errstate(over="ignore"):  # from long doubles
        return np.asarray(found, float).max(axis=1)


class _Scene:
    """Holds of one scene: what the environment makes of them, and what is true."""

    def __init__(self, holds: list[Hold]) -> None:
        self.holds, self.first = holds, holds[0]
        self.mechanism: Mechanism = mechanics.get(self.first.mechanism)
        self.truth = reference(self.first.mechanism, self.first.digits)
        defaults = self.mechanism.parameters
        self.params = {name: np.array([h.params.get(name, value) for h in holds]) for name, value in defaults.items()}
        self.torques = np.array([hold.torques for hold in holds], float)
        q = np.array([hold.q for hold in holds], float)
        self.qdot = self.truth.feasible(q, np.array([hold.qdot for hold in holds], float), self.params).astype(float)
        self.start, self.end = (np.concatenate([q, self.qdot], axis=1) for _ in range(2))
        self.flagged, self.begun = np.zeros(len(holds), bool), np.zeros(len(holds), bool)
        self.odd = [""] * len(holds)
        self.limit: float | None = None
        for i in range(len(holds)):
            self._step(i)

    def _step(self, i: int) -> None:
        hold = self.holds[i]
        try:
            env = LocomotionEnv(hold.mechanism, **hold.arguments)
            with np.errstate(all="ignore"):
                env.reset(options={"q": hold.q, "qdot": self.qdot[i]})
        except MechanismError:  # a pole of the frame, or parameters that no body has
            self.flagged[i] = True
            return
        self.begun[i] = True
        (self.limit,) = env.joint_limits.values() if hold.stops else (None,)
        self.start[i] = np.concatenate([env.q, env.qdot])
        observation, reward, terminated, _, info = env.step(hold.action)
        self.end[i] = np.concatenate([env.q, env.qdot])
        self.flagged[i] = bool(info.get("diverged", False))
        if not np.isfinite([*observation, reward, *info.values(), *self.end[i]]).all():
            self.odd[i] = "not finite"
        elif self.flagged[i] and not terminated:
            self.odd[i] = "diverged, but not terminated"
        elif self.limit is not None and self._angle(self.end[i]) > self.limit + CROSSING:
            self.odd[i] = "beyond the stop"

    def _angle(self, state: Array) -> float:
        (joint,) = self.mechanism.joint_limits
        return float(abs(state[self.mechanism.coordinates.index(joint)]))

    def outcomes(self, *, vector: bool) -> list[Outcome]:
        """A verdict for each hold."""
        count = len(self.holds)
        if vector:
            for i in self._unlike():
                self.odd[i] = self.odd[i] or "a row of many does not do the same"
        balance = self._balance()
        error, bound = np.full(count, np.nan), np.full(count, BOUND)
        good = ~self.flagged & np.array([not odd for odd in self.odd])
        chosen = np.flatnonzero(good & (np.abs(balance) <= GROSS))
        if len(chosen):
            error[chosen] = self._errors(chosen)
            loud = chosen[error[chosen] > BOUND]
            if len(loud):
                bound[loud] *= np.maximum(1, self._amplified(loud))
        outcomes = []
        for i in range(count):
            why, verdict = self.odd[i], FLAGGED if self.flagged[i] else HELD
            if good[i]:
                if not abs(balance[i]) <= (BALANCE if np.isnan(error[i]) else GROSS):
                    why = f"energy less work is {balance[i]:.1e} of the energy"
                elif error[i] > bound[i]:
                    why = f"wrong by {error[i]:.1e}, beyond {bound[i]:.1e}"
                elif np.isnan(error[i]):
                    verdict = UNCHECKED
                    if (apart := self._split(i)) > GROSS:
                        why = f"too fast for the reference, and {apart:.1e} from where {PARTS} shorter holds lead"
            if why:
                verdict, why = FAILED, f"{why}: {self.holds[i].script(self.qdot[i])}"
            outcomes.append(Outcome(verdict, float(error[i]), float(bound[i]), why))
        return outcomes

    def _split(self, i: int) -> float:
        """How far from its end shorter holds lead; 0 if they diverge."""
        hold, n = self.holds[i], self.mechanism.n
        env = LocomotionEnv(hold.mechanism, **{**hold.arguments, "dt": hold.dt / PARTS})
        env.reset(options={"q": self.start[i, :n], "qdot": self.qdot[i]})
        for _ in range(PARTS):
            if env.step(hold.action)[2]:
                return 0.0
        return float(scaled(self.end[i, None, :n] - env.q, env.q[None])[0])

    def _balance(self) -> Array:
        """Energy less work over the largest energy that was there, (N,); what impacts take does not count."""
        n = self.mechanism.n
        before, after = (
            np.asarray(self.truth.energy(state[:, :n], state[:, n:], self.params), float)
            for state in (self.start, self.end)
        )
        at = {**self.mechanism.parameters, **dict.fromkeys(self.mechanism.coordinates, 0.0)}
        forms = np.array(
            self.mechanism.numeric(tuple(self.mechanism.forces.values()), at)
        )  # constant in both mechanisms
        work = self.torques * ((self.end - self.start)[:, :n] @ forms.T)
        size = np.maximum(np.abs(work).max(axis=1), np.maximum(before, after))
        balance = (after - before - work.sum(axis=1)) / np.where(size > 0, size, 1)
        return balance if self.limit is None else np.maximum(balance, 0)

    def _errors(self, chosen: NDArray[np.int64]) -> Array:
        motion = self._follow(chosen, self.start[chosen])
        true = np.concatenate([motion.q, motion.qdot], axis=1)
        return np.where(motion.resolved, scaled(self.end[chosen] - true, true), np.nan)

    def _follow(self, chosen: NDArray[np.int64], start: Array) -> Motion:
        """The true motion of the chosen holds from some states."""
        n, steps = self.mechanism.n, SHORTEST if self.first.stops else 0
        params = {name: values[chosen] for name, values in self.params.items()}
        return self.truth.hold(
            start[:, :n], start[:, n:], self.torques[chosen], self.first.dt, params, limit=self.limit, shortest=steps
        )

    def _amplified(self, chosen: NDArray[np.int64]) -> Array:
        """How many times a change of the state at the start is as large at the end, (N,)."""
        n, count, rng = self.mechanism.n, len(chosen), np.random.default_rng(0)
        many = np.tile(chosen, NUDGES + 1)
        start = np.tile(self.start[chosen], (NUDGES + 1, 1))
        nudge = NUDGE * (1 + np.abs(start)) * rng.choice([-1.0, 1.0], start.shape)
        nudge[:count] = 0
        nudge[:, [self.mechanism.coordinates.index(name) for name in self.mechanism.fibre]] = 0  # as it changes nothing
        start = start + nudge
        params = {name: values[many] for name, values in self.params.items()}
        start[:, n:] = self.truth.feasible(start[:, :n], start[:, n:], params).astype(float)
        motion = self._follow(many, start)
        end = np.concatenate([motion.q, motion.qdot], axis=1)
        growth = scaled(end - np.tile(end[:count], (NUDGES + 1, 1)), end) / np.maximum(
            scaled(start - np.tile(start[:count], (NUDGES + 1, 1)), start), NUDGE
        )
        return np.nan_to_num(growth.reshape(NUDGES + 1, count).max(axis=0), nan=1.0)

    def _unlike(self) -> NDArray[np.int64]:
        """Which holds the vector environment does otherwise."""
        begun, n = np.flatnonzero(self.begun), self.mechanism.n
        if not len(begun):
            return begun
        limits = np.array([self.holds[i].limits for i in begun]).T
        arguments = {
            **self.first.arguments,
            "params": {name: values[begun] for name, values in self.params.items()},
            "torque_limits": dict(zip(self.mechanism.controls, limits, strict=True)),
        }
        envs = LocomotionVectorEnv(self.mechanism, num_envs=len(begun), autoreset_mode="Disabled", **arguments)
        envs.reset(options={"q": self.start[begun, :n], "qdot": self.qdot[begun]})
        actions = np.stack([self.holds[i].action for i in begun])
        _, _, terminated, _, infos = envs.step(actions)
        diverged = np.asarray(infos.get("diverged", np.zeros(len(begun), bool)), bool)
        same = (envs.q == self.end[begun, :n]).all(axis=1) & (diverged == self.flagged[begun])
        envs.close()
        return begun[~same | (diverged & ~terminated)]

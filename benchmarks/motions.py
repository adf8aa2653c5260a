"""Motions whose errors are looked at: starting states, torques, and the policies that lead to states.

Actions are float32, as environments take them, and torques are what environments make of them: nobody's torque is
rounded in another way.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mechanics.model import Model
from nhenv.configuration import Configuration

__all__ = ["DT", "MECHANISMS", "POLICIES", "Law", "Policy", "Problem", "configuration", "problem", "starts"]

Array = NDArray[np.float64]

# Mechanism -> the environment that moves it.
MECHANISMS = {"snakeboard": "nhenv/SnakeboardForward-v0", "roller_racer": "nhenv/RollerRacerForward-v0"}

DT = 0.05  # s, of a hold
# Square waves of 8 to 12 holds at full torque: the snakeboard's wheels swing by 0.5 to 1.1 rad to each side.
QUARTERS = (2, 3)  # holds


@dataclass(frozen=True)
class Problem:
    """Motions of one mechanism with known torques.

    Attributes:
        mechanism: its name.
        q, qdot: states at the beginning, (B, n).
        actions: of each hold, (T, B, m), float32.
        torques: in N m, (T, B, m).
        kinds: of torque, (B,).
        dt: length of a hold in s.
    """

    mechanism: str
    q: Array
    qdot: Array
    actions: NDArray[np.float32]
    torques: Array
    kinds: tuple[str, ...]
    dt: float = DT

    @property
    def env_id(self) -> str:
        """Environment that moves it."""
        return MECHANISMS[self.mechanism]

    @property
    def holds(self) -> int:
        """Number T of holds."""
        return len(self.actions)

    @property
    def count(self) -> int:
        """Number B of motions."""
        return len(self.q)

    @property
    def seconds(self) -> float:
        """Length of a motion."""
        return self.holds * self.dt


def configuration(mechanism: str) -> Configuration:
    """The numbers of a mechanism's environment; nothing is compiled."""
    return Configuration(mechanism)


def starts(mechanism: str, count: int, rng: np.random.Generator) -> tuple[Array, Array]:
    """Random states (B, n): anywhere, any heading, joints bent by up to 0.5 rad, moving at up to 0.3 of each field."""
    single = configuration(mechanism)
    model = Model(single.mechanism, single.params)
    n, k = single.mechanism.n, single.mechanism.rank
    q = rng.uniform(-np.pi, np.pi, (count, n))
    for joint in single.mechanism.joint_limits:
        q[:, single.mechanism.coordinates.index(joint)] = rng.uniform(-0.5, 0.5, count)
    return q, model.velocity(q, rng.uniform(-0.3, 0.3, (count, k)))


def problem(mechanism: str, conditions: int = 8, seconds: float = 10.0, seed: int = 0) -> Problem:
    """Motions from several initial conditions, each under a smooth torque that is held, and under bang-bang torque.

    held        A cos(2π f t) at the middle of each hold, A 0.3 to 0.6 of the limit, f 0.8 to 1.2 Hz
    bang-bang   the limit, with the sign of cos(2π f t), which changes at ends of holds
    """
    rng = np.random.default_rng(seed)
    single = configuration(mechanism)
    q, qdot = starts(mechanism, conditions, rng)
    m, holds = len(single.mechanism.controls), round(seconds / DT)
    hold = np.arange(holds)[:, None, None]
    sign = rng.choice([-1.0, 1.0], (conditions, m))
    amplitude, frequency = rng.uniform(0.3, 0.6, (conditions, m)), rng.uniform(0.8, 1.2, (conditions, m))
    held = sign * amplitude * np.cos(2 * np.pi * frequency * (hold + 0.5) * DT)
    quarter = rng.choice(QUARTERS, (conditions, m))
    bang = sign * np.where((hold + quarter) // (2 * quarter) % 2, -1.0, 1.0)
    actions = np.concatenate([held, bang], axis=1).astype(np.float32)
    return Problem(
        mechanism,
        np.tile(q, (2, 1)),
        np.tile(qdot, (2, 1)),
        actions,
        actions.astype(float) * single.torque_limits,
        ("held",) * conditions + ("bang-bang",) * conditions,
    )


# -- policies --------------------------------------------------------------------------------------

# Number of the hold, angles and rates (N, m) of the coordinates that the controls drive -> actions (N, m) in [-1, 1].
Law = Callable[[int, Array, Array], Array]


@dataclass(frozen=True)
class Policy:
    """What decides on actions, for N rows with numbers of their own.

    Attributes:
        name: as tables print it.
        closed: whether it looks at the state.
        make: (N, m, generator) -> its law.
    """

    name: str
    closed: bool
    make: Callable[[int, int, np.random.Generator], Law]


def _random(rows: int, controls: int, rng: np.random.Generator) -> Law:
    return lambda hold, angle, rate: rng.uniform(-1, 1, (rows, controls))


def _bang_bang(rows: int, controls: int, rng: np.random.Generator) -> Law:
    often = rng.choice([1.0, 0.5, 0.2, 0.1], (rows, 1))
    action = rng.choice([-1.0, 1.0], (rows, controls))

    def law(hold: int, angle: Array, rate: Array) -> Array:
        drawn = rng.choice([-1.0, 1.0], (rows, controls))
        action[:] = np.where(rng.uniform(size=(rows, controls)) < often, drawn, action)
        return action.copy()

    return law


def _sinusoid(rows: int, controls: int, rng: np.random.Generator) -> Law:
    amplitude, frequency = rng.uniform(0.2, 1, (rows, controls)), rng.uniform(0.3, 3, (rows, controls))
    phase = rng.uniform(0, 2 * np.pi, (rows, controls))
    return lambda hold, angle, rate: amplitude * np.sin(2 * np.pi * frequency * hold * DT + phase)


def _constant(rows: int, controls: int, rng: np.random.Generator) -> Law:
    action = rng.choice([-1.0, -0.5, 0.5, 1.0], (rows, controls))
    return lambda hold, angle, rate: action


def _resonant(rows: int, controls: int, rng: np.random.Generator) -> Law:
    # Pushes the way that the joint moves, until it is far out: swings as wide and as fast as the torque allows.
    turn = rng.uniform(0.3, 1.1, (rows, controls))
    begun = rng.choice([-1.0, 1.0], (rows, controls))
    return lambda hold, angle, rate: np.where(np.abs(angle) > turn, -np.sign(angle), np.sign(rate + 1e-9 * begun))


def _relay(rows: int, controls: int, rng: np.random.Generator) -> Law:
    lead = rng.choice([0.0, 0.05, 0.2], (rows, 1))  # s; without any the swings grow
    middle = rng.uniform(-0.5, 0.5, (rows, controls))
    return lambda hold, angle, rate: np.sign(middle - angle - lead * rate)


def _tracking(rows: int, controls: int, rng: np.random.Generator) -> Law:
    # A joint follows a sinusoid, saturated now and then; it looks ahead enough for that not to make swings of its own.
    amplitude, frequency = rng.uniform(0.2, 0.7, (rows, controls)), rng.uniform(0.5, 1.5, (rows, controls))
    phase = rng.uniform(0, 2 * np.pi, (rows, controls))

    def law(hold: int, angle: Array, rate: Array) -> Array:
        turn = 2 * np.pi * frequency * hold * DT + phase
        wanted, wanted_rate = amplitude * np.sin(turn), 2 * np.pi * frequency * amplitude * np.cos(turn)
        return np.clip(1.5 * (wanted - angle) + 0.25 * (wanted_rate - rate), -1, 1)

    return law


POLICIES = (
    Policy("random actions", False, _random),
    Policy("random bang-bang", False, _bang_bang),
    Policy("sinusoids", False, _sinusoid),
    Policy("constant torque", False, _constant),
    Policy("resonant", True, _resonant),
    Policy("relay", True, _relay),
    Policy("tracking", True, _tracking),
)

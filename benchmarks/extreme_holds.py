"""What is tried: families of holds for `benchmarks.extremes`, drawn with fixed seeds."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

import mechanics
from benchmarks.extremes import Hold

__all__ = ["Family", "families"]

RACER, SNAKEBOARD = "roller_racer", "snakeboard"
DECADES = 9.0
RIGHT = math.pi / 2
INTERPRETED = {"backend": "numpy"}  # nothing is compiled for a few holds in a frame that nobody chooses
DIGITS = 50  # of the reference where the constraints lose rank at the very start


@dataclass(frozen=True)
class Family:
    """Holds of one kind.

    Attributes:
        name: what is extreme.
        holds: to be tried.
        calm: whether a flag would be false: nothing about these is beyond what can be computed.
    """

    name: str
    holds: list[Hold]
    calm: bool = False


class _Draw:
    """Random holds of one family, always the same."""

    def __init__(self, name: str) -> None:
        self.rng = np.random.default_rng(list(name.encode()))

    def decades(self) -> float:
        """A number within nine decades about 1."""
        return float(10 ** self.rng.uniform(-DECADES / 2, DECADES / 2))

    def velocity(self, mechanism: str, rate: float, length: float = 1.0) -> tuple[float, ...]:
        """Velocities up to `rate`, those of the position times a length; some violate the constraints."""
        n = mechanics.get(mechanism).n
        scale = np.array([length, length, *[1.0] * (n - 2)])
        return tuple((self.rng.uniform(-rate, rate, n) * scale).tolist())

    def torques(self, mechanism: str, size: float = 1.0) -> tuple[float, ...]:
        """Torques up to `size` of the mechanism's own limits."""
        own = mechanics.get(mechanism).torque_limits.values()
        return tuple(float(self.rng.uniform(-1, 1) * size * limit) for limit in own)


def _place(mechanism: str, joint: float) -> tuple[float, ...]:
    return (0.1, -0.2, 0.4, joint) if mechanism == RACER else (0.1, -0.2, 0.4, 0.3, joint)


def _near(draw: _Draw, mechanism: str, angles: Sequence[float], rate: float, **more: object) -> list[Hold]:
    return [
        Hold(mechanism, _place(mechanism, a), draw.velocity(mechanism, rate), draw.torques(mechanism), **more)  # type: ignore[arg-type]
        for a in angles
    ]


def _anywhere(
    draw: _Draw, mechanism: str, count: int, rate: float, torque: float = 1.0, *, stops: bool = False, dt: float = 0.05
) -> list[Hold]:
    return [
        Hold(
            mechanism,
            _place(mechanism, draw.rng.uniform(-1, 1)),
            draw.velocity(mechanism, rate),
            draw.torques(mechanism, torque),
            stops=stops,
            dt=dt,
        )  # fmt: skip
        for _ in range(count)
    ]


def _scaled(draw: _Draw, mechanism: str, *, alike: bool) -> Hold:
    """A body of another size: a similar one, or one whose masses and lengths have nothing to do with one another."""
    m, l = draw.decades(), draw.decades()
    share = draw.rng.uniform(0.1, 0.9, 3)
    params: Mapping[str, float]
    if mechanism == SNAKEBOARD:
        rotor = share[0] if alike else 10 ** draw.rng.uniform(-DECADES, -0.1)
        steering = 0.1 * share[1] * m * l**2 if alike else draw.decades() * 1e-4
        params = {"m": m, "l": l, "J_r": rotor * m * l**2, "J_w": steering}
        torques = np.array([params["J_r"], params["J_w"]])
    else:
        others = l, l * share[0], m * l**2 * share[1], 0.1 * m * l**2 * share[2]
        l_1, l_2, i_1, i_2 = others if alike else [draw.decades() for _ in range(4)]
        params = {"m": m, "l_1": l_1, "l_2": l_2, "I_1": i_1, "I_2": i_2}
        l, torques = min(l_1, l_2), np.array([i_2])
    torques *= draw.rng.uniform(-1, 1, len(torques))  # some rad/s²
    joint = draw.rng.uniform(-1, 1)
    return Hold(mechanism, _place(mechanism, joint), draw.velocity(mechanism, 1, l), torques.tolist(), params)


def families(count: int = 16) -> Iterator[Family]:
    """Everything that is tried, `count` holds of a kind where they are drawn."""
    yield from _singular(count)
    yield from _sizes(count)
    yield from _fast(count)


def _singular(count: int) -> Iterator[Family]:
    draw = _Draw("singular")
    angle = math.acos(-1 / 3)  # l_2 + l_1 cos psi = 0
    around = [angle, -angle, *(draw.rng.choice([-1, 1]) * (angle + draw.rng.uniform(-0.3, 0.3)) for _ in range(count))]
    yield Family("racer through c = 0, 1 m/s", _near(draw, RACER, around, 1.0), calm=True)
    yield Family("racer through c = 0, 5 m/s", _near(draw, RACER, around, 5.0), calm=True)
    for frame in ("regular", "orthonormal", "paper"):
        options = {"frame": frame, **INTERPRETED}
        yield Family(f"the same in the frame {frame!r}", _near(draw, RACER, around[:8], 1.0, options=options))
    near = [
        hold
        for gap in (1e-3, 1e-6, 1e-9, 1e-12)
        for hold in _near(
            draw, RACER, [math.pi + d for d in (0, 1e-6, 1e-3, 0.1, -0.1)], 3.0, params={"l_2": 0.3 * (1 - gap)}
        )
    ]
    yield Family("racer, l_2 = l_1 (1 - 1e-3 ... 1e-12), psi near pi", near)
    equal = [math.pi + d for d in (0, 1e-12, 1e-9, 1e-6, 1e-3, 0.1, -0.1)]
    yield Family("racer, l_2 = l_1, psi near pi", _near(draw, RACER, equal, 3.0, params={"l_2": 0.3}))
    sides = [side * (RIGHT + d) for side in (1, -1) for d in (0, 1e-12, 1e-9, 1e-6)]
    exact = _near(draw, SNAKEBOARD, sides, 3.0, digits=DIGITS)
    passing = [side * (RIGHT + d) for side in (1, -1) for d in draw.rng.uniform(-0.2, 0.2, count // 2)]
    yield Family("snakeboard at phi = ±pi/2", exact, calm=True)
    yield Family("snakeboard through phi = ±pi/2", _near(draw, SNAKEBOARD, passing, 5.0), calm=True)
    edge = [
        hold
        for gap in (1e-6, 1e-7, 1e-8, 1e-12)
        for hold in _near(draw, SNAKEBOARD, [RIGHT + d for d in (1e-3, 0.1, -0.1, 0.5)], 3.0,
                          params={"J_r": 6.0 * 0.2**2 * (1 - gap)})
    ]  # fmt: skip
    yield Family("snakeboard, J_r = m l² (1 - 1e-6 ... 1e-12), phi near pi/2", edge)


def _sizes(count: int) -> Iterator[Family]:
    for mechanism in (SNAKEBOARD, RACER):
        for alike, words in ((True, "similar bodies"), (False, "bodies of any proportions")):
            draw = _Draw(f"{mechanism} {words}")
            holds = [_scaled(draw, mechanism, alike=alike) for _ in range(count)]
            yield Family(f"{mechanism}, {words}, nine decades each", holds, calm=True)


def _fast(count: int) -> Iterator[Family]:
    few = max(count // 4, 3)
    for mechanism in (SNAKEBOARD, RACER):
        draw = _Draw(mechanism)
        for dt in (1e-9, 1e-5, 1.0, 10.0):
            holds = _anywhere(draw, mechanism, few, 0.3, 0.1, dt=dt)
            yield Family(f"{mechanism}, dt = {dt:g} s", holds, calm=dt <= 1)
        for rate in (1e1, 1e2, 1e4):
            for stops in (False, True):
                holds = _anywhere(draw, mechanism, few, rate, stops=stops)
                yield Family(f"{mechanism}, {'stops, ' * stops}rates of {rate:g}/s", holds, calm=rate == 10)
        short = _anywhere(draw, mechanism, few, 1e4, dt=1e-3)
        yield Family(f"{mechanism}, rates of 1e4/s, dt = 1 ms", short)
        for torque in (1e1, 1e2, 1e6):
            for stops in (False, True):
                size = torque / max(mechanics.get(mechanism).torque_limits.values())
                holds = _anywhere(draw, mechanism, few, 0.5, size, stops=stops)
                yield Family(f"{mechanism}, {'stops, ' * stops}{torque:g} N m", holds, calm=torque == 10)
                if torque == 1e6:
                    holds = _anywhere(draw, mechanism, few, 0.5, size, stops=stops, dt=1e-3)
                    yield Family(f"{mechanism}, {'stops, ' * stops}{torque:g} N m, dt = 1 ms", holds)
    rest = [
        Hold(RACER, (0, 0, 0, psi), (0, 0, 0, 0), (u,), dt=0.1, stops=True) for psi in (0.0, 0.5) for u in (80, -80)
    ]
    yield Family("racer at rest, stops, 80 N m, dt = 0.1 s", rest, calm=True)

"""A stranger for whole holds: SciPy's solver and its events on the model's rates, through impacts and releases."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from scipy.integrate import solve_ivp

from mechanics.model import Model

__all__ = ["HIT", "RELEASE", "through_events"]

HIT, RELEASE = "hit", "release"

# An adaptive method of order 8 at these tolerances stays within 1e-12 over one hold of the usual length.
SOLVER = {"method": "DOP853", "rtol": 1e-13, "atol": 1e-14}
NOTHING = 1e-11  # rad/s^2, by which a push must be inward to let go: without torques it is zero but for rounding


def through_events(
    model: Model,
    q: np.ndarray,
    v: np.ndarray,
    u: np.ndarray,
    dt: float,
    joint: tuple[int, float] | None = None,
    max_step: float = 0.005,
) -> tuple[np.ndarray, np.ndarray, list[tuple[str, float]]]:
    """State after `dt` seconds with the controls held: q (n,), v (k,), and what happened when.

    At a stop the angle is clamped and the joint's rate taken away. While what acts on it presses outward it is held,
    its pseudo-velocity zero; when that changes sign it is let go.

    Args:
        model: the mechanism's rates.
        q: (n,) coordinates.
        v: (k,) pseudo-velocities.
        u: (m,) controls.
        dt: duration in s.
        joint: place of its angle in q, and its stop; None if there is none.
        max_step: of the solver, so short that no joint turns twice and no push changes sign twice within a step.
    """
    n, state, time = len(q), np.concatenate([q, v]), 0.0
    happened: list[tuple[str, float]] = []

    def rates(t: float, y: np.ndarray, held: int | None) -> np.ndarray:
        change = model.rates(y[:n], y[n:], u)
        if held is not None:
            change[held] = 0.0
        return np.concatenate([model.velocity(y[:n], y[n:]), change])

    def run(end: float, events: Any = None, held: int | None = None) -> Any:
        solved = solve_ivp(rates, (time, end), state, events=events, args=(held,), max_step=max_step, **SOLVER)
        assert solved.success
        return solved

    if joint is None:
        state = run(dt).y[:, -1]
        return state[:n], state[n:], happened
    place, limit = joint
    (moving,) = np.flatnonzero(model.velocity(q, np.eye(len(v)))[:, place])

    def push(y: np.ndarray, side: float) -> float:
        return side * float(model.rates(y[:n], y[n:], u)[moving]) + NOTHING

    # Events are sought between the ends of a step: one for each stop, of outward passages only, so a start there is
    # none. A passage out and back within a step shows in the turn between them.
    passing = [_event(lambda t, y, held, side=side: side * y[place] - limit, 1) for side in (1, -1)]
    turning = _event(lambda t, y, held: y[n + moving], 0, terminal=False)
    while time < dt:
        let_go = happened[-1:] == [(RELEASE, time)]
        if abs(state[place]) >= limit and state[n + moving] * state[place] >= 0:
            side = math.copysign(1.0, state[place])
            state[place], state[n + moving] = side * limit, 0.0
            if not let_go and push(state, side) >= 0:
                releasing = _event(lambda t, y, held, side=side: push(y, side), -1)
                rest = run(dt, releasing, moving)
                time, state = rest.t[-1], rest.y[:, -1].copy()
                if rest.status == 1:
                    happened.append((RELEASE, time))
                continue
        flight = run(dt, [*passing, turning])
        for turn, there in zip(flight.t_events[2], flight.y_events[2], strict=True):
            if turn > time and abs(there[place]) > limit:
                flight = run(turn, passing)
                break
        hit, time, state = flight.status == 1, flight.t[-1], flight.y[:, -1].copy()
        if hit:
            happened.append((HIT, time))
            assert len(happened) < 100
            state[place], state[n + moving] = math.copysign(limit, state[place]), 0.0
    return state[:n], state[n:], happened


def _event(function: Any, direction: int, terminal: bool = True) -> Any:
    function.terminal, function.direction = terminal, direction
    return function

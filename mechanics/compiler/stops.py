"""A hold, from event to event, as source that generated kernels take in whole.

A flight whose estimated error is too large is halved until it is not. Within a flight, inelastic
stops of joint angles act where they are met. An impact clamps the angle and takes away that joint's
rate; the other pseudo-velocities of an orthogonal frame keep theirs, because the stop's reaction has
a component along that joint's vector field only. Afterwards the joint either stays on its stop, while
what acts on it presses outward, or leaves it at once.

Every function here is plain Python over arrays and runs compiled or not. Names in the section
below are stand-ins for what the generated module defines itself.
"""

from math import copysign, inf, sqrt
from typing import Any

from numpy import array, int64

__all__ = ["CONSTANTS", "PURE", "SOURCES", "first_event", "guess", "hold", "refine", "settle", "value_of", "zero"]

Array = Any  # NumPy array, or Numba's view of one

ANGLES = array((), int64)  # places in `state` of the angles of the joints that have stops
RATES = array((), int64)  # and of their pseudo-velocities


def advance(h: float, state: Array, control: Array, free: Array, k: Array, new: Array) -> bool:
    """Write the state after `h` seconds to `new`; joint j is held where free[j] is 0. Returns whether it is right."""
    raise NotImplementedError


def motion(state: Array, control: Array, k: Array, out: Array) -> None:
    """Write each joint's rate, then each joint's acceleration."""
    raise NotImplementedError


MAX_FLIGHTS = 1000  # within one hold, each from event to event or as long as it can be integrated at once
SHORTEST = 2.0**-24  # flight, of the hold
MAX_ITERATIONS = 100  # bisection alone needs 53
TIME_TOLERANCE = 1e-13  # of the hold: at 100 rad/s and 0.05 s, the angle is right to 5e-13 rad

AT_REST = 1e-12  # rad^2/s: a joint on its stop that leaves it no faster does not move, but for roundings

# What passes a level: a joint's angle, its rate, or the acceleration that it would have if it were not held.
ANGLE, RATE, PUSH = 0, 1, 2

CONSTANTS = ("MAX_FLIGHTS", "SHORTEST", "MAX_ITERATIONS", "TIME_TOLERANCE", "AT_REST", "ANGLE", "RATE", "PUSH")


def hold(
    h: float, state: Array, control: Array, k: Array, limits: Array, free: Array, work: Array, hits: Array, new: Array
) -> bool:
    """Advance `state` in place by `h` seconds with the controls held, through every event.

    Returns whether that could be done to the tolerance; if not, `state` is where it could be done until.
    """
    left = longest = h
    for _ in range(MAX_FLIGHTS):
        settle(state, control, k, limits, free, work)
        flight = min(longest, left)
        while not advance(flight, state, control, free, k, new):
            flight *= 0.5
            if flight < SHORTEST * h:
                return False
        longest = 2.0 * flight
        time, there = first_event(flight, state, control, k, limits, free, work, hits, new)
        if time != there:
            advance(time, state, control, free, k, new)
        for i in range(len(state)):  # state[:] = new costs Numba two seconds more to compile
            state[i] = new[i]
        for j in range(len(ANGLES)):
            if hits[j] <= time:
                state[ANGLES[j]] = copysign(limits[j], state[ANGLES[j]])
                state[RATES[j]] = 0.0
        left -= time
        if left <= 0.0:
            return True
    return False


def settle(state: Array, control: Array, k: Array, limits: Array, free: Array, work: Array) -> None:
    """Set free[j] to 0 for each joint that rests on its stop and is pressed outward, else to 1."""
    for j in range(len(ANGLES)):
        free[j] = 1.0
        angle = state[ANGLES[j]]
        if abs(angle) >= limits[j]:
            state[ANGLES[j]] = copysign(limits[j], angle)
            if state[RATES[j]] * angle >= -AT_REST:
                state[RATES[j]] = 0.0
                motion(state, control, k, work)
                if work[len(ANGLES) + j] * angle >= 0.0:
                    free[j] = 0.0


def first_event(
    h: float, state: Array, control: Array, k: Array, limits: Array, free: Array, work: Array, hits: Array, new: Array
) -> tuple[float, float]:
    """Time of the first impact or release within `h` seconds, or `h`; and the time of the state that `new` holds.

    On entry that is `h`. hits[j] is set to the time of joint j's own impact, infinite if it has none.
    """
    first = there = h
    for j in range(len(ANGLES)):
        hits[j] = inf
        angle, end, limit = ANGLES[j], h, limits[j]
        if there != h:
            advance(h, state, control, free, k, new)
            there = h
        if free[j] == 0.0:
            motion(new, control, k, work)
            side = copysign(1.0, state[angle])
            if side * work[len(ANGLES) + j] < 0.0:
                first = min(first, zero(j, PUSH, -side, 0.0, h, state, control, k, free, work, new))
                there = -1.0
            continue
        if state[RATES[j]] * new[RATES[j]] < 0.0:
            # It turned on the way: perhaps beyond the stop that it went for first, if it could get so far.
            motion(state, control, k, work)
            side = copysign(1.0, state[RATES[j]])
            if side * state[angle] + h * abs(work[j]) > limit:
                end = there = zero(j, RATE, -side, 0.0, h, state, control, k, free, work, new)
                if side * new[angle] <= limit:
                    advance(h, state, control, free, k, new)
                    end = there = h
        if abs(new[angle]) > limit:
            side = copysign(1.0, new[angle])
            hits[j] = there = zero(j, ANGLE, side, limit, end, state, control, k, free, work, new)
            first = min(first, hits[j])
    return first, there


def zero(
    j: int,
    kind: int,
    sign: float,
    level: float,
    end: float,
    state: Array,
    control: Array,
    k: Array,
    free: Array,
    work: Array,
    new: Array,
) -> float:
    """Time in (0, end] at which sign times a value of joint j passes `level` upward; `kind` says which value.

    Halley's method, kept in a bracket by bisection, which alone serves a push. `new` holds the state at `end` on entry,
    and for an angle or a rate the state at the time returned on leaving. A push has just passed at that time.
    """
    low, high = 0.0, end
    motion(new, control, k, work)
    above, rate_above, _ = value_of(j, kind, new, work)
    motion(state, control, k, work)
    below, rate_below, _ = value_of(j, kind, state, work)
    time = guess(sign * below - level, sign * above - level, sign * rate_below, sign * rate_above, end)
    for _ in range(MAX_ITERATIONS):
        advance(time, state, control, free, k, new)
        motion(new, control, k, work)
        value, rate, bend = value_of(j, kind, new, work)
        better, low, high = refine(time, low, high, sign * value - level, sign * rate, sign * bend, end)
        if better == time:
            break
        time = better
    return high if kind == PUSH else time


def value_of(j: int, kind: int, state: Array, work: Array) -> tuple[float, float, float]:
    """What `zero` watches, in a state whose `motion` is in `work`, and its first two derivatives, 0 if not known."""
    push = work[len(ANGLES) + j]
    if kind == ANGLE:
        return state[ANGLES[j]], work[j], push
    return (state[RATES[j]], push, 0.0) if kind == RATE else (push, 0.0, 0.0)


def guess(below: float, above: float, rate: float, rate_above: float, end: float) -> float:
    """About when a value passes zero that goes from `below` to `above` in the time `end`, at these rates there.

    From the cubic through both ends, which a held torque makes nearly exact.
    """
    chord = (above - below) / end
    bend = (3.0 * chord - 2.0 * rate - rate_above) / end
    twist = (rate + rate_above - 2.0 * chord) / (end * end)
    # The parabola without the twist has the root below; from there, Newton on the cubic.
    discriminant = rate * rate - 4.0 * bend * below
    root = rate + sqrt(discriminant if discriminant > 0.0 else 0.0)
    time = 0.5 * end
    if (below < 0.0) & (discriminant > 0.0) & (root > 0.0):
        time = min(-2.0 * below / root, end)
    for _ in range(3):
        cubic = below + time * (rate + time * (bend + time * twist))
        cubic_rate = rate + time * (2.0 * bend + time * 3.0 * twist)
        better = time - cubic / cubic_rate
        if (cubic_rate > 0.0) & (better > 0.0) & (better < end):
            time = better
    return time


def refine(
    time: float, low: float, high: float, value: float, rate: float, bend: float, end: float
) -> tuple[float, float, float]:
    """Halley's step from `time`, where what passes zero in (low, high) is `value`, at `rate`; and the new bracket.

    `bend` is the second derivative, or 0: then the step is Newton's. By bisection where the step leaves the bracket; no
    step where there is nothing left to gain.
    """
    low, high = (low, time) if value > 0.0 else (time, high)
    slope = rate - 0.5 * value * bend / rate
    step = value / (slope if slope > 0.0 else rate) if rate > 0.0 else inf
    better = time - step
    if not ((low < better) & (better < high)):
        better = 0.5 * (low + high)
    if (abs(step) <= TIME_TOLERANCE * end) | (not ((low < better) & (better < high))):
        better = time
    return better, low, high


# In the order in which a module that contains them defines them; those that are worth a place inside others first.
PURE = (guess, refine)
SOURCES = (value_of, zero, first_event, settle, hold)

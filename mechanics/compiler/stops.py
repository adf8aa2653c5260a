"""Inelastic stops of joint angles, as source that generated kernels take in whole.

An impact clamps the angle and takes away that joint's rate; the other pseudo-velocities of an
orthogonal frame keep theirs, because the stop's reaction has a component along that joint's
vector field only. Afterwards the joint either stays on its stop, while its torque presses
outward, or leaves it at once.

Every function here is plain Python over arrays and runs compiled or not. Names in the section
below are stand-ins for what the generated module defines itself.
"""

from math import copysign, inf, sqrt
from typing import Any

__all__ = ["CONSTANTS", "PURE", "SOURCES", "first_hit", "guess", "hold", "refine", "settle", "zero"]

Array = Any  # NumPy array, or Numba's view of one

ANGLES: tuple[int, ...] = ()  # places in `state` of the angles of the joints that have stops
RATES: tuple[int, ...] = ()  # and of their pseudo-velocities


def advance(h: float, state: Array, control: Array, free: Array, k: Array, new: Array) -> None:
    """Write the state after `h` seconds to `new`; joint j is held where free[j] is 0."""
    raise NotImplementedError


def motion(state: Array, control: Array, k: Array, out: Array) -> None:
    """Write each joint's rate, then each joint's acceleration."""
    raise NotImplementedError


MAX_EVENTS = 64  # impacts within one hold; a joint needs a full swing between two
MAX_ITERATIONS = 100  # bisection alone needs 53
TIME_TOLERANCE = 1e-13  # of the hold: at 100 rad/s and 0.05 s, the angle is right to 5e-13 rad

CONSTANTS = ("MAX_EVENTS", "MAX_ITERATIONS", "TIME_TOLERANCE")


def hold(
    h: float, state: Array, control: Array, k: Array, limits: Array, free: Array, work: Array, hits: Array, new: Array
) -> int:
    """Advance `state` in place by `h` seconds with the controls held, through every impact.

    On entry `new` holds the state after `h` seconds without stops, unless a joint is at its stop.
    Returns the number of impacts.
    """
    left, known, impacts = h, True, 0
    for _ in range(MAX_EVENTS):
        if settle(state, control, k, limits, free, work) or not known:
            advance(left, state, control, free, k, new)
        time, there = first_hit(left, state, control, k, limits, free, work, hits, new)
        if time != there:
            advance(time, state, control, free, k, new)
        for i in range(len(state)):  # state[:] = new costs Numba two seconds more to compile
            state[i] = new[i]
        for j in range(len(ANGLES)):
            if hits[j] <= time:
                state[ANGLES[j]] = copysign(limits[j], state[ANGLES[j]])
                state[RATES[j]] = 0.0
                impacts += 1
        left -= time
        known = False
        if left <= 0.0:
            return impacts
    # Never seen, as an inelastic stop does not bounce; joints at a stop rest there for what is left.
    for j in range(len(ANGLES)):
        free[j] = 0.0 if abs(state[ANGLES[j]]) >= limits[j] else 1.0
    advance(left, state, control, free, k, new)
    for i in range(len(state)):
        state[i] = new[i]
    return impacts


def settle(state: Array, control: Array, k: Array, limits: Array, free: Array, work: Array) -> bool:
    """Set free[j] to 0 for each joint that rests on its stop and is pressed outward, else to 1.

    Returns whether anything is now other than free flight from the given state.
    """
    changed = False
    for j in range(len(ANGLES)):
        free[j] = 1.0
        angle = state[ANGLES[j]]
        if abs(angle) >= limits[j]:
            changed = True
            state[ANGLES[j]] = copysign(limits[j], angle)
            if state[RATES[j]] * angle >= 0.0:
                state[RATES[j]] = 0.0
                motion(state, control, k, work)
                if work[len(ANGLES) + j] * angle >= 0.0:
                    free[j] = 0.0
    return changed


def first_hit(
    h: float, state: Array, control: Array, k: Array, limits: Array, free: Array, work: Array, hits: Array, new: Array
) -> tuple[float, float]:
    """Time of the first impact within `h` seconds, or `h`; and the time of the state that `new` holds.

    On entry that is `h`. hits[j] is set to joint j's own time, infinite if it has no impact.
    """
    first = there = h
    for j in range(len(ANGLES)):
        hits[j] = inf
        if free[j] == 0.0:
            continue
        angle, end, limit = ANGLES[j], h, limits[j]
        if there != h:
            advance(h, state, control, free, k, new)
            there = h
        if state[RATES[j]] * new[RATES[j]] < 0.0:
            # It turned on the way: perhaps beyond the stop that it went for first, if it could get so far.
            motion(state, control, k, work)
            side = copysign(1.0, state[RATES[j]])
            if side * state[angle] + h * abs(work[j]) > limit:
                end = there = zero(j, True, -side, 0.0, h, state, control, k, free, work, new)
                if side * new[angle] <= limit:
                    advance(h, state, control, free, k, new)
                    end = there = h
        if abs(new[angle]) > limit:
            side = copysign(1.0, new[angle])
            hits[j] = there = zero(j, False, side, limit, end, state, control, k, free, work, new)
            first = min(first, hits[j])
    return first, there


def zero(
    j: int,
    turning: bool,
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
    """Time in (0, end] at which joint j's angle, or its rate if `turning`, passes `level` upward.

    What passes is sign * value. Newton's method, kept in a bracket by bisection; `new` holds the
    state at `end` on entry, and the state at the time returned on leaving.
    """
    place, slope = (RATES[j], len(ANGLES) + j) if turning else (ANGLES[j], j)
    low, high = 0.0, end
    below, above = sign * state[place] - level, sign * new[place] - level
    motion(new, control, k, work)
    rate_above = sign * work[slope]
    motion(state, control, k, work)
    time = guess(below, above, sign * work[slope], rate_above, end)
    for _ in range(MAX_ITERATIONS):
        advance(time, state, control, free, k, new)
        motion(new, control, k, work)
        better, low, high = refine(time, low, high, sign * new[place] - level, sign * work[slope], end)
        if better == time:
            break
        time = better
    return time


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


def refine(time: float, low: float, high: float, value: float, rate: float, end: float) -> tuple[float, float, float]:
    """Newton's step from `time`, where what passes zero in (low, high) is `value`, at `rate`; and the new bracket.

    By bisection where Newton's step leaves the bracket; no step where there is nothing left to gain.
    """
    low, high = (low, time) if value > 0.0 else (time, high)
    step = value / rate if rate > 0.0 else inf
    better = time - step
    if not ((low < better) & (better < high)):
        better = 0.5 * (low + high)
    if (abs(step) <= TIME_TOLERANCE * end) | (not ((low < better) & (better < high))):
        better = time
    return better, low, high


# In the order in which a module that contains them defines them; those that are worth a place inside others first.
PURE = (guess, refine)
SOURCES = (zero, first_hit, settle, hold)

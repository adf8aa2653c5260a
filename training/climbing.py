"""Sequential linear programming: actions that drive farther and farther, until no small change helps.

Near the motion that some actions give, the holds are linear (`training.shooting`). The best small change of all actions
in that linear picture is a linear program: the changes of the states are variables too, tied by one equation a hold, so
that the heading can be kept within a trust region whatever an early action would do to it much later. A gradient alone
does not get there: without drag, the snakeboard's last heading changes by thousands of radians a unit of its first
actions.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.optimize import linprog

from training.metrics import joint_index
from training.shooting import Linear, Shooting

__all__ = ["TRIALS", "best_change", "climb", "pressed"]

Array = NDArray[np.float64]

TRIALS = 8  # shares of a step that are tried side by side: 1, 1/2, 1/4, ...
FIRST_RADIUS = 0.3  # of the trust region, in actions
LAST_RADIUS = 1e-5
ANGLE = 0.5  # rad that an angle may change where an action may change by 1
WINDOW = 5  # rounds that must gain something together
TOUCHING = 1e-9  # rad from a stop
# rad from a stop, where a joint that swings may be between two holds: then it turns before it grazes the stop within
# one. Grazing makes kinks, at which a linear picture ends. The snakeboard's steering turns within 50 rad/s² (25 ms)²/2.
MARGIN = 0.016


def climb(
    shooting: Shooting,
    actions: Array,
    rounds: int,
    tolerance: float = 2e-3,
    heard: Callable[[float], None] = lambda distance: None,
) -> tuple[float, Array]:
    """Distance in metres and actions (T, m) of the top that is climbed from some actions.

    Args:
        shooting: made with `TRIALS` trials.
        actions: shape (T, m).
        rounds: linear programs, at most.
        tolerance: metres that `WINDOW` rounds must gain, else it is the top.
        heard: hears of the distance after every round.
    """
    actions = pressed(shooting, np.clip(actions, -1, 1))
    reached, radius = [shooting.distance(actions)], FIRST_RADIUS
    shares = 0.5 ** np.arange(TRIALS)
    for _ in range(rounds):
        states, linear = shooting.linear(actions)
        change, promised = best_change(shooting, states, linear, actions, radius)
        trials = np.clip(actions + shares[:, None, None] * change, -1, 1)
        distances = shooting.distances(trials)
        best = int(np.argmax(distances))
        gain = distances[best] - reached[-1]
        if gain > 0:
            actions = pressed(shooting, trials[best])
            kept_promise = best == 0 and gain > promised / 2
            radius = min(2.0, 2 * radius) if kept_promise else min(1.0, 1.5 * shares[best]) * radius
            reached.append(shooting.distance(actions))
        else:
            radius *= 2 * shares[-1]
            reached.append(reached[-1])
        heard(reached[-1])
        if radius < LAST_RADIUS or (len(reached) > WINDOW and reached[-1] < reached[-1 - WINDOW] + tolerance):
            break
    return reached[-1], actions


def best_change(
    shooting: Shooting, states: Array, linear: Linear, actions: Array, radius: float
) -> tuple[Array, float]:
    """Change (T, m) of the actions that gains most in the linear picture, and the metres it should gain.

    Args:
        shooting: says what the states are.
        states: before each hold and after the last, shape (T + 1, n + k).
        linear: the holds near them.
        actions: shape (T, m).
        radius: largest change of an action; heading and joints with stops may change by `ANGLE` times that.
    """
    steps, m = actions.shape
    k = len(linear.kept)
    # Unknowns: all δu, then all δs from after the first hold to after the last. Each hold has k equations.
    held = sparse.block_diag([*linear.B])
    moved = sparse.bmat([[None, sparse.csr_array((k, k))], [sparse.block_diag([*linear.A[1:]]), None]])
    equations = sparse.hstack([-held, sparse.eye_array(steps * k) - moved], format="csr")
    gains = np.concatenate([linear.d.ravel(), linear.c[1:].ravel(), np.zeros(k)])
    low, high = np.full((steps, k), -np.inf), np.full((steps, k), np.inf)
    for i, state in enumerate(linear.kept):
        stop = shooting.stops[state] if state < len(shooting.stops) else np.inf
        if state == shooting.heading or np.isfinite(stop):
            after = states[1:, state]
            low[:, i] = np.maximum(-ANGLE * radius, np.minimum(MARGIN - stop - after, 0.0))
            high[:, i] = np.minimum(ANGLE * radius, np.maximum(stop - MARGIN - after, 0.0))
    low = np.concatenate([np.maximum(-radius, -1 - actions).ravel(), low.ravel()])
    high = np.concatenate([np.minimum(radius, 1 - actions).ravel(), high.ravel()])
    solution = linprog(  # type: ignore[call-overload]  # the stubs know no sparse arrays
        -gains,
        A_eq=equations,
        b_eq=np.zeros(steps * k),
        bounds=np.column_stack([low, high]),
        method="highs-ipm",  # three times as fast here as the simplex method
    )
    if solution.x is None:  # no change is a solution, so that only rounding can be in the way
        return np.zeros_like(actions), 0.0
    return solution.x[: steps * m].reshape(steps, m), -float(solution.fun)


def pressed(shooting: Shooting, actions: Array) -> Array:
    """The same motion, with every joint that rests on its stop pressed against it with all its force.

    A stop takes any force, so that the distance says nothing about how large it should be; but with none, the least
    change would let the joint drift away from it.
    """
    states, actions = shooting.states(actions), actions.copy()
    for control, joint in enumerate(joint_index(shooting.mechanism)):
        for side in (-1, 1):
            touching = side * states[:, joint] > shooting.stops[joint] - TOUCHING
            actions[touching[:-1] & touching[1:], control] = side
    return actions

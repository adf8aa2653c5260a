"""Motion by another road: Lagrange multipliers, extrapolated midpoints, more digits than float64 has.

    M q̈ = u_a F_a - ∇V - C(q, q̇) + ω^T λ,    ω q̈ = -ω̇ q̇

with no frame, no connection and no tableau, for many motions side by side. A joint's stop is one more constraint: the
impact is what M-orthogonal projection takes away, and the joint rests while the multiplier of dψ presses outward.
Each motion has a step of its own, chosen by the error that the extrapolation shows; what it can't resolve it says.
"""

from __future__ import annotations

import contextlib
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

import mpmath
import numpy as np
import sympy as sp
from numpy.typing import ArrayLike, NDArray

from benchmarks.textbook import textbook
from mechanics.mechanism import Mechanism

__all__ = ["DIGITS", "Motion", "Multipliers"]

Array = NDArray[Any]  # long doubles, or objects of mpmath: (dimension, motions) unless said otherwise
Rows = list[list[Array]]
Vector = Sequence[Array] | Array

DIGITS = float(-np.log10(np.finfo(np.longdouble).eps))  # of a long double: 19 on x86, 16 where it is a double

LEVELS = 8  # of extrapolation: order 16, 72 evaluations
TOLERANCE = 3e-15  # of a step, relative to the motion; where the multipliers are nearly singular no less can be had
LONGEST, BRISK = 400, 20  # steps of a motion, and after how many it may be given up
IMPACTS = 64  # pieces of a motion
SEARCH, NEAR = 60, 1e-17  # of an impact: evaluations, and when it is found
SMALLEST = 1e-9  # a step shorter than this part of the motion is that of a pole


@dataclass(frozen=True)
class Motion:
    """Where motions end.

    Attributes:
        q: coordinates, shape (N, n).
        qdot: velocities, shape (N, n).
        resolved: whether the motion could be followed, shape (N,); what is not is NaN.
        impacts: on stops, shape (N,).
        gained: energy at the end less that at the start, shape (N,).
    """

    q: Array
    qdot: Array
    resolved: NDArray[np.bool_]
    impacts: NDArray[np.int64]
    gained: Array


class Multipliers:
    """One mechanism.

    Args:
        mechanism: what moves.
        digits: of its numbers, by mpmath, slowly; None for long doubles.
    """

    def __init__(self, mechanism: Mechanism, digits: int | None = None) -> None:
        self.mechanism, self.digits = mechanism, digits
        self._tolerance = TOLERANCE
        self._ingredients = _ingredients(json.dumps(mechanism.to_dict()), digits)

    def acceleration(self, q: ArrayLike, qdot: ArrayLike, u: ArrayLike, params: Mapping[str, ArrayLike]) -> Array:
        """Accelerations (N, n) of motions: q, q̇ (N, n), u (N, m), parameters (N,) or numbers."""
        with self._precision():
            states = np.concatenate([self._numbers(q).T, self._numbers(qdot).T])
            return self._rates(states, self._numbers(u).T, self._parameters(params, states.shape[1]), ())[
                self.mechanism.n :
            ].T

    def residual(self, q: ArrayLike, qdot: ArrayLike, params: Mapping[str, ArrayLike]) -> Array:
        """Values (N, c) of the constraint one-forms on q̇."""
        with self._precision():
            qs, rates = self._numbers(q).T, self._numbers(qdot).T
            _, forms, _, _ = self._at(qs, self._parameters(params, qs.shape[1]))
            found = [_dot(row, rates) for row in forms]
            return np.stack(found, axis=1) if found else np.zeros((qs.shape[1], 0))

    def energy(self, q: ArrayLike, qdot: ArrayLike, params: Mapping[str, ArrayLike]) -> Array:
        """Kinetic plus potential energy (N,) of states (N, n)."""
        with self._precision():
            qs, rates = self._numbers(q).T, self._numbers(qdot).T
            return self._energy(qs, rates, self._parameters(params, qs.shape[1]))

    def feasible(self, q: ArrayLike, qdot: ArrayLike, params: Mapping[str, ArrayLike]) -> Array:
        """Velocities (N, n) less what violates the constraints."""
        with self._precision():
            qs, rates = self._numbers(q).T, self._numbers(qdot).T
            return self._projected(qs, rates, self._parameters(params, qs.shape[1]), ()).T

    def hold(
        self,
        q: ArrayLike,
        qdot: ArrayLike,
        u: ArrayLike,
        duration: float,
        params: Mapping[str, ArrayLike],
        *,
        units: ArrayLike = 1.0,
        limit: float | None = None,
        shortest: float = 0.0,
    ) -> Motion:
        """Where motions are after `duration` seconds under constant controls.

        Args:
            q: coordinates at the start, shape (N, n).
            qdot: velocities, shape (N, n); what violates the constraints is taken away.
            u: controls, shape (N, m).
            duration: in s.
            params: parameters by name, a number or (N,).
            units: of the coordinates, for errors of what is near zero, shape (n,) or (N, n).
            limit: stop of the mechanism's joint in rad; None for none.
            shortest: least number of steps, lest a passage out and back be stepped over.
        """
        with self._precision(), np.errstate(all="ignore"):
            return self._hold(q, qdot, u, duration, params, units, limit, shortest)

    def _hold(
        self,
        q: ArrayLike,
        qdot: ArrayLike,
        u: ArrayLike,
        duration: float,
        params: Mapping[str, ArrayLike],
        units: ArrayLike,
        limit: float | None,
        shortest: float,
    ) -> Motion:
        n = self.mechanism.n
        start, controls = self._numbers(q).T, self._numbers(u).T
        count = start.shape[1]
        p = self._parameters(params, count)
        sizes = self._numbers(np.broadcast_to(units, (count, n))).T
        sizes = np.concatenate([sizes, sizes / self._numbers(duration)])
        states = np.concatenate([start, self._projected(start, self._numbers(qdot).T, p, ())])
        before = self._energy(states[:n], states[n:], p)
        left = self._numbers(np.full(count, duration))
        longest = left / self._numbers(max(shortest, 1.0))
        resolved, impacts = np.ones(count, bool), np.zeros(count, np.int64)
        joint = self.mechanism.coordinates.index(next(iter(self.mechanism.joint_limits))) if limit is not None else -1
        for _ in range(IMPACTS):
            active = resolved & np.asarray(left > 0, bool)
            if not active.any():
                break
            held = np.zeros(count, bool)
            if limit is not None:
                held = active & self._settled(states, controls, p, joint, limit)
            for rests in (False, True):
                chosen = np.flatnonzero(active & (held == rests))
                if not len(chosen):
                    continue
                own = [each[chosen] for each in p]
                ends, used, hit, fine = self._fly(
                    states[:, chosen], controls[:, chosen], own, sizes[:, chosen], left[chosen], longest[chosen],
                    (joint,) if rests else (), joint, None if rests else limit,
                )  # fmt: skip
                states[:, chosen], left[chosen] = ends, left[chosen] - used
                resolved[chosen] &= fine
                impacts[chosen] += hit
        resolved &= ~np.asarray(left > 0, bool)
        states[:, ~resolved] = np.nan
        after = self._energy(states[:n], states[n:], p)
        return Motion(states[:n].T, states[n:].T, resolved, impacts, after - before)

    # -- flights -------------------------------------------------------------------------------

    def _settled(self, states: Array, u: Array, p: Sequence[Array], joint: int, limit: float) -> NDArray[np.bool_]:
        """Whether the joint rests on its stop; its rate is taken away there if it points outward."""
        n = self.mechanism.n
        angle = states[joint]
        outward = np.asarray((abs(angle) >= limit) & (states[n + joint] * angle >= 0), bool)
        if outward.any():
            chosen = np.flatnonzero(outward)
            own = [each[chosen] for each in p]
            states[joint, chosen] = np.where(angle[chosen] > 0, 1, -1) * self._numbers(limit)
            states[n:, chosen] = self._projected(states[:n, chosen], states[n:, chosen], own, (joint,))
            pressed = self._rates(states[:, chosen], u[:, chosen], own, ())[n + joint] * angle[chosen] >= 0
            outward[chosen] = np.asarray(pressed, bool)
        return outward

    def _fly(
        self,
        states: Array,
        u: Array,
        p: Sequence[Array],
        sizes: Array,
        left: Array,
        longest: Array,
        held: tuple[int, ...],
        joint: int,
        limit: float | None,
    ) -> tuple[Array, Array, NDArray[np.bool_], NDArray[np.bool_]]:
        """(states, time used, whether a stop was met, whether that is resolved) of flights, to the stop or the end."""
        count = states.shape[1]
        states, used = states.copy(), self._numbers(np.zeros(count))
        step = np.minimum(longest, left)
        hit, fine, done = np.zeros(count, bool), np.ones(count, bool), np.zeros(count, bool)
        for taken in range(LONGEST):
            active = np.flatnonzero(~done)
            if not len(active):
                break
            old, own, size = states[:, active], [each[active] for each in p], sizes[:, active]
            h = np.minimum(step[active], left[active] - used[active])
            new, error = self._step(old, u[:, active], own, size, h, held)
            accepted = error <= 1
            grow = np.where(error > 0, 0.8 * np.maximum(error, 1e-12) ** (-1 / (2 * LEVELS - 1)), 4.0)
            wanted = h * self._numbers(np.clip(np.where(np.isfinite(error), grow, 0.1), 0.1, 4.0))
            step[active] = np.minimum(np.where(accepted & np.asarray(h < step[active], bool), step[active], wanted),
                                      longest[active])  # fmt: skip
            arrived = used[active] + h
            if limit is not None:
                met = accepted & self._beyond(old, new, h, joint, limit)
                if met.any():
                    chosen = np.flatnonzero(met)
                    part = old[:, chosen], u[:, active][:, chosen], [each[chosen] for each in own], size[:, chosen]
                    time, there, found = self._landing(*part, h[chosen], new[:, chosen], joint, limit)
                    new[:, chosen] = there
                    arrived[chosen] = used[active][chosen] + time
                    hit[active[chosen]] = done[active[chosen]] = found
                    # What only seemed to go beyond is a flight like others.
            keep = active[accepted]
            states[:, keep], used[keep] = new[:, accepted], arrived[accepted]
            at_end = np.asarray(used[keep] >= left[keep], bool)
            done[keep] |= at_end
            lost = active[np.asarray(step[active] < SMALLEST * left[active], bool) & ~accepted]
            if taken > BRISK:  # as fast as that, it would never get there
                slow = np.asarray(step[active] * LONGEST < left[active] - used[active], bool) & ~done[active]
                lost = np.concatenate([lost, active[slow]])
            fine[lost], done[lost] = False, True
        fine &= done
        return states, np.where(done & ~hit, left, used), hit, fine

    def _beyond(self, old: Array, new: Array, h: Array, joint: int, limit: float) -> NDArray[np.bool_]:
        """Whether a step goes beyond the stop, at its end or perhaps on the way."""
        n = self.mechanism.n
        turned = np.asarray(old[n + joint] * new[n + joint] < 0, bool)
        # A parabola of these rates goes this far; twice that, as it is not one.
        reach = abs(old[joint]) + h * abs(old[n + joint])
        outward = np.asarray(old[n + joint] * old[joint] > 0, bool)
        leaving = np.asarray((abs(old[joint]) >= limit) & (old[n + joint] * old[joint] <= 0), bool)
        return np.asarray(abs(new[joint]) > limit, bool) | (
            turned & outward & ~leaving & np.asarray(reach > limit, bool)
        )

    def _landing(
        self, old: Array, u: Array, p: Sequence[Array], size: Array, h: Array, new: Array, joint: int, limit: float
    ) -> tuple[Array, Array, NDArray[np.bool_]]:
        """(time, state there, whether the stop is met) of steps that go beyond it, by bisection and secants."""
        n = self.mechanism.n
        side = np.where(abs(new[joint]) > limit, np.sign(np.asarray(new[joint], float)), 0)
        side = self._numbers(np.where(side == 0, np.sign(np.asarray(old[n + joint], float)), side))

        def state(time: Array) -> Array:
            return self._step(old, u, p, size, time, ())[0]

        # Where the end is within the stop, the turn is where it may be beyond: the rate's zero comes first.
        turning = np.asarray(side * new[joint] <= limit, bool)
        end, found = h, np.ones(len(h), bool)
        if turning.any():
            inward = -side * old[n + joint], -side * new[n + joint]
            turn = _zero(lambda time: -side * state(time)[n + joint], *inward, h, turning)
            end = np.where(turning, turn, h)
            there = state(end)
            found = ~turning | np.asarray(side * there[joint] > limit, bool)
            new = np.where(turning, there, new)
        start = side * old[joint] - limit
        beyond = side * new[joint] - limit
        time = _zero(lambda time: side * state(time)[joint] - limit, start, beyond, end, found)
        time = np.where(found, time, h)
        there = state(time)
        there[joint] = np.where(found, side * self._numbers(limit), there[joint])
        return time, there, found

    def _step(
        self, states: Array, u: Array, p: Sequence[Array], sizes: Array, h: Array, held: tuple[int, ...]
    ) -> tuple[Array, NDArray[np.float64]]:
        """States (2n, N) after steps h (N,), and their errors over what is allowed (N,): Gragg, Bulirsch and Stoer."""
        slope = self._rates(states, u, p, held)
        table: list[Array] = []
        for level in range(1, LEVELS + 1):
            part = h / (2 * level)
            last, now = states, states + part * slope
            for _ in range(2 * level - 1):
                last, now = now, last + 2 * part * self._rates(now, u, p, held)
            row = [(last + now + part * self._rates(now, u, p, held)) / 2]
            for k, previous in enumerate(table, start=1):
                ratio = self._numbers(level * level) / ((level - k) * (level - k))
                row.append(row[-1] + (row[-1] - previous) / (ratio - 1))
            table = row
        new = table[-1]
        scale = np.maximum(abs(states), abs(new)) + abs(h * slope) + sizes
        error = np.asarray(abs(table[-1] - table[-2]) / scale, float).max(axis=0) / self._tolerance
        return new, np.where(np.isfinite(error), error, np.inf)

    # -- equations -----------------------------------------------------------------------------

    def _rates(self, states: Array, u: Array, p: Sequence[Array], held: tuple[int, ...]) -> Array:
        """Rates (2n, N) of (q, q̇).

        Off the constraints, where a midpoint lies, λ has poles that the motion has not (the snakeboard's φ = ±π/2): the
        equations are those of the nearest velocity that satisfies them.
        """
        n = self.mechanism.n
        q = states[:n]
        place = _Place(*self._at(q, p), held)
        rates = place.project(states[n:])
        bias, curvature = self._ingredients.moving(*q, *p, *rates)
        drive = [
            sum((u[a] * row[i] for a, row in enumerate(place.forces)), -each + 0 * q[0]) for i, each in enumerate(bias)
        ]
        return np.stack([*rates, *place.respond(drive, [*curvature, *([0] * len(held))])])

    def _projected(self, q: Array, qdot: Array, p: Sequence[Array], held: tuple[int, ...]) -> Array:
        """Velocities (n, N) less what violates the constraints, orthogonally."""
        return np.stack(_Place(*self._at(q, p), held).project(qdot))

    def _energy(self, q: Array, qdot: Array, p: Sequence[Array]) -> Array:
        inertia, _, _, potential = self._at(q, p)
        return _dot([_dot(row, qdot) for row in inertia], qdot) / 2 + potential

    def _at(self, q: Array, p: Sequence[Array]) -> tuple[Rows, Rows, Rows, Array]:
        """(inertia tensor, constraint one-forms, control forces, potential) at coordinates (n, N)."""
        inertia, forms, forces, potential = self._ingredients.resting(*q, *p)
        nothing = 0 * q[0]
        matrices = [[[entry + nothing for entry in row] for row in rows] for rows in (inertia, forms, forces)]
        return (*matrices, potential + nothing)

    # -- numbers -------------------------------------------------------------------------------

    def _precision(self) -> contextlib.AbstractContextManager[Any]:
        return contextlib.nullcontext() if self.digits is None else mpmath.workdps(self.digits)

    def _numbers(self, values: ArrayLike) -> Array:
        if self.digits is None:
            return np.asarray(values, np.longdouble)
        array = np.asarray(values)
        return np.frompyfunc(_mpf, 1, 1)(array) if array.ndim else mpmath.mpf(array.item())

    def _parameters(self, params: Mapping[str, ArrayLike], count: int) -> list[Array]:
        return [self._numbers(np.broadcast_to(params[name], count)) for name in self.mechanism.parameters]


def _zero(
    function: Callable[[Array], Array], below: Array, above: Array, end: Array, wanted: NDArray[np.bool_]
) -> Array:
    """Times (N,) in (0, end] at which a function passes zero upward, from `below` to `above`: Illinois' method.

    Where that is not `wanted`, any time.
    """
    low, high = 0 * end, end
    for _ in range(SEARCH):
        slope = above - below
        time = low - below * (high - low) / np.where(slope != 0, slope, 1)
        time = np.where((time > low) & (time < high), time, (low + high) / 2)
        value = function(time)
        out = np.asarray(value > 0, bool)
        # An end that stays is given half its weight.
        low, below, high, above = (
            np.where(out, low, time), np.where(out, below / 2, value),
            np.where(out, time, high), np.where(out, value, above / 2),
        )  # fmt: skip
        if np.all(np.asarray((high - low <= NEAR * end) | (abs(value) <= NEAR), bool) | ~wanted):
            break
    return np.where(abs(above) < abs(below), high, low)


def _mpf(value: Any) -> Any:
    return value if isinstance(value, mpmath.mpf) else mpmath.mpf(float(value))


class _Place:
    """Inertia and constraints at configurations (n, N), those of joints `held` on their stops included."""

    def __init__(self, inertia: Rows, forms: Rows, forces: Rows, potential: Array, held: tuple[int, ...]) -> None:
        nothing = 0 * potential
        held_forms = [[nothing + (1 if i == joint else 0) for i in range(len(inertia))] for joint in held]
        self.forms, self.forces = [*forms, *held_forms], forces
        self._inertia = _Cholesky(inertia)
        self._answers = [self._inertia.solve(row) for row in self.forms]  # M^-1 ω^T, a row each
        self._gram = _Cholesky([[_dot(row, answer) for answer in self._answers] for row in self.forms])

    def project(self, qdot: Vector) -> list[Array]:
        """Velocities less what violates the constraints."""
        return self._less(qdot, [_dot(row, qdot) for row in self.forms])

    def respond(self, drive: Sequence[Array], curvature: Sequence[Any]) -> list[Array]:
        """Accelerations under covectors `drive`."""
        free = self._inertia.solve(drive)
        return self._less(free, [bend + _dot(row, free) for bend, row in zip(curvature, self.forms, strict=True)])

    def _less(self, vector: Vector, violation: list[Array]) -> list[Array]:
        multipliers = self._gram.solve(violation)
        return [
            each - sum(m * answer[i] for m, answer in zip(multipliers, self._answers, strict=True))
            for i, each in enumerate(vector)
        ]


class _Cholesky:
    """Symmetric positive definite matrices, entries (N,), whose sizes may be as different as they like."""

    def __init__(self, matrix: Rows) -> None:
        size = len(matrix)
        self._factors: Rows = [[] for _ in range(size)]
        self._pivots: list[Array] = []
        for i in range(size):
            for j in range(i):
                inner = sum(self._factors[i][k] * self._factors[j][k] * self._pivots[k] for k in range(j))
                self._factors[i].append((matrix[i][j] - inner) / self._pivots[j])
            inner = sum(self._factors[i][k] ** 2 * self._pivots[k] for k in range(i))
            self._pivots.append(matrix[i][i] - inner)

    def solve(self, right: Sequence[Array]) -> list[Array]:
        """The solution, a row of numbers (N,) for each unknown."""
        size, x = len(right), list(right)
        for i in range(size):
            for k in range(i):
                x[i] = x[i] - self._factors[i][k] * x[k]
        x = [each / pivot for each, pivot in zip(x, self._pivots, strict=True)]
        for i in reversed(range(size)):
            for k in range(i + 1, size):
                x[i] = x[i] - self._factors[k][i] * x[k]
        return x


def _dot(a: Vector, b: Vector) -> Any:
    total = a[0] * b[0]
    for x, y in zip(a[1:], b[1:], strict=True):
        total = total + x * y
    return total


@dataclass(frozen=True)
class _Ingredients:
    """What the equations are made of.

    Attributes:
        resting: (*q, *parameters) -> (inertia tensor, constraint one-forms, control forces, potential).
        moving: (*q, *parameters, *q̇) -> (d/dt (M q̇) - ∂/∂q (T - V) without q̈, ω̇ q̇).
    """

    resting: Callable[..., Any]
    moving: Callable[..., Any]


@cache
def _ingredients(data: str, digits: int | None) -> _Ingredients:
    mechanism = Mechanism.from_dict(json.loads(data))
    t = textbook(mechanism)
    modules: list[Any] = ["numpy"]
    if digits is not None:
        functions = ("sin", "cos", "tan", "sqrt", "exp", "log", "atan", "asin", "acos", "sinh", "cosh", "tanh")
        modules = [{f: np.frompyfunc(getattr(mpmath, f), 1, 1) for f in functions}, "numpy"]
    places = [*t.q, *t.parameters]
    resting = [t.inertia, t.forms, t.forces, mechanism.symbolic(mechanism.potential)]
    return _Ingredients(
        sp.lambdify(places, resting, modules, cse=True),
        sp.lambdify([*places, *t.qdot], [t.bias, t.turning], modules, cse=True),
    )

"""True motions: Lagrange's multipliers in long double, extrapolated to order sixteen.

The equations of `benchmarks.textbook` are solved for many states at once and integrated by Gragg's midpoint rule,
extrapolated as Bulirsch and Stoer do (rational weights, so that no coefficient is rounded to double precision). The
number of steps of each state is doubled until doubling changes nothing; what is returned is the finer result, at the
rounding of long double, 1e-19.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from fractions import Fraction
from typing import Any

import numpy as np
import sympy as sp
from numpy.typing import ArrayLike, NDArray

from benchmarks.textbook import textbook
from mechanics.mechanism import Mechanism

__all__ = ["Reference"]

Array = NDArray[Any]  # of np.longdouble

LONG = np.longdouble
DIGITS = 63  # bits of the mantissa that are needed; a platform where long double is double has 52
COLUMNS = 8  # midpoint rules with 2, 4, .. 16 substeps: order 16
AGREEMENT = 1e-15  # of two results, where the finer is then 2**16 times as accurate
STEPS_A_RADIAN = 2  # to begin with; some six are needed
MOST_STEPS = 1 << 12


class Reference:
    """A mechanism's motions under controls that are held.

    Args:
        mechanism: what moves; without drag.
        params: values that replace the mechanism's defaults.
        refinement: factor for all numbers of steps; with 2, the result says how good that with 1 is.
    """

    def __init__(self, mechanism: Mechanism, params: Mapping[str, float] | None = None, *, refinement: int = 1) -> None:
        if np.finfo(LONG).nmant < DIGITS:
            raise RuntimeError(
                f"long double has {np.finfo(LONG).nmant} bits on this machine and {DIGITS} are needed; "
                "run this on x86-64 or on Linux for ARM"
            )
        self.mechanism, self.refinement = mechanism, refinement
        self._params = [LONG(value) for value in mechanism.resolve(params).values()]
        self._ingredients = _ingredients(mechanism)
        counts = [2 * j for j in range(COLUMNS, 0, -1)]
        self._weights = {count: _weight(count, counts) for count in counts}

    def start(self, q: ArrayLike, qdot: ArrayLike) -> tuple[Array, Array]:
        """Coordinates and velocities (B, n) in long double, which satisfy the constraints to its rounding."""
        q, qdot = np.array(q, LONG), np.array(qdot, LONG)
        M, forms, _, _, _ = self._numbers(q.T, qdot.T)
        drift = [-_dot(row, qdot.T) for row in forms]
        change = _solve(M, forms, [_ZERO] * len(M), drift)
        return q, qdot + np.stack(np.broadcast_arrays(*change, qdot[:, 0])[:-1], axis=-1)

    def acceleration(self, q: Array, qdot: Array, u: Array) -> Array:
        """Accelerations (n, B) of coordinates (n, B) with velocities (n, B) under controls (m, B)."""
        M, forms, forces, bias, turning = self._numbers(q, qdot)
        right = [_minus(_dot([row[a] for row in forces], u), b) for a, b in enumerate(bias)]
        found = _solve(M, forms, right, [-g for g in turning])
        return np.stack([np.broadcast_to(a, q.shape[1:]) for a in found])

    def hold(self, q: Array, qdot: Array, u: ArrayLike, dt: float) -> tuple[Array, Array, NDArray[np.int64]]:
        """State after controls u (B, m) were held for dt seconds: q (B, n), q̇ (B, n), and the steps taken (B,)."""
        state, n = np.concatenate([q.T, qdot.T]), q.shape[1]
        controls, length = np.array(u, LONG).T, LONG(dt)
        result, taken = np.empty_like(state), np.zeros(state.shape[1], np.int64)
        turned = np.abs(state[n:]).max(axis=0).astype(float) * dt * STEPS_A_RADIAN
        first = self.refinement * 2 ** np.floor(np.log2(np.maximum(turned, 1))).astype(np.int64)
        steps = int(first.min(initial=self.refinement))
        before = np.full_like(state, np.nan)  # by half as many steps
        with np.errstate(all="ignore"):  # too few steps may lead anywhere
            while (todo := np.flatnonzero(taken == 0)).size:
                if steps > MOST_STEPS:
                    raise RuntimeError(f"{self.mechanism.name}: no agreement in {steps} steps from {state[:, todo[0]]}")
                begun = todo[first[todo] <= steps]
                now = self._steps(state[:, begun], controls[:, begun], length, steps)
                scale = np.maximum(1, np.abs(state[:, begun]).max(axis=0))
                agreed = np.abs(now - before[:, begun]).max(axis=0) <= AGREEMENT * scale
                result[:, begun[agreed]], taken[begun[agreed]], before[:, begun] = now[:, agreed], steps, now
                steps *= 2
        return result[:n].T.copy(), result[n:].T.copy(), taken

    def motion(
        self, q: ArrayLike, qdot: ArrayLike, law: Callable[[int, Array, Array], ArrayLike], dt: float, holds: int
    ) -> tuple[Array, Array]:
        """Coordinates and velocities (T + 1, B, n) at the ends of T holds.

        Args:
            q: coordinates at the beginning, (B, n).
            qdot: velocities at the beginning, (B, n).
            law: number of the hold, q and q̇ (B, n) at its beginning -> controls (B, m).
            dt: length of a hold.
            holds: number T of them.
        """
        states = [self.start(q, qdot)]
        for hold in range(holds):
            states.append(self.hold(*states[-1], law(hold, *states[-1]), dt)[:2])
        return np.stack([state[0] for state in states]), np.stack([state[1] for state in states])

    def _steps(self, state: Array, u: Array, dt: Any, steps: int) -> Array:
        h = dt / steps
        for _ in range(steps):
            state = state + self._increment(state, u, h)
        return state

    def _increment(self, state: Array, u: Array, h: Any) -> Array:
        """What one extrapolated step adds: midpoint rules in the distance gone, whose roundings are small."""
        # All rules side by side, the longest first: those that are through stand at the end.
        width = state.shape[1]
        lengths = [h / count for count in self._weights]
        part = np.repeat(np.array(lengths, LONG), width)
        origin, u = np.tile(state, len(lengths)), np.tile(u, len(lengths))
        distance = part * np.tile(self._rates(state, u[:, :width]), len(lengths))
        before = np.zeros_like(distance)
        for substep in range(1, max(self._weights)):
            going = slice(0, width * sum(count > substep for count in self._weights))
            rates = self._rates(origin[:, going] + distance[:, going], u[:, going])
            before[:, going] += 2 * part[going] * rates
            before[:, going], distance[:, going] = distance[:, going].copy(), before[:, going].copy()
        parts = distance.reshape(len(state), len(lengths), width)
        return sum((weight * parts[:, i] for i, weight in enumerate(self._weights.values())), np.zeros_like(state))

    def _rates(self, state: Array, u: Array) -> Array:
        n = len(state) // 2
        return np.concatenate([state[n:], self.acceleration(state[:n], state[n:], u)])

    def _numbers(self, q: Array, qdot: Array) -> Any:
        return self._ingredients(*q, *self._params, *qdot)


# -- ingredients -----------------------------------------------------------------------------------

_ZERO = 0  # what generated code returns for an entry that is identically zero


def _ingredients(mechanism: Mechanism) -> Callable[..., Any]:
    """Function of (*q, *parameters, *q̇) -> M (n, n), ω (c, n), F (m, n), bias (n,), turning (c,)."""
    t = textbook(mechanism)
    outputs = [t.inertia, t.forms, t.forces, t.bias, t.turning]
    return sp.lambdify([*t.q, *t.parameters, *t.qdot], outputs, "numpy", cse=True)


def _weight(count: int, counts: Sequence[int]) -> Any:
    """Weight of the rule with `count` substeps in the limit of infinitely many."""
    weight = Fraction(1)
    for other in counts:
        if other != count:
            weight *= Fraction(count**2, count**2 - other**2)
    return LONG(weight.numerator) / LONG(weight.denominator)


def _absent(entry: Any) -> bool:
    return isinstance(entry, int) and entry == 0


def _dot(row: Any, column: Any) -> Any:
    total: Any = _ZERO
    for a, b in zip(row, column, strict=True):
        if not _absent(a):
            total = a * b if _absent(total) else total + a * b
    return total


def _minus(a: Any, b: Any) -> Any:
    return a if _absent(b) else -b if _absent(a) else a - b


def _solve(M: Any, forms: Any, right: Sequence[Any], drift: Sequence[Any]) -> list[Any]:
    """The part x of (x, λ) with M x - ω^T λ = right, ω x = drift.

    Gauss's elimination in the given order, arrays as entries, zeros skipped: M is positive definite, and so is what is
    left for λ, therefore no pivot vanishes.
    """
    n, c = len(M), len(forms)
    rows = [[*M[i], *(_minus(_ZERO, forms[r][i]) for r in range(c)), right[i]] for i in range(n)]
    rows += [[*forms[r], *[_ZERO] * c, drift[r]] for r in range(c)]
    for k, pivot in enumerate(rows):
        for row in rows[k + 1 :]:
            if _absent(row[k]):
                continue
            factor = row[k] / pivot[k]
            for j in range(k + 1, n + c + 1):
                if not _absent(pivot[j]):
                    row[j] = _minus(row[j], factor * pivot[j])
    x: list[Any] = [_ZERO] * (n + c)
    for k in reversed(range(n + c)):
        rest = _minus(rows[k][-1], _dot(rows[k][k + 1 : -1], x[k + 1 :]))
        x[k] = _ZERO if _absent(rest) else rest / rows[k][k]
    return x[:n]

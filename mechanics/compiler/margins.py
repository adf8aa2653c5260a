"""How far a frame is from where it fails: at a pole, or where one of its vector fields vanishes.

The motion may be smooth there, but the pseudo-velocities are not: an error of these, or the rounding of an angle, is
divided by the margin before it is one of q̇ = X v, and the stages of a method go through that once more. So a method
may use the square of the margin of its tolerance, and must give up where a rounding is more than the tolerance.

A margin compares an expression with the sum of its terms without their signs, sines and cosines at their largest. It
has no unit, is at most about 1, and depends neither on how large a body is nor on how its masses compare:

* |d|/(that sum) of what the equations divide by, if it has zeros (the roller racer's ℓ₂ + ℓ₁ cos ψ in its frame
  "paper"). What is positive for every body that can exist, such as the length of a vector field, does not count: it is
  small where the inertia is, which does no harm.
* for each vector field the sum of the same over its components: it vanishes where all of them do (the roller racer's
  X₁ where ℓ₁ = ℓ₂ and ψ = π).

What holds divisions inside of what is divided by, or coordinates outside of sines and cosines, has no margin here.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np
import sympy as sp
from numpy.typing import NDArray

from mechanics.compiler.codegen import needed
from mechanics.geometry.reduction import ReducedEquations
from mechanics.geometry.symmetry import planar_symmetry
from mechanics.mechanism import Matrix

__all__ = ["trust"]

Array = NDArray[np.float64]

# Where a margin is above 1/GAIN, all of the tolerance may be used: always in the racer's default frame with its default
# parameters.
GAIN = 2.0
# Roundings make an error of q̇, over 1 + |q̇|, of this over the margin in a hold: two units in the last place of an
# angle near π. Measured on racers of nearly equal links: up to 7e-16.
ROUNDING = 1e-15

POINTS, DECADES = 20_000, 1.0  # where it is tried whether a margin ever is small, parameters so far from their defaults


def trust(equations: ReducedEquations, frame: Matrix | None, tolerance: float | sp.Symbol) -> tuple[sp.Expr, ...]:
    """Shares of a tolerance, in terms of coordinates and parameters: the square of the least may be used.

    They are above 1 wherever the frame is good, and not positive where a rounding alone is more than the tolerance.
    Those that never are below 1 are left out.

    Args:
        equations: of a mechanism.
        frame: the rows of vector fields that they were derived in, None for a frame that was found.
        tolerance: of q̇, over 1 + |q̇|.
    """
    trial = _Trial(equations)
    margins = dict.fromkeys([*_poles(equations, trial), *_lengths(equations, frame)])
    return tuple(GAIN * (m - ROUNDING / tolerance) for m in margins if (trial.values(m) < 1 / GAIN).any())


def _poles(equations: ReducedEquations, trial: _Trial) -> Iterable[sp.Expr]:
    """Margins of what the rates divide by."""
    rates = [*equations.velocity, *equations.acceleration]
    texts = [*rates, *needed(rates, equations.definitions).values()]
    powers = sorted({power for text in texts for power in text.atoms(sp.Pow)}, key=sp.default_sort_key)
    for power in powers:
        if power.exp.is_Integer and power.exp < 0:  # below a root is only what is positive
            for factor in sp.Mul.make_args(power.base):
                base = factor.base if factor.is_Pow else factor
                reach = _reach(base, equations)
                if reach is not None and reach != sp.Abs(base) and trial.has_zeros(base):
                    yield sp.Abs(base) / reach


def _lengths(equations: ReducedEquations, frame: Matrix | None) -> Iterable[sp.Expr]:
    """Margins of the vector fields."""
    mechanism = equations.mechanism
    symmetry = planar_symmetry(mechanism, frame)
    # Lengths do not depend on the pose: they are read where the axes agree.
    still = dict.fromkeys(map(sp.Symbol, mechanism.fibre), sp.S.Zero) if symmetry and not symmetry.turning else {}
    for column in range(equations.frame.cols):
        parts = set()
        for entry in equations.frame.col(column).xreplace(still):
            above = sp.Mul(*(f for f in sp.Mul.make_args(entry) if not (f.is_Pow and f.exp.is_negative)))
            reach = _reach(above, equations)
            if reach not in (None, 0):
                parts.add(sp.S.One if reach == sp.Abs(above) else sp.Abs(above) / reach)
        if parts and sp.S.One not in parts:
            yield sp.Add(*parts)


def _reach(expression: sp.Expr, equations: ReducedEquations) -> sp.Expr | None:
    """Bound of |expression| whatever the angles are, in terms of parameters; None if none is known."""
    meanings = dict(equations.definitions)
    fixed = set(equations.parameters)

    def reach(e: sp.Expr) -> sp.Expr | None:
        if e.free_symbols <= fixed:
            return sp.Abs(e)
        if e in meanings:
            return reach(meanings[e])
        if e.func in (sp.sin, sp.cos):
            return sp.S.One
        if e.is_Pow and e.exp.is_Rational and e.exp.is_positive:
            inner = reach(e.base)
            return None if inner is None else inner**e.exp
        if e.is_Add or e.is_Mul or e.func is sp.Abs:
            parts = [reach(a) for a in e.args]
            if all(part is not None for part in parts):
                return (sp.Mul if e.is_Mul else sp.Add)(*parts)
        return None

    return reach(expression)


class _Trial:
    """Bodies that can exist, of many proportions, at random configurations."""

    def __init__(self, equations: ReducedEquations) -> None:
        mechanism, rng = equations.mechanism, np.random.default_rng(3)
        numbers = {**mechanism.parameters, **mechanism.drag}
        values: dict[str, Array] = {
            name: value * 10 ** rng.uniform(-DECADES, DECADES, POINTS) for name, value in numbers.items()
        }
        values |= {name: rng.uniform(-np.pi, np.pi, POINTS) for name in mechanism.coordinates}
        with np.errstate(all="ignore"):
            inertia = mechanism.numeric(mechanism.inertia, values)
        finite = np.asarray(np.isfinite(inertia).all(axis=(1, 2)), bool)
        smallest = np.linalg.eigvalsh(np.where(finite[:, None, None], inertia, -1.0))[:, 0]
        exists = np.asarray(smallest > 0, bool)
        self._known: dict[sp.Symbol, Array] = {sp.Symbol(name): array[exists] for name, array in values.items()}
        self._meanings: Mapping[sp.Symbol, sp.Expr] = dict(equations.definitions)

    def values(self, expression: sp.Expr) -> Array:
        """Its value at each of them."""
        for symbol, meaning in needed([expression], [*self._meanings.items()]).items():
            if symbol not in self._known:
                self._known[symbol] = self._value(meaning)
        return self._value(expression)

    def has_zeros(self, expression: sp.Expr) -> bool:
        """Whether its sign changes."""
        values = self.values(expression)
        return bool((values > 0).any() and (values < 0).any())

    def _value(self, expression: sp.Expr) -> Array:
        symbols = sorted(expression.free_symbols, key=str)
        with np.errstate(all="ignore"):
            return np.asarray(sp.lambdify(symbols, expression, "numpy")(*(self._known[s] for s in symbols)), float)

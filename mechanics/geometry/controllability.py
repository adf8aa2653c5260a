"""Section 6: where can a mechanism go from rest?

Y_a are the input fields P M^-1 F_a, <Y:Z> = ∇̃_Y Z + ∇̃_Z Y is the symmetric product, Sym the smallest set of
fields that contains the Y_a and their symmetric products, Lie(Sym) its closure under Lie brackets. From
rest at q, without potential and without drag (Lewis and Murray 1997, Lewis 2000):

* *locally configuration accessible* (what can be reached contains an open set) if Lie(Sym) has rank n at q. If it
  has less everywhere, nowhere: motions from rest stay in its integral manifolds. (All data are analytic; the rank
  at a random configuration is the rank almost everywhere, and nowhere exceeded.)
* *locally configuration controllable* (q is inside of what can be reached, in however short a time) if moreover
  every bad product is at q a linear combination of good products of fewer factors. A product is bad if every
  Y_a occurs in it an even number of times. This condition is sufficient only, and depends on the choice
  of controls: where it fails nothing follows, but for a single control (below).
* All velocities in D can be had too if Sym spans D at q; none outside of Sym, where it spans less everywhere.

One control with <Y:Y> not in span Y at q: not locally configuration controllable with bounded forces
(Lewis 1997). For let f be a function with Y(f) = 0 nearby and df(<Y:Y>) = -2 at q, and q̇ = w Y + z. In a short
time from rest |z| <= C ∫ w² dt, as only w is driven, and f̈ = w² + O(|q - q0| w² + |w||z| + |z|²): f never sinks.

A. D. Lewis and R. M. Murray, Configuration controllability of simple mechanical control systems, SIAM J. Control and
Optimization 35(3), 1997. A. D. Lewis, Local configuration controllability for a class of mechanical systems
with a single input, European Control Conference 1997. A. D. Lewis, Simple mechanical control systems with
constraints, IEEE Trans. Automatic Control 45(8), 2000 (the paper's reference [11]).
"""

from __future__ import annotations

import numbers
from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import Any

import mpmath
import numpy as np
import sympy as sp

from mechanics.geometry.closures import Field
from mechanics.geometry.formulas import Formulas
from mechanics.geometry.jets import DIGITS
from mechanics.geometry.reduction import ReducedEquations, reduce
from mechanics.geometry.verdict import LargestRanks, Point, Report, examine
from mechanics.mechanism import Mechanism, MechanismError

__all__ = ["Controllability", "Report", "analyse"]

# A float stands for anything within 1e-10 of it: a rounded pi/2, or a root that a solver found, is
# wrong by 1e-16. Whole numbers, fractions and SymPy's numbers are told apart to 28 digits.
FLOAT_RESOLUTION, EXACT_RESOLUTION = 1e-10, 1e-30
MAX_DEGREE = 8


def analyse(
    mechanism: Mechanism, frame: str | Sequence[Sequence[str]] | None = None, degree: int = 4
) -> Controllability:
    """Controllability of a mechanism from rest, as in section 6.

    Drag is left out, even if the mechanism declares some.

    Args:
        mechanism: one that no potential moves.
        frame: as in `mechanics.reduce`. The formulas depend on it, the answers do not.
        degree: largest number of factors of symmetric products and of Lie brackets.

    Raises:
        MechanismError: if the conditions do not apply to this mechanism.
    """
    return Controllability(reduce(mechanism, frame), degree)


class Controllability:
    """Controllability of a mechanism from rest, in general and at any configuration.

    Args:
        equations: the reduced equations.
        degree: largest number of factors.

    Attributes:
        equations: as given.
        degree: as given.
        inputs: control -> name of its input field. One that is a multiple of a vector X_i of the frame, by a factor
            that vanishes nowhere, is replaced with X_i as in section 6: only the unit of the control changes.
        generic: report on almost all configurations, for parameters near their defaults.
    """

    def __init__(self, equations: ReducedEquations, degree: int = 4) -> None:
        m = equations.mechanism
        if isinstance(degree, bool) or not isinstance(degree, int) or not 1 <= degree <= MAX_DEGREE:
            raise MechanismError(f"{m.name}: degree must be a whole number from 1 to {MAX_DEGREE}, got {degree!r}")
        if not m.controls:
            raise MechanismError(f"{m.name}: without controls it stays at rest; declare forces")
        if any(e != 0 for e in equations.potential_acceleration):
            raise MechanismError(
                f"{m.name}: the potential {m.potential} moves it from rest, and these conditions are for motions that "
                'controls alone begin; analyse dataclasses.replace(mechanism, potential="0") to see what they can do'
            )
        self.equations, self.degree = equations, degree
        self._inputs = _input_fields(equations)
        self._largest: dict[tuple[Any, ...], LargestRanks] = {}  # by the parameters' values
        self.inputs = dict(zip(m.controls, (name for name, _ in self._inputs), strict=True))
        rng = np.random.default_rng(7)
        params = {name: value * rng.uniform(0.9, 1.1) for name, value in m.parameters.items()}
        with mpmath.workdps(DIGITS):
            point, largest, self._symmetric, self._closure = self._in_general(_numbers(m, params))
            self.generic = examine(point, largest)

    def _in_general(self, params: Mapping[str, Any]) -> tuple[Point, LargestRanks, list[Field], list[Field]]:
        """A point in general position for some parameters, and what the closures are there: as large as anywhere."""
        m, rng = self.equations.mechanism, np.random.default_rng(8)
        q = {name: m.joint_limits.get(name, np.pi) * rng.uniform(-1, 1) for name in m.coordinates}
        point = Point(self.equations, self._inputs, {**params, **_numbers(m, q)}, self.degree, FLOAT_RESOLUTION)
        symmetric, complete = point.products.basis(self.degree)
        closure, known = point.brackets(symmetric).basis(self.degree)
        largest = LargestRanks(len(symmetric) if complete else None, len(closure) if complete and known else None)
        return point, largest, symmetric, closure

    def at(self, q: Sequence[Any] | Mapping[str, Any], params: Mapping[str, Any] | None = None) -> Report:
        """Report on one configuration.

        Args:
            q: (n,) coordinates, or by name. A float means anything within 1e-10 of it (`math.pi/2` is
                a right angle); if all of q and of the parameters are whole numbers, fractions and SymPy's
                numbers, 28 digits count.
            params: values that replace the mechanism's defaults.

        Raises:
            MechanismError: for impossible values, and where the frame has a pole or does not span D.
        """
        m = self.equations.mechanism
        by_name = q if isinstance(q, Mapping) else dict(zip(m.coordinates, q, strict=False))
        if len(q) != m.n or set(by_name) != set(m.coordinates):
            raise MechanismError(f"{m.name}: q must be {m.n} numbers, for {', '.join(m.coordinates)}; got {q!r}")
        m.resolve(params)
        given = {**m.parameters, **(params or {}), **by_name}
        resolution = EXACT_RESOLUTION if all(map(_is_exact, given.values())) else FLOAT_RESOLUTION
        with mpmath.workdps(DIGITS):
            values = _numbers(m, given)
            key = tuple(values[name] for name in m.parameters)
            if key not in self._largest:
                self._largest[key] = self._in_general({name: values[name] for name in m.parameters})[1]
            point = Point(self.equations, self._inputs, values, self.degree, resolution)
            return examine(point, self._largest[key])

    # -- formulas ------------------------------------------------------------------------------

    @cached_property
    def _formulas(self) -> Formulas:
        return Formulas(self.equations, self._inputs)

    def symmetric_products(self, degree: int) -> dict[str, tuple[sp.Expr, ...]]:
        """Symmetric products of so many factors, without those that vanish everywhere; (k,) along the frame."""
        return self._formulas.written(self._formulas.products(degree))

    @cached_property
    def symmetric(self) -> dict[str, tuple[sp.Expr, ...]]:
        """Symmetric products that span Sym at almost all configurations; (k,) along the frame."""
        return self._formulas.written(self._symmetric)

    @cached_property
    def closure(self) -> dict[str, tuple[sp.Expr, ...]]:
        """Brackets of those, or of the frame if they span D, that span Lie(Sym) there; (n,) along the coordinates."""
        return self._formulas.written(self._closure)

    @cached_property
    def symmetric_conditions(self) -> tuple[sp.Expr, ...] | None:
        """Functions of q: `symmetric` spans D where none of them is zero. None if it does so nowhere."""
        return self._formulas.conditions(self._symmetric) if len(self._symmetric) == self.generic.rank else None

    @cached_property
    def closure_conditions(self) -> tuple[sp.Expr, ...] | None:
        """Functions of q: `closure` spans all directions where none of them is zero. None if it does so nowhere."""
        return self._formulas.conditions(self._closure) if len(self._closure) == self.generic.dimension else None

    @property
    def conditions(self) -> tuple[sp.Expr, ...] | None:
        """Functions of q: accessible where none of them is zero (sufficient: elsewhere ask `at`). None if nowhere."""
        if self.closure_conditions is None:
            return None
        return tuple(dict.fromkeys((*(self.symmetric_conditions or ()), *self.closure_conditions)))

    def __str__(self) -> str:
        e = self.equations
        lines = [f"{control} acts along {name}" for control, name in self.inputs.items()]
        try:
            lines += [f"{name} = ({', '.join(map(str, value))}) in the frame" for name, value in self.symmetric.items()]
            lines += [f"{name} = ({', '.join(map(str, value))})" for name, value in self.closure.items()]
            for title, conditions in (("Sym spans D", self.symmetric_conditions), ("accessible", self.conditions)):
                if conditions:
                    lines.append(f"{title} where none of these is zero: {', '.join(map(str, conditions))}")
        except MechanismError as error:
            lines.append(str(error))
        return "\n  ".join((f"{e.mechanism.name}: {', '.join(e.mechanism.coordinates)}", *lines)) + f"\n{self.generic}"


def _input_fields(e: ReducedEquations) -> list[tuple[str, tuple[sp.Expr, ...]]]:
    """Name of each control's field and its components along the frame.

    Where F_a(X_i) = Y^i_a |X_i|^2 is a number for one i and zero for the others, X_i stands for Y_a.
    """
    k, m = e.input_coefficients.shape
    rng = np.random.default_rng(9)  # An identity between analytic functions that holds at random points holds.
    symbols = [*e.coordinates, *e.parameters]
    sizes = [*[1.0] * len(e.coordinates), *e.mechanism.parameters.values()]
    points = [rng.uniform(0.9, 1.1, len(sizes)) * sizes for _ in range(3)]
    fields = []
    for a in range(m):
        along = [i for i in range(k) if e.input_coefficients[i, a] != 0]
        fields.append((f"Y{a + 1}", tuple(e.input_coefficients[:, a])))
        if len(along) == 1:
            (i,) = along
            pairing = sp.lambdify(symbols, e.input_coefficients[i, a] * e.squared_norms[i], "numpy")
            values = [pairing(*point) for point in points]
            if np.allclose(values, values[0], rtol=1e-9, atol=0):
                fields[-1] = (f"X{i + 1}", tuple(sp.Integer(i == j) for j in range(k)))
    return fields


def _numbers(mechanism: Mechanism, values: Mapping[str, Any]) -> dict[str, Any]:
    """The values as mpmath's numbers."""
    result = {}
    for name, value in values.items():
        try:
            if isinstance(value, sp.Expr):
                number = sp.lambdify((), value, "mpmath")()
            elif isinstance(value, numbers.Rational):
                number = mpmath.mpf(int(value.numerator)) / int(value.denominator)
            else:
                number = mpmath.mpf(float(value))
            if mpmath.isfinite(number):
                result[name] = mpmath.mpf(number)
                continue
        except (TypeError, ValueError, NameError):
            pass
        raise MechanismError(f"{mechanism.name}: {name} must be a finite real number, got {value!r}")
    return result


def _is_exact(value: Any) -> bool:
    return isinstance(value, numbers.Rational) or (isinstance(value, sp.Expr) and not value.has(sp.Float))

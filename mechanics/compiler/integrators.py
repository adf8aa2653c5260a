"""One-step methods as data: a method *is* its Butcher tableau.

    Z_i = z0 + h sum_j a_ij f(Z_j),    z1 = z0 + h sum_i b_i f(Z_i)

An explicit tableau (strictly lower triangular `a`) integrates anything. A full one, such as
Gauss-Legendre collocation, would be implicit on coupled states, but is evaluated explicitly on
states that depend on one another in layers only; `codegen` needs no more than the numbers here.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, partial

from mechanics.expressions import unknown_name

__all__ = ["Method", "method", "method_names"]

# Coefficients are double precision: conditions on them hold to a few roundings of a sum of 12.
CONDITION_TOLERANCE = 1e-14


@dataclass(frozen=True)
class Method:
    """A Runge-Kutta method of s stages, which checks its own consistency.

    Attributes:
        name: as chosen by a user, such as "gauss4".
        a: [s, s] stage weights.
        b: [s] end weights.
        c: [s] nodes, as fractions of the step.
        order: the error of one step of length h is O(h^(order + 1)).
        source: where the coefficients come from.
    """

    name: str
    a: tuple[tuple[float, ...], ...]
    b: tuple[float, ...]
    c: tuple[float, ...]
    order: int
    source: str

    def __post_init__(self) -> None:
        if len(self.a) != self.stages or any(len(row) != self.stages for row in self.a) or len(self.c) != self.stages:
            raise ValueError(f"{self.name}: a must be s x s, b and c of length s")
        for row, c in zip(self.a, self.c, strict=True):
            self._expect("a row of a sums to its node", sum(row), c)
        for k in range(1, self.order + 1):
            moment = sum(b * c ** (k - 1) for b, c in zip(self.b, self.c, strict=True))
            self._expect(f"sum b c^{k - 1} = 1/{k}", moment, 1 / k)

    def _expect(self, what: str, value: float, expected: float) -> None:
        # Dormand-Prince 8 has weights up to 43, whose roundings add up.
        scale = max(1.0, *(abs(x) for row in self.a for x in row))
        if abs(value - expected) > CONDITION_TOLERANCE * scale:
            raise ValueError(f"{self.name} violates '{what}': {value} is not {expected}")

    @property
    def stages(self) -> int:
        """Number s of stages."""
        return len(self.b)

    @property
    def explicit(self) -> bool:
        """Whether every stage uses earlier stages only."""
        return all(x == 0 for i, row in enumerate(self.a) for x in row[i:])


def _rk4() -> Method:
    a = ((0.0, 0.0, 0.0, 0.0), (0.5, 0.0, 0.0, 0.0), (0.0, 0.5, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0))
    return Method("rk4", a, (1 / 6, 1 / 3, 1 / 3, 1 / 6), (0.0, 0.5, 0.5, 1.0), 4, "Kutta 1901")


def _dop853() -> Method:
    # Public attributes of the class; imported here because scipy.integrate takes half a second.
    from scipy.integrate import DOP853

    s = DOP853.n_stages
    a = tuple(tuple(map(float, row[:s])) for row in DOP853.A[:s])
    return Method(
        "dop853",
        a,
        tuple(map(float, DOP853.B)),
        tuple(map(float, DOP853.C[:s])),
        8,
        "Hairer, Norsett and Wanner, Solving Ordinary Differential Equations I, II.5",
    )


def _gauss(s: int) -> Method:
    # Nodes are the roots of the shifted Legendre polynomial; a_ij integrates the j-th Lagrange
    # polynomial up to c_i. Forty digits, because a float64 Vandermonde solve loses ten of sixteen.
    import mpmath

    with mpmath.workdps(40):
        legendre = mpmath.taylor(lambda x: mpmath.legendre(s, 2 * x - 1), 0, s)[::-1]
        c = sorted(mpmath.polyroots(legendre, maxsteps=200, extraprec=200), key=lambda root: root.real)
        c = [mpmath.re(root) for root in c]
        powers = mpmath.matrix(s, s)
        for k in range(s):
            for j in range(s):
                powers[k, j] = c[j] ** k

        def weights(end: mpmath.mpf) -> tuple[float, ...]:
            moments = mpmath.matrix([end ** (k + 1) / (k + 1) for k in range(s)])
            return tuple(float(w) for w in mpmath.lu_solve(powers, moments))

        a = tuple(weights(end) for end in c)
        b = weights(mpmath.mpf(1))
    return Method(f"gauss{s}", a, b, tuple(map(float, c)), 2 * s, "Gauss-Legendre collocation, Kuntzmann and Butcher")


_METHODS: dict[str, Callable[[], Method]] = {
    "rk4": _rk4,
    "dop853": _dop853,
    **{f"gauss{s}": partial(_gauss, s) for s in range(1, 7)},
}


def method_names() -> tuple[str, ...]:
    """Names that `method` knows."""
    return tuple(_METHODS)


@cache
def method(name: str) -> Method:
    """Return the method of this name; raise ValueError with the known names if there is none."""
    if name not in _METHODS:
        raise ValueError(unknown_name("integrator", name, ("auto", *_METHODS)))
    return _METHODS[name]()

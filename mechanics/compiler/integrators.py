"""One-step methods as data: a method *is* its Butcher tableau.

    Z_i = z0 + h sum_j a_ij f(Z_j),    z1 = z0 + h sum_i b_i f(Z_i)

An explicit tableau (strictly lower triangular `a`) integrates anything. A full one, such as
Gauss-Legendre collocation, would be implicit on coupled states, but is evaluated explicitly on
states that depend on one another in layers only; `codegen` needs no more than the numbers here.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache, cached_property, partial
from itertools import combinations_with_replacement
from math import prod
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mechanics.expressions import unknown_name

__all__ = ["Method", "method", "method_names"]

Tree = tuple["Tree", ...]  # a rooted tree: what hangs from its root

# Coefficients are double precision: conditions on them hold to a few roundings of a sum of 15.
CONDITION_TOLERANCE = 1e-14
NULL = 1e-10  # singular values of conditions below this, of the largest, are roundings of a zero


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
        safety: how much larger the error may be than its estimates lead to expect, see `thresholds`. Measured on 90,000
            holds from states that gaits, relays and random actions reach: with stops none was wrong by more than 7e-11
            at a tolerance of 1e-10, without them two of the snakeboard's, by 5e-10 at 40 rad/s.
    """

    name: str
    a: tuple[tuple[float, ...], ...]
    b: tuple[float, ...]
    c: tuple[float, ...]
    order: int
    source: str
    safety: float = 100.0

    def __post_init__(self) -> None:
        if len(self.a) != self.stages or any(len(row) != self.stages for row in self.a) or len(self.c) != self.stages:
            raise ValueError(f"{self.name}: a must be s x s, b and c of length s")
        for row, c in zip(self.a, self.c, strict=True):
            self._expect("a row of a sums to its node", sum(row), c)
        for k in range(1, self.order + 1):
            moment = sum(b * c ** (k - 1) for b, c in zip(self.b, self.c, strict=True))
            self._expect(f"sum b c^{k - 1} = 1/{k}", moment, 1 / k)

    def _expect(self, what: str, value: float, expected: float) -> None:
        # Dormand-Prince 8 has weights up to 43 and Verner 9 up to 15, whose roundings add up.
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

    @property
    def symmetric(self) -> bool:
        """Whether the nodes lie symmetrically in the step."""
        return bool(np.allclose(self.c, 1 - np.array(self.c)[::-1], rtol=0, atol=CONDITION_TOLERANCE))

    @cached_property
    def estimates(self) -> tuple[tuple[tuple[float, ...], int], ...]:
        """Weights d of error estimates h sum_i d_i f(Z_i) from the stages that there are, each with its order p.

        The first is the combination of all stages that vanishes to the highest order: weights b + d would make another
        method, of order p. It is the null vector of the conditions of all rooted trees of up to p nodes; sum |d_i| = 1.

        With symmetric nodes it is odd or even about the middle of the step, and so blind to rates of the other parity,
        such as those of a motion that turns back halfway. A second estimate, of order p - 1, sees these.
        """
        first = next(((d[-1], p) for p in range(self.order - 1, 0, -1) if len(d := self._null(p))), None)
        found = [first] if first else []
        if first and self.symmetric:
            d, p = first
            others = [other - (other @ d) * d for other in self._null(p - 1)]
            found += [(max(others, key=np.linalg.norm), p - 1)] if others else []
        if len(found) < 1 + self.symmetric:
            raise ValueError(f"{self.name} has too few stages for an estimate of its error; choose another method")
        return tuple((tuple((d / np.abs(d).sum()).tolist()), p) for d, p in found)

    def _null(self, p: int) -> NDArray[np.float64]:
        """Combinations (.., s) of all stages that meet the conditions of order p of a method that does not move."""
        if p < 1:
            return np.empty((0, self.stages))
        conditions = np.array([self._weights(tree) for n in range(1, p + 1) for tree in _trees(n)])
        conditions /= np.abs(conditions).max(axis=1, keepdims=True) + 1e-300
        _, values, vectors = np.linalg.svd(conditions)
        rank = int(np.sum(values > NULL * values[0]))
        return np.where(np.abs(vectors[rank:]) > NULL, vectors[rank:], 0.0)

    def thresholds(self, tolerance: float) -> tuple[float, ...]:
        """Largest value of each estimate with which the error of a step is below `tolerance`.

        Error and estimate are sums over the rooted trees of the first order at which they do not vanish, of what the
        method leaves there times a derivative. If these are all powers of one rate L, the error is C (h L)^(order + 1)
        and the estimate D (h L)^(p + 1), C and D the norms of what is left: one follows from the other.
        """
        left = [self._weights(tree) @ self.b - 1 / _density(tree) for tree in _trees(self.order + 1)]
        reach = (tolerance / self.safety / np.linalg.norm(left)) ** (1 / (self.order + 1))
        seen = [np.linalg.norm([self._weights(tree) @ d for tree in _trees(p + 1)]) for d, p in self.estimates]
        return tuple(float(size * reach ** (p + 1)) for size, (_, p) in zip(seen, self.estimates, strict=True))

    def _weights(self, tree: Tree) -> NDArray[np.float64]:
        """(s,) weight of each stage in the order condition of a tree (Butcher)."""
        known = self._known
        if tree not in known:
            known[tree] = np.ones(self.stages)
            for branch in tree:
                known[tree] = known[tree] * (np.array(self.a) @ self._weights(branch))
        return known[tree]

    @cached_property
    def _known(self) -> dict[Tree, NDArray[np.float64]]:
        return {}


@cache
def _trees(n: int) -> tuple[Tree, ...]:
    """The rooted trees with n nodes."""
    return tuple(_forests(n - 1, n - 1))


def _forests(nodes: int, largest: int) -> Iterator[Tree]:
    """Sets of trees with so many nodes in all, none of more than `largest`."""
    if nodes == 0:
        yield ()
    for size in range(min(nodes, largest), 0, -1):
        for count in range(1, nodes // size + 1):
            for rest in _forests(nodes - count * size, size - 1):
                for trees in combinations_with_replacement(_trees(size), count):
                    yield trees + rest


def _size(tree: Tree) -> int:
    """Number of nodes."""
    return 1 + sum(map(_size, tree))


def _density(tree: Tree) -> int:
    """What the sum of a method's weights in the order condition of a tree is to be the inverse of."""
    return _size(tree) * prod(map(_density, tree))


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


def _verner9() -> Method:
    # Only what propagates the solution: the pair's sixteenth stage serves the error estimate alone.
    nodes = (
        0.0, 0.03462, 0.09702435063878044, 0.14553652595817068, 0.561, 0.229007911590485, 0.544992088409515, 0.645,
        0.48375, 0.06757, 0.25, 0.6590650618730999, 0.8206, 0.9012, 1.0,
    )  # fmt: skip
    # Stage: the stages that it uses, and their weights.
    rows = {
        2: ((1,), (0.03462,)),
        3: ((1, 2), (-0.038933543885728734, 0.13595789452450918)),
        4: ((1, 3), (0.03638413148954267, 0.109152394468628)),
        5: ((1, 3, 4), (2.02576391439397, -7.638023836496292, 6.173259922102322)),
        6: ((1, 4, 5), (0.05112275589406061, 0.17708237945550215, 0.0008027762409222502)),
        7: ((1, 4, 5, 6), (0.13160063579752163, -0.29572762526696367, 0.08781378035642952, 0.6213052975225275)),
        8: ((1, 6, 7), (0.07166666666666667, 0.33055335789153195, 0.24277997544180138)),
        9: ((1, 6, 7, 8), (0.071806640625, 0.3294380283228177, 0.11651900292718229, -0.034013671875)),
        10: ((1, 6, 7, 8, 9), (0.04836757646340647, 0.03928989925676164, 0.10547409458903446, -0.021438652846483126,
             -0.10412291746271944)),
        11: ((1, 6, 7, 8, 9, 10), (-0.026645614872014785, 0.03333333333333333, -0.1631072244872467,
             0.033960816841277615, 0.1572319413814626, 0.21522674780318796)),
        12: ((1, 6, 7, 8, 9, 10, 11), (0.036890092487086225, -0.1465181576725543, 0.22425777681720244,
             0.022944057170660725, -0.003585005290572876, 0.08669223316444385, 0.43838406519683376)),
        13: ((1, 6, 7, 8, 9, 10, 11, 12), (-0.48660122151133406, -6.304602650282853, -0.2812456182894726,
             -2.6790192362198493, 0.5188156639241576, 1.3653531876033418, 5.8850910885039465, 2.8028087862720628)),
        14: ((1, 6, 7, 8, 9, 10, 11, 12, 13), (0.41853674577534716, 6.724547581906459, -0.4254442801646118,
             3.3432791530012658, 0.6170816631175378, -0.9299661239399328, -6.099948804751011, -3.002206187889399,
             0.2553202529443446)),
        15: ((1, 6, 7, 8, 9, 10, 11, 12, 13, 14), (-0.7793740861228846, -13.937342538107776, 1.2520488533793572,
             -14.69150040801687, -0.4947050585331417, 2.2429749091462368, 13.367893803828643, 14.396650486650687,
             -0.79758133317768, 0.4409353709534278)),
    }  # fmt: skip
    end = ((1, 8, 9, 10, 11, 12, 13, 14, 15), (0.014611976858423152, -0.3915211862331339, 0.23109325002895065,
           0.12747667699928525, 0.2246434176204158, 0.5684352689748513, 0.058258715572158275, 0.13643174034822156,
           0.030570139830827976))  # fmt: skip

    def spread(used: tuple[int, ...], weights: tuple[float, ...]) -> tuple[float, ...]:
        row = dict(zip(used, weights, strict=True))
        return tuple(row.get(stage, 0.0) for stage in range(1, len(nodes) + 1))

    a = tuple(spread(*rows.get(stage, ((), ()))) for stage in range(1, len(nodes) + 1))
    source = "Verner, Numerically optimal Runge-Kutta pairs with interpolants, 2010: the most efficient 9(8) pair"
    return Method("verner9", a, spread(*end), nodes, 9, source, safety=25.0)


def _collocation(name: str, polynomial: Callable[[Any], Any], degree: int, order: int, source: str) -> Method:
    # Nodes are the roots of a polynomial on [0, 1]; a_ij integrates the j-th Lagrange polynomial up to
    # c_i. Forty digits, because a float64 Vandermonde solve loses ten of sixteen.
    import mpmath

    with mpmath.workdps(40):
        coefficients = mpmath.taylor(polynomial, 0, degree)[::-1]
        roots = mpmath.polyroots(coefficients, maxsteps=200, extraprec=200)
        c = sorted(mpmath.re(root) for root in roots)
        powers = mpmath.matrix(degree, degree)
        for k in range(degree):
            for j in range(degree):
                powers[k, j] = c[j] ** k

        def weights(end: mpmath.mpf) -> tuple[float, ...]:
            moments = mpmath.matrix([end ** (k + 1) / (k + 1) for k in range(degree)])
            return tuple(float(w) for w in mpmath.lu_solve(powers, moments))

        a = tuple(weights(end) for end in c)
        b = weights(mpmath.mpf(1))
    return Method(name, a, b, tuple(map(float, c)), order, source)


def _gauss(s: int) -> Method:
    from mpmath import legendre

    source = "Gauss-Legendre collocation, Kuntzmann and Butcher"
    return _collocation(f"gauss{s}", lambda x: legendre(s, 2 * x - 1), s, 2 * s, source)


def _lobatto(s: int) -> Method:
    # Both ends are nodes. What depends on the state alone is the same at the end of a step, in what is
    # observed there and at the start of the next: s - 1 evaluations for the order of s - 1 Gauss nodes.
    from mpmath import legendre

    source = "Lobatto IIIA collocation, Ehle and Butcher"
    # x (1 - x) P'_{s-1} is, up to a factor, P_s - P_{s-2}.
    return _collocation(
        f"lobatto{s}", lambda x: legendre(s, 2 * x - 1) - legendre(s - 2, 2 * x - 1), s, 2 * s - 2, source
    )


_METHODS: dict[str, Callable[[], Method]] = {
    "rk4": _rk4,
    "dop853": _dop853,
    "verner9": _verner9,
    **{f"gauss{s}": partial(_gauss, s) for s in range(1, 7)},
    **{f"lobatto{s}": partial(_lobatto, s) for s in range(3, 8)},
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

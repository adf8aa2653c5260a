"""The local connection of a mechanism in the plane, and its height functions: how far a small loop moves it.

Of all velocities that the constraints allow while the shape changes at the rate ṙ, one has the least kinetic energy.
It has no momentum along what the constraints leave free with the shape held, and its body velocity is

    ξ = g⁻¹ġ = -A(r) ṙ,

the nonholonomic connection of Bloch, Krishnaprasad, Marsden and Murray (1996) at the identity of SE(2); what momentum
there is adds to it. Around a small loop in two shape coordinates a, b the mechanism moves by -∬ H da db in its own
axes, with the curvature

    H = ∂A_b/∂a - ∂A_a/∂b - [A_a, A_b],

whose three components, along, across and turning, are the height functions. All is worked out in numbers from the
inertia tensor and the one-forms.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mechanics.expressions import unknown_name
from mechanics.geometry.symmetry import planar_symmetry
from mechanics.mechanism import Mechanism, MechanismError

__all__ = ["height_functions", "local_connection", "shape_coordinates"]

Array = NDArray[np.float64]

# Fourth-order central differences of functions of order one over radians: errors of 1e-12, and as much of rounding.
STEP = 1e-3
STENCIL = {-2: 1 / 12, -1: -2 / 3, 1: 2 / 3, 2: -1 / 12}
INDEPENDENT = 1e-9  # smallest singular value of what must be independent, relative to the largest


def shape_coordinates(mechanism: Mechanism) -> tuple[str, ...]:
    """Coordinates that say how the mechanism is bent; raise `MechanismError` unless the others are its pose alone."""
    symmetry = planar_symmetry(mechanism) if mechanism.fibre else None
    if symmetry is None or symmetry.turning:
        raise MechanismError(
            f"{mechanism.name} has no local connection: that takes coordinates x, y and heading by which it may be "
            "displaced without anything changing, and others that stay as they are when it is"
        )
    return tuple(name for name in mechanism.coordinates if name not in mechanism.fibre)


def local_connection(mechanism: Mechanism, shape: ArrayLike, params: Mapping[str, float] | None = None) -> Array:
    """A(r), shape (..., 3, s): body velocities along x, y and the heading, with the sign turned, for each shape rate.

    Args:
        mechanism: in the plane, with s shape coordinates.
        shape: their values r, shape (..., s).
        params: values that replace the mechanism's parameters.

    Raises:
        MechanismError: there is no such connection, or not there: the constraints hold the shape.
    """
    names = shape_coordinates(mechanism)
    r = np.asarray(shape, dtype=float)
    zero = np.zeros(r.shape[:-1])
    values: dict[str, ArrayLike] = {**mechanism.resolve(params), **dict.fromkeys(mechanism.fibre, zero)}
    values |= dict(zip(names, np.moveaxis(r, -1, 0), strict=True))
    order = [mechanism.coordinates.index(name) for name in (*mechanism.fibre, *names)]
    inertia = mechanism.numeric(mechanism.inertia, values)[..., order, :][..., :, order]
    s, n, c = len(names), mechanism.n, len(mechanism.one_forms)
    forms = mechanism.numeric(mechanism.one_forms, values)[..., order] if c else np.zeros((*zero.shape, 0, n))
    # The least of 1/2 q̇ M q̇ with forms q̇ = 0 and the shape's rates given: multipliers do it.
    ties = np.concatenate([forms, np.broadcast_to(np.eye(n)[3:], (*zero.shape, s, n))], axis=-2)
    singular = np.linalg.svd(ties / np.linalg.norm(ties, axis=-1, keepdims=True), compute_uv=False)
    if c + s > n or (singular[..., -1] <= INDEPENDENT * singular[..., 0]).any():
        raise MechanismError(f"{mechanism.name}: its constraints do not let each of {', '.join(names)} move on its own")
    matrix = np.zeros((*zero.shape, n + c + s, n + c + s))
    matrix[..., :n, :n], matrix[..., :n, n:], matrix[..., n:, :n] = inertia, ties.swapaxes(-1, -2), ties
    given = np.eye(n + c + s)[:, n + c :]
    solved = np.asarray(np.linalg.solve(matrix, np.broadcast_to(given, (*zero.shape, *given.shape))), np.float64)
    return -solved[..., :3, :]


def height_functions(
    mechanism: Mechanism, shape: ArrayLike, params: Mapping[str, float] | None = None, pair: Sequence[str] | None = None
) -> Array:
    """H(r), shape (..., 3): along, across and turning, over a loop that runs from the first to the second of a pair.

    Args:
        mechanism: in the plane, with s shape coordinates.
        shape: their values r, shape (..., s).
        params: values that replace the mechanism's parameters.
        pair: names of two shape coordinates; None if there are only two.
    """
    names = shape_coordinates(mechanism)
    pair = tuple(names if pair is None else pair)
    for name in pair:
        if name not in names:
            raise MechanismError(f"{mechanism.name}: {unknown_name('shape coordinate', name, names)}")
    if len(set(pair)) != 2:
        raise MechanismError(f"{mechanism.name}: height functions are of two shape coordinates, not of {pair}")
    r = np.asarray(shape, dtype=float)
    a, b = (names.index(name) for name in pair)

    def slope(along: int, of: int) -> Array:
        unit = STEP * np.eye(len(names))[along]
        return sum(
            weight / STEP * local_connection(mechanism, r + k * unit, params)[..., of] for k, weight in STENCIL.items()
        )  # type: ignore[return-value]

    A = local_connection(mechanism, r, params)
    return slope(a, b) - slope(b, a) - _bracket(A[..., a], A[..., b])


def _bracket(first: Array, second: Array) -> Array:
    """Lie bracket of se(2), of body velocities (..., 3)."""
    x1, y1, w1 = np.moveaxis(first, -1, 0)
    x2, y2, w2 = np.moveaxis(second, -1, 0)
    return np.stack([w2 * y1 - w1 * y2, w1 * x2 - w2 * x1, np.zeros_like(w1)], axis=-1)

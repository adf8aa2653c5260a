"""Invariance under planar displacements, the hypothesis of Lemma 3.3.

A mechanism whose fibre is (x, y, heading) moves in a plane that looks the same everywhere and in
every direction if its inertia tensor, control forces and potential do not change under the action
of SE(2): (x, y) -> R(a)(x, y) + b, heading -> heading + a. Joint angles stay as they are; angles that are
measured from the x axis, as the heading is, turn by a too. If the vector fields of the frame are
invariant, so are the generalized Christoffel symbols and the input coefficients, and they may be
computed at the identity x = y = heading = 0.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import chain, combinations

import numpy as np

from mechanics.mechanism import Matrix, Mechanism

__all__ = ["PlanarSymmetry", "planar_symmetry"]

# Both sides are computed in double precision from entries of order one to ten: rounding is below
# 1e-13, a broken symmetry changes them by the order of the entries.
TOLERANCE = 1e-9
POINTS = 4


@dataclass(frozen=True)
class PlanarSymmetry:
    """The action of SE(2) that leaves a mechanism as it is, by indices of coordinates.

    Attributes:
        x: first coordinate of the position.
        y: second coordinate of the position.
        heading: angle of the body in the plane.
        turning: further angles measured from the x axis, which turn with the heading.
    """

    x: int
    y: int
    heading: int
    turning: tuple[int, ...] = ()


def planar_symmetry(mechanism: Mechanism, frame: Matrix) -> PlanarSymmetry | None:
    """Action of SE(2) that leaves inertia, forces, potential and frame invariant, or None.

    Args:
        mechanism: the mechanism; one without fibre coordinates has no such symmetry.
        frame: [k, n] rows of the vector fields.
    """
    if not mechanism.fibre:
        return None
    x, y, heading = (mechanism.coordinates.index(name) for name in mechanism.fibre)
    others = [i for i in range(mechanism.n) if i not in (x, y, heading)]
    for turning in chain.from_iterable(combinations(others, size) for size in range(len(others) + 1)):
        symmetry = PlanarSymmetry(x, y, heading, turning)
        if _holds(symmetry, mechanism, frame):
            return symmetry
    return None


def _holds(symmetry: PlanarSymmetry, mechanism: Mechanism, frame: Matrix) -> bool:
    """Check at random configurations q and displacements g.

    With T the tangent map of q -> g q, an invariant vector field has X(g q) = T X(q), a one-form
    F(g q) T = F(q), the inertia tensor T^T M(g q) T = M(q). An identity between analytic functions
    that holds at random points holds.
    """
    rng = np.random.default_rng(2)
    plane = [symmetry.x, symmetry.y]
    with np.errstate(all="ignore"):
        for _ in range(POINTS):
            q = rng.uniform(-1.5, 1.5, mechanism.n)
            angle, shift = rng.uniform(-math.pi, math.pi), rng.uniform(-2, 2, 2)
            tangent = np.eye(mechanism.n)
            tangent[np.ix_(plane, plane)] = [[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]]
            moved = tangent @ q
            moved[plane] += shift
            moved[[symmetry.heading, *symmetry.turning]] += angle
            here, there = (
                {**mechanism.parameters, **dict(zip(mechanism.coordinates, p, strict=True))} for p in (q, moved)
            )
            inertia = tangent.T @ mechanism.numeric(mechanism.inertia, there) @ tangent
            pairs = [(mechanism.numeric(mechanism.inertia, here), inertia)]
            pairs.append((mechanism.numeric(frame, here) @ tangent.T, mechanism.numeric(frame, there)))
            if mechanism.forces:
                forces = tuple(mechanism.forces.values())
                pairs.append((mechanism.numeric(forces, here), mechanism.numeric(forces, there) @ tangent))
            potential = ((mechanism.potential,),)
            pairs.append((mechanism.numeric(potential, here), mechanism.numeric(potential, there)))
            if not all(np.allclose(a, b, rtol=TOLERANCE, atol=TOLERANCE) for a, b in pairs):
                return False
    return True

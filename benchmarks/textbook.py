"""The textbook's equations with Lagrange's multipliers, as expressions: nothing of the reduced equations is in here.

[[M, -ω^T], [ω, 0]] (q̈, λ) = (F^T u - bias, -turning),  bias = Ṁ q̇ - ∂T/∂q + ∂V/∂q,  turning = ω̇ q̇
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import sympy as sp

from mechanics.mechanism import Mechanism

__all__ = ["REGULAR", "Textbook", "textbook"]

# Constraints that say the same as a mechanism's own and stay independent where those do not. The snakeboard's are half
# the sum of its own over cos(phi), and half their difference: at phi = ±π/2 its own are one and the same.
REGULAR = {
    "snakeboard": (
        ("-sin(theta)", "cos(theta)", "0", "0", "0"),
        ("sin(phi)*cos(theta)", "sin(phi)*sin(theta)", "l*cos(phi)", "0", "0"),
    )
}


@dataclass(frozen=True)
class Textbook:
    """What the equations are made of; n coordinates, c constraints, m controls.

    Attributes:
        q, qdot, parameters: symbols.
        inertia: M (n, n).
        forms: ω (c, n).
        forces: F (m, n).
        bias: (n,).
        turning: (c,).
    """

    q: list[sp.Symbol]
    qdot: list[sp.Symbol]
    parameters: list[sp.Symbol]
    inertia: list[list[sp.Expr]]
    forms: list[list[sp.Expr]]
    forces: list[list[sp.Expr]]
    bias: list[sp.Expr]
    turning: list[sp.Expr]


def textbook(mechanism: Mechanism) -> Textbook:
    """The equations of a mechanism without drag."""
    q = [mechanism.symbols[name] for name in mechanism.coordinates]
    qdot = [sp.Symbol(name) for name in mechanism.rates]

    def read(rows: Any) -> list[list[sp.Expr]]:
        return [[mechanism.symbolic(text) for text in row] for row in rows]

    rows = read(REGULAR.get(mechanism.name, mechanism.one_forms))
    inertia, forms = sp.Matrix(read(mechanism.inertia)), sp.Matrix(len(rows), mechanism.n, sum(rows, []))
    velocity = sp.Matrix(qdot)
    lagrangian = (velocity.T * inertia * velocity)[0] / 2 - mechanism.symbolic(mechanism.potential)
    bias = (inertia * velocity).jacobian(q) * velocity - sp.Matrix([sp.diff(lagrangian, c) for c in q])
    return Textbook(
        q,
        qdot,
        [mechanism.symbols[name] for name in mechanism.parameters],
        inertia.tolist(),
        forms.tolist(),
        read(mechanism.forces.values()),
        list(bias),
        list((forms * velocity).jacobian(q) * velocity),
    )

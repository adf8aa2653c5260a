"""What a motion conserves while the controls are held.

Where the control covectors F_a are constant, a held control u_a acts as the force of the potential -u_a F_a q. The
energy in it is conserved, whatever the constraints: K + V - sum_a u_a F_a q.
"""

from __future__ import annotations

import sympy as sp

from mechanics.geometry.reduction import ReducedEquations

__all__ = ["conserved"]


def conserved(equations: ReducedEquations) -> dict[str, sp.Expr]:
    """The terms of what is conserved: "kinetic", K(q, v), and "potential", V(q) - sum_a u_a F_a q, both in J.

    Raises:
        ValueError: there is nothing to keep, because drag acts or a control's covector changes along the motion.
    """
    mechanism = equations.mechanism
    if any(entry != 0 for entry in equations.drag):
        raise ValueError(
            f"{mechanism.name}: with drag the energy is not conserved, and cannot be kept; choose keep_energy or drag"
        )
    potential = equations.energy.xreplace(dict.fromkeys(equations.pseudo_velocities, sp.S.Zero))
    coordinates = set(equations.coordinates)
    for u, (name, row) in zip(equations.controls, mechanism.forces.items(), strict=True):
        covector = [mechanism.symbolic(text) for text in row]
        if moving := {symbol for entry in covector for symbol in entry.free_symbols} & coordinates:
            raise ValueError(
                f"{mechanism.name}: the energy can be kept only under controls with constant covectors; that of "
                f"{name!r} depends on {', '.join(sorted(map(str, moving)))}. Choose keep_energy=False"
            )
        potential -= u * sum((f * q for f, q in zip(covector, equations.coordinates, strict=True)), sp.S.Zero)
    norms = zip(equations.squared_norms, equations.pseudo_velocities, strict=True)
    return {"kinetic": sum((norm * v**2 for norm, v in norms), sp.S.Zero) / 2, "potential": potential}

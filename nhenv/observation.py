"""What an environment observes of a mechanism that does not say what to observe.

Angles that the equations turn with, rates, and the velocity in the body's own axes; no position, no
heading, nothing that makes no difference. Whether a coordinate makes a difference, and whether it is
an angle, is a question of invariance, which `mechanics.geometry.symmetry` answers.
"""

from __future__ import annotations

import numpy as np

from mechanics.mechanism import Mechanism

__all__ = ["default_observation"]

# Directions are unit vectors: what the constraints allow of one, where they do not forbid it, is of order one.
TOLERANCE = 1e-9


def default_observation(mechanism: Mechanism) -> dict[str, str]:
    """Label -> expression of what is observed by default, in SI units.

    For each coordinate but those of the pose, if anything depends on it: its angle over the stop if it has one,
    cosine and sine if a full turn changes nothing (from the heading, where it is measured from the x axis as the
    heading is), else its value. Then the rates of all these coordinates. Then speed, drift and turning rate, as far
    as the constraints allow them.

    Args:
        mechanism: the mechanism; without a fibre, every coordinate counts as a shape coordinate.
    """
    from mechanics.geometry.symmetry import cyclic_coordinates, invariance, planar_symmetry  # needs SymPy

    shape = [name for name in mechanism.coordinates if name not in mechanism.fibre]
    cyclic = cyclic_coordinates(mechanism)
    symmetry = planar_symmetry(mechanism) if mechanism.fibre else None
    turning = [mechanism.coordinates[i] for i in symmetry.turning] if symmetry else []
    seen: dict[str, str] = {}
    for name in shape:
        if name in cyclic:
            continue
        if name in mechanism.joint_limits:
            seen[name] = f"{name}/{float(mechanism.joint_limits[name])!r}"
        elif invariance(mechanism, {name: f"{name} + 2*pi*sign(_sense)"}):
            angle = f"{name} - {mechanism.fibre[2]}" if name in turning else name
            seen |= {f"cos_{name}": f"cos({angle})", f"sin_{name}": f"sin({angle})"}
        else:
            seen[name] = name
    seen |= {f"{name}_dot": f"{name}_dot" for name in shape}
    if mechanism.fibre:
        seen |= {label: label for label in _allowed(mechanism)}
    return seen


def _allowed(mechanism: Mechanism) -> list[str]:
    """Velocities of the body that the constraints do not forbid, tried at a random configuration."""
    # Free of units: the null space of the one-forms meets a direction's kernel or does not.
    q = dict(zip(mechanism.coordinates, np.random.default_rng(7).uniform(-1.3, 1.3, mechanism.n).tolist(), strict=True))
    x, y, heading = (mechanism.coordinates.index(name) for name in mechanism.fibre)
    cos, sin = np.cos(q[mechanism.fibre[2]]), np.sin(q[mechanism.fibre[2]])
    directions = np.zeros((3, mechanism.n))
    directions[0, [x, y]], directions[1, [x, y]], directions[2, heading] = (cos, sin), (-sin, cos), 1.0
    if mechanism.one_forms:
        forms = mechanism.numeric(mechanism.one_forms, {**mechanism.parameters, **q})
        unit = np.linalg.qr(forms.T)[0]
        directions -= directions @ unit @ unit.T
    labels = ("speed", "drift", "heading_dot")
    return [label for label, d in zip(labels, directions, strict=True) if np.linalg.norm(d) > TOLERANCE]

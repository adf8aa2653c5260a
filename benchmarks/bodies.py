"""The catalogue's mechanisms as rigid bodies, which Kane's method is given in place of an inertia tensor.

A rotor is a planar body without mass, even on a lying axle, where nothing but 1/2 I (angle')^2 counts of its
energy: the shortest description, in Kane's favour. tests/benchmarks holds them against the inertia tensors.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from mechanics.mechanism import Mechanism

__all__ = ["Body", "bodies", "planar"]


@dataclass(frozen=True, kw_only=True)
class Body:
    """A rigid body, as expressions in a mechanism's coordinates, parameters and definitions.

    Attributes:
        mass: in kg.
        centre: (3,) position of the centre of mass in space, in m.
        turns: (axis, angle) pairs, rotations after one another, each about an axis of the body so far.
        inertia: (6,) I_xx, I_yy, I_zz, I_xy, I_yz, I_zx about the centre of mass and the axes after `turns`.
        spin: a last such rotation which leaves the inertia as it is, as that of a wheel about its axle does.
    """

    mass: str
    centre: tuple[str, str, str]
    turns: tuple[tuple[str, str], ...]
    inertia: tuple[str, str, str, str, str, str]
    spin: tuple[str, str] | None = None


def planar(angle: str, inertia: str, mass: str = "0", x: str = "x", y: str = "y") -> Body:
    """Body that moves in the plane, with its inertia about the normal."""
    return Body(mass=mass, centre=(x, y, "0"), turns=(("z", angle),), inertia=("0", "0", inertia, "0", "0", "0"))


def bodies(mechanism: Mechanism) -> Sequence[Body] | None:
    """Bodies of a mechanism of the catalogue or of its families (snake_5, trailer_1), None for another one."""
    name = re.sub(r"_\d+$", "", mechanism.name)
    if name not in _BODIES:
        return None
    described = _BODIES[name]
    return described(mechanism) if callable(described) else described


def _principal(first: str, second: str, third: str) -> tuple[str, str, str, str, str, str]:
    return (first, second, third, "0", "0", "0")


def _snake(mechanism: Mechanism) -> tuple[Body, ...]:
    angles = mechanism.coordinates[2:]
    links, x, y = [planar(angles[0], "J", "m")], "x", "y"
    for last, angle in zip(angles, angles[1:], strict=False):
        x += f" + L/2*(cos({last}) + cos({angle}))"
        y += f" + L/2*(sin({last}) + sin({angle}))"
        links.append(planar(angle, "J", "m", x, y))
    return tuple(links)


def _trailer(mechanism: Mechanism) -> tuple[Body, ...]:
    axles, x, y = [planar("theta", "J_0", "m_0")], "x", "y"
    for i, angle in enumerate(mechanism.coordinates[3:], start=1):
        x += f" - d_{i}*cos({angle})"
        y += f" - d_{i}*sin({angle})"
        axles.append(planar(angle, f"J_{i}", f"m_{i}", x, y))
    return tuple(axles)


# A body whose centre of mass lies a ahead of (x, y)
_AHEAD = planar("theta", "I_c", "m", "x + a*cos(theta)", "y + a*sin(theta)")


def _wheel(side: str, angle: str) -> Body:
    """Wheel of the inverted pendulum, which turns with the body as well."""
    return Body(
        mass="m_w",
        centre=(f"x {side} b*sin(theta)", f"y - ({side} b*cos(theta))", "r"),
        turns=(("z", "theta"),),
        inertia=_principal("J_d", "J_w", "J_d"),
        spin=("y", f"alpha + {angle}"),
    )


_BODIES: dict[str, Sequence[Body] | Callable[[Mechanism], Sequence[Body]]] = {
    # The wheels steer in opposite directions, so that nothing but phi'^2 is left of their spin.
    "snakeboard": (
        planar("theta", "m*l**2 - J_r", "m"),
        planar("theta + psi", "J_r"),
        planar("phi", "J_w"),
    ),
    "roller_racer": (planar("theta", "I_1", "m"), planar("theta + psi", "I_2")),
    "roller_racer_massive": (
        planar("theta", "I_1", "m"),
        planar(
            "theta + psi",
            "I_2",
            "m_2",
            "x + l_1*cos(theta) + d*cos(theta + psi)",
            "y + l_1*sin(theta) + d*sin(theta + psi)",
        ),
    ),
    "chaplygin_sleigh": (_AHEAD,),
    "chaplygin_beanie": (_AHEAD, planar("theta + phi", "B")),
    "sleigh_with_arm": (
        _AHEAD,
        planar("theta + phi", "J_a", "m_a", "x + l*cos(theta + phi)", "y + l*sin(theta + phi)"),
    ),
    "knife_edge_incline": (planar("theta", "J", "m"),),
    "vertical_rolling_disk": (planar("theta", "J", "m"), planar("phi", "I_c")),
    "differential_drive": (_AHEAD, planar("phi_r", "I_w"), planar("phi_l", "I_w")),
    "car": (_AHEAD, planar("theta + delta", "J")),
    "trailer": _trailer,
    "snake": _snake,
    "planar_rigid_body": (planar("theta", "J", "m"),),
    "suslov": (
        Body(
            mass="0",
            centre=("0", "0", "0"),
            turns=(("x", "alpha"), ("y", "beta"), ("z", "gamma")),
            inertia=("I_11", "I_22", "I_33", "0", "I_23", "I_13"),
        ),
    ),
    "falling_rolling_disk": (
        Body(
            mass="m",
            centre=("x + r*sin(phi)*sin(theta)", "y - r*sin(phi)*cos(theta)", "r*cos(phi)"),
            turns=(("z", "theta"), ("x", "phi")),
            inertia=_principal("I", "J", "I"),
            spin=("y", "psi"),
        ),
    ),
    "wheeled_inverted_pendulum": (
        Body(
            mass="m_b",
            centre=("x + l*sin(alpha)*cos(theta)", "y + l*sin(alpha)*sin(theta)", "r + l*cos(alpha)"),
            turns=(("z", "theta"), ("y", "alpha")),
            inertia=_principal("I_x", "I_y", "I_z"),
        ),
        _wheel("+", "psi_r"),
        _wheel("-", "psi_l"),
    ),
    "chaplygin_sphere": (
        Body(
            mass="m",
            centre=("x", "y", "r"),
            turns=(("z", "theta"), ("x", "phi"), ("y", "psi")),
            inertia=_principal("I_1", "I_2", "I_3"),
        ),
    ),
}

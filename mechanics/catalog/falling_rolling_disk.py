"""The falling rolling disk: a coin or a wheel without a fork, which may lean.

(x, y) is the point of contact, theta the direction of travel, phi the lean to the right of it (0
upright, ±pi/2 flat on the ground), psi the angle by which the disk has rolled. The disk has mass m,
radius r, inertia J about its axle and I about a diameter. u_phi and u_psi are torques about the line of
travel and about the axle, such as the gyroscope and the pendulum inside the one-wheeled robot Gyrover give
(Brown and Xu, 1996); the inertia of such a drive is left out.

With w = psi' + theta' sin(phi) the rate of the spin about the axle, rolling straight on is stable if

    w^2 > m g r I / (J (J + m r^2)),

which is v^2 > g r/3 for a thin uniform disk; below, it falls. The energy is conserved without torques. Angles and
frame have a pole where the disk lies flat, beyond the stops of phi: skids on both sides.
"""

from mechanics.bodies import Body
from mechanics.mechanism import Mechanism

__all__ = ["falling_rolling_disk"]

falling_rolling_disk = Mechanism(
    name="falling_rolling_disk",
    coordinates=("x", "y", "theta", "phi", "psi"),
    # A thin uniform disk: J = m r^2/2, I = m r^2/4.
    parameters={"m": 2.0, "r": 0.2, "I": 0.02, "J": 0.04, "g": 9.81},
    # The centre is at r (sin(phi) to the right, cos(phi) up) from the contact.
    inertia=(
        ("m", "0", "m*r*sin(phi)*cos(theta)", "m*r*cos(phi)*sin(theta)", "0"),
        ("0", "m", "m*r*sin(phi)*sin(theta)", "-m*r*cos(phi)*cos(theta)", "0"),
        (
            "m*r*sin(phi)*cos(theta)",
            "m*r*sin(phi)*sin(theta)",
            "I*cos(phi)**2 + (J + m*r**2)*sin(phi)**2",
            "0",
            "J*sin(phi)",
        ),
        ("m*r*cos(phi)*sin(theta)", "-m*r*cos(phi)*cos(theta)", "0", "I + m*r**2", "0"),
        ("0", "0", "J*sin(phi)", "0", "J"),
    ),
    # The contact moves along theta as fast as the rim.
    one_forms=(
        ("1", "0", "0", "0", "-r*cos(theta)"),
        ("0", "1", "0", "0", "-r*sin(theta)"),
    ),
    forces={"u_phi": ("0", "0", "0", "1", "0"), "u_psi": ("0", "0", "0", "0", "1")},
    potential="m*g*r*cos(phi)",
    frames={
        # Components of the angular velocity: about the line of travel, about the axle, and about the
        # diameter through the contact. Norms squared: I + m r^2, J + m r^2, I.
        "principal": (
            ("0", "0", "0", "1", "0"),
            ("r*cos(theta)", "r*sin(theta)", "0", "0", "1"),
            ("-r*tan(phi)*cos(theta)", "-r*tan(phi)*sin(theta)", "1/cos(phi)", "0", "-tan(phi)"),
        ),
    },
    citation="J. I. Neimark and N. A. Fufaev, Dynamics of Nonholonomic Systems, 1972; "
    "A. M. Bloch, Nonholonomic Mechanics and Control, 2003",
    fibre=("x", "y", "theta"),
    joint_limits={"phi": 0.6},
    # The first holds the disk up to its stops.
    torque_limits={"u_phi": 2.5, "u_psi": 0.2},
    observation={
        "phi": "phi/0.6",
        "phi_dot": "phi_dot/5",
        "theta_dot": "theta_dot/5",
        "speed": "speed",
    },
    # Rolling and pivoting on a soft ground.
    rayleigh="(c_psi*psi_dot**2 + c_theta*theta_dot**2)/2",
    drag={"c_psi": 0.004, "c_theta": 0.004},
    # Seen from above: the ellipse of the rim, whose middle lies to the right of the contact when the disk leans there.
    bodies={
        "disk": Body(
            "disc",
            ("x + r*sin(phi)*sin(theta)", "y - r*sin(phi)*cos(theta)", "theta"),
            ("2*r", "r*(0.16 + 2*abs(sin(phi)))"),
        ),
        "contact": Body("wheel", ("x", "y", "theta"), ("r", "0.1*r")),
        "mark": Body(
            "disc", ("r*sin(psi)", "-r*cos(psi)*sin(phi)", "0"), ("0.24*r", "0.24*r"), on="disk", colour="orange"
        ),
    },
)

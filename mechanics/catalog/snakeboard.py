"""The snakeboard of Bullo and Zefran, section 4 (model of Ostrowski, Lewis, Burdick and Murray).

A board with a rotor on it and wheel axles that steer in opposite directions by the same angle.
(x, y) is the centre of mass, theta the heading, psi the rotor's angle and phi the wheels',
both relative to the board.
"""

from mechanics.bodies import Body
from mechanics.mechanism import Mechanism

__all__ = ["snakeboard"]

snakeboard = Mechanism(
    name="snakeboard",
    coordinates=("x", "y", "theta", "psi", "phi"),
    parameters={"m": 6.0, "l": 0.2, "J_r": 0.072, "J_w": 0.01},
    # Positive definite only if J_r < m l^2: the rotor is part of the whole.
    inertia=(
        ("m", "0", "0", "0", "0"),
        ("0", "m", "0", "0", "0"),
        ("0", "0", "l**2*m", "J_r", "0"),
        ("0", "0", "J_r", "J_r", "0"),
        ("0", "0", "0", "0", "J_w"),
    ),
    one_forms=(
        ("sin(phi - theta)", "cos(phi - theta)", "l*cos(phi)", "0", "0"),
        ("-sin(phi + theta)", "cos(phi + theta)", "-l*cos(phi)", "0", "0"),
    ),
    forces={"u_psi": ("0", "0", "0", "1", "0"), "u_phi": ("0", "0", "0", "0", "1")},
    definitions={"D": "m*l**2 - J_r*sin(phi)**2"},
    frames={
        # Every generalized Christoffel symbol vanishes here. Norms squared: J_r, 1, J_w.
        "flat": (
            ("0", "0", "0", "1", "0"),
            (
                "l*cos(phi)*cos(theta)/sqrt(D)",
                "l*cos(phi)*sin(theta)/sqrt(D)",
                "-sin(phi)/sqrt(D)",
                "sin(phi)/sqrt(D)",
                "0",
            ),
            ("0", "0", "0", "0", "1"),
        ),
        # Section 4.1: X1 rotates with both joints held; the other two change psi and phi.
        "paper": (
            ("l*cos(phi)*cos(theta)", "l*cos(phi)*sin(theta)", "-sin(phi)", "0", "0"),
            (
                "J_r/(m*l)*cos(phi)*sin(phi)*cos(theta)",
                "J_r/(m*l)*cos(phi)*sin(phi)*sin(theta)",
                "-J_r/(m*l**2)*sin(phi)**2",
                "1",
                "0",
            ),
            ("0", "0", "0", "0", "1"),
        ),
    },
    citation="F. Bullo and M. Zefran, On mechanical control systems with nonholonomic constraints and symmetries, 2002",
    fibre=("x", "y", "theta"),
    joint_limits={"phi": 1.2},
    torque_limits={"u_psi": 1.0, "u_phi": 0.5},
    # Rolling at the wheels, which all have the same speed, that of the front ones; friction in both joints.
    rayleigh="(C*(cos(theta - phi)*x_dot + sin(theta - phi)*y_dot - l*sin(phi)*theta_dot)**2"
    " + b_psi*psi_dot**2 + b_phi*phi_dot**2)/2",
    drag={"C": 1.2, "b_psi": 0.05, "b_phi": 0.02},
    observation={"phi": "phi/1.2", "phi_dot": "phi_dot/10", "psi_dot": "psi_dot/10", "speed": "speed"},
    bodies={
        "front truck": Body(
            "axle", ("x + l*cos(theta)", "y + l*sin(theta)", "theta - phi"), ("0.8*l", "0.4*l", "0.14*l")
        ),
        "rear truck": Body(
            "axle", ("x - l*cos(theta)", "y - l*sin(theta)", "theta + phi"), ("0.8*l", "0.4*l", "0.14*l")
        ),
        "board": Body("rectangle", ("x", "y", "theta"), ("1.5*l", "0.36*l")),
        "front foot": Body("disc", ("l", "0", "-phi"), ("0.5*l", "0.4*l"), on="board", colour="sky"),
        "rear foot": Body("disc", ("-l", "0", "phi"), ("0.5*l", "0.4*l"), on="board", colour="sky"),
        "rotor": Body("rectangle", ("0", "0", "psi"), ("1.4*l", "0.14*l"), on="board", colour="orange"),
        "bearing": Body("disc", ("0", "0", "0"), ("0.24*l", "0.24*l"), on="board", colour="orange"),
    },
)

"""Chaplygin's sphere: a ball with its centre of mass in the middle and three different inertias, rolling on a plane.

(x, y) is the point of contact. The attitude is a rotation by theta about the vertical, then by phi about the axis
that was x, then by psi about the body's second axis; I_1, I_2, I_3 are the principal inertias, r is the radius.
u_1, u_2, u_3 are torques about the principal axes, as three rotors inside would give; their own spin is left out.

Without torques the angular momentum about the point of contact is constant in space, all three components of it,
and the system is integrable (Chaplygin). It has no fibre for tasks in the plane: a ball has no heading, and these
angles have a pole at phi = ±pi/2 through which it rolls as through any other attitude.
"""

from mechanics.mechanism import Mechanism

__all__ = ["chaplygin_sphere"]

chaplygin_sphere = Mechanism(
    name="chaplygin_sphere",
    coordinates=("x", "y", "theta", "phi", "psi"),
    parameters={"m": 1.0, "r": 0.1, "I_1": 0.003, "I_2": 0.004, "I_3": 0.005},
    definitions={
        # Inertia about the nodal axis and the one across it in the body's first and third axis.
        "A": "I_1*cos(psi)**2 + I_3*sin(psi)**2",
        "B": "I_1*sin(psi)**2 + I_3*cos(psi)**2",
        "C": "(I_3 - I_1)*sin(psi)*cos(psi)",
        "k_phi": "C*cos(phi)/(A + m*r**2)",
        "k_psi": "I_2*sin(phi)/(I_2 + m*r**2*cos(phi)**2)",
    },
    inertia=(
        ("m", "0", "0", "0", "0"),
        ("0", "m", "0", "0", "0"),
        ("0", "0", "B*cos(phi)**2 + I_2*sin(phi)**2", "C*cos(phi)", "I_2*sin(phi)"),
        ("0", "0", "C*cos(phi)", "A", "0"),
        ("0", "0", "I_2*sin(phi)", "0", "I_2"),
    ),
    one_forms=(
        ("cos(theta)", "sin(theta)", "0", "0", "-r*cos(phi)"),
        ("-sin(theta)", "cos(theta)", "0", "r", "0"),
    ),
    forces={
        "u_1": ("0", "0", "-sin(psi)*cos(phi)", "cos(psi)", "0"),
        "u_2": ("0", "0", "sin(phi)", "0", "1"),
        "u_3": ("0", "0", "cos(psi)*cos(phi)", "sin(psi)", "0"),
    },
    frames={
        # Rolling by phi and by psi alone, and the spin about the vertical made orthogonal to both.
        "euler": (
            ("r*sin(theta)", "-r*cos(theta)", "0", "1", "0"),
            ("r*cos(phi)*cos(theta)", "r*cos(phi)*sin(theta)", "0", "0", "1"),
            (
                "-k_phi*r*sin(theta) - k_psi*r*cos(phi)*cos(theta)",
                "k_phi*r*cos(theta) - k_psi*r*cos(phi)*sin(theta)",
                "1",
                "-k_phi",
                "-k_psi",
            ),
        ),
    },
    citation="S. A. Chaplygin, On a ball's rolling on a horizontal plane, 1903 (Regular and Chaotic Dynamics 7(2), "
    "2002); D. Schneider, Non-holonomic Euler-Poincare equations and stability in Chaplygin's sphere, "
    "Dynamical Systems 17(2), 2002",
    torque_limits={"u_1": 0.02, "u_2": 0.02, "u_3": 0.02},
    observation={"theta_dot": "theta_dot/10", "phi_dot": "phi_dot/10", "psi_dot": "psi_dot/10"},
)

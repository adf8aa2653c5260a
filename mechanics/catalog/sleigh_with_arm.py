"""A Chaplygin sleigh that swings an arm: it drives and steers itself, and brakes, by one torque.

(x, y) is the point where the edge touches the ground, theta the heading, phi the angle of the arm relative to
it. The arm turns about the vertical through that point and carries the mass m_a at the distance l, with the
moment of inertia J_a about its own centre. The body's centre of mass lies a ahead of the edge; m is its mass
and I_c its moment of inertia about that point. tau_arm acts between body and arm.

It belongs to the sleighs with a moving mass inside of Osborne and Zenkov and of Bizyaev, Borisov and Mamaev.
With v the speed along the edge, w = theta_dot and W = theta_dot + phi_dot the arm's rate in space,

    (m + m_a) v_dot = m a w^2 + m_a l (W^2 cos(phi) + W_dot sin(phi)),
    (I_c + m a^2) w_dot = -m a v w - tau_arm,
    (J_a + m_a l^2) W_dot = m_a l (v_dot sin(phi) - v w cos(phi)) + tau_arm.

With l = 0 it is the Chaplygin beanie. Unlike the beanie's, its speed can fall.
"""

from mechanics.bodies import Body
from mechanics.mechanism import Mechanism

__all__ = ["sleigh_with_arm"]

sleigh_with_arm = Mechanism(
    name="sleigh_with_arm",
    coordinates=("x", "y", "theta", "phi"),
    parameters={"m": 1.0, "a": 0.1, "I_c": 0.01, "m_a": 0.5, "l": 0.2, "J_a": 0.001},
    inertia=(
        ("m + m_a", "0", "-a*m*sin(theta) + s", "s"),
        ("0", "m + m_a", "a*m*cos(theta) + c", "c"),
        ("-a*m*sin(theta) + s", "a*m*cos(theta) + c", "I_c + a**2*m + J_a + l**2*m_a", "J_a + l**2*m_a"),
        ("s", "c", "J_a + l**2*m_a", "J_a + l**2*m_a"),
    ),
    one_forms=(("-sin(theta)", "cos(theta)", "0", "0"),),
    forces={"tau_arm": ("0", "0", "0", "1")},
    definitions={
        "s": "-l*m_a*sin(theta + phi)",
        "c": "l*m_a*cos(theta + phi)",
    },
    frames={
        # Made orthogonal, the last field turns the arm while the whole recoils: the first pseudo-velocity is momentum
        # along the heading over the whole mass, the others are w and W.
        "momentum": (
            ("cos(theta)", "sin(theta)", "0", "0"),
            ("0", "0", "1", "-1"),
            ("0", "0", "0", "1"),
        ),
    },
    citation="J. M. Osborne and D. V. Zenkov, Steering the Chaplygin sleigh by a moving mass, IEEE Conference on "
    "Decision and Control, 2005; I. A. Bizyaev, A. V. Borisov and I. S. Mamaev, The Chaplygin sleigh with parametric "
    "excitation: chaotic dynamics and nonholonomic acceleration, Regular and Chaotic Dynamics 22(8), 2017",
    fibre=("x", "y", "theta"),
    torque_limits={"tau_arm": 0.1},
    observation={
        "sin_phi": "sin(phi)",
        "cos_phi": "cos(phi)",
        "theta_dot": "theta_dot/2",
        "phi_dot": "phi_dot/10",
        "speed": "speed",
    },
    rayleigh="(c_w*(x_dot**2 + y_dot**2) + c_phi*phi_dot**2)/2",
    drag={"c_w": 0.05, "c_phi": 0.002},
    bodies={
        "body": Body("rectangle", ("x + a*cos(theta)", "y + a*sin(theta)", "theta"), ("2.8*a", "1.6*a")),
        "edge": Body("wheel", ("-a", "0", "0"), ("0.9*a", "0.2*a"), on="body"),
        "arm": Body("bar", ("-a", "0", "phi"), ("l", "0.14*l"), on="body", colour="orange"),
        "mass": Body("disc", ("l", "0", "0"), ("0.35*l", "0.35*l"), on="arm", colour="orange"),
    },
)

"""The differential drive robot: a body on two driven wheels with one axis, steered by their difference.

(x, y) is the middle of the axle, theta the heading, phi_r and phi_l are the angles of the right and the left
wheel. The centre of mass lies a ahead of the axle; m and I_c are mass and moment of inertia about it of the
whole robot, I_w is a wheel's moment of inertia about the axle, b half the track, r the wheels' radius. A
caster, free of mass and friction, holds the robot up.

With v the speed along the heading, w = theta_dot (Sarkar, Yun and Kumar; Dhaouadi and Abu Hatab),

    (m + 2 I_w/r^2) v_dot = m a w^2 + (tau_r + tau_l)/r,
    (I_c + m a^2 + 2 I_w b^2/r^2) w_dot = -m a v w + b (tau_r - tau_l)/r:

a Chaplygin sleigh with heavier inertia, so that it runs straight only with the centre of mass in front.
"""

from mechanics.bodies import Body
from mechanics.mechanism import Mechanism

__all__ = ["differential_drive"]

differential_drive = Mechanism(
    name="differential_drive",
    coordinates=("x", "y", "theta", "phi_r", "phi_l"),
    parameters={"m": 5.0, "a": 0.05, "I_c": 0.08, "I_w": 0.001, "b": 0.15, "r": 0.05},
    inertia=(
        ("m", "0", "-a*m*sin(theta)", "0", "0"),
        ("0", "m", "a*m*cos(theta)", "0", "0"),
        ("-a*m*sin(theta)", "a*m*cos(theta)", "I_c + a**2*m", "0", "0"),
        ("0", "0", "0", "I_w", "0"),
        ("0", "0", "0", "0", "I_w"),
    ),
    one_forms=(
        ("-sin(theta)", "cos(theta)", "0", "0", "0"),
        ("cos(theta)", "sin(theta)", "b", "-r", "0"),
        ("cos(theta)", "sin(theta)", "-b", "0", "-r"),
    ),
    forces={"tau_r": ("0", "0", "0", "1", "0"), "tau_l": ("0", "0", "0", "0", "1")},
    frames={
        # Speed and turning rate. Norms squared: m + 2 I_w/r^2, I_c + m a^2 + 2 I_w b^2/r^2.
        "body": (
            ("cos(theta)", "sin(theta)", "0", "1/r", "1/r"),
            ("0", "0", "1", "b/r", "-b/r"),
        ),
    },
    citation="N. Sarkar, X. Yun and V. Kumar, Control of mechanical systems with rolling constraints: application to "
    "dynamic control of mobile robots, Int. J. Robotics Research 13, 1994; R. Dhaouadi and A. Abu Hatab, Dynamic "
    "modelling of differential-drive mobile robots using Lagrange and Newton-Euler methodologies, 2013",
    fibre=("x", "y", "theta"),
    torque_limits={"tau_r": 0.05, "tau_l": 0.05},
    observation={"theta_dot": "theta_dot/2", "speed": "speed"},
    # Friction of the two motors and gears.
    rayleigh="c_m*(phi_r_dot**2 + phi_l_dot**2)/2",
    drag={"c_m": 0.0005},
    bodies={
        "body": Body("disc", ("x", "y", "theta"), ("2*b", "2*b")),
        "nose": Body("bar", ("0", "0", "0"), ("b", "0.08*b"), on="body", colour="sky"),
        "right wheel": Body("wheel", ("0", "-b", "0"), ("2*r", "0.5*r"), on="body"),
        "left wheel": Body("wheel", ("0", "b", "0"), ("2*r", "0.5*r"), on="body"),
        "right mark": Body("disc", ("r*sin(phi_r)", "-b", "0"), ("0.4*r", "0.4*r"), on="body", colour="orange"),
        "left mark": Body("disc", ("r*sin(phi_l)", "b", "0"), ("0.4*r", "0.4*r"), on="body", colour="orange"),
    },
)

"""The Chaplygin beanie: a Chaplygin sleigh that drives itself by turning a rotor on its back.

(x, y) is the point where the wheel (or edge) touches the ground, theta the heading, phi the angle of the
rotor relative to the body. The centre of mass of the whole lies a ahead of the wheel; m is the whole mass,
I_c the body's moment of inertia about that point, B that of the balanced rotor. tau_rotor acts between them.

With v the speed along the heading and w = theta_dot (Kelly, Fairchild, Hassing and Tallapragada),

    v_dot = a w^2,    (I_c + m a^2) w_dot = -m a v w - tau_rotor,    B (w_dot + phi_ddot) = tau_rotor:

with a > 0 whatever the rotor does drives the beanie forward, and nothing but drag slows it down. Swung to and
fro, the rotor turns it at first and then drives it straight on. The faster it is the less it turns,
w = -tau_rotor/(m a v) in the end, so that v^3 grows as 3 <tau_rotor^2> t/(m^2 a): the speed-up as t^(1/3) of
Bizyaev, Borisov, Kozlov and Mamaev.
"""

from mechanics.bodies import Body
from mechanics.mechanism import Mechanism

__all__ = ["chaplygin_beanie"]

chaplygin_beanie = Mechanism(
    name="chaplygin_beanie",
    coordinates=("x", "y", "theta", "phi"),
    parameters={"m": 1.5, "a": 0.1, "I_c": 0.01, "B": 0.02},
    inertia=(
        ("m", "0", "-a*m*sin(theta)", "0"),
        ("0", "m", "a*m*cos(theta)", "0"),
        ("-a*m*sin(theta)", "a*m*cos(theta)", "B + I_c + a**2*m", "B"),
        ("0", "0", "B", "B"),
    ),
    one_forms=(("-sin(theta)", "cos(theta)", "0", "0"),),
    forces={"tau_rotor": ("0", "0", "0", "1")},
    frames={
        # The second field turns the body under a rotor that stays; the third pseudo-velocity is thus the rotor's
        # rate in space, theta_dot + phi_dot. Norms squared: m, I_c + m a^2, B.
        "body": (
            ("cos(theta)", "sin(theta)", "0", "0"),
            ("0", "0", "1", "-1"),
            ("0", "0", "0", "1"),
        ),
    },
    citation="S. D. Kelly, M. J. Fairchild, P. M. Hassing and P. Tallapragada, Proportional heading control for planar "
    "navigation: the Chaplygin beanie and fishlike robotic swimming, American Control Conference, 2012; I. A. Bizyaev, "
    "A. V. Borisov, V. V. Kozlov and I. S. Mamaev, Fermi-like acceleration and power-law energy growth in nonholonomic "
    "systems, Nonlinearity 32, 2019",
    fibre=("x", "y", "theta"),
    torque_limits={"tau_rotor": 0.2},
    observation={"theta_dot": "theta_dot/2", "phi_dot": "phi_dot/10", "speed": "speed"},
    rayleigh="(c_w*(x_dot**2 + y_dot**2) + c_phi*phi_dot**2)/2",
    drag={"c_w": 0.05, "c_phi": 0.001},
    bodies={
        "body": Body("disc", ("x + a*cos(theta)", "y + a*sin(theta)", "theta"), ("3.2*a", "2.2*a")),
        "wheel": Body("wheel", ("-a", "0", "0"), ("0.9*a", "0.2*a"), on="body"),
        "rotor": Body("rectangle", ("0", "0", "phi"), ("1.9*a", "0.3*a"), on="body", colour="orange"),
        "bearing": Body("disc", ("0", "0", "0"), ("0.5*a", "0.5*a"), on="body", colour="orange"),
    },
)

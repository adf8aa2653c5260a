"""The Chaplygin sleigh: a rigid body on a knife edge, the simplest mechanism whose constraint is not holonomic.

(x, y) is the point where the edge touches the ground, theta the edge's heading. The centre of mass lies a
ahead of it on the edge's line; m is the mass, I_c the moment of inertia about the centre of mass. F_long
pushes along the edge and tau turns.

With v the speed along the edge, w = theta_dot and I = I_c + m a^2 (Neimark and Fufaev),

    v_dot = a w^2 + F_long/m,    I w_dot = -m a v w + tau.

Energy is kept and phase volume is not: without forces every motion tends to a straight one with the centre
of mass in front, v = v_m tanh(k t) and w = w_m sech(k t) with k = m a v_m/I. One that slides backwards turns,
by the angle pi sqrt(I/(m a^2)) in all, and goes on forwards.
"""

from mechanics.bodies import Body
from mechanics.mechanism import Mechanism

__all__ = ["chaplygin_sleigh"]

chaplygin_sleigh = Mechanism(
    name="chaplygin_sleigh",
    coordinates=("x", "y", "theta"),
    parameters={"m": 1.5, "a": 0.15, "I_c": 0.02},
    inertia=(
        ("m", "0", "-a*m*sin(theta)"),
        ("0", "m", "a*m*cos(theta)"),
        ("-a*m*sin(theta)", "a*m*cos(theta)", "I_c + a**2*m"),
    ),
    one_forms=(("-sin(theta)", "cos(theta)", "0"),),
    forces={"F_long": ("cos(theta)", "sin(theta)", "0"), "tau": ("0", "0", "1")},
    frames={
        # Speed along the edge and turning rate. Norms squared: m, I_c + m a^2.
        "body": (
            ("cos(theta)", "sin(theta)", "0"),
            ("0", "0", "1"),
        ),
    },
    citation="S. A. Chaplygin, On the theory of motion of nonholonomic systems. The reducing-multiplier theorem, 1911 "
    "(Regular and Chaotic Dynamics 13, 2008); Ju. I. Neimark and N. A. Fufaev, Dynamics of nonholonomic systems, 1972",
    fibre=("x", "y", "theta"),
    torque_limits={"F_long": 0.5, "tau": 0.05},
    observation={"theta_dot": "theta_dot/2", "speed": "speed"},
    # The edge drags along its line, and where it is turned on the spot.
    rayleigh="(c_w*(x_dot**2 + y_dot**2) + c_theta*theta_dot**2)/2",
    drag={"c_w": 0.1, "c_theta": 0.005},
    bodies={
        "body": Body("rectangle", ("x + a*cos(theta)", "y + a*sin(theta)", "theta"), ("2.8*a", "1.6*a")),
        "centre of mass": Body("disc", ("0", "0", "0"), ("0.3*a", "0.3*a"), on="body", colour="orange"),
        "edge": Body("wheel", ("-a", "0", "0"), ("0.9*a", "0.14*a"), on="body"),
    },
)

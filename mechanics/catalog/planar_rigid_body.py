"""The planar rigid body with two thrusters of Lewis and Murray: a hovercraft seen from above.

Nothing constrains it. (x, y) is the centre of mass, theta the heading. u_1 pushes along the heading
through the centre of mass; u_2 pushes sideways at the distance h behind it, so that a push to the left
turns the body to the right.
"""

from mechanics.bodies import Body
from mechanics.mechanism import Mechanism

__all__ = ["planar_rigid_body"]

planar_rigid_body = Mechanism(
    name="planar_rigid_body",
    coordinates=("x", "y", "theta"),
    parameters={"m": 2.0, "J": 0.03, "h": 0.1},
    inertia=(("m", "0", "0"), ("0", "m", "0"), ("0", "0", "J")),
    one_forms=(),
    forces={
        "u_1": ("cos(theta)", "sin(theta)", "0"),
        "u_2": ("-sin(theta)", "cos(theta)", "-h"),
    },
    frames={
        # Velocities in the body's axes: the reduced equations are those of Euler and Poincaré.
        "body": (
            ("cos(theta)", "sin(theta)", "0"),
            ("-sin(theta)", "cos(theta)", "0"),
            ("0", "0", "1"),
        ),
        # Velocities in the axes of the plane: every generalized Christoffel symbol vanishes.
        "flat": (("1", "0", "0"), ("0", "1", "0"), ("0", "0", "1")),
    },
    citation="A. D. Lewis and R. M. Murray, Configuration controllability of simple mechanical control systems, "
    "SIAM J. Control and Optimization 35(3), 1997",
    fibre=("x", "y", "theta"),
    torque_limits={"u_1": 0.5, "u_2": 0.25},
    observation={"speed": "speed", "drift": "drift", "theta_dot": "theta_dot/5"},
    # The air under the skirt.
    rayleigh="(c_v*(x_dot**2 + y_dot**2) + c_w*theta_dot**2)/2",
    drag={"c_v": 0.2, "c_w": 0.005},
    bodies={
        "skirt": Body("disc", ("x", "y", "theta"), ("3.6*h", "2.4*h"), colour="grey"),
        "hull": Body("disc", ("0", "0", "0"), ("3*h", "1.8*h"), on="skirt"),
        "bow": Body("bar", ("0.6*h", "0", "0"), ("0.7*h", "0.2*h"), on="skirt", colour="sky"),
        "thruster": Body("rectangle", ("-h", "0", "pi/2"), ("0.8*h", "0.3*h"), on="skirt", colour="orange"),
    },
)

"""The wheeled inverted pendulum: a robot that balances on two wheels, each with a motor.

(x, y) is the middle of the axle, theta the heading, alpha the lean of the body forward, psi_r and psi_l the
angles of the right and the left wheel relative to the body, which the motors turn. The body has mass m_b, its
centre at the distance l above the axle, and inertias I_x, I_y, I_z about its own axes: forward, along the axle,
upward. A wheel has mass m_w, radius r, inertia J_w about the axle and J_d about a diameter; the wheels are 2 b apart.

Upright is unstable. A torque that drives the wheels forward tips the body backward, so that the robot goes back for a
moment before it can go on, and leans forward as long as it speeds up: it stays at a lean only at the acceleration that
belongs to it. Skids stop the body on both sides.
"""

from mechanics.bodies import Body
from mechanics.mechanism import Mechanism

__all__ = ["wheeled_inverted_pendulum"]

wheeled_inverted_pendulum = Mechanism(
    name="wheeled_inverted_pendulum",
    coordinates=("x", "y", "theta", "alpha", "psi_r", "psi_l"),
    parameters={
        "m_b": 2.0,
        "l": 0.1,
        "I_x": 0.015,
        "I_y": 0.012,
        "I_z": 0.008,
        "m_w": 0.3,
        "r": 0.1,
        "b": 0.15,
        "J_w": 0.0015,
        "J_d": 0.0008,
        "g": 9.81,
    },  # fmt: skip
    definitions={
        "m_0": "m_b + 2*m_w",
        # About the vertical: body and wheels, without their spin
        "J_0": "I_z*cos(alpha)**2 + (I_x + m_b*l**2)*sin(alpha)**2 + 2*(J_d + m_w*b**2)",
        # Share of rolling in the field that changes the lean
        "k": "m_b*l*cos(alpha)/(m_0 + 2*J_w/r**2)",
    },
    inertia=(
        ("m_0", "0", "-m_b*l*sin(alpha)*sin(theta)", "m_b*l*cos(alpha)*cos(theta)", "0", "0"),
        ("0", "m_0", "m_b*l*sin(alpha)*cos(theta)", "m_b*l*cos(alpha)*sin(theta)", "0", "0"),
        ("-m_b*l*sin(alpha)*sin(theta)", "m_b*l*sin(alpha)*cos(theta)", "J_0", "0", "0", "0"),
        (
            "m_b*l*cos(alpha)*cos(theta)",
            "m_b*l*cos(alpha)*sin(theta)",
            "0",
            "I_y + m_b*l**2 + 2*J_w",
            "J_w",
            "J_w",
        ),
        ("0", "0", "0", "J_w", "J_w", "0"),
        ("0", "0", "0", "J_w", "0", "J_w"),
    ),
    one_forms=(
        ("-sin(theta)", "cos(theta)", "0", "0", "0", "0"),
        ("cos(theta)", "sin(theta)", "b", "-r", "-r", "0"),
        ("cos(theta)", "sin(theta)", "-b", "-r", "0", "-r"),
    ),
    forces={"u_r": ("0", "0", "0", "0", "1", "0"), "u_l": ("0", "0", "0", "0", "0", "1")},
    potential="m_b*g*l*cos(alpha)",
    frames={
        # Rolling, turning, and leaning with as much rolling as makes it orthogonal.
        "rolling": (
            ("cos(theta)", "sin(theta)", "0", "0", "1/r", "1/r"),
            ("0", "0", "1", "0", "b/r", "-b/r"),
            ("-k*cos(theta)", "-k*sin(theta)", "0", "1", "-1 - k/r", "-1 - k/r"),
        ),
    },
    citation="K. Pathak, J. Franch and S. K. Agrawal, Velocity and position control of a wheeled inverted pendulum by "
    "partial feedback linearization, IEEE Trans. Robotics 21(3), 2005",
    fibre=("x", "y", "theta"),
    joint_limits={"alpha": 0.3},
    torque_limits={"u_r": 0.15, "u_l": 0.15},
    observation={
        "alpha": "alpha/0.3",
        "alpha_dot": "alpha_dot/5",
        "theta_dot": "theta_dot/5",
        "speed": "speed",
    },
    # Bearings of the motors, and rolling.
    rayleigh="(c_m*(psi_r_dot**2 + psi_l_dot**2) + c_w*(x_dot**2 + y_dot**2))/2",
    drag={"c_m": 0.003, "c_w": 0.05},
    # The head, twice as high as the centre, shows the lean.
    bodies={
        "wheels": Body("axle", ("x", "y", "theta"), ("2*b", "2*r", "0.3*r")),
        "right mark": Body(
            "disc", ("r*sin(alpha + psi_r)", "-b", "0"), ("0.24*r", "0.24*r"), on="wheels", colour="orange"
        ),
        "left mark": Body(
            "disc", ("r*sin(alpha + psi_l)", "b", "0"), ("0.24*r", "0.24*r"), on="wheels", colour="orange"
        ),
        "body": Body("rectangle", ("l*sin(alpha)", "0", "0"), ("0.6*r + 2*l*abs(sin(alpha))", "1.3*b"), on="wheels"),
        "head": Body("disc", ("2*l*sin(alpha)", "0", "0"), ("0.7*r", "0.7*b"), on="wheels", colour="sky"),
    },
)

"""The vertical rolling disk: a disk that rolls without slipping and never tilts.

(x, y) is the point of contact, theta the heading, phi the angle that the disk has rolled; Bloch writes phi
for the first and theta for the second. m is the mass, R the radius, I_c the moment of inertia about the
axle and J about the vertical. u_roll turns the axle, u_steer the heading.

All generalized Christoffel symbols vanish (Bloch, 1.4):

    (I_c + m R^2) phi_ddot = u_roll,    J theta_ddot = u_steer,

and without torque the disk rolls on a circle of radius R phi_dot/theta_dot.
"""

from mechanics.bodies import Body
from mechanics.mechanism import Mechanism

__all__ = ["vertical_rolling_disk"]

vertical_rolling_disk = Mechanism(
    name="vertical_rolling_disk",
    coordinates=("x", "y", "theta", "phi"),
    # A homogeneous disk: I_c = m R^2/2, J = m R^2/4.
    parameters={"m": 1.0, "R": 0.2, "I_c": 0.02, "J": 0.01},
    inertia=(
        ("m", "0", "0", "0"),
        ("0", "m", "0", "0"),
        ("0", "0", "J", "0"),
        ("0", "0", "0", "I_c"),
    ),
    one_forms=(
        ("1", "0", "0", "-R*cos(theta)"),
        ("0", "1", "0", "-R*sin(theta)"),
    ),
    forces={"u_roll": ("0", "0", "0", "1"), "u_steer": ("0", "0", "1", "0")},
    frames={
        # The rates of rolling and turning. Norms squared: I_c + m R^2, J.
        "body": (
            ("R*cos(theta)", "R*sin(theta)", "0", "1"),
            ("0", "0", "1", "0"),
        ),
    },
    citation="A. M. Bloch, Nonholonomic Mechanics and Control, 2003, section 1.4",
    fibre=("x", "y", "theta"),
    torque_limits={"u_roll": 0.08, "u_steer": 0.01},
    observation={"theta_dot": "theta_dot/2", "speed": "speed"},
    rayleigh="(c_phi*phi_dot**2 + c_theta*theta_dot**2)/2",
    drag={"c_phi": 0.003, "c_theta": 0.001},
    bodies={
        "disk": Body("wheel", ("x", "y", "theta"), ("2*R", "0.16*R")),
        # A mark on the rim, as far ahead of the axle as it is, and small where it is below.
        "mark": Body(
            "disc",
            ("R*sin(phi)", "0", "0"),
            ("R*(0.2 + 0.1*cos(phi))", "R*(0.2 + 0.1*cos(phi))"),
            on="disk",
            colour="orange",
        ),
    },
)

"""The car: rear-wheel drive and a steering with inertia, each axle one wheel (the dynamic bicycle model).

(x, y) is the middle of the rear axle, theta the heading, delta the steering angle relative to the body. L is
the wheelbase; the centre of mass lies a ahead of the rear axle, m and I_c are mass and moment of inertia
about it, J is that of the steering, front wheels included. F_rear pushes at the rear axle along the heading,
tau_steer acts between the body and the steering.

The kinematics are those of Murray and Sastry, theta_dot = (V/L) tan(delta) with V the speed of the rear axle.
With I_t = I_c + m a^2 + J,

    (m + I_t tan(delta)^2/L^2) V_dot + (I_t/L^2) tan(delta) sec(delta)^2 delta_dot V + (J/L) tan(delta) delta_ddot
        = F_rear,    J (theta_ddot + delta_ddot) = tau_steer.
"""

from mechanics.bodies import Body
from mechanics.mechanism import Mechanism

__all__ = ["car"]

car = Mechanism(
    name="car",
    coordinates=("x", "y", "theta", "delta"),
    # A model car in the scale 1:10.
    parameters={"m": 2.0, "a": 0.12, "I_c": 0.02, "J": 0.002, "L": 0.26},
    inertia=(
        ("m", "0", "-a*m*sin(theta)", "0"),
        ("0", "m", "a*m*cos(theta)", "0"),
        ("-a*m*sin(theta)", "a*m*cos(theta)", "I_c + J + a**2*m", "J"),
        ("0", "0", "J", "J"),
    ),
    one_forms=(
        ("-sin(theta)", "cos(theta)", "0", "0"),
        ("sin(delta + theta)", "-cos(delta + theta)", "-L*cos(delta)", "0"),
    ),
    forces={"F_rear": ("cos(theta)", "sin(theta)", "0", "0"), "tau_steer": ("0", "0", "0", "1")},
    definitions={"D": "m*L**2*cos(delta)**2 + (I_c + a**2*m)*sin(delta)**2"},
    frames={
        # Drive with the steering held, and steer: of the two only the second moves delta, as its stops need. Regular
        # at delta = +-pi/2, where tan(delta) is not.
        "steering": (
            ("L*cos(delta)*cos(theta)", "L*cos(delta)*sin(theta)", "sin(delta)", "0"),
            ("0", "0", "0", "1"),
        ),
        # The steering held in space while the car drives. Every generalized Christoffel symbol vanishes: without
        # forces both pseudo-velocities are constant. Norms squared: J, 1.
        "flat": (
            ("0", "0", "0", "1"),
            (
                "L*cos(delta)*cos(theta)/sqrt(D)",
                "L*cos(delta)*sin(theta)/sqrt(D)",
                "sin(delta)/sqrt(D)",
                "-sin(delta)/sqrt(D)",
            ),
        ),
    },
    citation="R. M. Murray and S. S. Sastry, Nonholonomic motion planning: steering using sinusoids, IEEE Transactions "
    "on Automatic Control 38, 1993 (kinematics)",
    fibre=("x", "y", "theta"),
    joint_limits={"delta": 0.6},
    torque_limits={"F_rear": 0.6, "tau_steer": 0.02},
    observation={"delta": "delta/0.6", "delta_dot": "delta_dot/5", "speed": "speed"},
    # Rolling and air, and the steering's friction.
    rayleigh="(c_w*(x_dot**2 + y_dot**2) + c_delta*delta_dot**2)/2",
    drag={"c_w": 0.1, "c_delta": 0.002},
    # The two front wheels steer about one centre of turning (Ackermann), on both sides of the model's single one.
    bodies={
        "rear axle": Body("axle", ("x", "y", "theta"), ("L/2", "L/4", "L/10")),
        "left wheel": Body(
            "wheel", ("L", "L/4", "atan2(sin(delta), cos(delta) - sin(delta)/4)"), ("L/4", "L/10"), on="rear axle"
        ),
        "right wheel": Body(
            "wheel", ("L", "-L/4", "atan2(sin(delta), cos(delta) + sin(delta)/4)"), ("L/4", "L/10"), on="rear axle"
        ),
        "body": Body("rectangle", ("L/2", "0", "0"), ("1.5*L", "0.36*L"), on="rear axle"),
        "window": Body("rectangle", ("0.65*L", "0", "0"), ("0.2*L", "0.3*L"), on="rear axle", colour="sky"),
    },
)

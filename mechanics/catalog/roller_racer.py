"""The roller racer of Bullo and Zefran, section 5 (model of Krishnaprasad and Tsakiris).

Two links with an axle each and a torque on the joint between them. (x, y, theta) is the pose of
the body, psi the angle of the front link relative to it; the front link has inertia I_2 and no mass.
"""

from mechanics.bodies import Body
from mechanics.mechanism import Mechanism

__all__ = ["roller_racer"]

roller_racer = Mechanism(
    name="roller_racer",
    coordinates=("x", "y", "theta", "psi"),
    parameters={"m": 3.0, "l_1": 0.3, "l_2": 0.1, "I_1": 0.05, "I_2": 0.005},
    inertia=(
        ("m", "0", "0", "0"),
        ("0", "m", "0", "0"),
        ("0", "0", "I_1 + I_2", "I_2"),
        ("0", "0", "I_2", "I_2"),
    ),
    one_forms=(
        ("sin(theta)", "-cos(theta)", "0", "0"),
        ("sin(theta + psi)", "-cos(theta + psi)", "-(l_2 + l_1*cos(psi))", "-l_2"),
    ),
    forces={"u_psi": ("0", "0", "0", "1")},
    definitions={
        "c": "l_2 + l_1*cos(psi)",
        "k": "l_2*I_1 - l_1*I_2*cos(psi)",
        "f_1": "m*c**2 + (I_1 + I_2)*sin(psi)**2",
        "f_2": "m*l_2**2*I_1 + m*l_1**2*I_2*cos(psi)**2 + I_1*I_2*sin(psi)**2",
        # X2 of section 5.1, shared by the frames below
        "X2_V": "k*sin(psi)/f_1",
        "X2_theta": "-(m*l_2*c + I_2*sin(psi)**2)/f_1",
    },
    frames={
        # X1 scaled by c: regular where the paper's basis has its pole. Norms squared f_1, f_2/f_1.
        "regular": (
            ("c*cos(theta)", "c*sin(theta)", "sin(psi)", "0"),
            ("X2_V*cos(theta)", "X2_V*sin(theta)", "X2_theta", "1"),
        ),
        "orthonormal": (
            ("c*cos(theta)/sqrt(f_1)", "c*sin(theta)/sqrt(f_1)", "sin(psi)/sqrt(f_1)", "0"),
            (
                "X2_V*cos(theta)*sqrt(f_1/f_2)",
                "X2_V*sin(theta)*sqrt(f_1/f_2)",
                "X2_theta*sqrt(f_1/f_2)",
                "sqrt(f_1/f_2)",
            ),
        ),
        # Section 5.1: singular where c = 0, although D is not.
        "paper": (
            ("cos(theta)", "sin(theta)", "sin(psi)/c", "0"),
            ("X2_V*cos(theta)", "X2_V*sin(theta)", "X2_theta", "1"),
        ),
    },
    citation="F. Bullo and M. Zefran, On mechanical control systems with nonholonomic constraints and symmetries, 2002",
    fibre=("x", "y", "theta"),
    joint_limits={"psi": 1.2},
    torque_limits={"u_psi": 0.4},
    # Rolling at the wheels of the body and of the front link, friction in the joint.
    rayleigh="(C*(cos(theta)*x_dot + sin(theta)*y_dot)**2"
    " + C*(cos(theta + psi)*x_dot + sin(theta + psi)*y_dot + l_1*sin(psi)*theta_dot)**2 + b_psi*psi_dot**2)/2",
    drag={"C": 0.3, "b_psi": 0.02},
    observation={"psi": "psi/1.2", "psi_dot": "psi_dot/10", "speed": "speed"},
    bodies={
        "axle": Body("axle", ("x", "y", "theta"), ("0.8*l_1", "0.4*l_1", "0.12*l_1")),
        "front axle": Body(
            "axle", ("l_1 + l_2*cos(psi)", "l_2*sin(psi)", "psi"), ("l_1", "0.3*l_1", "0.1*l_1"), on="axle"
        ),
        "body": Body("rectangle", ("l_1/12", "0", "0"), ("0.6*l_1", "0.5*l_1"), on="axle"),
        "frame": Body("bar", ("0", "0", "0"), ("l_1", "0.14*l_1"), on="axle"),
        "link": Body("bar", ("l_1", "0", "psi"), ("l_2", "0.14*l_1"), on="axle", colour="orange"),
        "joint": Body("disc", ("l_1", "0", "0"), ("0.2*l_1", "0.2*l_1"), on="axle", colour="orange"),
    },
    # A heavy body with a light front link is driven away from that link.
    forward="l_1*I_2 - l_2*I_1",
)

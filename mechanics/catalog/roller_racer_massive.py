"""The roller racer whose front link has a mass, before Krishnaprasad and Tsakiris neglect it.

As `roller_racer`, but for the link's mass m_2 at the distance d from the joint, on the way to the link's axle
(at l_2). I_2 is the inertia about that centre of mass. With the centre over the axle, d = l_2, the
link's mass does not change the direction in which the racer is driven.
"""

from mechanics.bodies import Body
from mechanics.mechanism import Mechanism

__all__ = ["roller_racer_massive"]

roller_racer_massive = Mechanism(
    name="roller_racer_massive",
    coordinates=("x", "y", "theta", "psi"),
    parameters={"m": 3.0, "m_2": 0.5, "l_1": 0.3, "l_2": 0.1, "d": 0.05, "I_1": 0.05, "I_2": 0.005},
    definitions={
        "c": "l_2 + l_1*cos(psi)",
        # Inertia over the body's velocity along its axis, its turning rate and psi'.
        "N_12": "-m_2*d*sin(psi)",
        "N_22": "I_1 + I_2 + m_2*(l_1**2 + d**2 + 2*l_1*d*cos(psi))",
        "N_23": "I_2 + m_2*(d**2 + l_1*d*cos(psi))",
        # Momenta of rolling with the joint held, (c, sin(psi), 0); f_1 is twice its energy.
        "p_1": "(m + m_2)*c + N_12*sin(psi)",
        "p_2": "N_12*c + N_22*sin(psi)",
        "p_3": "N_12*c + N_23*sin(psi)",
        "f_1": "c*p_1 + sin(psi)*p_2",
        # What turns the joint: the solution of the constraint and of orthogonality to rolling.
        "X2_V": "(l_2*p_2 - c*p_3)/f_1",
        "X2_theta": "-(l_2*p_1 + sin(psi)*p_3)/f_1",
    },
    inertia=(
        ("m + m_2", "0", "-m_2*(l_1*sin(theta) + d*sin(theta + psi))", "-m_2*d*sin(theta + psi)"),
        ("0", "m + m_2", "m_2*(l_1*cos(theta) + d*cos(theta + psi))", "m_2*d*cos(theta + psi)"),
        (
            "-m_2*(l_1*sin(theta) + d*sin(theta + psi))",
            "m_2*(l_1*cos(theta) + d*cos(theta + psi))",
            "N_22",
            "N_23",
        ),
        ("-m_2*d*sin(theta + psi)", "m_2*d*cos(theta + psi)", "N_23", "I_2 + m_2*d**2"),
    ),
    one_forms=(
        ("sin(theta)", "-cos(theta)", "0", "0"),
        ("sin(theta + psi)", "-cos(theta + psi)", "-c", "-l_2"),
    ),
    forces={"u_psi": ("0", "0", "0", "1")},
    frames={
        # As the roller racer's: regular where c = 0.
        "regular": (
            ("c*cos(theta)", "c*sin(theta)", "sin(psi)", "0"),
            ("X2_V*cos(theta)", "X2_V*sin(theta)", "X2_theta", "1"),
        ),
    },
    citation="P. S. Krishnaprasad and D. P. Tsakiris, Oscillations, SE(2)-snakes and motion control: a study of the "
    "Roller Racer, Dynamical Systems 16(4), 2001",
    fibre=("x", "y", "theta"),
    joint_limits={"psi": 1.2},
    torque_limits={"u_psi": 0.4},
    observation={"psi": "psi/1.2", "psi_dot": "psi_dot/10", "speed": "speed"},
    bodies={
        "axle": Body("axle", ("x", "y", "theta"), ("0.8*l_1", "0.4*l_1", "0.12*l_1")),
        "front axle": Body(
            "axle", ("l_1 + l_2*cos(psi)", "l_2*sin(psi)", "psi"), ("l_1", "0.3*l_1", "0.1*l_1"), on="axle"
        ),
        "body": Body("rectangle", ("l_1/12", "0", "0"), ("0.6*l_1", "0.5*l_1"), on="axle"),
        "frame": Body("bar", ("0", "0", "0"), ("l_1", "0.14*l_1"), on="axle"),
        "link": Body("bar", ("l_1", "0", "psi"), ("l_2", "0.14*l_1"), on="axle", colour="orange"),
        "mass": Body(
            "disc", ("l_1 + d*cos(psi)", "d*sin(psi)", "psi"), ("0.3*l_1", "0.3*l_1"), on="axle", colour="orange"
        ),
        "joint": Body("disc", ("l_1", "0", "0"), ("0.2*l_1", "0.2*l_1"), on="axle", colour="yellow"),
    },
    # Sign of the force along the axis that swinging the straight joint gives.
    forward="l_1*I_2 - l_2*I_1 + m_2*l_1*(l_2 - d)*(l_2 - d - l_1)",
    # Both axles roll with friction, the front one at the speed of its own wheels.
    rayleigh="(c_w*((cos(theta)*x_dot + sin(theta)*y_dot)**2 + (cos(theta + psi)*x_dot + sin(theta + psi)*y_dot"
    " + l_1*sin(psi)*theta_dot)**2) + c_psi*psi_dot**2)/2",
    drag={"c_w": 0.05, "c_psi": 0.005},
)

"""Suslov's problem: a rigid body about a fixed point that cannot turn about one of its own axes.

alpha, beta, gamma are successive rotations about the body's first, second and third axis (Cardan
angles). The third component of the angular velocity in the body's axes is held at zero, as by a sharp
wheel fixed in the body that rolls inside a sphere about the fixed point (Vagner). The first two axes
are chosen such that I_12 = 0. u_1 and u_2 are torques about them.

In the default frame the pseudo-velocities are the angular velocities w_1 and w_2:

    I_11 w_1' = -w_2 (I_13 w_1 + I_23 w_2) + u_1,    I_22 w_2' = w_1 (I_13 w_1 + I_23 w_2) + u_2.

Without torque the energy is constant, and yet every motion tends to a steady rotation about the one
axis (-I_23, I_13, 0) of the body. The angles have a pole at beta = ±pi/2, the device has none.
"""

from mechanics.mechanism import Mechanism

__all__ = ["suslov"]

suslov = Mechanism(
    name="suslov",
    coordinates=("alpha", "beta", "gamma"),
    parameters={"I_11": 0.02, "I_22": 0.03, "I_33": 0.025, "I_13": 0.006, "I_23": -0.004},
    definitions={
        # Angular velocity in the body's axes: a alpha' + b beta' + (0, 0, gamma').
        "a_1": "cos(beta)*cos(gamma)",
        "a_2": "-cos(beta)*sin(gamma)",
        "a_3": "sin(beta)",
        "b_1": "sin(gamma)",
        "b_2": "cos(gamma)",
        "M_aa": "I_11*a_1**2 + I_22*a_2**2 + I_33*a_3**2 + 2*a_3*(I_13*a_1 + I_23*a_2)",
        "M_ab": "I_11*a_1*b_1 + I_22*a_2*b_2 + a_3*(I_13*b_1 + I_23*b_2)",
        "M_ac": "I_13*a_1 + I_23*a_2 + I_33*a_3",
        "M_bb": "I_11*b_1**2 + I_22*b_2**2",
        "M_bc": "I_13*b_1 + I_23*b_2",
    },
    inertia=(
        ("M_aa", "M_ab", "M_ac"),
        ("M_ab", "M_bb", "M_bc"),
        ("M_ac", "M_bc", "I_33"),
    ),
    one_forms=(("a_3", "0", "1"),),
    forces={"u_1": ("a_1", "b_1", "0"), "u_2": ("a_2", "b_2", "0")},
    frames={
        # Unit rotations about the first two axes. Norms squared: I_11, I_22.
        "body": (
            ("cos(gamma)/cos(beta)", "sin(gamma)", "-cos(gamma)*tan(beta)"),
            ("-sin(gamma)/cos(beta)", "cos(gamma)", "sin(gamma)*tan(beta)"),
        ),
    },
    citation="G. K. Suslov, Theoretical Mechanics, 1946; V. V. Kozlov, On the theory of integration of the equations "
    "of nonholonomic mechanics, Advances in Mechanics 8(3), 1985; "
    "A. M. Bloch, Nonholonomic Mechanics and Control, 2003",
    torque_limits={"u_1": 0.05, "u_2": 0.05},
    observation={"w_1": "(a_1*alpha_dot + b_1*beta_dot)/5", "w_2": "(a_2*alpha_dot + b_2*beta_dot)/5"},
)

"""A knife edge on an inclined plane: gravity makes it drift across the slope and not down.

(x, y) is the point where the edge touches the plane, below the centre of mass, x downhill and y across;
theta is the edge's heading from the line of fall. m is the mass, J the moment of inertia about the plane's
normal, alpha the plane's inclination and g gravity. F_long pushes along the edge and tau turns.

With v the speed along the edge (Neimark and Fufaev; Bloch, 1.6),

    m v_dot = m g sin(alpha) cos(theta) + F_long,    J theta_ddot = tau.

Set spinning at the rate w from rest, it runs along a cycloid, x = h sin(w t)^2, y = h (w t - sin(2 w t)/2)
with h = g sin(alpha)/(2 w^2): it never gets further down than h. To go forward is here to go up. By default the
largest push is half of the weight along the slope, too little to climb straight and enough to climb askew.
"""

from mechanics.bodies import Body
from mechanics.mechanism import Mechanism

__all__ = ["knife_edge_incline"]

knife_edge_incline = Mechanism(
    name="knife_edge_incline",
    coordinates=("x", "y", "theta"),
    parameters={"m": 1.0, "J": 0.02, "g": 9.81, "alpha": 0.05},
    inertia=(
        ("m", "0", "0"),
        ("0", "m", "0"),
        ("0", "0", "J"),
    ),
    one_forms=(("sin(theta)", "-cos(theta)", "0"),),
    forces={"F_long": ("cos(theta)", "sin(theta)", "0"), "tau": ("0", "0", "1")},
    potential="-g*m*x*sin(alpha)",
    frames={
        # Speed along the edge and turning rate. Norms squared: m, J.
        "body": (
            ("cos(theta)", "sin(theta)", "0"),
            ("0", "0", "1"),
        ),
    },
    citation="Ju. I. Neimark and N. A. Fufaev, Dynamics of nonholonomic systems, 1972; A. M. Bloch, Nonholonomic "
    "Mechanics and Control, 2003, section 1.6",
    fibre=("x", "y", "theta"),
    torque_limits={"F_long": 0.25, "tau": 0.04},
    observation={"theta_dot": "theta_dot/2", "speed": "speed"},
    forward="-1",
    rayleigh="(c_w*(x_dot**2 + y_dot**2) + c_theta*theta_dot**2)/2",
    drag={"c_w": 0.1, "c_theta": 0.01},
    # Twice the radius of gyration of a plate is its width, more or less.
    bodies={
        "plate": Body("disc", ("x", "y", "theta"), ("3*sqrt(J/m)", "1.5*sqrt(J/m)")),
        "edge": Body("wheel", ("0", "0", "0"), ("2.4*sqrt(J/m)", "0.12*sqrt(J/m)"), on="plate"),
    },
)

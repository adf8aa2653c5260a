"""A tractor with trailers, each hitched to the middle of the axle before it; the catalogue's has two.

(x, y) is the middle of the tractor's axle, theta the tractor's heading and theta_i that of the i-th trailer,
all measured from the x axis. Tractor and trailers have their masses m_0, m_i at their axles, J_0, J_i are
their moments of inertia and d_i is the distance between the axles of trailer i and of what pulls it. F_drive
pushes the tractor along its heading, tau_tractor turns it.

The kinematics are those of Laumond and of Sordalen. With v the speed of the tractor and theta_0 = theta,
trailer i moves with p_i v and turns with w_i v, where

    p_i = cos(theta_0 - theta_1) ... cos(theta_{i-1} - theta_i),    w_i = p_{i-1} sin(theta_{i-1} - theta_i)/d_i.

On the distribution only the tractor's forces are left: N v_dot + 1/2 N_dot v = F_drive and
J_0 theta_ddot = tau_tractor with N = m_0 + sum_i (m_i p_i^2 + J_i w_i^2). Pulled, the trailers follow; pushed
back, they jackknife.
"""

from mechanics.bodies import Body
from mechanics.mechanism import Mechanism, MechanismError

__all__ = ["n_trailer", "trailer"]


def n_trailer(n: int, name: str | None = None) -> Mechanism:
    """Tractor with n trailers.

    Args:
        n: number of trailers, at least 1.
        name: the mechanism's name; trailer_n by default.
    """
    if isinstance(n, bool) or not isinstance(n, int) or n < 1:
        raise MechanismError(f"a tractor pulls at least 1 trailer, in a whole number; got {n!r}")
    trailers = range(1, n + 1)
    angles = ("theta", *(f"theta_{i}" for i in trailers))

    def entry(j: int, k: int) -> str:
        """Inertia of the angles: an axle i >= j, k is moved by both."""
        if 0 in (j, k):
            return "J_0" if j == k else "0"
        pulled = f"({_masses(max(j, k), n)})*d_{j}*d_{k}"
        return f"J_{j} + {pulled}" if j == k else f"{pulled}*cos({angles[j]} - {angles[k]})"

    sines = ("0", *(f"({_masses(j, n)})*d_{j}*sin({angles[j]})" for j in trailers))
    cosines = ("0", *(f"-({_masses(j, n)})*d_{j}*cos({angles[j]})" for j in trailers))
    inertia = (
        (_masses(0, n), "0", *sines),
        ("0", _masses(0, n), *cosines),
        *((sines[j], cosines[j], *(entry(j, k) for k in range(n + 1))) for j in range(n + 1)),
    )

    def no_slip(i: int) -> tuple[str, ...]:
        """Velocity of axle i across its heading."""
        levers = (f"-d_{j}*cos({angles[i]} - {angles[j]})" if 1 <= j <= i else "0" for j in range(n + 1))
        return (f"-sin({angles[i]})", f"cos({angles[i]})", *levers)

    definitions = {"p_0": "1"}
    for i in trailers:
        definitions[f"p_{i}"] = f"p_{i - 1}*cos({angles[i - 1]} - {angles[i]})"
        definitions[f"w_{i}"] = f"p_{i - 1}*sin({angles[i - 1]} - {angles[i]})/d_{i}"
    definitions["N"] = " + ".join(("m_0", *(f"m_{i}*p_{i}**2 + J_{i}*w_{i}**2" for i in trailers)))
    rolling = " + ".join(f"p_{i}**2" for i in range(n + 1))
    hitches = {f"{f}_hitch_{i}": f"{f}({angles[i - 1]} - {angles[i]})" for i in trailers for f in ("sin", "cos")}
    rest = ("0",) * n
    return Mechanism(
        name=name or f"trailer_{n}",
        coordinates=("x", "y", *angles),
        parameters={
            "m_0": 3.0,
            "J_0": 0.04,
            **{f"m_{i}": 1.0 for i in trailers},
            **{f"J_{i}": 0.02 for i in trailers},
            **{f"d_{i}": 0.4 for i in trailers},
        },
        inertia=inertia,
        one_forms=tuple(no_slip(i) for i in range(n + 1)),
        forces={
            "F_drive": ("cos(theta)", "sin(theta)", "0", *rest),
            "tau_tractor": ("0", "0", "1", *rest),
        },
        definitions=definitions,
        frames={
            # Every generalized Christoffel symbol vanishes: the rate of v sqrt(N) is F_drive/sqrt(N). Norms squared:
            # 1, J_0.
            "flat": (
                ("cos(theta)/sqrt(N)", "sin(theta)/sqrt(N)", "0", *(f"w_{i}/sqrt(N)" for i in trailers)),
                ("0", "0", "1", *rest),
            ),
            # Speed and turning rate of the tractor. Norms squared: N, J_0.
            "tractor": (
                ("cos(theta)", "sin(theta)", "0", *(f"w_{i}" for i in trailers)),
                ("0", "0", "1", *rest),
            ),
        },
        citation="J.-P. Laumond, Controllability of a multibody mobile robot, IEEE Transactions on Robotics and "
        "Automation 9, 1993; O. J. Sordalen, Conversion of the kinematics of a car with n trailers into a chained "
        "form, IEEE International Conference on Robotics and Automation, 1993",
        fibre=("x", "y", "theta"),
        torque_limits={"F_drive": 1.5, "tau_tractor": 0.04},
        observation={**hitches, "theta_dot": "theta_dot/2", "speed": "speed"},
        # Axle i rolls with p_i times the speed of the tractor.
        rayleigh=f"(c_w*({rolling})*(x_dot**2 + y_dot**2) + c_theta*theta_dot**2)/2",
        drag={"c_w": 0.1, "c_theta": 0.02},
        bodies=_bodies(angles),
    )


def _masses(first: int, last: int) -> str:
    """Sum of the masses of the axles from first to last."""
    return " + ".join(f"m_{i}" for i in range(first, last + 1))


def _bodies(angles: tuple[str, ...]) -> dict[str, Body]:
    """The tractor, and trailers whose bars reach to the axle that pulls them."""
    bodies = {
        "axle": Body("axle", ("x", "y", "theta"), ("0.28", "0.14", "0.04")),
        "tractor": Body("rectangle", ("0.06", "0", "0"), ("0.3", "0.18"), on="axle"),
        "window": Body("rectangle", ("0.12", "0", "0"), ("0.06", "0.14"), on="axle", colour="sky"),
    }
    pulling = "axle"
    for i, angle in enumerate(angles[1:], 1):
        hitch = f"{angle} - {angles[i - 1]}"
        axle, size = f"axle {i}", ("0.26", "0.11", "0.035")
        bodies[axle] = Body("axle", (f"-d_{i}*cos({hitch})", f"-d_{i}*sin({hitch})", hitch), size, on=pulling)
        bodies[f"bar {i}"] = Body("bar", ("0", "0", "0"), (f"d_{i}", "0.025"), on=axle, colour="grey")
        bodies[f"trailer {i}"] = Body("rectangle", ("0", "0", "0"), ("0.22", "0.16"), on=axle, colour="orange")
        pulling = axle
    return bodies


trailer = n_trailer(2, "trailer")
